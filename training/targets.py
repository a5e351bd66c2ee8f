"""Polygons to training targets."""

from __future__ import annotations

import cv2
import numpy as np

CORE_SHRINK = 0.62
GSD = 0.04  # metres per pixel at which photos outside of the range are run
# The network knows modules twice as small; but finer pixels, though interpolated, tell it more of narrow seams.
GSD_RANGE = (0.025, 0.045)
SUPER = 4
SHIFT = 4


def fill(quads: np.ndarray, size: int) -> np.ndarray:
    """Area coverage 0..1 of polygons in a size x size raster, pixel centres at whole numbers."""
    mask = np.zeros((size * SUPER, size * SUPER), np.uint8)
    if len(quads):
        # cv2 fills every pixel the outline touches: pull the outline in by half a fine pixel.
        c = quads.mean(axis=1, keepdims=True)
        fine = (quads + 0.5) * SUPER - 0.5
        c = (c + 0.5) * SUPER - 0.5
        d = fine - c
        n = np.linalg.norm(d, axis=2, keepdims=True)
        fine = c + d * np.maximum(0.0, 1 - 0.6 / np.maximum(n, 1e-6))
        for q in np.round(fine * (1 << SHIFT)).astype(np.int32):
            cv2.fillConvexPoly(mask, q, 255, cv2.LINE_8, SHIFT)
    return cv2.resize(mask, (size, size), interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0


def shrink(quads: np.ndarray, k: float) -> np.ndarray:
    c = quads.mean(axis=1, keepdims=True)
    return c + (quads - c) * k


def make_targets(quads: np.ndarray, ignore: list[np.ndarray], size: int) -> tuple[np.ndarray, np.ndarray]:
    """Targets (2, size, size) and the pixel weights (2, size, size).

    The face outside the core gets more weight on the core channel: that ring is what keeps neighbours apart.
    """
    quads = quads[np.isfinite(quads).all(axis=(1, 2))]
    quads = quads[(quads.max(axis=1) > -8).all(axis=1) & (quads.min(axis=1) < size + 8).all(axis=1)]
    module = fill(quads, size)
    core = fill(shrink(quads, CORE_SHRINK), size)
    weight = np.ones((2, size, size), np.float32)
    weight[1] += 1.5 * np.clip(module - core, 0, 1)
    # Seams and outlines: where the face's coverage is partial, and thin gaps between faces.
    closed = cv2.morphologyEx(module, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    weight[0] += 2.0 * np.clip(closed - module, 0, 1)
    if ignore:
        mask = np.zeros((size, size), np.uint8)
        for p in ignore:
            cv2.fillPoly(mask, [np.round(p * (1 << SHIFT)).astype(np.int32)], 1, cv2.LINE_8, SHIFT)
        weight *= 1.0 - mask
    return np.stack([module, core]), weight
