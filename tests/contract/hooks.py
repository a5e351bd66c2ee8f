"""What schemathesis must know of this API beyond its description."""

import os
import uuid

import schemathesis


@schemathesis.serializer("application/offset+octet-stream", "application/octet-stream")
def plain_bytes(context, value):
    """Bytes go as they are."""
    return value if isinstance(value, bytes) else str(value).encode()


@schemathesis.hook
def map_case(context, case):
    """The key that the test itself shows must live on, and so must the plant that it looks at: others are deleted."""
    parameters = case.path_parameters or {}
    if parameters.get("key") == os.environ["CONTRACT_OWN_KEY"]:
        parameters["key"] = str(uuid.uuid4())
    deletes = case.method.upper() == "DELETE" and case.operation.path == "/api/v1/plants/{plant}"
    if deletes and parameters.get("plant") == os.environ["CONTRACT_PLANT"]:
        parameters["plant"] = str(uuid.uuid4())
    return case
