#!/usr/bin/env python3
"""50 clients upload photos at once while a dashboard asks 200 times a second: no error, and answers stay quick.

The service runs in a process of its own, the dashboard in another, the uploads in a third; all share the machine's cores
and talk over loopback. The plant that the dashboard looks at is the example, mapped before the clock starts. Bounded in
time: it stops by itself. The last line gives the figures; the exit code is 1 where one does not hold.
"""

import argparse
import http.client
import json
import multiprocessing
import resource
import sys
import tempfile
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path += [str(ROOT / "tests" / "clients"), str(ROOT / "clients" / "python")]
from heliomap_client import Client  # noqa: E402
from service import EXAMPLE, Service, map_example  # noqa: E402

DASHBOARD_P99_MS = 100.0
SERVER_MEMORY_BYTES = 1 << 30


def upload(listen: str, key: str, survey: str, clients: int, end: float, result) -> None:
    """So many clients, each sending one photo after the other: how many were stored, and what went wrong."""
    photos = [photo.read_bytes() for photo in sorted((EXAMPLE / "images").iterdir())]
    stored, errors = [0] * clients, []

    def one(number: int) -> None:
        connection = http.client.HTTPConnection(listen, timeout=120)
        headers = {"Authorization": f"Bearer {key}", "Content-Type": "application/octet-stream"}
        while time.time() < end:
            count = stored[number]
            # What follows the end of the image makes each file another.
            body = photos[count % len(photos)] + f"{number} {count}".encode()
            try:
                connection.request("PUT", f"{survey}/images/{number:02}_{count:05}.jpg", body=body, headers=headers)
                answer = connection.getresponse()
                text = answer.read()
                if answer.status != 201:
                    errors.append(f"{answer.status} {text[:200]!r}")
                    return
            except (OSError, http.client.HTTPException) as error:
                errors.append(repr(error))
                return
            stored[number] += 1

    threads = [threading.Thread(target=one, args=(number,)) for number in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    result.send((sum(stored), errors))


def look(listen: str, key: str, paths: list[str], rate: float, end: float, result) -> None:
    """A dashboard that asks at a steady rate, whether or not it was answered: milliseconds from when each request was due."""
    times, errors = [], []
    begun, lock, count = time.time(), threading.Lock(), [0]

    def one() -> None:
        connection = http.client.HTTPConnection(listen, timeout=30)
        headers = {"Authorization": f"Bearer {key}", "Accept-Encoding": "gzip"}
        while True:
            with lock:
                number = count[0]
                count[0] += 1
            due = begun + number / rate
            if due > end:
                return
            time.sleep(max(0.0, due - time.time()))
            try:
                connection.request("GET", paths[number % len(paths)], headers=headers)
                answer = connection.getresponse()
                answer.read()
                if answer.status != 200:
                    errors.append(str(answer.status))
            except (OSError, http.client.HTTPException) as error:
                errors.append(repr(error))
                connection = http.client.HTTPConnection(listen, timeout=30)
            times.append((time.time() - due) * 1e3)

    threads = [threading.Thread(target=one) for _ in range(16)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    result.send((times, errors))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument("--rate", type=float, default=200.0, help="dashboard requests per second")
    parser.add_argument("--seconds", type=float, default=60.0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="heliomap-load-") as name, Service(Path(name) / "data") as service:
        client = Client(service.url, service.key)
        plant, _, job = map_example(client, Path(name) / "survey", "Load")
        here = f"/api/v1/plants/{plant}"
        model = f"{here}/models/latest"
        modules = [one["id"] for one in client.call("GET", f"{model}/modules?limit=50")["features"]]
        paths = ["/api/v1/plants", model, f"{here}/jobs/{job['id']}", f"{model}/modules?limit=100", f"{model}/benches"]
        paths += [f"{here}/modules/{module}" for module in modules[:15]]
        flight = f"{here}/surveys/{client.create_survey(plant, 'load')['id']}"

        end = time.time() + args.seconds
        mine, theirs = zip(*(multiprocessing.Pipe(duplex=False) for _ in range(2)))
        work = [
            multiprocessing.Process(
                target=upload, args=(service.listen, service.key, flight, args.clients, end, theirs[0])
            ),
            multiprocessing.Process(target=look, args=(service.listen, service.key, paths, args.rate, end, theirs[1])),
        ]
        for process in work:
            process.start()
        stored, upload_errors = mine[0].recv()
        times, look_errors = mine[1].recv()
        for process in work:
            process.join()
        listed = sum(1 for _ in client.items(f"{flight}/images?limit=1000"))
        status = Path(f"/proc/{service.process.pid}/status").read_text()
        memory = 1024 * int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1])
    server = resource.getrusage(resource.RUSAGE_CHILDREN)
    times.sort()
    p50, p99 = (times[min(len(times) - 1, int(len(times) * share))] for share in (0.5, 0.99))
    errors = upload_errors + look_errors
    holds = not errors and listed == stored and p99 < DASHBOARD_P99_MS and memory < SERVER_MEMORY_BYTES
    print(json.dumps({"errors": errors[:5]}) if errors else "no error")
    print(
        f"{args.clients} clients stored {stored} photos in {args.seconds:.0f} s ({listed} listed) beside {len(times)} dashboard "
        f"requests: {len(errors)} errors, dashboard median {p50:.1f} ms, p99 {p99:.1f} ms, service's memory at most "
        f"{memory / 2**20:.0f} MiB, processor time of service and clients {server.ru_utime + server.ru_stime:.0f} s: "
        f"{'holds' if holds else 'DOES NOT HOLD'}"
    )
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
