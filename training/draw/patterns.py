"""Colours and one-dimensional patterns."""

from __future__ import annotations

import numpy as np

MM = 0.002  # resolution of the one-dimensional profiles in metres


def rgb(*v: float) -> np.ndarray:
    return np.array(v, np.float32)


def log_uniform(rng: np.random.Generator, lo: float, hi: float) -> float:
    return float(np.exp(rng.uniform(np.log(lo), np.log(hi))))


def stripes(length: float, centers: np.ndarray, widths: np.ndarray | float) -> np.ndarray:
    """1 within stripes, 0 elsewhere, at MM resolution, with fractional ends."""
    n = int(np.ceil(length / MM))
    edges = np.zeros(n + 2)
    centers = np.ravel(centers)
    widths = np.broadcast_to(np.ravel(widths), centers.shape)
    for p, s in ((np.clip((centers - widths / 2) / MM, 0, n), 1.0), (np.clip((centers + widths / 2) / MM, 0, n), -1.0)):
        i = p.astype(int)
        f = p - i
        np.add.at(edges, i, s * (1 - f))
        np.add.at(edges, i + 1, s * f)
    return np.clip(np.cumsum(edges)[:n], 0, 1)


def integrate(profile: np.ndarray, texel: float, count: int) -> np.ndarray:
    """Box average of a profile over `count` texels."""
    c = np.concatenate([[0], np.cumsum(profile)]) * MM
    x = np.arange(count + 1) * texel
    v = np.interp(x, np.arange(len(c)) * MM, c)
    return (np.diff(v) / texel).astype(np.float32)


def lines(start: float, length: float, parts: int) -> np.ndarray:
    """Positions that divide [start, start + length] into parts (inner ones only)."""
    return start + length * np.arange(1, parts) / parts


def union(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Coverage (len(b), len(a)) of vertical stripes `a` and horizontal stripes `b` together."""
    return 1 - (1 - a)[None, :] * (1 - b)[:, None]
