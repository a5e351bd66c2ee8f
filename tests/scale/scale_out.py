#!/usr/bin/env python3
"""Two workers map a survey together, each on one core and in a network namespace of its own; then one is cut off.

A hub has Postgres, an S3-compatible server and the service without a worker; two workers reach it through links of their
own, and nothing else. A survey is mapped by one worker, then by both, several times in turn. Then it is mapped by both
while the link of one is down: of the one that helps, then of the one whose job it is.

- the survey takes both at most `--share` of the time that one takes;
- with one cut off it ends all the same;
- the model is always the same, to the last digit (identifiers apart, which differ by plant).

Where the machine does other things meanwhile, times say nothing: such a run is repeated, some times, and where it does not
get quiet nothing is said of the share. Needs root for the namespaces; without, or where there are none, all run on the
loopback interface, nothing is cut off but killed, and the output says so.

Only Python's standard library is used. The last line gives the figures; the exit code is 1 where something does not hold, 2
where all holds but the share, which the busy machine did not let be measured.
"""

import argparse
import json
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
NET = "10.213.7"
HUB = f"{NET}.1"
NAMES = ("a", "b")
FINAL = ("succeeded", "failed", "cancelled")
TICKS = os.sysconf("SC_CLK_TCK")
#: Beyond this share of a core for what is not of this test, times are not those of a quiet machine.
QUIET = 0.15
#: How often a run is tried before the machine is too busy.
TRIES = 4
#: How long to wait before the next try.
PAUSE_S = 20


def log(text: str) -> None:
    print(text, flush=True)


def namespace(name: str) -> str:
    return f"heliomap-{name}"


def run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


def tear_down() -> None:
    for name in ("hub", *NAMES):
        subprocess.run(["ip", "netns", "delete", namespace(name)], capture_output=True)


def set_up() -> str | None:
    """Makes the namespaces; why there are none, else."""
    if os.geteuid() != 0:
        return "only root makes network namespaces"
    if not shutil.which("ip"):
        return "there is no program `ip` (Debian: iproute2)"
    tear_down()
    hub = namespace("hub")
    within = ("ip", "-n", hub)
    try:
        run("ip", "netns", "add", hub)
        run(*within, "link", "set", "lo", "up")
        run(*within, "link", "add", "bridge", "type", "bridge")
        run(*within, "address", "add", f"{HUB}/24", "dev", "bridge")
        run(*within, "link", "set", "bridge", "up")
        for number, name in enumerate(NAMES, start=2):
            worker = namespace(name)
            run("ip", "netns", "add", worker)
            run("ip", "-n", worker, "link", "set", "lo", "up")
            run(*within, "link", "add", f"to-{name}", "type", "veth", "peer", "name", "to-hub", "netns", worker)
            run(*within, "link", "set", f"to-{name}", "master", "bridge", "up")
            run("ip", "-n", worker, "address", "add", f"{NET}.{number}/24", "dev", "to-hub")
            run("ip", "-n", worker, "link", "set", "to-hub", "up")
    except subprocess.CalledProcessError as error:
        tear_down()
        return f"`{' '.join(error.cmd)}` failed: {error.stderr.decode().strip()}"
    return None


