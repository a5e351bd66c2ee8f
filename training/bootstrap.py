"""Labels for real frames that nobody labelled: predict, fit each bench's lattice, keep what fits.

`python -m training.bootstrap --model models/unet.onnx --rows 3 --out labels.json [--overlay DIR]`

Every bench of the test flight has `--rows` rows of equal modules in one plane, so its modules are a lattice seen
through a homography. Boxes are linked to their neighbours, the homography is fitted robustly, and the labels are the
lattice's cells, not the boxes: single misses, merges and shifts vanish. A bench whose lattice does not fit is ignored
in training, as is everything else that looks like a module. The northernmost line of the flight is for tests
(`--part test`), the one before it for neither: photos of next lines overlap, and a bench must not be in both.
"""

from __future__ import annotations

import argparse
import json
from collections import deque
from pathlib import Path

import cv2
import numpy as np

from . import sources
from .augment import transform
from .evaluate import detect
from .postprocess import Box, touches_frame
from .runner import Runner
from .sources import Photo

FACE = 0.985  # side of a face against the pitch of the lattice


def split(part: str) -> list[Path]:
    """Frames by the northing of their camera, cut between flight lines."""
    root = sources.data_root() / "missouri-west"
    shots = json.loads((root / "reconstruction.json").read_text())[0]["shots"]
    north = {}
    for name, shot in shots.items():
        r, _ = cv2.Rodrigues(np.array(shot["rotation"], dtype=np.float64))
        center = -r.T @ np.array(shot["translation"], dtype=np.float64)
        north[name] = center[1]
    names = sorted(north, key=lambda n: north[n])
    lo, hi = (0.0, 0.68) if part == "train" else (0.84, 1.0)
    chosen = names[int(lo * len(names)) : int(hi * len(names))]
    return [root / "images" / n for n in sorted(chosen) if (root / "images" / n).exists()]


def index_lattices(found: list[Box]) -> list[dict[int, tuple[int, int]]]:
    """Groups of boxes with their integer positions along u and v."""
    centers = np.array([b.center for b in found])
    flip = np.array([1.0 if b.u[np.argmax(np.abs(found[0].u))] * found[0].u[np.argmax(np.abs(found[0].u))] > 0 else -1.0 for b in found])
    u = np.array([b.u for b in found]) * flip[:, None]
    v = np.array([b.v for b in found])
    v = v * np.where(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] > 0, 1.0, -1.0)[:, None]
    mu, mv = np.median(u, axis=0), np.median(v, axis=0)
    basis = np.linalg.inv(np.stack([mu, mv], axis=1))
    groups, seen = [], set()
    for start in range(len(found)):
        if start in seen:
            continue
        group, queue = {start: (0, 0)}, deque([start])
        seen.add(start)
        while queue:
            a = queue.popleft()
            rel = (centers - centers[a]) @ basis.T
            for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                d = np.abs(rel - np.array(step) * 1.02).max(axis=1)
                b = int(np.argmin(d))
                if d[b] < 0.3 and b not in seen:
                    seen.add(b)
                    group[b] = (group[a][0] + step[0], group[a][1] + step[1])
                    queue.append(b)
        groups.append(group)
    return groups


