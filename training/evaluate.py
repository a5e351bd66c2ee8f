"""Measures a model: `python -m training.evaluate --model models/unet.onnx [--card models/unet.md]`.

Recall, precision at IoU 0.5 of oriented boxes against the modules wholly inside the frame (what is cut by the frame
or lies in an ignored area counts neither way), mean IoU, median centre error, splits, merges, per plant and frame, and on
the validation plants per condition. Modules under glare count apart.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from . import instances, sources
from .card import GLARE_SHARE, write_card
from .postprocess import Box, boxes, overlap, quad_area, touches_frame
from .runner import Runner, resample
from .sources import Photo
from .targets import CORE_SHRINK, GSD, GSD_RANGE


FACE_T, ERODE = 0.99, 1  # of the comparison by morphology: what does best on the validation plants
GLARE_LEVEL = 240  # of all three channels
MODULE_PX = 24.0  # short side of a module to which photos are scaled that have no camera

# Conditions of a rendered plant by which the validation is told apart.
CONDITIONS = {
    "dusty": lambda c: c["dirt"] > 0.1,
    "low sun (below 25 degrees)": lambda c: c["sun"]["elevation"] < 25,
    "haze": lambda c: c["finish"]["haze"] > 0.05,
    "blurred": lambda c: c["finish"]["blur"] > 0.7,
    "motion blur": lambda c: c["finish"]["motion"] > 0,
    "noisy": lambda c: c["finish"]["noise"] > 3,
}


@dataclass
class Score:
    """Counts of one photo, or sums over many."""

    truth: int = 0
    found: int = 0
    boxes: int = 0
    false: int = 0
    splits: int = 0
    merges: int = 0
    ious: list[float] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    worst: float = 1.0
    glared: int = 0
    glared_found: int = 0

    def add(self, o: "Score") -> None:
        for k in ("truth", "found", "boxes", "false", "splits", "merges", "glared", "glared_found"):
            setattr(self, k, getattr(self, k) + getattr(o, k))
        self.ious += o.ious
        self.errors += o.errors
        if o.truth:
            self.worst = min(self.worst, o.recall)

    @property
    def recall(self) -> float:
        return self.found / self.truth if self.truth else 1.0

    @property
    def precision(self) -> float:
        return 1 - self.false / self.boxes if self.boxes else 1.0

    def row(self) -> dict:
        return {
            "modules": self.truth,
            "recall": round(100 * self.recall, 2),
            "worst": round(100 * self.worst, 2),
            "precision": round(100 * self.precision, 2),
            "iou": round(float(np.mean(self.ious)), 3) if self.ious else None,
            "center_px": round(float(np.median(self.errors)), 3) if self.errors else None,
            "splits": self.splits,
            "merges": self.merges,
            "glared": self.glared,
            "glared_found": self.glared_found,
        }


def inside(quads: np.ndarray, w: int, h: int) -> np.ndarray:
    return ((quads >= -0.5) & (quads <= np.array([w - 0.5, h - 0.5]))).all(axis=(1, 2))


def under_glare(photo: Photo) -> np.ndarray:
    """Modules of whose pixels more than GLARE_SHARE are saturated."""
    white = (photo.image.min(axis=2) >= GLARE_LEVEL).astype(np.uint8)
    out = np.zeros(len(photo.quads), bool)
    h, w = white.shape
    for i, q in enumerate(photo.quads):
        x0, y0 = np.clip(np.floor(q.min(axis=0)).astype(int), 0, (w - 1, h - 1))
        x1, y1 = np.clip(np.ceil(q.max(axis=0)).astype(int) + 1, 1, (w, h))
        mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
        if mask.size:
            cv2.fillConvexPoly(mask, np.round((q - (x0, y0)) * 16).astype(np.int32), 1, cv2.LINE_8, 4)
            out[i] = (white[y0:y1, x0:x1] * mask).sum() > GLARE_SHARE * max(1, mask.sum())
    return out


def compare(photo: Photo, found: list[Box], scale: float = 1.0) -> Score:
    """Greedy matching by IoU. Boxes are in the photo's own pixels."""
    h, w = photo.image.shape[:2]
    ins = inside(photo.quads, w, h)
    found = [b for b in found if not touches_frame(b, w, h)]
    glare = under_glare(photo)
    s = Score(truth=int((ins & ~glare).sum()), glared=int((ins & glare).sum()))
    centers = photo.quads.mean(axis=1) if len(photo.quads) else np.zeros((0, 2))
    pairs = []
    for j, b in enumerate(found):
        c = b.corners
        area = quad_area(c)
        near = np.nonzero(np.linalg.norm(centers - b.center, axis=1) < 1.5 * b.length)[0]
        covered = 0
        for i in near:
            q = photo.quads[i]
            a = quad_area(q)
            x = overlap(q, c)
            covered += x > 0.5 * a
            pairs.append((x / (a + area - x), i, j))
        s.merges += covered > 1
    pairs.sort(reverse=True)
    used_i, used_j = set(), set()
    for iou, i, j in pairs:
        if iou < 0.5 or i in used_i or j in used_j:
            continue
        used_i.add(i)
        used_j.add(j)
        if ins[i] and glare[i]:
            s.glared_found += 1
        elif ins[i]:
            s.found += 1
            s.boxes += 1
            s.ious.append(iou)
            s.errors.append(float(np.linalg.norm(centers[i] - found[j].center)))
    for j, b in enumerate(found):
        if j in used_j:
            continue
        p = (float(b.center[0]), float(b.center[1]))
        if any(cv2.pointPolygonTest(g.astype(np.float32), p, False) >= 0 for g in photo.ignore):
            continue
        hit = [i for _, i, k in pairs if k == j and cv2.pointPolygonTest(photo.quads[i].astype(np.float32), p, False) >= 0]
        if hit and (glare[hit[0]] or not ins[hit[0]]):
            continue  # on a module that the frame cuts, or that has no outline to be compared with
        s.boxes += 1
        s.false += 1
    for i in np.nonzero(ins & ~glare)[0]:
        q = photo.quads[i].astype(np.float32)
        s.splits += sum(cv2.pointPolygonTest(q, (float(b.center[0]), float(b.center[1])), False) >= 0 for b in found) > 1
    s.worst = s.recall
    return s


