"""What lies below: soil, grass, gravel, snow, asphalt, and tracks over it."""

from __future__ import annotations

import cv2
import numpy as np

from ..augment import Rng, noise_field
from .canvas import UP, Canvas, poly_mask
from .patterns import rgb

GROUNDS = [
    (rgb(0.25, 0.36, 0.14), rgb(0.42, 0.45, 0.22)),  # grass
    (rgb(0.13, 0.22, 0.08), rgb(0.26, 0.36, 0.14)),  # dark grass
    (rgb(0.48, 0.46, 0.24), rgb(0.62, 0.57, 0.36)),  # dry grass
    (rgb(0.36, 0.26, 0.18), rgb(0.52, 0.40, 0.28)),  # soil
    (rgb(0.20, 0.15, 0.11), rgb(0.30, 0.24, 0.18)),  # dark soil
    (rgb(0.72, 0.60, 0.44), rgb(0.85, 0.73, 0.56)),  # sand
    (rgb(0.65, 0.42, 0.28), rgb(0.78, 0.56, 0.38)),  # red earth
    (rgb(0.50, 0.50, 0.49), rgb(0.68, 0.66, 0.64)),  # gravel
    (rgb(0.70, 0.69, 0.66), rgb(0.85, 0.84, 0.81)),  # bright gravel
    (rgb(0.86, 0.89, 0.93), rgb(0.97, 0.98, 1.00)),  # snow
    (rgb(0.30, 0.30, 0.31), rgb(0.40, 0.40, 0.42)),  # asphalt
    (rgb(0.55, 0.57, 0.60), rgb(0.66, 0.67, 0.70)),  # concrete, roof felt
]


def surface(rng: Rng, n: int, gsd: float) -> np.ndarray:
    a, b = GROUNDS[rng.integers(len(GROUNDS))]
    a = a + rng.normal(0, 0.03, 3).astype(np.float32)
    f = noise_field(rng, n, rng.uniform(3, 12) / gsd) * 0.5
    f += noise_field(rng, n, rng.uniform(0.5, 2) / gsd) * rng.uniform(0.1, 0.5)
    f += noise_field(rng, n, max(2.0, rng.uniform(0.08, 0.4) / gsd)) * rng.uniform(0.1, 0.7)
    grain = rng.standard_normal((n, n), dtype=np.float32) * rng.uniform(0.05, 0.6)
    f = 1 / (1 + np.exp(-(f + grain)))
    g = a + (b - a) * f[..., None]
    return g * (1 + (f - 0.5) * rng.uniform(0, 0.8))[..., None]


def ground(rng: Rng, n: int, gsd: float) -> np.ndarray:
    """One surface, or two in patches (n, n, 3)."""
    return cv2.resize(coarse(rng, n // 2, 2 * gsd), (n, n), interpolation=cv2.INTER_LINEAR)


def coarse(rng: Rng, n: int, gsd: float) -> np.ndarray:
    x = surface(rng, n, gsd)
    if rng.random() < 0.6:
        mask = noise_field(rng, n, rng.uniform(3, 20) / gsd) + rng.normal(0, 0.6)
        mask += noise_field(rng, n, rng.uniform(0.4, 2) / gsd) * rng.uniform(0, 0.5)
        mask = 1 / (1 + np.exp(-np.clip(mask * rng.uniform(1, 15), -30, 30)))
        x = x + (surface(rng, n, gsd) - x) * mask[..., None]
    return x


def track(c: Canvas, theta: float) -> None:
    """A road, track or trench, mostly along or across the benches."""
    rng, extent = c.rng, c.extent
    a = theta + rng.choice([0, np.pi / 2]) + rng.normal(0, 0.1)
    d, w = np.array([np.cos(a), np.sin(a), 0]), rng.uniform(0.3, 5)
    o = np.array([*rng.uniform(-extent / 2, extent / 2, 2), 0])
    nrm = np.array([-d[1], d[0], 0])
    q = np.array([o - d * 99 - nrm * w / 2, o + d * 99 - nrm * w / 2, o + d * 99 + nrm * w / 2, o - d * 99 + nrm * w / 2])
    m = poly_mask(c.n, [c.cam(q)], rng.uniform(0.5, 6) * UP)
    a_, b_ = GROUNDS[rng.integers(3, len(GROUNDS))]
    color = a_ + (b_ - a_) * rng.random() + rng.standard_normal((c.n, c.n, 1), dtype=np.float32) * 0.04
    c.x += (color - c.x) * m[..., None]
