#!/usr/bin/env python3
"""Maps the example plant through the HTTP service, as ground-station software would, and checks the result.

Starts `heliomap serve` on an embedded SQLite database and local files, creates a plant and a survey, uploads photos and
reconstruction, starts a job and follows it to its end, fetches the plant as GeoJSON, and compares it with the truth.
Only Python's standard library is used.
"""

import argparse
import io
import json
import os
import signal
import socket
import subprocess
import sys
import tarfile
import time
import urllib.error
import urllib.request
import uuid
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
EXAMPLE = ROOT / "examples" / "plant"
OUT = ROOT / "out" / "demo"
TERMINAL = sys.stderr.isatty()


class Api:
    """The few calls that a ground station needs."""

    def __init__(self, base: str):
        self.base = base

    def call(self, method: str, path: str, body: bytes | None = None, kind: str = "application/octet-stream") -> dict:
        headers = {"Content-Type": kind} if body is not None else {}
        request = urllib.request.Request(self.base + path, data=body, method=method, headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=120) as answer:
                return json.loads(answer.read() or b"{}")
        except urllib.error.HTTPError as error:
            try:
                problem = json.loads(error.read())
            except ValueError:
                raise SystemExit(f"{method} {path}: {error}") from error
            raise SystemExit(f"{method} {path}: {problem.get('title')}: {problem.get('detail')}") from error

    def post(self, path: str, value: dict) -> dict:
        return self.call("POST", path, json.dumps(value).encode(), "application/json")

    def put_file(self, path: str, file: Path) -> dict:
        return self.call("PUT", path, file.read_bytes())

    def post_files(self, path: str, files: list[Path]) -> dict:
        boundary = uuid.uuid4().hex
        parts = []
        for file in files:
            head = f'--{boundary}\r\nContent-Disposition: form-data; name="file"; filename="{file.name}"\r\n\r\n'
            parts += [head.encode(), file.read_bytes(), b"\r\n"]
        body = b"".join(parts) + f"--{boundary}--\r\n".encode()
        return self.call("POST", path, body, f"multipart/form-data; boundary={boundary}")


def bar(name: str, done: int, total: int) -> None:
    """A progress bar on a terminal, a line per step elsewhere."""
    if TERMINAL:
        filled = 30 * done // max(total, 1)
        print(
            f"\r  {name:<10} [{'=' * filled}{' ' * (30 - filled)}] {done}/{total} ", end="", file=sys.stderr, flush=True
        )
        if done == total:
            print(file=sys.stderr)
    else:
        print(f"  {name}: {done} of {total}", file=sys.stderr, flush=True)


def stop_earlier(pid_file: Path) -> None:
    """Ends the service that an earlier run left running."""
    try:
        pid = int(pid_file.read_text())
        if "heliomap" in Path(f"/proc/{pid}/comm").read_text():
            os.kill(pid, signal.SIGTERM)
            time.sleep(1)
    except (OSError, ValueError):
        pass


def port_for(keep: bool) -> int:
    """The usual port if the service is to stay and the port is free; any free one otherwise."""
    if keep:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", 8080)) != 0:
                return 8080
    return 0


def start_service(binary: Path, keep: bool) -> tuple[subprocess.Popen, str]:
    """The running service and its address."""
    data = OUT / "data"
    subprocess.run(["rm", "-rf", str(data)], check=True)
    log = open(OUT / "service.log", "w")
    service = subprocess.Popen(
        [
            str(binary),
            "serve",
            "--insecure",
            "--listen",
            f"127.0.0.1:{port_for(keep)}",
            "--data-dir",
            str(data),
            "--detector",
            f"{ROOT}/models/unet.onnx,{ROOT}/models/yolo.onnx",
        ],
        stdout=subprocess.PIPE,
        stderr=log,
        text=True,
        start_new_session=True,
    )
    line = service.stdout.readline()
    address = next((word.rstrip("/") for word in line.split() if word.startswith("http://")), None)
    if address is None:
        service.kill()
        raise SystemExit(f"the service did not start; see {OUT / 'service.log'}")
    return service, address