def detect(runner: Runner, photo: Photo, scale: float = 1.0, shrink: float = CORE_SHRINK) :
    """Boxes in the photo's own pixels, and what the network said at the working scale."""
    image = resample(photo.image, scale)
    out = runner(image)
    found = boxes(out, shrink) if runner.kind == "unet" else instances.boxes(*out)
    size = np.array(photo.image.shape[1::-1]) / np.array(image.shape[1::-1])
    for b in found:
        b.center = (b.center + 0.5) * size - 0.5
        b.u, b.v = b.u * size, b.v * size
    return found, out


def morphology(runner: Runner, photo: Photo, scale: float = 1.0) -> tuple[list[Box], np.ndarray]:
    """Boxes from the face mask alone, the paper's way: threshold, erosion, segments, rectangles, dilation. For comparison."""
    image = resample(photo.image, scale)
    prob = runner(image)
    mask = cv2.erode((prob[0] > FACE_T).astype(np.uint8), np.ones((2 * ERODE + 1,) * 2, np.uint8))
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    size = np.array(photo.image.shape[1::-1]) / np.array(image.shape[1::-1])
    found = []
    for c in contours:
        (x, y), (w, h), angle = cv2.minAreaRect(c)
        if len(c) < 5 or min(w, h) < 2:
            continue
        a = np.deg2rad(angle)
        # A pixel for the outline through the pixels' centres, two for each step of erosion.
        u, v = np.array([np.cos(a), np.sin(a)]) * (w + 1 + 2 * ERODE), np.array([-np.sin(a), np.cos(a)]) * (h + 1 + 2 * ERODE)
        u, v = (u, v) if w >= h else (v, -u)
        found.append(Box((np.array([x, y]) + 0.5) * size - 0.5, u * size, v * size, 1.0))
    median = np.median([b.area for b in found]) if found else 0
    return [b for b in found if 0.45 * median < b.area < 2 * median], prob


def working_scale(gsd: float | None) -> float:
    """Photos within the liked range run as they are, others at the working distance."""
    if gsd is None or GSD_RANGE[0] <= gsd <= GSD_RANGE[1]:
        return 1.0
    return gsd / GSD


def overlay(photo: Photo, found: list[Box], path: Path, truth: bool = True) -> None:
    """Draws boxes (green) over the photo, missed modules in red."""
    img = cv2.cvtColor(photo.image, cv2.COLOR_RGB2BGR).copy()
    h, w = img.shape[:2]
    if truth and len(photo.quads):
        for q, ok in zip(photo.quads, inside(photo.quads, w, h)):
            if ok and not any(cv2.pointPolygonTest(q.astype(np.float32), (float(b.center[0]), float(b.center[1])), False) >= 0 for b in found):
                cv2.polylines(img, [np.round(q * 16).astype(np.int32)], True, (0, 0, 255), 2, cv2.LINE_AA, 4)
    for b in found:
        color = (0, 255, 0) if not touches_frame(b, w, h) else (255, 160, 0)
        cv2.polylines(img, [np.round(b.corners * 16).astype(np.int32)], True, color, 1, cv2.LINE_AA, 4)
        cv2.circle(img, tuple(np.round(b.center).astype(int).tolist()), 1, (0, 255, 255), -1)
    cv2.imwrite(str(path), img)


