"""Roofs: ribbed and corrugated sheets, tiles, felt, with skylights, walkways and edges. None of it is a module."""

from __future__ import annotations

import cv2
import numpy as np

from ..augment import Rng
from .canvas import Canvas, hull, rectangle
from .patterns import log_uniform, rgb

SHEETS = [
    rgb(0.55, 0.56, 0.58), rgb(0.80, 0.81, 0.82), rgb(0.93, 0.93, 0.92), rgb(0.33, 0.34, 0.36), rgb(0.20, 0.21, 0.23), rgb(0.30, 0.45, 0.66),
    rgb(0.16, 0.30, 0.55), rgb(0.45, 0.62, 0.58), rgb(0.24, 0.48, 0.36), rgb(0.66, 0.32, 0.28), rgb(0.48, 0.22, 0.20), rgb(0.62, 0.52, 0.38),
    rgb(0.42, 0.34, 0.44),
]  # fmt: skip


def profile(rng: Rng, count: int, texel: float) -> np.ndarray:
    """Light and shade (count) across ribs, waves or standing seams."""
    pitch = log_uniform(rng, 0.08, 0.7)
    t = (np.arange(count) * texel / pitch + rng.random()) % 1.0
    r, depth = rng.random(), rng.uniform(0.08, 0.6)
    if r < 0.35:  # waves
        p = 0.5 * np.sin(2 * np.pi * t)
    elif r < 0.75:  # ribs: a bright flank and a dark one
        w = rng.uniform(0.08, 0.3)
        p = np.where(t < w, 1.0, np.where(t < 2 * w, -1.0, 0.0)) * (1 if rng.random() < 0.5 else -1)
    else:  # narrow seams
        p = np.where(t < rng.uniform(0.04, 0.12), rng.choice([-1.0, 1.0]), 0.0)
    return 1 + depth * p.astype(np.float32)


def tiles(rng: Rng, shape: tuple[int, int], texel: float) -> np.ndarray:
    """Light and shade of tiles: rows with a dark lower edge, waves along each."""
    v, u = np.arange(shape[0])[:, None] * texel, np.arange(shape[1])[None, :] * texel
    pv, pu = rng.uniform(0.28, 0.4), rng.uniform(0.18, 0.35)
    rows = np.where((v / pv) % 1.0 < rng.uniform(0.12, 0.3), -rng.uniform(0.2, 0.8), 0.0)
    waves = rng.uniform(0, 0.4) * np.sin(2 * np.pi * (u / pu + 0.5 * np.floor(v / pv)))
    return np.clip(1 + rows + waves, 0.1, 2).astype(np.float32)


def sheet(rng: Rng, width: float, depth: float, texel: float) -> np.ndarray:
    """The texture of a roof, `width` along the eaves by `depth` metres, ribs down the slope."""
    nu, nv = (int(np.clip(s / texel, 8, 900)) for s in (width, depth))
    tu, tv = width / nu, depth / nv
    color = SHEETS[rng.integers(len(SHEETS))] * np.float32(np.exp(rng.normal(0, 0.15))) + rng.normal(0, 0.03, 3).astype(np.float32)
    tex = np.ones((nv, nu, 3), np.float32) * color
    if rng.random() < 0.2:
        light = tiles(rng, (nv, nu), (tu + tv) / 2)
    else:
        light = np.broadcast_to(profile(rng, nu, tu)[None, :], (nv, nu)).copy()
        if rng.random() < 0.6:  # sheets of different age, joints across and along
            w, h = max(2, int(rng.uniform(0.7, 1.2) / tu)), max(2, int(rng.uniform(2, 8) / tv))
            tint = np.exp(rng.normal(0, rng.choice([0.02, 0.06, 0.2]), (nv // h + 1, nu // w + 1))).astype(np.float32)
            light *= tint[np.arange(nv) // h][:, np.arange(nu) // w]
            if rng.random() < 0.7:
                light[::h] *= rng.uniform(0.6, 1.2)
            if rng.random() < 0.4:
                light[:, ::w] *= rng.uniform(0.6, 1.2)
    tex *= light[..., None]
    if rng.random() < 0.4:  # rust, moss, soot
        spots = cv2.resize(rng.standard_normal((12, 12), dtype=np.float32), (nu, nv), interpolation=cv2.INTER_CUBIC)
        m = 1 / (1 + np.exp(-(spots + rng.normal(-1, 0.6)) * rng.uniform(2, 8)))
        stain = (rgb(0.45, 0.25, 0.15) if rng.random() < 0.5 else rgb(0.2, 0.2, 0.2)) * rng.uniform(0.6, 1.4)
        tex += (stain - tex) * (m * rng.uniform(0.2, 0.8))[..., None]
    if rng.random() < 0.35:
        skylights(rng, tex, tu, tv)
    if rng.random() < 0.5:  # screws along the purlins
        rows = np.arange(int(rng.integers(1, 12)), nv, max(2, int(rng.uniform(0.8, 1.6) / tv)))
        tex[rows, :: max(2, int(rng.uniform(0.2, 0.4) / tu))] *= rng.uniform(0.5, 1.6)
    return tex


def skylights(rng: Rng, tex: np.ndarray, tu: float, tv: float) -> None:
    """Translucent sheets in a regular array: brighter or darker than the roof, with its ribs, never touching each other."""
    nv, nu = tex.shape[:2]
    w, h = max(2, int(rng.uniform(0.6, 1.2) / tu)), max(2, int(rng.uniform(1.5, 6) / tv))
    du, dv = int(w * rng.uniform(2.2, 6)), int(h * rng.uniform(1.4, 3))
    tint = rgb(0.82, 0.86, 0.86) * rng.uniform(0.3, 1.15) if rng.random() < 0.6 else rgb(0.13, 0.15, 0.2) * rng.uniform(0.6, 2)
    strength = rng.uniform(0.5, 0.95)
    for y in range(int(rng.integers(0, dv)), nv, dv):
        for x in range(int(rng.integers(0, du)), nu, du):
            part = tex[y : y + h, x : x + w]
            part += (tint - part) * strength


def roof(c: Canvas, theta: float, wide: bool) -> None:
    """A roof in the plane z = 0, its eaves along `theta`; `wide`: under the whole picture."""
    rng, extent = c.rng, c.extent
    w, d = (extent * 2.2, extent * 2.2) if wide else extent * rng.uniform(0.5, 1.6, 2)
    center = np.zeros(2) if wide else rng.uniform(-0.3, 0.3, 2) * extent
    q = c.cam(rectangle(center, w, d, theta, 0.0))
    if not wide:  # its wall's shadow about it, a bright or dark edge
        out = rectangle(center, w + 0.6, d + 0.6, theta, 0.0)
        c.shadow([hull(c.cam(out), c.cam(c.onto_ground(out + [0, 0, rng.uniform(1, 6)])))])
        c.fill(c.cam(out), rgb(1, 1, 1) * rng.uniform(0.2, 1.0))
    c.paste(sheet(rng, w, d, c.texel), q)
    if rng.random() < 0.5:  # a ridge, a gutter or a walkway
        flat = np.array([-np.sin(theta), np.cos(theta)])
        along = rng.random() < 0.6
        o = center + (flat if along else np.array([flat[1], -flat[0]])) * rng.uniform(-0.5, 0.5) * extent
        bar = rectangle(o, 2.2 * extent, rng.uniform(0.15, 0.8), theta + (0 if along else np.pi / 2), 0.0)
        c.fill(c.cam(bar), SHEETS[rng.integers(len(SHEETS))] * np.float32(rng.uniform(0.7, 1.2)))
