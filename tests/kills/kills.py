#!/usr/bin/env python3
"""Kills server and worker at random while surveys are uploaded and mapped, and checks that nothing is lost.

One service without a worker and one worker run on one store. While clients upload the example survey and follow its
job, one of the two is killed (SIGKILL) every now and then and started again at once. Every other kill is aimed at a stage of
the mapping, in turn: it comes within a moment after the worker's log says that the stage begins. Each photo's name holds the next
photo's bytes first, so that bytes that nothing names are deleted just when they come again. Afterwards:

- every file whose upload was acknowledged is in its survey, and its bytes have the digest that was acknowledged;
- every job has ended once, and made one model;
- the models are what a run without kills makes, to the last digit (identifiers apart, which differ by plant).

Only Python's standard library is used. The last line gives the figures; the exit code is 1 where something does not hold.
"""

import argparse
import hashlib
import http.client
import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
EXAMPLE = ROOT / "examples" / "plant"
#: What kills are aimed at, by what the worker logs at its beginning. Layouts are made while others are detected in.
STAGES = {stage: f'"stage":"{stage}"' for stage in ("read", "detect", "locate", "fuse", "refine", "assemble")}
STAGES["store"] = "storing the model begins"
FINAL = ("succeeded", "failed", "cancelled")
#: What the network throws at a client whose server dies.
LOST = (urllib.error.URLError, ConnectionError, http.client.HTTPException, TimeoutError)


def log(text: str) -> None:
    print(text, flush=True)


class Process:
    """A program that is started again when it is killed."""

    def __init__(self, name: str, command: list[str], folder: Path):
        self.name, self.command = name, command
        self.log = open(folder / f"{name}.log", "ab")
        self.read = open(folder / f"{name}.log", "r", errors="replace")
        self.child: subprocess.Popen | None = None

    def start(self) -> None:
        self.child = subprocess.Popen(self.command, stdout=self.log, stderr=self.log)

    def said_nothing_yet(self) -> None:
        """What it has said so far does not count."""
        self.read.seek(0, os.SEEK_END)

    def says(self, what: str) -> bool:
        """Whether it has said something since the last time."""
        return what in self.read.read()

    def kill(self) -> None:
        self.child.send_signal(signal.SIGKILL)
        self.child.wait()

    def stop(self) -> None:
        if self.child and self.child.poll() is None:
            self.child.terminate()
            try:
                self.child.wait(timeout=60)
            except subprocess.TimeoutExpired:
                self.child.kill()


class Api:
    """Requests that are sent until they are answered: each may be repeated."""

    def __init__(self, base: str, patience_s: float = 120):
        self.base, self.patience_s = base, patience_s
        self.repeated = 0

    def call(self, method: str, path: str, body: bytes | None = None, kind: str = "application/octet-stream"):
        end = time.monotonic() + self.patience_s
        while True:
            headers = {"Content-Type": kind} if body is not None else {}
            request = urllib.request.Request(self.base + path, data=body, method=method, headers=headers)
            try:
                with urllib.request.urlopen(request, timeout=30) as answer:
                    return json.loads(answer.read())
            except urllib.error.HTTPError as error:
                text = error.read().decode(errors="replace")
                if error.code < 500 and error.code not in (408, 429):
                    raise SystemExit(f"{method} {path}: {error.code} {text}") from error
                reason = text
            except LOST as error:
                reason = str(error)
            if time.monotonic() > end:
                raise SystemExit(f"{method} {path} is not answered: {reason}")
            self.repeated += 1
            time.sleep(0.05)

    def post(self, path: str, value: dict) -> dict:
        return self.call("POST", path, json.dumps(value).encode(), "application/json")


def survey_files() -> dict[str, Path]:
    """The example's files by their place in the API's survey."""
    files = {f"images/{file.name}": file for file in sorted((EXAMPLE / "images").iterdir())}
    for name in ("reconstruction.json", "reference_lla.json", "undistorted/depthmaps/merged.ply"):
        files[f"reconstruction/{name}"] = EXAMPLE / name
    return files


