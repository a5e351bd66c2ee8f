"""What stands about and is no module: boxes, cars, windows, greenhouses, water, signs, posts, trees."""

from __future__ import annotations

import cv2
import numpy as np

from ..augment import Rng, noise_field
from .canvas import Canvas, hull, poly_mask, rectangle
from .patterns import log_uniform, rgb
from .roof import sheet


def block(c: Canvas, center, w: float, d: float, angle: float, z: float, tex: np.ndarray) -> None:
    """A box with a texture on top, and its shadow."""
    rng = c.rng
    q = rectangle(center, w, d, angle, z)
    base = q.copy()
    base[:, 2] = 0
    c.shadow([hull(c.cam(base), c.cam(c.onto_ground(q)))])
    c.fill(hull(c.cam(base), c.cam(q)), tex.reshape(-1, 3).mean(axis=0) * np.float32(rng.uniform(0.4, 0.9)))
    c.paste(tex, c.cam(q))


def plain(rng: Rng) -> np.ndarray:
    """A texture of one colour."""
    color = rgb(*rng.uniform(0.05, 1, 3)) if rng.random() < 0.4 else rgb(1, 1, 1) * rng.uniform(0.05, 1.1)
    return np.ones((64, 64, 3), np.float32) * color


def grid(rng: Rng) -> np.ndarray:
    """Stripes, some crossed by others."""
    tex = plain(rng)
    tex[:: int(rng.integers(3, 16))] *= rng.uniform(0.4, 1.5)
    if rng.random() < 0.45:
        tex[:, :: int(rng.integers(3, 16))] *= rng.uniform(0.4, 1.5)
    return tex


def anywhere(c: Canvas) -> np.ndarray:
    return c.rng.uniform(-0.7, 0.7, 2) * c.extent


def boxes(c: Canvas, theta: float) -> None:
    """A container, cabinet, beam, pallet or shed."""
    rng = c.rng
    kind = rng.choice(["box", "roof", "long", "grid"], p=[0.45, 0.2, 0.2, 0.15])
    w, d = {"box": rng.uniform(0.4, 6, 2), "roof": rng.uniform(3, 15, 2), "long": (rng.uniform(3, 30), rng.uniform(0.1, 0.5)),
            "grid": rng.uniform(2, 10, 2)}[kind]  # fmt: skip
    z = {"box": rng.uniform(0, 2.6), "roof": rng.uniform(2, 5), "long": rng.uniform(0, 0.5), "grid": rng.uniform(0, 2.0)}[kind]
    tex = sheet(rng, w, d, c.texel) if kind == "roof" else grid(rng) if kind == "grid" else plain(rng)
    block(c, anywhere(c), w, d, theta + rng.choice([0, np.pi / 2, rng.uniform(0, np.pi)]), z, tex)


def car(rng: Rng) -> np.ndarray:
    """The top of a car (80, 32): windscreens darker than the paint."""
    gray = rng.random() < 0.8
    tex = np.ones((80, 32, 3), np.float32) * (rgb(1, 1, 1) * rng.choice([0.95, 0.75, 0.5, 0.15, 0.06]) if gray else rgb(*rng.uniform(0.05, 0.8, 3)))
    tex[24:34, 4:28] = tex[62:70, 5:27] = rgb(0.08, 0.09, 0.11) * rng.uniform(0.6, 2.5)
    tex[34:62, 2:5] = tex[34:62, 27:30] = tex[0, 0] * 0.5
    return tex


def parking(c: Canvas, theta: float) -> None:
    """Rows of cars between white lines."""
    rng = c.rng
    a = theta + rng.choice([0, np.pi / 2, rng.uniform(0, np.pi)])
    along, across = np.array([np.cos(a), np.sin(a)]), np.array([-np.sin(a), np.cos(a)])
    o, pitch = anywhere(c), rng.uniform(2.3, 2.9)
    count, full = int(rng.integers(3, 16)), rng.uniform(0.3, 1.0)
    if rng.random() < 0.6:
        c.fill(c.cam(rectangle(o + along * pitch * (count - 1) / 2, pitch * count + 2, 12, a, 0.0)), rgb(1, 1, 1) * rng.uniform(0.2, 0.65))
    white = rgb(1, 1, 1) * rng.uniform(0.6, 1.1)
    for side in range(int(rng.integers(1, 3))):
        for i in range(count):
            p = o + along * pitch * i + across * 5.2 * side
            if rng.random() < 0.8:
                c.fill(c.cam(rectangle(p - along * pitch / 2, 0.12, 4.8, a, 0.0)), white)
            if rng.random() < full:
                block(c, p + rng.normal(0, 0.15, 2), 1.8, rng.uniform(3.8, 4.8), a + np.pi * rng.integers(2), 1.2, car(rng))