def validation(runner: Runner, find=detect) -> dict[str, dict]:
    """Rows of the validation plants: all, per style, per condition, per size of a module."""
    sums: dict[str, Score] = {"all": Score()}
    for photo in sources.renders("validation"):
        scale = working_scale(photo.gsd)
        found, _ = find(runner, photo, scale)
        score = compare(photo, found)
        px = photo.module_px * scale
        size = "under 16 px" if px < 16 else "16 to 26 px" if px < 26 else "26 px and more"
        names = ["all", photo.conditions["style"], f"short side {size}"]
        names += [name for name, holds in CONDITIONS.items() if holds(photo.conditions)]
        for name in names:
            sums.setdefault(name, Score()).add(score)
    return {name: sums[name].row() for name in sorted(sums)}


def scaled(photos: list[Photo], scale: float | None = None) -> list[tuple[Photo, float]]:
    """Photos with the scale at which each is run: the given one, or that of the working distance."""
    return [(p, working_scale(p.gsd) if scale is None else scale) for p in photos]


def test_sets() -> dict[str, Callable[[], list[tuple[Photo, float]]]]:
    """Name of the set to what loads its photos, with the scale at which each is run."""
    sets = {f"train/{f.name}": lambda f=f: scaled(sources.load_render(f)) for f in sources.render_folders("test")}
    example = sources.data_root() / "example"
    if (example / "truth.json").exists():
        sets["example"] = lambda: scaled(sources.load_render(example))
    # The real frames are far sharper than the working distance: halved and at a third.
    sets["real held out, 1/2"] = lambda: scaled(sources.real_frames(test=True), 0.5)
    sets["real held out, 1/3"] = lambda: scaled(sources.real_frames(test=True), 1 / 3)
    sets["missouri-west, northern line"] = lambda: scaled(sources.west_test(), 1.0)
    sets["real-solarseg, second tile, 1/2"] = lambda: scaled(sources.orthophotos(test=True), 0.5)
    sets["flight-halfcut"] = lambda: scaled(sources.halfcut_flight())
    # For validation, not for tests. No camera tells the scale: modules are brought to MODULE_PX.
    for name in sources.names_of("real-halfcut"):
        sets[f"real-halfcut (validation), {Path(name).stem}"] = lambda name=name: [
            (p, MODULE_PX / p.module_px) for p in sources.own_labels("real-halfcut", [name])
        ]
    return sets


def speed(runner: Runner) -> float:
    """Processor time in seconds per megapixel of one thread, best of four: other programs beside change it little."""
    x = np.random.default_rng(0).integers(0, 255, (896, 1344, 3), dtype=np.uint8)
    runner(x)
    times = []
    for _ in range(4):
        begun = time.process_time()
        runner(x)
        times.append(time.process_time() - begun)
    return min(times) / (x.shape[0] * x.shape[1] / 1e6)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--model", type=Path, default=Path("models/unet.onnx"), help=".onnx, or a checkpoint .pt")
    p.add_argument("--kind", choices=("unet", "yolo"), default="unet", help="of a checkpoint")
    p.add_argument("--card", type=Path, help="write the model card here")
    p.add_argument("--overlay", type=Path, help="write overlays into this folder")
    p.add_argument("--validation", action="store_true", help="only the validation plants")
    p.add_argument("--morphology", action="store_true", help="boxes from the face mask alone, for comparison")
    p.add_argument("--only", help="only sets whose name contains this")
    p.add_argument("--threads", type=int, default=2)
    a = p.parse_args()
    cv2.setNumThreads(a.threads)
    runner = Runner(a.model, a.threads, a.kind)
    find = morphology if a.morphology else detect
    rows: dict[str, dict] = {}
    conditions = validation(runner, find) if a.validation or a.card else {}
    for name, row in conditions.items():
        print(f"validation, {name}", json.dumps(row), flush=True)
    if a.validation:
        return
    for name, load in test_sets().items():
        photos = load() if not a.only or a.only in name else []
        if not photos:
            continue
        total = Score()
        for photo, scale in photos:
            found, _ = find(runner, photo, scale)
            total.add(compare(photo, found))
            if a.overlay:
                a.overlay.mkdir(parents=True, exist_ok=True)
                overlay(photo, found, a.overlay / f"{name}-{Path(photo.name).stem}.png".replace("/", "_").replace(" ", "_"))
        rows[name] = total.row()
        print(name, json.dumps(rows[name]), flush=True)
    per_mp = speed(Runner(a.model, 1, a.kind))
    print(f"{per_mp:.3f} s of processor time per megapixel, one thread")
    if a.card:
        write_card(a.card, a.model, runner.meta, rows, conditions, per_mp)


if __name__ == "__main__":
    main()
