"""Probabilities to boxes: the reference of what the service does with the network's output.

1. Components (4-connected) of `core` > CORE_T. One that is far too large is cut at rising thresholds; one that rises
   only above CORE_LOW is taken in if it has the size of the others and stands near one.
2. Each component takes in its rim (one pixel, `core` > RIM_T). Moments are weighted by `core`.
3. A module is a parallelogram (a table seen at an angle is no rectangle). The second moments C of a parallelogram
   with edges u, v are (u u' + v v') / 12; C^(-1/2) turns it into a square, whose rotation phi follows from the
   fourth moment: arg E[(x + iy)^4] = pi + 4 phi. These complex moments are averaged over neighbours, for a blurred
   square of few pixels tells its rotation only faintly. Then u = sqrt(12) C^(1/2) (cos phi, sin phi), v likewise,
   both divided by the shrink factor. C^(1/2) is averaged likewise, over neighbours of about the same size. VAR_PIXEL, the variance of a pixel's own area, is taken off C first.
4. Boxes with little `module` inside, of a size far from the median (weighted by area), or overlapping a better one are
   dropped, and weak ones without a single neighbour where the lattice would have it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

CORE_T = 0.5
CORE_LOW = 0.3
LADDER = (0.65, 0.8, 0.9, 0.96)
RIM_T = 0.1
VAR_PIXEL = 1.0 / 12.0
MODULE_MIN = 0.5
SIZE_RANGE = (0.45, 2.0)  # area against the median
OVERLAP = 0.2
MIN_AREA = 6
ALONE = 0.9  # score from which a box needs no neighbour
LATTICE = 0.2  # tolerance of a neighbour's place, in modules
SIZE_SIGMA = 0.35  # of the logarithm of sizes, likewise
REACH = 2.0  # of the averaging over neighbours, in module sizes


@dataclass
class Box:
    """A parallelogram: centre and full edge vectors, `u` the longer."""

    center: np.ndarray
    u: np.ndarray
    v: np.ndarray
    score: float

    @property
    def length(self) -> float:
        return float(np.hypot(*self.u))

    @property
    def area(self) -> float:
        return float(abs(self.u[0] * self.v[1] - self.u[1] * self.v[0]))

    @property
    def corners(self) -> np.ndarray:
        u, v = self.u / 2, self.v / 2
        return self.center + np.array([-u - v, u - v, u + v, -u + v])


@dataclass
class Blob:
    """Moments of one component."""

    mass: float
    center: np.ndarray
    root: np.ndarray  # C^(1/2)
    fourth: complex  # of the whitened component
    score: float


def components(mask: np.ndarray):
    n, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return n, labels, stats


def blobs_of(core: np.ndarray, threshold: float) -> tuple[list[Blob], list[tuple]]:
    """Blobs of core > threshold and, for each, the window it lies in."""
    h, w = core.shape
    n, labels, stats = components(core > threshold)
    out, windows = [], []
    for i in range(1, n):
        if stats[i, cv2.CC_STAT_AREA] < MIN_AREA:
            continue
        x0, y0 = stats[i, 0] - 1, stats[i, 1] - 1
        x1, y1 = x0 + stats[i, 2] + 2, y0 + stats[i, 3] + 2
        x0, y0, x1, y1 = max(0, x0), max(0, y0), min(w, x1), min(h, y1)
        own = labels[y0:y1, x0:x1] == i
        foreign = (labels[y0:y1, x0:x1] > 0) & ~own
        p = core[y0:y1, x0:x1]
        rim = cv2.dilate(own.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & ~foreign & (p > RIM_T)
        out.append(blob(p, own | rim, x0, y0))
        windows.append((x0, y0, x1, y1, own))
    return out, windows


def blob(p: np.ndarray, where: np.ndarray, x0: int, y0: int) -> Blob:
    yy, xx = np.nonzero(where)
    wgt = p[yy, xx].astype(np.float64)
    m = wgt.sum()
    cx, cy = (wgt * xx).sum() / m, (wgt * yy).sum() / m
    d = np.stack([xx - cx, yy - cy])
    cov = (d * wgt) @ d.T / m
    val, vec = np.linalg.eigh(cov - VAR_PIXEL * np.eye(2))
    val = np.maximum(val, 0.02)
    root = vec @ np.diag(np.sqrt(val)) @ vec.T
    white = vec @ np.diag(1 / np.sqrt(val)) @ vec.T @ d
    z = white[0] + 1j * white[1]
    return Blob(m, np.array([cx + x0, cy + y0]), root, complex((wgt * z**4).sum() / m), float(np.percentile(wgt, 75)))


def middle(sizes: np.ndarray) -> float:
    """The size at which half of the total area is reached: specks, however many, do not move it."""
    s = np.sort(sizes)
    return float(s[np.searchsorted(np.cumsum(s), 0.5 * s.sum())])


def boxes(prob: np.ndarray, shrink: float, refine: bool = True) -> list[Box]:
    """Oriented boxes from probabilities (channels module and core first), pixel centres at whole numbers."""
    module, core = prob[0], prob[1]
    found, windows = blobs_of(core, CORE_T)
    if not found:
        return []
    median = middle(np.array([b.mass for b in found]))
    if refine:
        kept: list[Blob] = []
        for b, (x0, y0, x1, y1, own) in zip(found, windows):
            parts = [b]
            if b.mass > 1.7 * median:
                p = np.where(own, core[y0:y1, x0:x1], 0)
                for t in LADDER:
                    sub, _ = blobs_of(p, t)
                    sub = [s for s in sub if s.mass > 0.3 * median]
                    if len(sub) > 1:
                        parts = sub
                        break
                for s in parts:
                    if s is not b:
                        s.center = s.center + (x0, y0)
            kept += parts
        # Faint ones of the right size that no strong component touches.
        strong = np.array([b.center for b in kept])
        faint, windows = blobs_of(core, CORE_LOW)
        for b, (x0, y0, x1, y1, own) in zip(faint, windows):
            near = ((strong - b.center) ** 2).sum(axis=1).min() < (3.0 * np.sqrt(median) / shrink) ** 2
            if near and core[y0:y1, x0:x1][own].max() <= CORE_T and 0.4 * median < b.mass < 1.6 * median:
                kept.append(b)
        found = kept
    centers = np.array([b.center for b in found])
    fourth = np.array([b.fourth for b in found])
    mass = np.array([b.mass for b in found])
    roots = np.array([b.root for b in found])
    reach = REACH * np.sqrt(median) / shrink
    out = []
    for i, b in enumerate(found):
        d2 = ((centers - b.center) ** 2).sum(axis=1)
        k = np.exp(-0.5 * d2 / reach**2)
        phi = (np.angle((k * fourth).sum()) - np.pi) / 4
        # Neighbours have the same shape: those of about the same size share theirs.
        k = k * np.exp(-0.5 * (np.log(mass / b.mass) / SIZE_SIGMA) ** 2)
        root = (k[:, None, None] * roots).sum(axis=0) / k.sum()
        axes = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
        u, v = (np.sqrt(12) / shrink * root @ axes).T
        if np.hypot(*v) > np.hypot(*u):
            u, v = v, -u
        out.append(Box(b.center, u, v, b.score))
    med = middle(np.array([b.area for b in out]))
    lo, hi = SIZE_RANGE
    out = [b for b in out if lo * med < b.area < hi * med and inside_mean(module, b) > MODULE_MIN]
    out = suppress(out)
    return [b for b, n in zip(out, support(out)) if n >= 1 or b.score > ALONE]


def support(found: list[Box]) -> list[int]:
    """How many of its four lattice neighbours each box has."""
    counts = []
    centers = np.array([b.center for b in found]).reshape(-1, 2)
    for b in found:
        rel = (centers - b.center) @ np.linalg.inv(np.stack([b.u, b.v], axis=1)).T
        steps = [(1, 0), (-1, 0), (0, 1), (0, -1)]
        counts.append(sum(bool((np.abs(rel - np.array(s) * 1.02).max(axis=1) < LATTICE).any()) for s in steps))
    return counts


def inside_mean(module: np.ndarray, b: Box) -> float:
    """Mean `module` on a 5 x 5 grid over the inner 70 % of the box."""
    g = np.linspace(-0.35, 0.35, 5)
    gu, gv = np.meshgrid(g, g)
    x = np.round(b.center[0] + b.u[0] * gu + b.v[0] * gv).astype(int)
    y = np.round(b.center[1] + b.u[1] * gu + b.v[1] * gv).astype(int)
    ok = (x >= 0) & (y >= 0) & (x < module.shape[1]) & (y < module.shape[0])
    return float(module[y[ok], x[ok]].mean()) if ok.any() else 0.0


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Area of the intersection of two convex quadrilaterals."""
    return float(cv2.intersectConvexConvex(a.astype(np.float32), b.astype(np.float32))[0])


def quad_area(q: np.ndarray) -> float:
    x, y = q[:, 0], q[:, 1]
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)


def suppress(found: list[Box]) -> list[Box]:
    """Greedy: a box that overlaps a better one by more than OVERLAP of the smaller of both is dropped."""
    order = sorted(found, key=lambda b: -b.score)
    kept: list[Box] = []
    for b in order:
        near = [k for k in kept if np.linalg.norm(k.center - b.center) < (k.length + b.length) / 2]
        if all(overlap(b.corners, k.corners) < OVERLAP * min(b.area, k.area) for k in near):
            kept.append(b)
    return kept


def touches_frame(b: Box, width: int, height: int, margin: float = 0.0) -> bool:
    """Whether the box reaches out of the frame (the service drops these: the module may be incomplete)."""
    c = b.corners
    return bool(
        (c[:, 0] < -0.5 - margin).any()
        or (c[:, 1] < -0.5 - margin).any()
        or (c[:, 0] > width - 0.5 + margin).any()
        or (c[:, 1] > height - 0.5 + margin).any()
    )
