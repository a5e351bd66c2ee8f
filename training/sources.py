"""Photos with polygons: rendered plants, hand-labelled real frames, self-labelled frames.

The data folder is named by the environment variable HELIOMAP_DATA and holds `example/`, `train/`,
`real-labelled/`, `missouri-west/` and `real-solarseg/`.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

TEST_PLANTS = ("10", "11", "12", "13")
VALIDATION_PLANTS = ("18", "23", "26", "33", "34", "39", "44", "46", "54")
TEST_FRAMES = ("tsukuba_vegetation.jpg",)
ORTHOPHOTOS = ("solarseg_1.jpg",)  # the other tile is for tests


@dataclass
class Photo:
    """An RGB photo, the modules' quadrilaterals (n, 4, 2) in pixels (centres at whole numbers), ignored areas."""

    name: str
    image: np.ndarray
    quads: np.ndarray
    ignore: list[np.ndarray] = field(default_factory=list)
    conditions: dict = field(default_factory=dict)
    gsd: float | None = None  # metres per pixel where known

    @property
    def module_px(self) -> float:
        """Median short side of a module in pixels."""
        if len(self.quads) == 0:
            return 20.0
        a = np.linalg.norm(self.quads[:, 1] - self.quads[:, 0], axis=1)
        b = np.linalg.norm(self.quads[:, 2] - self.quads[:, 1], axis=1)
        return float(np.median(np.minimum(a, b)))


def data_root() -> Path:
    root = os.environ.get("HELIOMAP_DATA")
    if not root:
        raise SystemExit("set HELIOMAP_DATA to the folder that holds example/, train/, real-labelled/, missouri-west/")
    return Path(root)


def read_rgb(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise SystemExit(f"cannot read {path}")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def project(points: np.ndarray, shot: dict, camera: dict, width: int, height: int) -> np.ndarray:
    """World points (n, 3) to pixels of a width x height photo (Brown model with k1, k2); NaN behind the camera."""
    p = (points - np.asarray(shot["center"])) @ np.asarray(shot["R"]).T
    z = np.where(p[:, 2] > 0.5, p[:, 2], np.nan)
    x, y = p[:, 0] / z, p[:, 1] / z
    r2 = x * x + y * y
    # Far outside the frame the polynomial folds back into it: keep only what lies within reach of the lens.
    f = camera["focal_norm"] * max(width, height)
    reach = 1.3 * np.hypot(width, height) / 2 / f
    s = np.where(r2 < reach * reach, 1 + camera.get("k1", 0.0) * r2 + camera.get("k2", 0.0) * r2 * r2, np.nan)
    return np.stack([f * s * x + width / 2 - 0.5, f * s * y + height / 2 - 0.5], axis=1)


def visible(quads: np.ndarray, width: int, height: int) -> np.ndarray:
    """Quads that touch the frame."""
    if len(quads) == 0:
        return quads.reshape(0, 4, 2)
    ok = np.isfinite(quads).all(axis=(1, 2))
    quads = quads[ok]
    lo, hi = quads.min(axis=1), quads.max(axis=1)
    return quads[(hi[:, 0] > 0) & (hi[:, 1] > 0) & (lo[:, 0] < width - 1) & (lo[:, 1] < height - 1)]


def load_render(folder: Path) -> list[Photo]:
    truth = json.loads((folder / "truth.json").read_text())
    corners = np.array([m["corners"] for m in truth["modules"]], dtype=np.float64).reshape(-1, 3)
    photos = []
    for shot in truth["shots"]:
        path = folder / "images" / shot["name"]
        if not path.exists():
            continue
        image = read_rgb(path)
        h, w = image.shape[:2]
        quads = project(corners, shot, truth["camera"], w, h).reshape(-1, 4, 2)
        height = shot["center"][2] - float(corners[:, 2].mean())
        photos.append(
            Photo(
                f"{folder.name}/{shot['name']}",
                image,
                visible(quads, w, h),
                conditions=truth.get("conditions") or {},
                gsd=height / (truth["camera"]["focal_norm"] * max(w, h)),
            )
        )
    return photos


def load_labelled(folder: Path, labels: dict, names: list[str]) -> list[Photo]:
    photos = []
    for name in names:
        entry = labels[name]
        path = folder / name
        if not path.suffix:
            path = path.with_suffix(".jpg")
        quads = np.array(entry["modules"], dtype=np.float64).reshape(-1, 4, 2)
        ignore = [np.array(p, dtype=np.float64) for p in entry.get("ignore", [])]
        photos.append(Photo(f"{folder.name}/{name}", read_rgb(path), quads, ignore))
    return photos


def real_frames(test: bool) -> list[Photo]:
    folder = data_root() / "real-labelled"
    labels = json.loads((folder / "labels.json").read_text())
    held = {Path(n).stem for n in TEST_FRAMES}
    names = [n for n in sorted(labels) if (Path(n).stem in held) == test]
    return load_labelled(folder, labels, names)


def names_of(folder: str) -> list[str]:
    """Photos of a folder of the data that are there and have labels kept beside this file."""
    labels = json.loads((Path(__file__).with_name("labels") / f"{folder}.json").read_text())
    return [n for n in sorted(labels) if (data_root() / folder / n).exists()]


def own_labels(folder: str, names: list[str]) -> list[Photo]:
    labels = json.loads((Path(__file__).with_name("labels") / f"{folder}.json").read_text())
    return load_labelled(data_root() / folder, labels, names)


def orthophotos(test: bool) -> list[Photo]:
    return own_labels("real-solarseg", [n for n in names_of("real-solarseg") if (n in ORTHOPHOTOS) != test])


def halfcut_flight() -> list[Photo]:
    """A rendered flight over half-cut modules with black frames, for tests alone."""
    folder = data_root() / "flight-halfcut"
    return load_render(folder) if (folder / "truth.json").exists() else []


def render_folders(part: str) -> list[Path]:
    """Folders of the rendered plants of a part: `train`, `validation` (thresholds are chosen there) or `test`."""
    folders = sorted(p for p in (data_root() / "train").iterdir() if (p / "truth.json").exists())
    parts = {name: "test" for name in TEST_PLANTS} | {name: "validation" for name in VALIDATION_PLANTS}
    return [p for p in folders if parts.get(p.name, "train") == part]


def renders(part: str) -> list[Photo]:
    return [photo for folder in render_folders(part) for photo in load_render(folder)]


def west_test() -> list[Photo]:
    """Test frames of missouri-west with the labels kept in this folder."""
    path, root = Path(__file__).with_name("labels") / "missouri-west-test.json", data_root() / "missouri-west" / "images"
    if not path.exists() or not root.exists():
        return []
    labels = json.loads(path.read_text())
    return load_labelled(root, labels, sorted(labels))


def self_labelled(path: str | None) -> list[Photo]:
    """Frames of missouri-west with labels written by `training.bootstrap` (see README)."""
    if not path or not Path(path).exists():
        return []
    labels = json.loads(Path(path).read_text())
    return load_labelled(data_root() / "missouri-west" / "images", labels, sorted(labels))
