"""The service's interface, as its /openapi.yaml describes it."""

from __future__ import annotations

import http.client
import json
import os
import random
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Protocol, TypeVar

if TYPE_CHECKING:
    from .upload import UploadReport

Json = dict[str, Any]
"""A JSON object as the service answers it."""

FINAL = ("succeeded", "failed", "cancelled")
"""States in which a job does not change any more."""

COPIED_BYTES = 1 << 16
"""How much of an answer is in memory at once."""

T = TypeVar("T")


class HeliomapError(Exception):
    """Whatever this client raises of itself."""


class Problem(HeliomapError):
    """The service refused a request and says why (RFC 9457)."""

    def __init__(self, status: int, document: Json, retry_after_s: float | None = None):
        self.status = status
        self.document = document
        self.retry_after_s = retry_after_s
        """When the service asks to come again, where it says."""
        self.code: str = document.get("code", str(status))
        """A stable word."""
        super().__init__(f"{self.code}: {document.get('detail') or document.get('title') or 'no reason was given'}")


class Unreachable(HeliomapError):
    """The service did not answer, however often it was asked."""


class _Body(Protocol):
    def read(self, size: int = ..., /) -> bytes: ...


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """A key is for the service that it was given for, and for no other."""

    def redirect_request(self, *_: Any) -> None:
        return None