def upload(api: Api) -> str:
    """Uploads the survey; its path in the API."""
    plant = api.post("/plants", {"name": "Example plant"})["id"]
    survey = f"/plants/{plant}/surveys/" + api.post(f"/plants/{plant}/surveys", {"name": "First flight"})["id"]
    photos = sorted((EXAMPLE / "images").iterdir())
    # One photo by itself, as an unreliable link would send it; the others in forms of three.
    api.put_file(f"{survey}/images/{photos[0].name}", photos[0])
    bar("photos", 1, len(photos))
    for at in range(1, len(photos), 3):
        api.post_files(f"{survey}/images", photos[at : at + 3])
        bar("photos", min(at + 3, len(photos)), len(photos))
    files = [EXAMPLE / "reconstruction.json", EXAMPLE / "reference_lla.json"]
    files += [file for file in sorted((EXAMPLE / "undistorted").rglob("*")) if file.is_file()]
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w:gz", compresslevel=1) as tar:
        for file in files:
            tar.add(file, arcname=str(file.relative_to(EXAMPLE)))
    api.call("PUT", f"{survey}/reconstruction", archive.getvalue(), "application/gzip")
    bar("geometry", len(files), len(files))
    state = api.call("GET", survey)
    if not state["complete"]:
        raise SystemExit("the survey is not complete: " + "; ".join(m["message"] for m in state["missing"]))
    return survey


def follow(api: Api, plant: str, job: str) -> dict:
    """Waits for the end of a job, with its progress."""
    shown = None
    while True:
        state = api.call("GET", f"/plants/{plant}/jobs/{job}")
        progress = state.get("progress") or {}
        now = (progress.get("stage"), progress.get("done"), progress.get("total"))
        if now != shown and now[0] is not None:
            shown = now
            bar(*now)
        if state["state"] in ("succeeded", "failed", "cancelled"):
            return state
        time.sleep(0.3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--binary", type=Path, default=ROOT / "target" / "release" / "heliomap")
    parser.add_argument("--keep", action="store_true", help="leave the service running")
    args = parser.parse_args()
    binary = args.binary.resolve()
    OUT.mkdir(parents=True, exist_ok=True)
    pid_file = OUT / "service.pid"
    stop_earlier(pid_file)
    service, address = start_service(binary, args.keep)
    kept = False
    try:
        print(f"heliomap serves at {address}; uploading the example plant", flush=True)
        api = Api(address + "/api/v1")
        start = time.monotonic()
        survey = upload(api)
        plant = survey.split("/")[2]
        print(f"uploaded in {time.monotonic() - start:.1f} s; mapping", flush=True)
        start = time.monotonic()
        job = follow(api, plant, api.post(f"{survey}/jobs", {})["id"])
        if job["state"] != "succeeded":
            raise SystemExit(f"the job {job['state']}: {(job.get('error') or {}).get('message')}")
        print(f"mapped in {time.monotonic() - start:.1f} s", flush=True)
        for warning in job.get("warnings", []):
            print(f"  warning ({warning['code']}): {warning['message']}")
        for layer in ("modules", "sectors", "benches", "lines"):
            collection = api.call("GET", f"/plants/{plant}/models/latest/{layer}")
            (OUT / f"{layer}.geojson").write_text(json.dumps(collection))
            print(f"  {len(collection['features'])} {layer}: {OUT.relative_to(ROOT) / (layer + '.geojson')}")
        print("checking against the truth", flush=True)
        check = subprocess.run(
            [
                str(binary),
                "evaluate",
                str(OUT / "modules.geojson"),
                str(EXAMPLE / "truth.json"),
                "--strict",
                "--plots",
                str(OUT / "plots"),
            ],
            check=False,
        )
        if check.returncode != 0:
            raise SystemExit("the map of the example plant is not what it should be")
        if args.keep:
            kept = True
            pid_file.write_text(str(service.pid))
            print(f"\nLook at the plant: {address}/ (stop the service with: kill {service.pid})")
        else:
            print(
                "\nThe plant is in out/demo; `make demo KEEP=1` leaves the service running so that you can look at it."
            )
    finally:
        if not kept:
            service.terminate()
            service.wait(timeout=30)


if __name__ == "__main__":
    main()
