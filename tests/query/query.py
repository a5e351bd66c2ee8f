#!/usr/bin/env python3
"""How fast a dashboard is answered about a plant of a million modules, over HTTP, with a key, on SQLite or Postgres.

Rows of a made-up model are written into the database as the service writes them, then asked for: modules by identifier,
boxes of about 1,000 modules, and a plant of 5,000 modules as one compressed GeoJSON, whole in each answer. The last lines
give the figures, of which the 99th percentile is bounded; the exit code is 1 where one does not hold.
"""

import argparse
import gzip
import http.client
import io
import json
import math
import random
import sqlite3
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path += [str(ROOT / "tests" / "clients"), str(ROOT / "clients" / "python")]
from heliomap_client import Client  # noqa: E402
from service import Service  # noqa: E402

#: Degrees from one module to the next: about 1 m east, 2 m north.
EAST, NORTH = 1.4e-5, 1.8e-5
WEST_END, SOUTH_END = 8.0, 50.0
#: Degrees of a strip by which the service finds features.
STRIP = 0.0005
#: Rows and columns of the plant that is asked for as a whole.
WHOLE = (50, 100)
#: Bounds in milliseconds, of the 99th percentile.
BOUNDS = {"module": 5.0, "box": 25.0, "plant": 50.0}


def feature(rng: random.Random, plant: str, row: int, column: int) -> tuple:
    """A module as the service stores it: identifier, label, GeoJSON, box, strip."""
    west, south = WEST_END + column * EAST, SOUTH_END + row * NORTH
    east, north = west + 0.9 * EAST, south + 0.9 * NORTH
    identifier = str(uuid.UUID(int=rng.getrandbits(128), version=5))
    groups = [str(uuid.UUID(int=(row << 16) + place, version=5)) for place in (1, 2, 3)]
    label = f"L{row // 4 + 1:03}-B{column // 50 + 1:02}-R{row % 4 + 1}-{column % 50 + 1:03}"
    ring = [[west, south, 100.1234], [east, south, 100.1234], [east, north, 101.2345], [west, north, 101.2345]]
    document = {
        "type": "Feature",
        "id": identifier,
        "geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]},
        "properties": {
            "id": identifier,
            "label": label,
            "plant": plant,
            "line": groups[0],
            "bench": groups[1],
            "sector": groups[2],
            "row": row % 4 + 1,
            "number": column % 50 + 1,
            "center": [west + EAST / 2, south + NORTH / 2, 100.6789],
            "tilt_deg": 25.0 + rng.random(),
            "azimuth_deg": 180.0 + rng.random(),
            "width_m": 0.992 + rng.random() / 1000,
            "height_m": 1.64 + rng.random() / 1000,
            "sigma_m": [rng.random() / 50 for _ in range(3)],
            "views": 4,
            "images": [f"DJI_{rng.randrange(10000):04}.JPG" for _ in range(4)],
            "status": "detected",
        },
    }
    strip = math.floor((west + 180) / STRIP)
    return identifier, label, json.dumps(document, separators=(",", ":")), west, south, east, north, strip


