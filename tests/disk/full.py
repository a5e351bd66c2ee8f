#!/usr/bin/env python3
"""Fills the disk of a service and makes room again: while it is full every write says so, afterwards all works by itself.

The data folder lies on a file system of its own (tmpfs, which needs root), so that SQLite meets a disk that is really full.

Only Python's standard library is used. The exit code is 1 where something does not hold.
"""

import argparse
import json
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path

#: Size of the file system, MB: the service needs a few.
SIZE_MB = 24
#: So long may the service take to start, or to notice that there is room, seconds.
PATIENCE_S = 30


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Service:
    def __init__(self, binary: Path, data: Path, log: Path) -> None:
        port = free_port()
        self.url = f"http://127.0.0.1:{port}"
        command = [binary, "serve", "--data-dir", data, "--listen", f"127.0.0.1:{port}"]
        with log.open("wb") as out:
            arguments = [*command, "--insecure", "--disk-reserve", "0"]
            self.process = subprocess.Popen(arguments, stdout=out, stderr=subprocess.STDOUT)

    def ask(self, method: str, path: str, body: object = None) -> tuple[int, dict]:
        """Status and document of an answer; status 0 where there is none."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.url + path, data, {"content-type": "application/json"}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return answer.status, json.loads(answer.read() or b"{}")
        except urllib.error.HTTPError as error:
            return error.code, json.loads(error.read() or b"{}")
        except OSError:
            return 0, {}

    def until_ready(self, status: int) -> dict:
        begun = time.monotonic()
        while time.monotonic() - begun < PATIENCE_S:
            found, answer = self.ask("GET", "/ready")
            if found == status:
                return answer
            time.sleep(0.2)
        sys.exit(f"/ready does not answer {status} within {PATIENCE_S} s, but {found}: {answer}")


def require(holds: bool, what: str) -> None:
    if not holds:
        sys.exit(f"failed: {what}")


def fill(folder: Path) -> Path:
    filler = folder / "filler"
    with filler.open("wb", buffering=0) as out:
        try:
            while out.write(bytes(4096)):
                pass
        except OSError:
            pass
    return filler


def check(service: Service, data: Path, log: Path) -> None:
    def create(name: str) -> tuple[int, dict]:
        return service.ask("POST", "/api/v1/plants", {"name": name})

    service.until_ready(200)
    require(create("before")[0] == 201, "a plant is created while there is room")
    filler = fill(data)
    # What SQLite has allocated already takes a few rows more.
    statuses = [create(f"full {index} {'long' * 40}")[0] for index in range(400)]
    require(statuses[-1] == 507, f"a write on a full disk answers 507, not {statuses[-1]}")
    require(set(statuses) <= {201, 507}, f"no write fails otherwise: {sorted(set(statuses))}")
    problem = service.until_ready(503)
    require("cannot be written" in problem["detail"], f"/ready names what cannot be written: {problem}")
    require(service.ask("GET", "/api/v1/plants")[0] == 200, "reading goes on")
    time.sleep(3)  # the worker looks for jobs meanwhile
    filler.unlink()
    service.until_ready(200)
    for index in range(20):
        status, answer = create(f"room again {index}")
        require(status == 201, f"a plant is created once there is room: {status} {answer}")
    written = log.read_bytes()
    require(b"non-zero transaction depth" not in written, "no connection stays in a transaction")
    looked = written.count(b"cannot look for jobs")
    time.sleep(3)
    require(log.read_bytes().count(b"cannot look for jobs") == looked, "the worker looks for jobs again")
    print(f"ok: {statuses.count(507)} writes refused while the disk was full, all work again with room")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--binary", type=Path, required=True)
    binary = parser.parse_args().binary.resolve()
    folder = Path(tempfile.mkdtemp(prefix="heliomap-disk-"))
    data, log = folder / "data", folder / "log"
    data.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={SIZE_MB}m", "tmpfs", data], check=True)
    service = None
    try:
        service = Service(binary, data, log)
        check(service, data, log)
    finally:
        if service:
            service.process.terminate()
            service.process.wait()
        subprocess.run(["umount", data], check=True)
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