def panes(c: Canvas, theta: float) -> None:
    """A greenhouse or a glass roof: pale panes between bars; or a facade or a sign: dark panes apart from each other."""
    rng = c.rng
    w, d = rng.uniform(3, 16, 2)
    tu, tv = (max(c.texel, s / 500) for s in (w, d))
    u, v = np.arange(int(w / tu))[None, :] * tu, np.arange(int(d / tv))[:, None] * tv
    if rng.random() < 0.5:
        pale = rgb(0.8, 0.86, 0.84) * rng.uniform(0.65, 1.1) * np.ones((v.size, u.size, 1), np.float32)
        pu, pv, bar = rng.uniform(0.5, 2.0), rng.uniform(0.6, 4.0), rng.uniform(0.03, 0.12)
        bars = ((u % pu) < bar) | ((v % pv) < bar)
        tex = np.where(bars[..., None], pale * rng.uniform(0.5, 1.3), pale * (1 + 0.1 * noise_field(rng, max(u.size, v.size), 12)[: v.size, : u.size, None]))
    else:
        wall = np.ones((v.size, u.size, 1), np.float32) * rgb(*rng.uniform(0.45, 1.0, 3))
        pu, pv = rng.uniform(1.0, 4.0), rng.uniform(1.2, 4.0)
        glass = ((u % pu) < pu * rng.uniform(0.25, 0.65)) & ((v % pv) < pv * rng.uniform(0.25, 0.6))
        tex = np.where(glass[..., None], rgb(0.1, 0.13, 0.17) * rng.uniform(0.5, 3), wall)
    block(c, anywhere(c), w, d, theta + rng.choice([0, np.pi / 2, rng.uniform(0, np.pi)]), rng.uniform(0, 4), tex.astype(np.float32))


def sign(c: Canvas, theta: float) -> None:
    """Letters and patches on a board or a roof."""
    rng = c.rng
    tex = np.repeat(np.repeat(plain(rng), 2, axis=0), 4, axis=1)
    ink = rgb(*rng.uniform(0, 1, 3))
    letters = "".join(rng.choice(list("ABEFHKLMNORTXZ0138"), int(rng.integers(2, 9))))
    m = np.zeros(tex.shape[:2], np.uint8)
    cv2.putText(m, letters, (6, 90), cv2.FONT_HERSHEY_SIMPLEX, 2.2, 255, int(rng.integers(2, 12)), cv2.LINE_AA)
    tex += (ink - tex) * (m[..., None] / np.float32(255))
    w = rng.uniform(2, 14)
    block(c, anywhere(c), w, w / 2 * rng.uniform(0.6, 1.2), theta + rng.choice([0, np.pi / 2, rng.uniform(0, np.pi)]), rng.uniform(0, 2), tex)


def water(c: Canvas, theta: float) -> None:
    """A pool, a pond or a flat puddle, with ripples."""
    rng = c.rng
    t = np.linspace(0, 2 * np.pi, int(rng.choice([4, 18])), endpoint=False) + theta
    r = log_uniform(rng, 1, 12) * (1 + 0.15 * rng.standard_normal(len(t)))
    o = anywhere(c)
    q = c.cam(np.stack([o[0] + r * np.cos(t), o[1] + r * np.sin(t), np.zeros(len(t))], axis=1))
    found = c.window(q, 4)
    if found is None:
        return
    view, lo = found
    ripple = noise_field(rng, c.n, max(2.0, rng.uniform(0.1, 0.8) / c.texel))[: view.shape[0], : view.shape[1], None]
    color = (rgb(0.1, 0.16, 0.18) if rng.random() < 0.6 else rgb(0.2, 0.45, 0.6)) * rng.uniform(0.4, 1.6)
    m = poly_mask(max(view.shape[:2]), [q - lo], rng.uniform(0, 2))[: view.shape[0], : view.shape[1], None]
    view += (color * (1 + rng.uniform(0, 0.3) * ripple) - view) * m