def label_frame(photo: Photo, found: list[Box], prob: np.ndarray, rows: int) -> tuple[list, list, int]:
    """Quads, ignored polygons, and how many benches were refused."""
    h, w = photo.image.shape[:2]
    whole = [b for b in found if not touches_frame(b, w, h, -1.0)]
    quads, taken, refused = [], np.zeros((h, w), np.uint8), 0
    for group in index_lattices(whole) if len(whole) > 5 else []:
        if len(group) < 3 * rows:
            continue
        ids = list(group)
        grid = np.array([group[i] for i in ids], dtype=np.float64)
        px = np.array([whole[i].center for i in ids])
        short = np.median([np.hypot(*whole[i].v) for i in ids])
        hom, ok = cv2.findHomography(grid, px, cv2.RANSAC, 0.12 * short, maxIters=2000, confidence=0.999)
        if hom is None or ok.mean() < 0.75:
            refused += 1
            continue
        ok = ok.ravel().astype(bool)
        across = [j for j in np.unique(grid[ok, 1]) if (grid[ok, 1] == j).sum() >= 3]
        if len(across) != rows:
            refused += 1
            continue
        hom, _ = cv2.findHomography(grid[ok], px[ok], 0)
        residual = np.linalg.norm(transform(grid[ok], hom) - px[ok], axis=1)
        if np.median(residual) > 0.06 * short:
            refused += 1
            continue
        lo, hi = int(grid[ok, 0].min()), int(grid[ok, 0].max())
        half = FACE / 2

        def column(i: int) -> bool:
            """Labels one column; whether any of its cells is a module within the frame."""
            some = False
            for j in across:
                cell = np.array([[i - half, j - half], [i + half, j - half], [i + half, j + half], [i - half, j + half]])
                q = transform(cell, hom)
                if not np.isfinite(q).all() or (q.max(axis=0) < 0).any() or (q.min(axis=0) > (w, h)).any():
                    continue
                mask = np.zeros((h, w), np.uint8)
                cv2.fillConvexPoly(mask, np.round(q * 16).astype(np.int32), 1, cv2.LINE_8, 4)
                if mask.sum() < 4 or prob[0][mask > 0].mean() < 0.6 or taken[mask > 0].mean() > 0.3:
                    continue  # past the end of the bench
                taken[mask > 0] = 1
                quads.append(np.round(q, 2).tolist())
                some = True
            return some

        for i in range(lo, hi + 1):
            column(i)
        # On from both ends, as far as the frame goes or the bench does.
        for start, step in ((lo - 1, -1), (hi + 1, 1)):
            i = start
            while abs(i - start) < 4 and column(i):
                i += step
    # What looks like a module and is none of the lattices': not labelled, so not counted.
    rest = ((prob[0] > 0.35) & (cv2.dilate(taken, np.ones((7, 7), np.uint8)) == 0)).astype(np.uint8)
    rest = cv2.dilate(cv2.morphologyEx(rest, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)), np.ones((9, 9), np.uint8))
    contours, _ = cv2.findContours(rest, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    ignore = []
    for c in contours:
        # Small or faint blobs are ground: they stay in as what the network must unlearn.
        mask = np.zeros((h, w), np.uint8)
        cv2.drawContours(mask, [c], -1, 1, -1)
        strong = (prob[0] > 0.7) & (mask > 0)
        if len(c) > 2 and strong.sum() > (0.5 * np.median([b.area for b in found]) if found else 200):
            ignore.append(c[:, 0].tolist())
    return quads, ignore, refused


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--model", type=Path, default=Path("models/unet.onnx"))
    p.add_argument("--rows", type=int, default=3)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--part", choices=("train", "test"), default="train")
    p.add_argument("--every", type=int, default=1, help="take every n-th frame")
    p.add_argument("--overlay", type=Path)
    p.add_argument("--threads", type=int, default=2)
    a = p.parse_args()
    cv2.setNumThreads(a.threads)
    runner = Runner(a.model, a.threads)
    labels, refused = {}, 0
    for path in split(a.part)[:: a.every]:
        photo = Photo(path.name, sources.read_rgb(path), np.zeros((0, 4, 2)))
        found, prob = detect(runner, photo)
        quads, ignore, bad = label_frame(photo, found, prob, a.rows)
        refused += bad
        if len(quads) < 6:
            continue
        labels[path.name] = {"modules": quads, "ignore": ignore}
        if a.overlay:
            a.overlay.mkdir(parents=True, exist_ok=True)
            img = cv2.cvtColor(photo.image, cv2.COLOR_RGB2BGR)
            for q in quads:
                cv2.polylines(img, [np.round(np.array(q) * 16).astype(np.int32)], True, (0, 255, 0), 1, cv2.LINE_AA, 4)
            for q in ignore:
                cv2.polylines(img, [np.array(q, dtype=np.int32)], True, (0, 0, 255), 1)
            cv2.imwrite(str(a.overlay / f"{path.stem}.png"), img)
    a.out.write_text(json.dumps(labels))
    print(f"{len(labels)} frames, {sum(len(v['modules']) for v in labels.values())} modules, {refused} benches refused")


if __name__ == "__main__":
    main()
