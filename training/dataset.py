"""The endless, reproducible stream of training samples: sample i depends on the seed and i alone."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
import torch
from torch.utils.data import IterableDataset, get_worker_info

from .augment import crop, photometric
from .draw import draw
from .sources import Photo
from .targets import make_targets

SHORT_SIDE = (9.0, 44.0)  # short side of a module in pixels
HARDNESS = {"halfcut": 2.5, "poly": 2.5}  # how often photos of a style are taken, others once


def dihedral(image: np.ndarray, quads: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """One of the eight symmetries of the square."""
    n = image.shape[0] - 1
    q = quads.copy()
    if k & 1:
        image, q = image[:, ::-1], np.stack([n - q[..., 0], q[..., 1]], axis=-1)
    if k & 2:
        image, q = image[::-1], np.stack([q[..., 0], n - q[..., 1]], axis=-1)
    if k & 4:
        image, q = image.transpose(1, 0, 2), q[..., ::-1]
    return np.ascontiguousarray(image), q


def shares(photos: list[Photo]) -> np.ndarray:
    """Cumulative shares of photos in the samples: those of hard styles come more often."""
    weight = np.cumsum([HARDNESS.get(p.conditions.get("style"), 1.0) for p in photos])
    return weight / weight[-1]


class Stream(IterableDataset):
    """Yields image (3, s, s) float and what `targets` makes of the modules' quadrilaterals.

    `sources` are (share, photos) pairs; what is left of 1 is drawn. Drawn pictures are used about three times, each time
    turned and finished differently.
    """

    def __init__(self, sources: list[tuple[float, list[Photo]]], size: int, seed: int, start: int = 0, targets=make_targets):
        self.sources = [(p, photos, shares(photos)) for p, photos in sources if photos and p > 0]
        self.size, self.seed, self.start, self.targets = size, seed, start, targets

    def __iter__(self):
        cv2.setNumThreads(0)
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        recent: deque = deque(maxlen=48)
        i = self.start + worker
        while True:
            rng = np.random.default_rng([self.seed, i])
            try:
                yield self.sample(rng, recent)
            except (cv2.error, np.linalg.LinAlgError, FloatingPointError):
                pass  # a degenerate random geometry: skip the sample
            i += workers

    def sample(self, rng: np.random.Generator, recent: deque):
        r = rng.random()
        for share, photos, hardness in self.sources:
            if r < share:
                photo = photos[np.searchsorted(hardness, rng.random())]
                image, quads, ignore = crop(photo, self.size, rng, SHORT_SIDE)
                image = photometric(image, rng, 1.0)
                break
            r -= share
        else:
            if len(recent) < 24 or rng.random() < 0.35:
                image, quads = draw(rng, self.size, SHORT_SIDE)
                recent.append((image, quads))
            else:
                image, quads = recent[rng.integers(len(recent))]
            image, quads = dihedral(image, quads, int(rng.integers(8)))
            image, ignore = photometric(image, rng, 0.6), []
        made = self.targets(quads, ignore, self.size)
        return (torch.from_numpy(image).permute(2, 0, 1).float().div_(255.0), *(torch.from_numpy(t) for t in made))