class Program:
    """A program with its log."""

    def __init__(self, name: str, command: list[str], folder: Path, env: dict[str, str]):
        self.name, self.command, self.env = name, command, {**os.environ, **env}
        self.log = folder / f"{name}.log"
        self.child: subprocess.Popen | None = None

    def start(self) -> None:
        with open(self.log, "ab") as out:
            self.child = subprocess.Popen(self.command, stdout=out, stderr=out, env=self.env)

    def stop(self, how: int = signal.SIGTERM) -> None:
        if self.child and self.child.poll() is None:
            self.child.send_signal(how)
            try:
                self.child.wait(timeout=60)
            except subprocess.TimeoutExpired:
                self.child.kill()
                self.child.wait()
        self.child = None

    def cpu_s(self) -> float:
        """Processor time so far."""
        fields = Path(f"/proc/{self.child.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / TICKS

    def said(self, what: str) -> bool:
        return what in self.log.read_text(errors="replace")


def machine_cpu_s() -> float:
    """Processor time of everything on this machine so far, what a host takes from it included."""
    user, nice, system, _idle, _iowait, irq, softirq, steal, *_ = (
        Path("/proc/stat").read_text().split("\n")[0].split()[1:]
    )
    return sum(map(int, (user, nice, system, irq, softirq, steal))) / TICKS


def processes() -> dict[int, tuple[int, float]]:
    """Each process' parent and processor time so far, that of its children that have ended included."""
    found = {}
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = file.read_text().rsplit(")", 1)[1].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        found[int(file.parent.name)] = int(fields[1]), sum(map(int, fields[11:15])) / TICKS
    return found


def trees_cpu_s(roots: set[int]) -> float:
    """Processor time of these processes and all that come of them, so far."""
    all_of_them, total = processes(), 0.0
    for process, (_, seconds) in all_of_them.items():
        above = process
        while above in all_of_them and above not in roots:
            above = all_of_them[above][0]
        total += seconds if above in roots else 0.0
    return total


def server_on(url: str) -> int:
    """The process of a server whose arguments name the port of this URL."""
    port = url.rsplit(":", 1)[1]
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            arguments = file.read_text(errors="replace").split("\0")
        except (FileNotFoundError, ProcessLookupError):
            continue
        if port in arguments or f"port={port}" in arguments:
            return int(file.parent.name)
    raise SystemExit(f"there is no process of {url}")


class Service:
    def __init__(self, base: str, data: Path):
        self.base, self.data, self.plants = base, data, 0

    def call(self, method: str, path: str, body: bytes | None = None, kind: str = "application/octet-stream"):
        headers = {"Content-Type": kind} if body is not None else {}
        request = urllib.request.Request(self.base + path, data=body, method=method, headers=headers)
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.loads(answer.read())

    def post(self, path: str, value: dict) -> dict:
        return self.call("POST", path, json.dumps(value).encode(), "application/json")

    def upload(self) -> tuple[str, str]:
        """The paths of a new plant and its survey."""
        self.plants += 1
        plant = f"/plants/{self.post('/plants', {'name': f'Plant {self.plants}'})['id']}"
        survey = f"{plant}/surveys/{self.post(f'{plant}/surveys', {'name': 'flight'})['id']}"
        for image in sorted((self.data / "images").iterdir()):
            self.call("PUT", f"{survey}/images/{image.name}", image.read_bytes())
        for name in ("reconstruction.json", "reference_lla.json", "undistorted/depthmaps/merged.ply"):
            if (self.data / name).is_file():
                self.call("PUT", f"{survey}/reconstruction/{name}", (self.data / name).read_bytes())
        return plant, survey

    def follow(self, plant: str, job: dict, look=lambda job: None, patience_s: float = 1200) -> dict:
        end = time.monotonic() + patience_s
        while job["state"] not in FINAL:
            if time.monotonic() > end:
                raise SystemExit(f"the job does not end: {job}")
            time.sleep(0.05)
            job = self.call("GET", f"{plant}/jobs/{job['id']}")
            look(job)
        return job

    def model(self, plant: str) -> str:
        """The plant as it was mapped, without identifiers."""
        layers = []
        for layer in ("modules", "sectors", "benches", "lines"):
            features = self.call("GET", f"{plant}/models/1/{layer}")["features"]
            layers.append([[feature["geometry"], feature["properties"]] for feature in features])
        return re.sub(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}", "id", json.dumps(layers))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--binary", type=Path, default=ROOT / "target" / "release" / "heliomap")
    parser.add_argument("--data", type=Path, help="folder of the survey, as OpenSfM leaves it")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--share", type=float, default=0.6)
    parser.add_argument("--inside", choices=("namespaces", "loopback"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.data is None:
        shared = Path(os.environ.get("HELIOMAP_DATA") or "/nowhere") / "small"
        args.data = shared if shared.is_dir() else ROOT / "examples" / "plant"
    if args.inside:
        return measure(args)
    why = set_up()
    if why:
        log(f"no network namespaces: {why}; two processes on the loopback interface instead, and killed, not cut off")
    script = [sys.executable, str(Path(__file__).resolve()), *sys.argv[1:]]
    servers = [str(ROOT / "tests" / "with-postgres.sh"), str(ROOT / "tests" / "with-s3.sh")]
    try:
        if why:
            return subprocess.run([*servers, *script, "--inside", "loopback"]).returncode
        env = {**os.environ, "HELIOMAP_TEST_LISTEN": HUB}
        command = ["ip", "netns", "exec", namespace("hub"), *servers, *script, "--inside", "namespaces"]
        return subprocess.run(command, env=env).returncode
    finally:
        if not why:
            tear_down()


def measure(args: argparse.Namespace) -> int:
    apart = args.inside == "namespaces"
    folder = Path(tempfile.mkdtemp(prefix="heliomap-scale-"))
    store = ["--database", os.environ["HELIOMAP_TEST_POSTGRES"] + "/postgres", "--blobs", "s3://heliomap-tests/scale"]
    env = {
        "AWS_ENDPOINT_URL": os.environ["HELIOMAP_TEST_S3"],
        "AWS_REGION": "eu-central-1",
        "AWS_ACCESS_KEY_ID": "heliomap",
        "AWS_SECRET_ACCESS_KEY": "heliomap",
        "HELIOMAP_LOG": "info",
    }
    server = Program(
        "server",
        [
            str(args.binary),
            "serve",
            "--insecure",
            "--no-worker",
            "--listen",
            "127.0.0.1:0",
            "--data-dir",
            str(folder / "server"),
            *store,
        ],
        folder,
        env,
    )
    cores = sorted(os.sched_getaffinity(0))
    workers = {}
    for number, name in enumerate(NAMES):
        place = ["ip", "netns", "exec", namespace(name)] if apart else []
        workers[name] = Program(
            name,
            [
                *place,
                "taskset",
                "--cpu-list",
                str(cores[number % len(cores)]),
                str(args.binary),
                "worker",
                "--lease",
                "3",
                "--data-dir",
                str(folder / name),
                *store,
            ],
            folder,
            env,
        )
    # The servers; what this script started, the service and the workers, comes of itself.
    own = {os.getpid(), server_on(os.environ["HELIOMAP_TEST_POSTGRES"]), server_on(os.environ["HELIOMAP_TEST_S3"])}
    wrongs: list[str] = []
    figures = busy = ""
    try:
        server.start()
        while not (found := re.search(r"listening on (\S+)", server.log.read_text() if server.log.exists() else "")):
            if server.child.poll() is not None:
                raise SystemExit(server.log.read_text())
            time.sleep(0.05)
        service = Service(found[1] + "/api/v1", args.data)
        log(
            f"{args.data}: {len(list((args.data / 'images').iterdir()))} photos; workers "
            f"{'in network namespaces' if apart else 'on loopback'}, each on one core"
        )

        def one_run(names: tuple[str, ...]) -> tuple[float, dict[str, float], float, str]:
            """Seconds, processor seconds by worker, cores that what is not of this test takes, and the model."""
            plant, survey = service.upload()
            before = {name: workers[name].cpu_s() for name in names}
            foreign = machine_cpu_s() - trees_cpu_s(own)
            begun = time.monotonic()
            job = service.follow(plant, service.post(f"{survey}/jobs", {}))
            took = time.monotonic() - begun
            cpu = {name: workers[name].cpu_s() - before[name] for name in names}
            foreign = machine_cpu_s() - trees_cpu_s(own) - foreign
            if job["state"] != "succeeded":
                raise SystemExit(f"the job {job['state']}: {job.get('error')}")
            return took, cpu, max(foreign, 0.0) / took, service.model(plant)

        def warm(*names: str) -> None:
            """Starts exactly these workers, and lets each map or help once, so that it has its models."""
            for name, worker in workers.items():
                if name not in names:
                    worker.stop()
            for name in names:
                if workers[name].child is None:
                    # Alone, so that it is this one that maps.
                    for other in names:
                        if other != name:
                            workers[other].stop()
                    workers[name].start()
                    one_run((name,))
            for name in names:
                if workers[name].child is None:
                    workers[name].start()
                    time.sleep(2)
                    one_run(names)

        alone, both, busiest_alone, busiest = [], [], [], []
        expected = None
        for names in (("a",), NAMES) * args.runs:
            warm(*names)
            for again in range(TRIES):
                if again:
                    time.sleep(PAUSE_S)
                took, cpu, foreign, model = one_run(names)
                expected = expected or model
                if model != expected:
                    wrongs.append(f"a model by {' and '.join(names)} is another one")
                quiet = foreign <= QUIET
                shares = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in cpu.items())
                log(
                    f"by {len(names)}: {took:.1f} s; processor time: {shares}; others took {foreign:.2f} of a core"
                    + ("" if quiet else ": does not count")
                )
                if quiet:
                    (alone if len(names) == 1 else both).append(took)
                    (busiest_alone if len(names) == 1 else busiest).append(max(cpu.values()))
                    break
            else:
                busy = f"the machine is busy: others took more than {QUIET} of a core {TRIES} times; what was measured says nothing"
                log(busy)
                break
        figures = busy
        if not busy:
            share = statistics.median(both) / statistics.median(alone)
            cpu_share = statistics.median(busiest) / statistics.median(busiest_alone)
            figures = (
                f"{statistics.median(alone):.1f} s by one, {statistics.median(both):.1f} s by two: {share:.2f} of the time; "
                f"of the processor time of the busier one {cpu_share:.2f}"
            )
            if share > args.share:
                wrongs.append(f"two workers take {share:.2f} of the time of one, more than {args.share}")

        for whom in ("helper", "owner"):
            warm(*NAMES)
            wrong = cut(service, workers, whom, apart, expected)
            log(
                f"the {whom} {'cut off' if apart else 'killed'} in the middle: "
                + (wrong or "the survey ended, the model is the same")
            )
            if wrong:
                wrongs.append(wrong)
    finally:
        for program in (*workers.values(), server):
            program.stop()
        if wrongs:
            log(f"logs: {folder}")
        else:
            shutil.rmtree(folder, ignore_errors=True)
    for wrong in wrongs:
        log(f"  WRONG: {wrong}")
    log(f"{figures}: {len(wrongs)} wrong")
    return 1 if wrongs else 2 if busy else 0


def cut(service: Service, workers: dict[str, Program], whom: str, apart: bool, expected: str) -> str | None:
    """Maps a survey while a worker is cut off; what is wrong."""
    plant, survey = service.upload()
    job = service.post(f"{survey}/jobs", {})
    done: dict[str, str] = {}

    def look(job: dict) -> None:
        progress = job.get("progress") or {}
        if done or progress.get("stage") != "detect" or progress.get("done", 0) < 1:
            return
        owner = next(
            name
            for name, worker in workers.items()
            if worker.said(f"job{{job={job['id']}")
            or re.search(rf"{job['id']}.*job started", worker.log.read_text(errors="replace"))
        )
        victim = owner if whom == "owner" else next(name for name in workers if name != owner)
        done["victim"] = victim
        if apart:
            run("ip", "link", "set", f"to-{victim}", "down")
        else:
            workers[victim].stop(signal.SIGKILL)

    try:
        job = service.follow(plant, job, look)
    finally:
        if apart and done:
            run("ip", "link", "set", f"to-{done['victim']}", "up")
        if done:
            # What it still does is of no use to anybody.
            workers[done["victim"]].stop(signal.SIGKILL)
    if not done:
        return f"the job ended before the {whom} could be cut off"
    if job["state"] != "succeeded":
        return f"with the {whom} cut off the job {job['state']}: {job.get('error')}"
    if len(service.call("GET", f"{plant}/models")["items"]) != 1:
        return f"with the {whom} cut off there is more than one model"
    if service.model(plant) != expected:
        return f"with the {whom} cut off the model is another one"
    return None


if __name__ == "__main__":
    try:
        sys.exit(main())
    except urllib.error.HTTPError as error:
        sys.exit(f"{error.url}: {error.code} {error.read().decode(errors='replace')}")
