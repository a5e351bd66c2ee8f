#!/usr/bin/env python3
"""Kills server and worker at random while surveys are uploaded and mapped, and checks that nothing is lost.

One service without a worker and one worker run on one store. While clients upload the example survey and follow its
job, one of the two is killed (SIGKILL) every now and then and started again at once. Every other kill is aimed at a stage
of the mapping, in turn: it comes after the worker's log says that the stage begins, before it ends where it takes as long
as without kills. Each photo's name holds the next photo's bytes first, so that bytes that nothing names are deleted just
when they come again. After each survey, and again for all of them at the end:

- every file whose upload was acknowledged is in its survey, and its bytes have the digest that was acknowledged;
- every job has ended once, and made one model; what it was when it ended it still is at the end;
- the models are what a run without kills makes, to the last digit (identifiers apart, which differ by plant);
- a webhook was told of each job's end by one message (the same one may come twice), which says how the job ended.

With `--kills` of 100 and more, every stage must have been hit: by a kill of the worker after which its log ends within
that stage.

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
from collections import Counter
from datetime import datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
EXAMPLE = ROOT / "examples" / "plant"
#: What kills are aimed at. Layouts are made while others are detected in.
STAGES = ("read", "detect", "locate", "fuse", "refine", "assemble", "store")
#: So many kills must hit every stage, upload and queue included.
MANY = 100
#: A stage that takes longer is not killed later than this after its beginning by a kill that is aimed at it.
LATEST_S = 0.5
FINAL = ("succeeded", "failed", "cancelled")
#: What the network throws at a client whose server dies.
LOST = (urllib.error.URLError, ConnectionError, http.client.HTTPException, TimeoutError)


def log(text: str) -> None:
    print(text, flush=True)


class Process:
    """A program that is started again when it is killed, and what its log says it is doing."""

    def __init__(self, name: str, command: list[str], folder: Path):
        self.name, self.command = name, command
        self.log = open(folder / f"{name}.log", "ab")
        self.read = open(folder / f"{name}.log", errors="replace")
        self.rest = ""
        self.child: subprocess.Popen | None = None
        #: The stages that it began since it was started, with the times; the last is `None` where it has no job.
        self.stages: list[tuple[str | None, float]] = []

    def start(self) -> None:
        self.look()
        self.stages = [(None, 0.0)]
        self.child = subprocess.Popen(self.command, stdout=self.log, stderr=self.log)

    def look(self) -> list[str | None]:
        """Reads on in the log; the stages that it says have begun, `None` for the end of a job."""
        *lines, self.rest = (self.rest + self.read.read()).split("\n")
        known = len(self.stages)
        for line in lines:
            if line.startswith("{"):
                event = json.loads(line)
                message = event["message"]
                at = datetime.fromisoformat(event["timestamp"]).timestamp()
                if message == "job started":
                    self.stages.append(("start", at))
                elif message == "stage begins":
                    self.stages.append((event["stage"], at))
                elif message == "storing the model begins":
                    self.stages.append(("store", at))
                elif message == "job left":
                    self.stages.append((None, at))
        return [stage for stage, _ in self.stages[known:]]

    def stage(self) -> str | None:
        """What it does now, or did when it was killed."""
        self.look()
        return self.stages[-1][0]

    def lengths(self) -> dict[str, float]:
        """How long the stages of its first job took."""
        self.look()
        spans = zip(self.stages, self.stages[1:])
        return {stage: end - begun for (stage, begun), (_, end) in reversed([*spans]) if stage}

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


class Receiver:
    """Takes the messages to a webhook."""

    def __init__(self):
        self.messages: list[dict] = []
        messages = self.messages

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                messages.append(json.loads(self.rfile.read(int(self.headers["content-length"]))))
                self.send_response(204)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        self.url = f"http://127.0.0.1:{server.server_port}/"


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

    def all(self, path: str) -> list[dict]:
        """A list to its end."""
        part = self.call("GET", path)
        items = part["items"]
        while part.get("next"):
            part = self.call("GET", part["next"].removeprefix("/api/v1"))
            items += part["items"]
        return items


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
        self.job: dict | None = None

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
        elif jobs[0] != self.job:
            wrongs.append(f"the job ended as {self.job} and is {jobs[0]} now")
        if self.job["state"] != "succeeded":
            return wrongs + [f"the job {self.job['state']}: {self.job.get('error')}"]
        if len(self.api.call("GET", f"/plants/{self.plant}/models")["items"]) != 1:
            wrongs.append("the job made more than one model")
        for layer, text in self.model().items():
            if text != expected[layer]:
                wrongs.append(f"the {layer} are not those of a run without kills")
        return wrongs


def told_wrongs(api: Api, hook: str, receiver: Receiver, rounds: list[Round]) -> list[str]:
    """What does not hold of the messages about these jobs' ends; waits for those that are still to be sent."""
    # Whoever died while it sent one has it for a minute.
    end = time.monotonic() + 120
    while any(told["state"] == "waiting" for told in api.all(f"{hook}/deliveries")) and time.monotonic() < end:
        time.sleep(0.5)
    wrongs = []
    kept = api.all(f"{hook}/deliveries")
    for one in rounds:
        job, state = one.job["id"], one.job["state"]
        rows = [told for told in kept if told["job"] == job]
        events = {(told["id"], told["event"]) for told in receiver.messages if told["job"] == job}
        if [told["state"] for told in rows] != ["delivered"]:
            wrongs.append(f"{one.name}: the messages about the job's end are {rows}")
        elif events != {(rows[0]["id"], f"job.{state}")}:
            wrongs.append(f"{one.name}: the job {state}, and what came of it is {sorted(events)}")
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
    store = ["--data-dir", str(data), "--keep-replaced", "0.1"] + (
        ["--database", args.database] if args.database else []
    )
    # Every kill counts as an attempt: the limit must not end a job here.
    lives = ["--max-attempts", str(1000 + args.kills)]
    hooks = ["--webhook-private-targets"]
    server = Process(
        "server",
        [
            str(args.binary),
            "serve",
            "--insecure",
            "--no-worker",
            "--listen",
            f"127.0.0.1:{port}",
            *store,
            *lives,
            *hooks,
        ],
        folder,
    )
    worker = Process(
        "worker",
        [str(args.binary), "worker", "--lease", "2", "--detector", str(ROOT / "models" / "unet.onnx"), *store, *hooks],
        folder,
    )
    api = Api(f"http://127.0.0.1:{port}/api/v1")
    receiver = Receiver()
    kills: Counter[tuple[str, str]] = Counter()
    failures: list[str] = []
    ended: list[Round] = []
    rounds = 0
    begun = time.monotonic()
    try:
        server.start()
        worker.start()
        hook = f"/webhooks/{api.post('/webhooks', {'url': receiver.url})['id']}"
        quiet = Round(api, "quiet")
        start = time.monotonic()
        quiet.run()
        quiet_s = time.monotonic() - start
        if quiet.job["state"] != "succeeded":
            raise SystemExit(f"the run without kills {quiet.job['state']}: {quiet.job.get('error')}")
        expected = quiet.model()
        ended.append(quiet)
        lengths = worker.lengths()
        log(
            f"without kills: {quiet_s:.1f} s from the first byte to the model, {len(expected['modules'])} bytes of modules"
        )
        while sum(kills.values()) < args.kills:
            rounds += 1
            current = Round(api, f"round {rounds}")
            failed: list[BaseException] = []

            def run(current: Round = current, failed: list[BaseException] = failed) -> None:
                try:
                    current.run()
                except BaseException as error:
                    failed.append(error)

            client = threading.Thread(target=run, daemon=True)
            client.start()
            while client.is_alive():
                number = sum(kills.values())
                aim = aims[number // 2 % len(aims)] if number % 2 else None
                if aim:
                    worker.look()
                    while client.is_alive() and aim not in worker.look():
                        time.sleep(0.001)
                    time.sleep(chance.uniform(0, min(lengths[aim], LATEST_S)))
                else:
                    client.join(chance.uniform(0.02, quiet_s / 2))
                if not client.is_alive() or number >= args.kills:
                    client.join()
                    break
                victim = server if chance.random() < (0.2 if aim else 0.4) else worker
                phase = current.phase if current.phase in ("create", "upload") else "queue"
                victim.kill()
                kills[victim.name, worker.stage() or phase] += 1
                victim.start()
            wrongs = [str(failed[0])] if failed else current.wrongs(data, expected)
            failures += [f"round {rounds}: {wrong}" for wrong in wrongs]
            if not failed:
                ended.append(current)
            state = "failed" if failed else f"{current.job['state']} at attempt {current.job['attempt']}"
            log(
                f"round {rounds}: {sum(kills.values())} kills so far, job {state}"
                + "".join(f"\n  WRONG: {w}" for w in wrongs)
            )
        last = [f"{one.name}: {wrong}" for one in ended for wrong in one.wrongs(data, expected)]
        last += told_wrongs(api, hook, receiver, ended)
        if args.kills >= MANY:
            hit = {stage for name, stage in kills if name == "worker" or stage not in STAGES}
            last += [f"no kill came in {stage}" for stage in ("upload", "queue", *STAGES) if stage not in hit]
        failures += last
        different = len({message["id"] for message in receiver.messages})
        log(
            f"at the end: {len(ended)} jobs, {len(receiver.messages)} messages, {different} of them different"
            + "".join(f"\n  WRONG: {wrong}" for wrong in last)
        )
    finally:
        worker.stop()
        server.stop()
        if failures:
            log(f"logs: {folder}")
        else:
            shutil.rmtree(folder, ignore_errors=True)
    for stage in dict.fromkeys(["create", "upload", "queue", "start", *STAGES, *(stage for _, stage in kills)]):
        log(f"  killed in {stage}: worker {kills['worker', stage]}, server {kills['server', stage]}")
    log(
        f"{sum(kills.values())} kills in {rounds} surveys, {api.repeated} requests repeated, "
        f"{time.monotonic() - begun:.0f} s: {len(failures)} wrong"
    )
    return 1 if failures else 0


if __name__ == "__main__":
    os.environ.update(HELIOMAP_LOG="info,heliomap::jobs=debug", HELIOMAP_LOG_FORMAT="json")
    sys.exit(main())