KINDS = [(boxes, 0.42), (parking, 0.14), (panes, 0.16), (sign, 0.1), (water, 0.1), (None, 0.08)]


def distractor(c: Canvas, theta: float) -> None:
    """One of all kinds of things."""
    kind = KINDS[int(c.rng.choice(len(KINDS), p=[p for _, p in KINDS]))][0]
    if kind is None:
        block(c, anywhere(c), *c.rng.uniform(0.3, 1.5, 2), theta, c.rng.uniform(0.2, 1.5), plain(c.rng))
    else:
        kind(c, theta)


def posts(c: Canvas, polygons: list[np.ndarray], flat: np.ndarray, pitch: float) -> None:
    """Posts, cables, cable trays across the ground below benches."""
    rng = c.rng
    color = rgb(1, 1, 1) * rng.uniform(0.1, 0.9)
    m = np.zeros((c.n, c.n), np.uint8)
    for p in polygons[:12]:
        f = rng.uniform(0, 1)
        a, b = p[0] + (p[1] - p[0]) * f, p[3] + (p[2] - p[3]) * f
        b = b + flat * rng.uniform(0, pitch)
        a[2] = b[2] = 0
        pa, pb = (tuple(int(v) for v in np.clip(p, -4000, 4000)) for p in c.cam(np.array([a, b])))
        cv2.line(m, pa, pb, 255, int(rng.integers(1, 5)), cv2.LINE_AA)
    m = (m.astype(np.float32) / 255)[..., None]
    c.x *= 1 - m
    c.x += color * m


def tree(c: Canvas, taken: list[np.ndarray]) -> None:
    """A tree or boulder: facets about a centre, with a shadow; not on a module."""
    rng, n = c.rng, c.n
    o, r = rng.uniform(0, n, 2), log_uniform(rng, 0.15, 4.0) / c.texel
    k = int(rng.integers(5, 12))
    a = np.linspace(0, 2 * np.pi, k, endpoint=False) + rng.uniform(0, 1, k) * 3 / k
    ring = np.stack([np.cos(a), np.sin(a)], axis=1) * r * rng.uniform(0.75, 1.1, (k, 1))
    push = rng.normal(0, 0.6, 2) * r
    if any(cv2.pointPolygonTest(q.astype(np.float32).reshape(-1, 1, 2), o, False) >= 0 for qs in taken for q in qs):
        return
    c.shadow([o + push + ring])
    base = (rgb(0.2, 0.28, 0.12) if rng.random() < 0.6 else rgb(0.4, 0.37, 0.33)) * rng.uniform(0.4, 1.6)
    inner = ring * rng.uniform(0.3, 0.7)
    for i in range(k):
        j = (i + 1) % k
        for t in (o + np.array([ring[i], ring[j], inner[j], inner[i]]), o + np.array([inner[i], inner[j], [0, 0]])):
            c.fill(t, base * np.float32(rng.uniform(0.6, 1.4)))


def bush(c: Canvas) -> None:
    """Leaves, also over the edge of a bench."""
    rng = c.rng
    o, r = rng.uniform(0, c.n, 2), rng.uniform(0.15, 1.0) / c.texel
    a = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    q = o + np.stack([np.cos(a), np.sin(a)], axis=1) * (r * (1 + 0.25 * rng.standard_normal(24)))[:, None]
    found = c.window(q, 3)
    if found is None:
        return
    view, lo = found
    m = poly_mask(max(view.shape[:2]), [q - lo], 1.0)[: view.shape[0], : view.shape[1], None]
    g = rgb(0.16, 0.26, 0.10) * rng.uniform(0.5, 2)
    view += (g * (1 + 0.4 * rng.standard_normal(m.shape, dtype=np.float32)) - view) * m
