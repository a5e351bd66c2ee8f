#!/usr/bin/env python3
"""Uploads a large file with tus-js-client and with tuspy over a line that breaks, and compares the bytes.

A proxy on loopback stands between client and service and cuts every connection again and again, at random places of the
file. In the middle of each upload the service is killed (SIGKILL) once and started again. The last line gives the
figures; the exit code is 1 where
something does not hold.
"""

import argparse
import asyncio
import hashlib
import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
PLACE = "undistorted/depthmaps/merged.ply"
#: A point cloud of one point.
PROPERTIES = b"".join(b"property float %s\n" % name for name in (b"x", b"y", b"z"))
CLOUD = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n" + PROPERTIES + b"end_header\n" + bytes(12)


class Proxy:
    """Passes bytes on to the service, and cuts all connections whenever so many have gone through."""

    def __init__(self, target: int, cuts: list[int]):
        self.target, self.cuts, self.passed, self.cut = target, sorted(cuts), 0, 0
        self.on_half = lambda: None
        self.open: set[asyncio.StreamWriter] = set()
        started = threading.Event()
        threading.Thread(target=self._run, args=(started,), daemon=True).start()
        started.wait()

    def _run(self, started: threading.Event) -> None:
        async def serve() -> None:
            server = await asyncio.start_server(self._client, "127.0.0.1", 0)
            self.port = server.sockets[0].getsockname()[1]
            started.set()
            await server.serve_forever()

        asyncio.run(serve())

    async def _client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            there, back = await asyncio.open_connection("127.0.0.1", self.target)
        except OSError:
            writer.transport.abort()
            return
        self.open |= {writer, back}
        await asyncio.gather(self._pass(reader, back, True), self._pass(there, writer, False))
        self.open -= {writer, back}

    async def _pass(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter, counts: bool) -> None:
        try:
            while data := await source.read(1 << 16):
                sink.write(data)
                await sink.drain()
                if counts:
                    self.passed += len(data)
                    if self.cuts and self.passed >= self.cuts[0]:
                        self.cuts.pop(0)
                        self.cut += 1
                        if len(self.cuts) == self.half:
                            self.on_half()
                        for one in list(self.open):
                            one.transport.abort()
        except OSError:
            pass
        finally:
            sink.close()


def call(base: str, method: str, path: str, value: dict | None = None) -> dict:
    body = json.dumps(value).encode() if value is not None else None
    request = urllib.request.Request(
        base + path, data=body, method=method, headers={"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.loads(answer.read())


def with_tus_js_client(endpoint: str, file: Path) -> None:
    subprocess.run(["node", str(HERE / "upload.mjs"), endpoint, str(file), PLACE], check=True)


def with_tuspy(endpoint: str, file: Path) -> None:
    from tusclient import client

    uploader = client.TusClient(endpoint).uploader(
        str(file), chunk_size=64 << 20, metadata={"path": PLACE}, retries=1000, retry_delay=0.1
    )
    uploader.upload()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--binary", type=Path, default=ROOT / "target" / "debug" / "heliomap")
    parser.add_argument("--megabytes", type=int, default=1024)
    parser.add_argument("--cuts", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    chance = random.Random(args.seed)
    wrong = 0
    with tempfile.TemporaryDirectory(prefix="heliomap-tus-") as folder:
        file = Path(folder) / "merged.ply"
        with open(file, "wb") as out:
            # A cloud of one point; what follows is no part of it.
            out.write(CLOUD)
            for _ in range(args.megabytes):
                out.write(chance.randbytes(1 << 20))
        size = file.stat().st_size
        with open(file, "rb") as source:
            digest = hashlib.file_digest(source, "sha256").hexdigest()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        log = open(Path(folder) / "service.log", "wb")
        command = [
            str(args.binary),
            "serve",
            "--insecure",
            "--no-worker",
            "--listen",
            f"127.0.0.1:{port}",
            "--data-dir",
            str(Path(folder) / "data"),
        ]
        base = f"http://127.0.0.1:{port}"

        def start() -> subprocess.Popen:
            service = subprocess.Popen(command, stdout=log, stderr=log)
            for _ in range(300):
                try:
                    call(base, "GET", "/health")
                    break
                except OSError:
                    time.sleep(0.1)
            return service

        service = [start()]
        try:
            plant = call(base, "POST", "/api/v1/plants", {"name": "tus"})["id"]
            for name, upload in (("tus-js-client", with_tus_js_client), ("tuspy", with_tuspy)):
                survey = call(base, "POST", f"/api/v1/plants/{plant}/surveys", {"name": name})["id"]
                here = f"/api/v1/plants/{plant}/surveys/{survey}"
                proxy = Proxy(port, [chance.randrange(1, size) for _ in range(args.cuts)])
                proxy.half = args.cuts // 2

                def restart() -> None:
                    service[0].send_signal(signal.SIGKILL)
                    service[0].wait()
                    threading.Thread(target=lambda: service.__setitem__(0, start())).start()

                proxy.on_half = restart
                begun = time.monotonic()
                upload(f"http://127.0.0.1:{proxy.port}{here}/uploads", file)
                seconds = time.monotonic() - begun
                files = call(base, "GET", here)["files"]
                good = [stored["sha256"] for stored in files] == [digest] and proxy.cut == args.cuts
                wrong += not good
                print(
                    f"{name}: {size} bytes through {proxy.cut} disconnects and one kill of the service in {seconds:.1f} s, "
                    f"{proxy.passed - size} bytes sent twice; {'the bytes agree' if good else f'WRONG: {files}'}",
                    flush=True,
                )
        finally:
            service[0].terminate()
            service[0].wait(timeout=60)
    print(f"{wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    os.environ.setdefault("HELIOMAP_LOG", "warn")
    sys.exit(main())
