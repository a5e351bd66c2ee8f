"""docs/API.md as it stands: every command in it is run, in its order, against the real service."""

from __future__ import annotations

import re
import subprocess
import tempfile
import unittest
from pathlib import Path

from service import BINARY, ROOT, Service, lay_out_example

ADDRESS = "http://127.0.0.1:8080"


class WalkTest(unittest.TestCase):
    def test_every_command_of_the_document_works(self) -> None:
        document = (ROOT / "docs" / "API.md").read_text()
        blocks = re.findall(r"^```sh\n(.*?)^```$", document, re.MULTILINE | re.DOTALL)
        self.assertGreater(len(blocks), 10)
        with tempfile.TemporaryDirectory(prefix="heliomap-walk-") as name:
            folder = Path(name)
            lay_out_example(folder / "survey")
            with Service(folder / "data") as service:
                # A problem that is answered is a failure, too.
                checked = 'curl() { command curl --fail-with-body "$@"; }\n'
                script = "set -euo pipefail\n" + checked + "".join(blocks).replace(ADDRESS, service.url)
                environment = {**service.environment, "PATH": f"{BINARY.parent}:{service.environment['PATH']}"}
                command = ["bash", "-x", "-c", script]
                ran = subprocess.run(
                    command, cwd=folder / "survey", env=environment, capture_output=True, text=True, timeout=300
                )
            self.assertEqual(ran.returncode, 0, f"{ran.stdout[-2000:]}\n{ran.stderr[-3000:]}")
            self.assertIn("event: job", ran.stdout)
            self.assertIn('"state": "succeeded"', ran.stdout)


if __name__ == "__main__":
    unittest.main()