class Client:
    """One heliomap service.

    `url` is its address without a path, `key` a key of it (none where it runs with `--insecure`). A request that fails for
    the network, or is asked to come later, is sent again up to `tries` times in all with growing pauses; all requests of
    this client may be repeated without harm. `timeout_s` is how long the line may stand still.
    """

    def __init__(self, url: str, key: str | None = None, *, timeout_s: float = 60.0, tries: int = 8):
        parts = urllib.parse.urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.netloc:
            raise ValueError(f"`{url}` is no address of a service, such as http://127.0.0.1:8080")
        self._root = f"{parts.scheme}://{parts.netloc}"
        self._key = key
        self._timeout_s = timeout_s
        self._tries = max(1, tries)
        self._opener = urllib.request.build_opener(_NoRedirect)

    # Requests.

    def open(
        self,
        method: str,
        path: str,
        *,
        headers: Mapping[str, str] | None = None,
        body: Callable[[], bytes | _Body | None] = lambda: None,
        tries: int | None = None,
    ) -> http.client.HTTPResponse:
        """Sends a request and gives its answer to be read. `body` makes the body anew for each try.

        Raises `Problem` where the service refuses, `Unreachable` where it does not answer.
        """
        return self._sent(method, path, headers, body, tries, lambda answer: answer)

    def _sent(
        self,
        method: str,
        path: str,
        headers: Mapping[str, str] | None,
        body: Callable[[], bytes | _Body | None],
        tries: int | None,
        read: Callable[[http.client.HTTPResponse], T],
    ) -> T:
        """As `open`; what `read` makes of the answer, asked for anew where the line breaks while it reads."""
        tries = tries or self._tries
        for attempt in range(1, tries + 1):
            request = urllib.request.Request(self._root + path, data=body(), method=method, headers=dict(headers or {}))
            if self._key:
                request.add_header("Authorization", f"Bearer {self._key}")
            try:
                return read(self._opener.open(request, timeout=self._timeout_s))
            except urllib.error.HTTPError as answer:
                with answer:
                    wait = answer.headers.get("Retry-After", "")
                    problem = Problem(answer.code, _document(answer), float(wait) if wait.isdigit() else None)
                # What a later try may mend: busy, overloaded, standing still, interrupted, failing.
                if attempt == tries or not (
                    answer.code in (408, 423, 429) or answer.code >= 500 or problem.code == "upload_interrupted"
                ):
                    raise problem from None
                pause = pause_s(attempt) if problem.retry_after_s is None else problem.retry_after_s
            except (OSError, http.client.HTTPException) as error:
                if attempt == tries:
                    raise Unreachable(f"{self._root} does not answer: {error}") from error
                pause = pause_s(attempt)
            time.sleep(pause)
        raise AssertionError("the last try returns or raises")

    def call(self, method: str, path: str, value: Json | None = None) -> Json:
        """Sends JSON, gives JSON."""
        headers = {"Accept": "application/json"}
        if value is not None:
            headers["Content-Type"] = "application/json"
        encoded = None if value is None else json.dumps(value).encode()

        def text(answer: http.client.HTTPResponse) -> bytes:
            with answer:
                return answer.read()

        told = self._sent(method, path, headers, lambda: encoded, None, text)
        return json.loads(told) if told else {}

    def items(self, path: str) -> Iterator[Json]:
        """All items of a list, part by part."""
        following: str | None = path
        while following:
            part = self.call("GET", following)
            yield from part["items"]
            following = part.get("next")

    # Plants and surveys.

    def create_plant(self, name: str) -> Json:
        """Creates a plant, or finds the one of that name."""
        return self.call("POST", "/api/v1/plants", {"name": name})

    def find_plant(self, name: str) -> Json | None:
        """The plant of that name, where the key may see it."""
        return _named(self.items(f"/api/v1/plants?name={_part(name)}"), name)

    def plants(self) -> Iterator[Json]:
        """All plants that the key may see."""
        return self.items("/api/v1/plants")

    def create_survey(self, plant: str, name: str) -> Json:
        """Creates a survey of a plant, or finds the one of that name."""
        return self.call("POST", f"{_plant(plant)}/surveys", {"name": name})

    def find_survey(self, plant: str, name: str) -> Json | None:
        """The plant's survey of that name."""
        return _named(self.items(f"{_plant(plant)}/surveys?name={_part(name)}"), name)

    def survey(self, plant: str, survey: str) -> Json:
        """A survey: its files, and what is missing before it can be mapped."""
        return self.call("GET", survey_path(plant, survey))

    def upload_folder(
        self,
        plant: str,
        survey: str,
        folder: str | os.PathLike[str],
        *,
        parallel: int = 4,
        on_file: Callable[[Json], None] = lambda _: None,
    ) -> UploadReport:
        """Uploads a survey's folder, `parallel` files at once; files that are there are left out, large ones resumed.

        `on_file` hears of each file as the service answers it.
        """
        from .upload import upload_folder

        return upload_folder(self, plant, survey, Path(folder), parallel, on_file)

    # Jobs.

    def start_job(self, plant: str, survey: str, **options: Any) -> Json:
        """Starts the mapping of a survey, or finds its unfinished job."""
        return self.call("POST", f"{survey_path(plant, survey)}/jobs", options)

    def job(self, plant: str, job: str) -> Json:
        """How a job stands."""
        return self.call("GET", f"{_plant(plant)}/jobs/{_part(job)}")

    def cancel_job(self, plant: str, job: str) -> Json:
        """Cancels a job."""
        return self.call("POST", f"{_plant(plant)}/jobs/{_part(job)}/cancel")

    def follow(self, plant: str, job: str, on_change: Callable[[Json], None] = lambda _: None) -> Json:
        """Waits until a job has ended and gives it. `on_change` hears whenever something of it has changed."""
        path = f"{_plant(plant)}/jobs/{_part(job)}/events"
        while True:
            with self.open("GET", path, headers={"Accept": "text/event-stream"}) as stream:
                try:
                    for event in _events(stream):
                        on_change(event)
                        if event["state"] in FINAL:
                            return event
                except (OSError, http.client.HTTPException):
                    pass
            # The line broke, or the service stopped: how the job stands now decides whether to listen again.
            standing = self.job(plant, job)
            if standing["state"] in FINAL:
                on_change(standing)
                return standing
            time.sleep(1)

    # Models.

    def models(self, plant: str) -> Iterator[Json]:
        """A plant's models, the newest first."""
        return self.items(f"{_plant(plant)}/models")

    def fetch_layer(
        self, plant: str, target: str | os.PathLike[str], layer: str = "modules", version: int | str = "latest"
    ) -> None:
        """Writes a layer of a model (`modules`, `sectors`, `benches` or `lines`) as one GeoJSON file, whole or not at all."""
        path = f"{_plant(plant)}/models/{_part(str(version))}/{_part(layer)}"
        target = Path(target)
        partial = target.with_name(target.name + ".part")

        def copy(answer: http.client.HTTPResponse) -> None:
            with answer, open(partial, "wb") as file:
                while chunk := answer.read(COPIED_BYTES):
                    try:
                        file.write(chunk)
                    except OSError as error:
                        raise HeliomapError(f"{partial} cannot be written: {error}") from error
                # An answer of known length that ends early ends without a word.
                if answer.length:
                    raise http.client.IncompleteRead(b"", answer.length)

        try:
            self._sent("GET", path, {"Accept": "application/geo+json"}, lambda: None, None, copy)
            partial.replace(target)
        finally:
            partial.unlink(missing_ok=True)

    def module(self, plant: str, module: str) -> Json:
        """One module of the newest model, a GeoJSON feature."""
        return self.call("GET", f"{_plant(plant)}/modules/{_part(module)}")


def _named(items: Iterator[Json], name: str) -> Json | None:
    """The one of that name among those whose names begin so."""
    return next((item for item in items if item["name"] == name), None)


def _part(text: str) -> str:
    return urllib.parse.quote(text, safe="")


def _plant(plant: str) -> str:
    return f"/api/v1/plants/{_part(plant)}"


def survey_path(plant: str, survey: str) -> str:
    """Where a survey is."""
    return f"{_plant(plant)}/surveys/{_part(survey)}"


def pause_s(attempt: int) -> float:
    """Seconds before the next try: twice as long each time, half a minute at most, by chance up to half as long again."""
    return min(30.0, 0.25 * 2.0**attempt) * random.uniform(1.0, 1.5)


def _document(answer: IO[bytes]) -> Json:
    try:
        document = json.loads(answer.read())
    except (ValueError, OSError, http.client.HTTPException):
        return {}
    return document if isinstance(document, dict) else {}


def _events(stream: IO[bytes]) -> Iterator[Json]:
    """The data of server-sent events."""
    data: list[str] = []
    for raw in stream:
        line = raw.decode().rstrip("\r\n")
        if line.startswith("data:"):
            data.append(line[5:].lstrip())
        elif not line and data:
            yield json.loads("\n".join(data))
            data = []