class Round:
    """One survey from its first byte to its model."""

    def __init__(self, api: Api, name: str):
        self.api, self.name = api, name
        self.phase = "create"
        self.acknowledged: dict[str, str] = {}

    def run(self) -> None:
        self.plant = self.api.post("/plants", {"name": self.name})["id"]
        self.survey = self.api.post(f"/plants/{self.plant}/surveys", {"name": "flight"})["id"]
        here = f"/plants/{self.plant}/surveys/{self.survey}"
        self.phase = "upload"
        files = survey_files()
        photos = [file for place, file in files.items() if place.startswith("images/")]
        for place, file in files.items():
            if file in photos:
                self.api.call("PUT", f"{here}/{place}", photos[(photos.index(file) + 1) % len(photos)].read_bytes())
            answer = self.api.call("PUT", f"{here}/{place}", file.read_bytes())
            self.acknowledged[answer["path"]] = answer["sha256"]
        self.phase = "queue"
        # An answer that was lost may have started the job: look before asking again.
        while not (jobs := self.api.call("GET", f"{here}/jobs")["items"]):
            try:
                Api(self.api.base, 0).post(f"{here}/jobs", {})
            except SystemExit:
                time.sleep(0.05)
        self.job = jobs[-1]
        while self.job["state"] not in FINAL:
            time.sleep(0.1)
            self.job = self.api.call("GET", f"/plants/{self.plant}/jobs/{self.job['id']}")
            self.phase = (self.job.get("progress") or {}).get("stage", "queue")
        self.phase = "done"

    def model(self) -> dict:
        """The plant as it was mapped, without identifiers."""
        layers = {}
        for layer in ("modules", "sectors", "benches", "lines"):
            features = self.api.call("GET", f"/plants/{self.plant}/models/1/{layer}")["features"]
            text = json.dumps([[f["geometry"], f["properties"]] for f in features])
            layers[layer] = re.sub(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}", "id", text)
        return layers

    def wrongs(self, data: Path, expected: dict) -> list[str]:
        """What does not hold."""
        wrongs = []
        here = f"/plants/{self.plant}/surveys/{self.survey}"
        stored = {file["path"]: file["sha256"] for file in self.api.call("GET", here)["files"]}
        for path, digest in self.acknowledged.items():
            blob = data / "blobs" / "plants" / self.plant / digest[:2] / digest
            if stored.get(path) != digest:
                wrongs.append(f"{path} was acknowledged and is not in the survey")
            elif not blob.is_file() or hashlib.sha256(blob.read_bytes()).hexdigest() != digest:
                wrongs.append(f"the bytes of {path} are not what was acknowledged")
        jobs = self.api.call("GET", f"{here}/jobs")["items"]
        if len(jobs) != 1:
            wrongs.append(f"the survey has {len(jobs)} jobs")
        if self.job["state"] != "succeeded":
            return wrongs + [f"the job {self.job['state']}: {self.job.get('error')}"]
        if len(self.api.call("GET", f"/plants/{self.plant}/models")["items"]) != 1:
            wrongs.append("the job made more than one model")
        for layer, text in self.model().items():
            if text != expected[layer]:
                wrongs.append(f"the {layer} are not those of a run without kills")
        return wrongs


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--binary", type=Path, default=ROOT / "target" / "debug" / "heliomap")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--database", help="a Postgres database to use in place of SQLite")
    args = parser.parse_args()
    chance = random.Random(args.seed)
    aims = list(STAGES)
    chance.shuffle(aims)
    folder = Path(tempfile.mkdtemp(prefix="heliomap-kills-"))
    data = folder / "data"
    port = free_port()
    store = ["--data-dir", str(data), "--keep-replaced", "0.1"] + (["--database", args.database] if args.database else [])
    # Every kill counts as an attempt: the limit must not end a job here.
    lives = ["--max-attempts", str(1000 + args.kills)]
    server = Process("server", [str(args.binary), "serve", "--insecure", "--no-worker", "--listen",
                                f"127.0.0.1:{port}", *store, *lives], folder)
    worker = Process("worker", [str(args.binary), "worker", "--lease", "2", "--detector",
                                str(ROOT / "models" / "unet.onnx"), *store], folder)
    api = Api(f"http://127.0.0.1:{port}/api/v1")
    kills: dict[str, int] = {}
    failures: list[str] = []
    rounds = 0
    begun = time.monotonic()
    try:
        server.start()
        worker.start()
        quiet = Round(api, "quiet")
        start = time.monotonic()
        quiet.run()
        quiet_s = time.monotonic() - start
        if quiet.job["state"] != "succeeded":
            raise SystemExit(f"the run without kills {quiet.job['state']}: {quiet.job.get('error')}")
        expected = quiet.model()
        log(f"without kills: {quiet_s:.1f} s from the first byte to the model, {len(expected['modules'])} bytes of modules")
        while sum(kills.values()) < args.kills:
            rounds += 1
            current = Round(api, f"round {rounds}")
            failed: list[BaseException] = []

            def run() -> None:
                try:
                    current.run()
                except BaseException as error:  # noqa: BLE001: it is told below
                    failed.append(error)

            client = threading.Thread(target=run, daemon=True)
            client.start()
            while client.is_alive():
                number = sum(kills.values())
                aim = aims[number // 2 % len(aims)] if number % 2 else None
                if aim:
                    worker.said_nothing_yet()
                    while client.is_alive() and not worker.says(STAGES[aim]):
                        time.sleep(0.002)
                    time.sleep(chance.uniform(0, 0.02))
                else:
                    client.join(chance.uniform(0.02, quiet_s / 2))
                if not client.is_alive() or number >= args.kills:
                    client.join()
                    break
                victim = server if chance.random() < (0.2 if aim else 0.4) else worker
                key = f"{victim.name} in {aim or current.phase}"
                kills[key] = kills.get(key, 0) + 1
                victim.kill()
                victim.start()
            wrongs = [str(failed[0])] if failed else current.wrongs(data, expected)
            failures += [f"round {rounds}: {wrong}" for wrong in wrongs]
            state = "failed" if failed else f"{current.job['state']} at attempt {current.job['attempt']}"
            log(f"round {rounds}: {sum(kills.values())} kills so far, job {state}" + "".join(f"\n  WRONG: {w}" for w in wrongs))
    finally:
        worker.stop()
        server.stop()
        if failures:
            log(f"logs: {folder}")
        else:
            shutil.rmtree(folder, ignore_errors=True)
    for key in sorted(kills):
        log(f"  killed {key}: {kills[key]}")
    log(f"{sum(kills.values())} kills in {rounds} surveys, {api.repeated} requests repeated, "
        f"{time.monotonic() - begun:.0f} s: {len(failures)} wrong")
    return 1 if failures else 0


if __name__ == "__main__":
    os.environ.update(HELIOMAP_LOG="info,heliomap::jobs=debug", HELIOMAP_LOG_FORMAT="json")
    sys.exit(main())
