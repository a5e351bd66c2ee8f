"""A real heliomap service with a key, and the example survey with the boxes of its modules, for tests of clients."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
EXAMPLE = ROOT / "examples" / "plant"
BINARY = Path(os.environ.get("HELIOMAP_BINARY", ROOT / "target" / "debug" / "heliomap")).resolve()
SIZE = (1368, 912)
"""Width and height of the example's photos, pixels."""
EDGE_PX = 3.0
"""A module this close to the edge of a photo counts as cut."""


class Service:
    """A service on a free port of loopback and an empty data folder, with the secret of an administrator's key."""

    def __init__(self, data: Path, *arguments: str, database: str | None = None):
        self.environment = {**os.environ, "HELIOMAP_DATA_DIR": str(data), "HELIOMAP_LOG": "warn"}
        if database:
            self.environment["HELIOMAP_DATABASE"] = database
        create = [str(BINARY), "keys", "create", "--name", "test", "--scope", "admin"]
        self.key = subprocess.run(
            create, env=self.environment, check=True, capture_output=True, text=True
        ).stdout.strip()
        self.arguments = arguments
        self.listen = "127.0.0.1:0"
        self.start()

    def start(self) -> None:
        """Starts it; again, on the port that it had."""
        command = [str(BINARY), "serve", "--listen", self.listen, *self.arguments]
        self.process = subprocess.Popen(command, env=self.environment, stdout=subprocess.PIPE, text=True)
        line = self.process.stdout.readline()
        self.url = line.removeprefix("heliomap is listening on ").strip()
        assert self.url.startswith("http://"), f"it does not listen: {line}"
        self.listen = self.url.removeprefix("http://")

    def kill(self) -> None:
        """Kills it without a word."""
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()

    def again(self) -> Service:
        """Starts it after it has ended."""
        self.start()
        return self

    def __enter__(self) -> Service:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        try:
            self.process.wait(timeout=30)
        except subprocess.TimeoutExpired:
            self.kill()
        self.process.stdout.close()


def lay_out_example(folder: Path) -> None:
    """The example's files in a folder, and in `boxes.json` where its modules are, so that no detector need run."""
    shutil.copytree(EXAMPLE, folder, dirs_exist_ok=True)
    (folder / "boxes.json").write_text(json.dumps(true_boxes()))


def map_example(client, folder: Path, name: str) -> tuple[str, str, dict]:
    """Lays out the example in a folder, uploads it to a new plant of that name and maps it: plant, survey, the job's end.

    `client` is a `heliomap_client.Client`.
    """
    lay_out_example(folder)
    plant = client.create_plant(name)["id"]
    survey = client.create_survey(plant, "June")["id"]
    client.upload_folder(plant, survey, folder)
    job = client.follow(plant, client.start_job(plant, survey)["id"])
    assert job["state"] == "succeeded", job
    return plant, survey, job


def true_boxes() -> dict:
    """The modules in the undistorted photos that resolve them, from the true cameras: as tests/common/boxes.rs."""
    truth = json.loads((EXAMPLE / "truth.json").read_text())
    estimated = next(iter(json.loads((EXAMPLE / "reconstruction.json").read_text())[0]["cameras"].values()))
    true = truth["camera"]
    focal = max(SIZE)

    def pixel(shot: dict, corner: list[float]) -> list[float] | None:
        seen = [a - b for a, b in zip(corner, shot["center"])]
        x, y, z = (sum(r * s for r, s in zip(row, seen)) for row in shot["R"])
        if z <= 0:
            return None
        x, y = distorted(x / z, y / z, true["k1"], true["k2"])
        scale = true["focal_norm"] / estimated["focal"]
        x, y = straightened(x * scale, y * scale, estimated["k1"], estimated["k2"])
        u, v = (estimated["focal"] * focal * n + size / 2 - 0.5 for n, size in zip((x, y), SIZE))
        inside = all(EDGE_PX < at < size - 1 - EDGE_PX for at, size in zip((u, v), SIZE))
        return [u, v] if inside else None

    images = []
    for shot in truth["shots"]:
        if shot["role"] == "detection":
            found = ([pixel(shot, corner) for corner in module["corners"]] for module in truth["modules"])
            boxes = [{"corners": corners} for corners in found if all(corners)]
            images.append({"image": shot["name"], "width": SIZE[0], "height": SIZE[1], "boxes": boxes})
    return {"images": images}


def distorted(x: float, y: float, k1: float, k2: float) -> tuple[float, float]:
    """Where a lens draws a direction (Brown, two radial terms)."""
    r2 = x * x + y * y
    factor = 1 + k1 * r2 + k2 * r2 * r2
    return x * factor, y * factor


def straightened(x: float, y: float, k1: float, k2: float) -> tuple[float, float]:
    """The direction that a lens draws there, by iteration."""
    u, v = x, y
    for _ in range(20):
        r2 = u * u + v * v
        factor = 1 + k1 * r2 + k2 * r2 * r2
        u, v = x / factor, y / factor
    return u, v
