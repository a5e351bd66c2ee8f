#!/usr/bin/env python3
"""Makes a fixture of one version of heliomap, for the test that later versions take over its data.

    heliomap detect examples/plant --detector models/unet-int8.onnx --out boxes.json
    tests/with-postgres.sh python tests/server/upgrade/make.py --binary heliomap --example examples/plant --models models \\
        --boxes boxes.json --out FOLDER --pack tests/server/upgrade/VERSION.tar.gz

Needs Pillow and the program of that version. For SQLite and for Postgres each: two organisations, keys of every scope, one of
them revoked, a plant whose survey was mapped from boxes to a model, a webhook with a message that did not arrive, a job that
waits in the queue, and a job whose worker was killed after it had stored checkpoints of some images. Writes

    sqlite/data/        the data folder
    sqlite/backup/      the result of `heliomap backup`
    postgres/dump.sql   the database, by `pg_dump --format=plain`
    postgres/data/      the blobs that belong to it
    expected.json       secrets of the keys (of this fixture alone), identifiers, and answers of that version

and packs them into one archive, in which equal files are stored once.
"""

import argparse
import hashlib
import io
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import tarfile
import time
import urllib.error
import urllib.request
from pathlib import Path

from PIL import Image, ImageFilter

# Photos are made small enough for a repository; the test needs their rows and bytes, not a good picture.
JPEG_QUALITY = 6
BLUR_PX = 1.5
# Every n-th point of the reconstruction is kept.
POINTS_STEP = 8
# Number of processed images after which the worker is killed.
CHECKPOINTS = 2


def rounded(value):
    """Boxes with corners to 0.1 px: fewer digits, smaller files."""
    if isinstance(value, float):
        return round(value, 1)
    if isinstance(value, list):
        return [rounded(item) for item in value]
    if isinstance(value, dict):
        return {name: rounded(item) for name, item in value.items()}
    return value


def small_survey(example: Path, boxes: bytes) -> dict[str, bytes]:
    """The example survey, by path."""
    boxes = json.dumps(rounded(json.loads(boxes)), separators=(",", ":")).encode()
    files = {"boxes.json": boxes, "reference_lla.json": (example / "reference_lla.json").read_bytes()}
    reconstructions = json.loads((example / "reconstruction.json").read_bytes())
    for reconstruction in reconstructions:
        points = sorted(reconstruction["points"].items())
        reconstruction["points"] = dict(points[::POINTS_STEP])
    files["reconstruction.json"] = json.dumps(reconstructions, separators=(",", ":")).encode()
    for path in sorted((example / "images").iterdir()):
        photo = Image.open(path)
        small = io.BytesIO()
        blurred = photo.filter(ImageFilter.GaussianBlur(BLUR_PX))
        blurred.save(small, "JPEG", quality=JPEG_QUALITY, exif=photo.info["exif"])
        files[f"images/{path.name}"] = small.getvalue()
    return files


class Service:
    """A running heliomap."""

    def __init__(self, args: argparse.Namespace, storage: list[str], flags: list[str], log: Path):
        command = [args.binary, "serve", "--listen", "127.0.0.1:0", *storage, *flags]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log.open("a"), text=True)
        line = self.process.stdout.readline()
        self.url = line.split()[-1].rstrip("/") + "/api/v1"

    def call(self, key: str, method: str, path: str, body: bytes | dict | None = None):
        headers = {"Authorization": f"Bearer {key}"}
        if isinstance(body, dict):
            body, headers["Content-Type"] = json.dumps(body).encode(), "application/json"
        request = urllib.request.Request(self.url + path, data=body, method=method, headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=120) as answer:
                return json.loads(answer.read() or b"null")
        except urllib.error.HTTPError as error:
            raise SystemExit(f"{method} {path}: {error.read().decode()}") from error

    def stop(self, how: int) -> None:
        self.process.send_signal(how)
        self.process.wait()


def upload(service: Service, key: str, survey: str, files: dict[str, bytes]) -> None:
    for path, content in files.items():
        place = path if path.startswith("images/") else f"reconstruction/{path}"
        service.call(key, "PUT", f"{survey}/{place}", content)