class Rows:
    """Writes into the service's database."""

    def __init__(self, data: Path, database: str | None):
        self.database = database
        self.sqlite = None if database else sqlite3.connect(data / "heliomap.db", isolation_level=None)

    def execute(self, statement: str) -> str:
        if self.sqlite:
            found = self.sqlite.execute(statement).fetchone()
            return str(found[0]) if found else ""
        found = self.psql("--tuples-only", "--no-align", "--quiet", "--command", statement)
        return found.partition("\n")[0]

    def psql(self, *arguments: str, feed: io.StringIO | None = None) -> str:
        command = ["psql", "--no-psqlrc", "--set=ON_ERROR_STOP=1", self.database, *arguments]
        return subprocess.run(
            command, input=feed.getvalue() if feed else None, check=True, capture_output=True, text=True
        ).stdout

    def features(self, model: str, features: Iterator[tuple]) -> None:
        if self.sqlite:
            self.sqlite.execute("BEGIN")
            rows = ((model, "modules", seq, *row) for seq, row in enumerate(features, 1))
            self.sqlite.executemany("INSERT INTO features VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)
            self.sqlite.execute("COMMIT")
            return
        feed = io.StringIO()
        for seq, row in enumerate(features, 1):
            feed.write("\t".join([model, "modules", str(seq), *map(str, row)]) + "\n")
            if seq % 50_000 == 0:
                self.psql("--command", "COPY features FROM STDIN", feed=feed)
                feed = io.StringIO()
        self.psql("--command", "COPY features FROM STDIN", feed=feed)

    def model(self, plant: str, rows: int, columns: int, rng: random.Random) -> list[str]:
        """A model of rows x columns modules; some of its identifiers."""
        model = self.execute(
            "INSERT INTO models (plant_id, version, survey_id, job_id, sha256, size, warnings, created_ms) "
            f"VALUES ('{plant}', 1, '{uuid.uuid4()}', '{uuid.uuid4()}', '{'0' * 64}', 1, '[]', 1) RETURNING seq"
        )
        some: list[str] = []

        def made() -> Iterator[tuple]:
            for row in range(rows):
                for column in range(columns):
                    one = feature(rng, plant, row, column)
                    if rng.random() < 0.01:
                        some.append(one[0])
                    yield one

        self.features(model, made())
        name = json.dumps({"name": "Query", "model_version": 1})
        extent = f"{WEST_END}, {SOUTH_END}, {WEST_END + columns * EAST}, {SOUTH_END + rows * NORTH}, {0.9 * NORTH}, {0.9 * EAST}"
        self.execute(
            "INSERT INTO layers (model_seq, layer, features, properties, min_lon, min_lat, max_lon, max_lat, tallest_deg, widest_deg) "
            f"VALUES ({model}, 'modules', {rows * columns}, '{name}', {extent})"
        )
        return some

    def finish(self) -> None:
        self.execute("ANALYZE")
        if self.sqlite:
            self.sqlite.close()


def measure(service: Service, paths: Iterator[str], check: Callable[[dict], None], compressed: bool) -> list[float]:
    """Milliseconds that each request takes, sorted, over one connection; answers must be compressed where that is asked."""
    connection = http.client.HTTPConnection(service.listen, timeout=60)
    headers = {"Authorization": f"Bearer {service.key}", "Accept-Encoding": "gzip"}
    times = []
    for path in paths:
        begun = time.perf_counter()
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        body = answer.read()
        times.append((time.perf_counter() - begun) * 1e3)
        assert answer.status == 200, (path, answer.status, body[:300])
        encoding = answer.headers.get("Content-Encoding")
        assert encoding == "gzip" or (encoding is None and not compressed), (path, encoding)
        check(json.loads(gzip.decompress(body) if encoding else body))
    return sorted(times)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--database", help="a Postgres database, postgres://…; SQLite where it is not given")
    parser.add_argument("--side", type=int, default=1000, help="modules along each side of the large plant")
    args = parser.parse_args()
    rng = random.Random(1)
    name = "Postgres" if args.database else "SQLite"
    with tempfile.TemporaryDirectory(prefix="heliomap-query-") as folder:
        data = Path(folder)
        with Service(data, "--no-worker", "--max-requests-per-second", "100000", database=args.database) as service:
            client = Client(service.url, service.key)
            large, small = (client.create_plant(plant)["id"] for plant in ("large", "small"))
        rows = Rows(data, args.database)
        begun = time.monotonic()
        some = rows.model(large, args.side, args.side, rng)
        rows.model(small, *WHOLE, rng)
        rows.finish()
        print(f"{name}: {args.side**2} modules written in {time.monotonic() - begun:.0f} s", flush=True)
        with service.again():
            counts: list[int] = []
            side = math.isqrt(1000)

            def box() -> str:
                west = WEST_END + rng.randrange(args.side - side) * EAST
                south = SOUTH_END + rng.randrange(args.side - side) * NORTH
                bounds = f"{west},{south},{west + (side - 0.5) * EAST},{south + (side - 0.5) * NORTH}"
                return f"/api/v1/plants/{large}/models/latest/modules?bbox={bounds}"

            def count(answer: dict) -> None:
                counts.append(len(answer["features"]))

            def whole(answer: dict) -> None:
                found = len(answer["features"])
                assert found == math.prod(WHOLE), found

            asked = [f"/api/v1/plants/{large}/modules/{rng.choice(some)}" for _ in range(2000)]
            all_of_small = f"/api/v1/plants/{small}/models/latest/modules"
            figures = {
                "module": measure(service, iter(asked), lambda answer: None, compressed=False),
                "box": measure(service, (box() for _ in range(500)), count, compressed=True),
                "plant": measure(service, (all_of_small for _ in range(200)), whole, compressed=True),
            }
            assert all(900 <= found <= 1100 for found in counts), (min(counts), max(counts))
    wrong = 0
    for what, times in figures.items():
        p50, p99 = (times[min(len(times) - 1, int(len(times) * share))] for share in (0.5, 0.99))
        holds = p99 < BOUNDS[what]
        wrong += not holds
        print(
            f"{name}: {what}: median {p50:.1f} ms, p99 {p99:.1f} ms, bound {BOUNDS[what]:.0f} ms: {'holds' if holds else 'DOES NOT HOLD'}"
        )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