def make(args: argparse.Namespace, out: Path, database: str | None) -> dict:
    """Fills a database and the data folder beside it; returns what a later version must answer."""
    data = out / "data"
    data.mkdir(parents=True)
    storage = ["--data-dir", str(data)] + (["--database", database] if database else [])
    detector = ["--detector", f"{args.models}/unet-int8.onnx"]
    log = out / "log"

    def command(*words: str) -> str:
        made = subprocess.run([args.binary, *words, *storage], check=True, stdout=subprocess.PIPE, text=True)
        return made.stdout.strip()

    keys = {
        scope: command("keys", "create", "--organisation", "Acme", "--scope", scope, "--name", f"the {scope} key")
        for scope in ["read", "upload", "review", "admin"]
    }
    keys["other organisation"] = command("keys", "create", "--scope", "admin", "--name", "operator")
    keys["revoked"] = command("keys", "create", "--organisation", "Acme", "--scope", "read", "--name", "revoked")
    service = Service(args, storage, [*detector, "--webhook-private-targets"], log)
    admin, uploads = keys["admin"], keys["upload"]
    listed = service.call(admin, "GET", "/keys")["items"]
    revoked = next(key["id"] for key in listed if key["name"] == "revoked")
    service.call(admin, "DELETE", f"/keys/{revoked}")

    plant = service.call(admin, "POST", "/plants", {"name": "Solar park Höhe"})["id"]
    other = service.call(keys["other organisation"], "POST", "/plants", {"name": "Of others"})["id"]
    webhook = service.call(admin, "POST", "/webhooks", {"url": "http://127.0.0.1:9/hook", "plant": plant})

    def survey(name: str) -> str:
        made = service.call(uploads, "POST", f"/plants/{plant}/surveys", {"name": name})
        return f"/plants/{plant}/surveys/{made['id']}"

    def job(of: str) -> dict:
        return service.call(uploads, "POST", f"{of}/jobs", {})

    def state(of: dict) -> dict:
        return service.call(admin, "GET", f"/plants/{plant}/jobs/{of['id']}")

    mapped, interrupted, queued = survey("Mapped"), survey("Interrupted"), survey("Queued")
    upload(service, uploads, mapped, args.files)
    done = job(mapped)
    while state(done)["state"] not in ("succeeded", "failed"):
        time.sleep(0.2)
    if state(done)["state"] != "succeeded":
        raise SystemExit(f"the survey was not mapped: {state(done)}")
    # Without boxes: the detector takes a while, so that the worker can be killed meanwhile.
    for of in (interrupted, queued):
        upload(service, uploads, of, {path: content for path, content in args.files.items() if path != "boxes.json"})
    half = job(interrupted)
    while not (
        (state(half).get("progress") or {}).get("stage") == "detect" and state(half)["progress"]["done"] >= CHECKPOINTS
    ):
        time.sleep(0.05)
    # Checkpoints are stored about every second.
    time.sleep(2)
    service.stop(signal.SIGKILL)
    service = Service(args, storage, ["--no-worker", "--webhook-private-targets"], log)
    waiting = job(queued)
    answers = {}
    for path in [
        "/plants",
        f"/plants/{plant}",
        f"/plants/{plant}/surveys",
        mapped,
        f"{mapped}/images",
        f"/plants/{plant}/jobs",
        f"/plants/{plant}/models",
        f"/plants/{plant}/models/1/modules?limit=3",
        f"/plants/{plant}/models/1/benches?limit=3",
        "/webhooks",
        f"/webhooks/{webhook['id']}/deliveries",
        "/keys",
        "/audit?limit=200",
        "/usage",
    ]:
        try:
            answers[path] = service.call(admin, "GET", path)
        except SystemExit as problem:
            print(problem)
    service.stop(signal.SIGTERM)
    return {
        "keys": keys,
        "plant": plant,
        "plant_of_other_organisation": other,
        "surveys": {"mapped": mapped, "interrupted": interrupted, "queued": queued},
        "jobs": {"succeeded": done["id"], "interrupted": half["id"], "queued": waiting["id"]},
        "webhook": webhook,
        "answers": answers,
    }


def count_checkpoints(rows: list) -> None:
    if len(rows) < 1:
        raise SystemExit("the killed job has no checkpoints")
    print(f"{len(rows)} checkpoint(s) of the killed job")


def pack(folder: Path, archive: Path) -> None:
    """Packs a fixture; files with the same bytes become hard links."""
    first: dict[str, Path] = {}
    with tarfile.open(archive, "w:gz", compresslevel=9) as packed:
        for path in sorted(folder.rglob("*")):
            name = str(path.relative_to(folder))
            entry = packed.gettarinfo(path, name)
            entry.uid = entry.gid = 0
            entry.uname = entry.gname = ""
            if not path.is_file():
                packed.addfile(entry)
                continue
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            if digest in first:
                entry.type, entry.linkname, entry.size = tarfile.LNKTYPE, str(first[digest].relative_to(folder)), 0
                packed.addfile(entry)
                continue
            first[digest] = path
            entry.type = tarfile.REGTYPE
            entry.size = path.stat().st_size
            with path.open("rb") as content:
                packed.addfile(entry, content)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", required=True)
    parser.add_argument("--example", type=Path, required=True)
    parser.add_argument("--models", type=Path, required=True)
    parser.add_argument("--boxes", type=Path, required=True, help="output of `heliomap detect EXAMPLE`")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pack", type=Path, help="archive to write")
    args = parser.parse_args()
    args.files = small_survey(args.example, args.boxes.read_bytes())
    print({path: len(content) for path, content in args.files.items()})
    for name in ["sqlite", "postgres"]:
        shutil.rmtree(args.out / name, ignore_errors=True)
    expected = {"sqlite": make(args, args.out / "sqlite", None)}
    folder = args.out / "sqlite" / "data"
    rows = sqlite3.connect(folder / "heliomap.db")
    count_checkpoints(
        rows.execute("SELECT image FROM checkpoints").fetchall()
        if "image" in [c[1] for c in rows.execute("PRAGMA table_info(checkpoints)")]
        else rows.execute("SELECT name FROM checkpoints").fetchall()
    )
    rows.close()
    subprocess.run([args.binary, "backup", "--data-dir", folder, args.out / "sqlite" / "backup"], check=True)

    server = os.environ["HELIOMAP_TEST_POSTGRES"]
    programs = Path(os.environ["HELIOMAP_TEST_POSTGRES_BIN"])
    subprocess.run([programs / "createdb", f"--maintenance-db={server}/postgres", "fixture"], check=True)
    database = f"{server}/fixture"
    expected["postgres"] = make(args, args.out / "postgres", database)
    dump = subprocess.run(
        [programs / "pg_dump", "--format=plain", "--no-owner", "--no-privileges", database],
        check=True,
        stdout=subprocess.PIPE,
    ).stdout
    (args.out / "postgres" / "dump.sql").write_bytes(dump)
    lines = dump.decode().split("COPY public.checkpoints", 1)[1].split("\\.", 1)[0].splitlines()[1:]
    count_checkpoints(lines)
    (args.out / "expected.json").write_text(json.dumps(expected, indent=1, ensure_ascii=False) + "\n")
    for log in args.out.glob("*/log"):
        log.unlink()
    if args.pack:
        pack(args.out, args.pack)


if __name__ == "__main__":
    main()
