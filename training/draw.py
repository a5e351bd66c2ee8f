"""Procedural photos of photovoltaic plants: a few milliseconds each, with exact polygons.

Benches are textured planes in space, seen by a tilted camera. A bench's texture is separable (seams, frames, cell
gaps, busbars are stripes along its two axes), so that it is integrated exactly over each texel from one-dimensional
profiles of millimetre resolution: a 2 mm seam at 6 cm per pixel keeps its true faint contrast. Only numpy and OpenCV.
"""

from __future__ import annotations

import cv2
import numpy as np

from .augment import Rng, noise_field

MM = 0.002  # resolution of the one-dimensional profiles in metres
UP = 2  # supersampling of the canvas


def rgb(*v: float) -> np.ndarray:
    return np.array(v, np.float32)


# --- ground -----------------------------------------------------------------------------------------------------

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


def ground(rng: Rng, n: int, gsd: float) -> np.ndarray:
    def one() -> np.ndarray:
        a, b = GROUNDS[rng.integers(len(GROUNDS))]
        a = a + rng.normal(0, 0.03, 3).astype(np.float32)
        f = noise_field(rng, n, rng.uniform(3, 12) / gsd) * 0.5
        f += noise_field(rng, n, rng.uniform(0.5, 2) / gsd) * rng.uniform(0.1, 0.5)
        f += noise_field(rng, n, max(2.0, rng.uniform(0.08, 0.4) / gsd)) * rng.uniform(0.1, 0.7)
        grain = rng.standard_normal((n, n), dtype=np.float32) * rng.uniform(0.05, 0.6)
        f = 1 / (1 + np.exp(-(f + grain)))
        g = a + (b - a) * f[..., None]
        light = 1 + (f - 0.5) * rng.uniform(0, 0.8)
        g *= light[..., None]
        return g

    x = one()
    if rng.random() < 0.6:
        mask = noise_field(rng, n, rng.uniform(3, 20) / gsd) + rng.normal(0, 0.6)
        mask += noise_field(rng, n, rng.uniform(0.4, 2) / gsd) * rng.uniform(0, 0.5)
        mask = 1 / (1 + np.exp(-np.clip(mask * rng.uniform(1, 15), -30, 30)))
        x = x + (one() - x) * mask[..., None]
    return x


# --- one-dimensional patterns -----------------------------------------------------------------------------------


def stripes(length: float, centers: np.ndarray, widths: np.ndarray | float) -> np.ndarray:
    """1 within stripes, 0 elsewhere, at MM resolution, with fractional ends."""
    n = int(np.ceil(length / MM))
    edges = np.zeros(n + 2)
    widths = np.broadcast_to(widths, np.shape(centers))
    for c, w in zip(np.ravel(centers), np.ravel(widths)):
        lo, hi = np.clip([(c - w / 2) / MM, (c + w / 2) / MM], 0, n)
        for p, s in ((lo, 1), (hi, -1)):
            i = int(p)
            f = p - i
            edges[i] += s * (1 - f)
            edges[i + 1] += s * f
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


# --- modules ----------------------------------------------------------------------------------------------------


class Style:
    """The look of one plant's modules."""

    def __init__(self, rng: Rng):
        kind = rng.choice(["poly", "mono", "black", "thin"], p=[0.42, 0.3, 0.16, 0.12])
        self.kind = kind
        if kind == "thin":
            self.size = (0.6, 1.2) if rng.random() < 0.6 else (rng.uniform(0.6, 1.25), rng.uniform(1.2, 2.3))
        else:
            w = rng.uniform(0.98, 1.15) if rng.random() < 0.85 else rng.uniform(0.75, 1.35)
            self.size = (w, w * rng.uniform(1.55, 2.1))
        self.cells = {"thin": (1, 1)}.get(kind, (int(rng.choice([6, 6, 6, 5, 4])), 0))
        if kind != "thin":
            nx = self.cells[0]
            ny = int(round(nx * self.size[1] / self.size[0]))
            self.cells = (nx, ny)
        self.halfcut = kind != "thin" and rng.random() < (0.2 if kind == "poly" else 0.5)
        if self.halfcut:
            self.cells = (self.cells[0], 2 * self.cells[1])
        base = {
            "poly": [rgb(0.14, 0.19, 0.42), rgb(0.22, 0.27, 0.46), rgb(0.20, 0.20, 0.36), rgb(0.28, 0.36, 0.62)],
            "mono": [rgb(0.10, 0.11, 0.18), rgb(0.16, 0.18, 0.27), rgb(0.22, 0.26, 0.36), rgb(0.10, 0.12, 0.14), rgb(0.22, 0.18, 0.27), rgb(0.30, 0.30, 0.33)],
            "black": [rgb(0.06, 0.06, 0.09), rgb(0.11, 0.11, 0.15), rgb(0.13, 0.15, 0.22)],
            "thin": [rgb(0.10, 0.09, 0.10), rgb(0.19, 0.14, 0.19), rgb(0.13, 0.17, 0.18), rgb(0.17, 0.13, 0.10)],
        }[kind]
        self.color = base[rng.integers(len(base))] * np.float32(np.exp(rng.normal(0, 0.25)))
        self.color = np.clip(self.color + rng.normal(0, 0.035, 3).astype(np.float32), 0.02, 1)
        self.module_var = rng.choice([0.02, 0.06, 0.14, 0.25], p=[0.3, 0.35, 0.25, 0.1])
        self.hue_var = rng.choice([0.005, 0.02, 0.05])
        self.cell_var = rng.uniform(0, 0.12) if kind == "poly" else rng.uniform(0, 0.03)
        # Between the cells: back sheet (white, dark) seen through; strength from invisible to harsh.
        self.cell_color = rgb(0.85, 0.87, 0.9) * rng.uniform(0.5, 1.1) if rng.random() < 0.65 else self.color * rng.uniform(0.3, 1.5)
        self.cell_gap = rng.uniform(0.002, 0.012) * (1 if kind in ("poly", "mono") else 0.4)
        if rng.random() < 0.15:
            self.cell_gap = rng.uniform(0.01, 0.022)
        self.gap_ratio = 1.0  # gaps across the short side, against those across the long side
        # The cut corners of mono cells leave bright diamonds.
        self.chamfer = rng.uniform(0.01, 0.035) if kind in ("mono", "black") and rng.random() < 0.6 else 0.0
        self.bus_gap = rng.uniform(0.001, 0.003)
        self.bus_count = int(rng.choice([0, 2, 3, 5]))
        self.bus_color = rgb(0.8, 0.82, 0.85) * rng.uniform(0.5, 1.1)
        self.bus_across = rng.random() < 0.3  # busbars across the short side
        self.half_gap = rng.uniform(0.004, 0.025)
        self.margin = rng.uniform(0.0, 0.03) if kind != "thin" else 0.0  # back sheet between frame and cells
        silver = rgb(0.78, 0.79, 0.82) * rng.uniform(0.6, 1.25)
        dark = rgb(0.07, 0.07, 0.08) * rng.uniform(0.5, 2)
        p_black = {"poly": 0.15, "mono": 0.5, "black": 0.9, "thin": 0.7}[kind]
        self.frame_color = dark if rng.random() < p_black else silver
        self.frame = 0.0 if kind == "thin" and rng.random() < 0.6 else rng.uniform(0.008, 0.035)
        self.hatched = rng.random() < 0.08  # moire of the cell grid
        self.landscape = rng.random() < 0.45
        tight = lambda: float(rng.choice([rng.uniform(0.001, 0.006), rng.uniform(0.006, 0.02), rng.uniform(0.02, 0.05)], p=[0.35, 0.45, 0.2]))
        self.seam = (tight(), tight())  # along the row, up the slope
        # What shows in the seam: see-through (dark or ground), bright clamps, rails; broken along its length.
        self.seam_color = []
        for _ in range(2):
            r = rng.random()
            c = rgb(0.05, 0.05, 0.06) if r < 0.5 else rgb(0.9, 0.9, 0.88) if r < 0.8 else rgb(*rng.uniform(0.1, 0.8, 3))
            self.seam_color.append(c * rng.uniform(0.6, 1.2))
        self.broken = [rng.random() < 0.45, rng.random() < 0.45]
        self.streak = [rng.uniform(0.0, 0.06) if rng.random() < 0.35 else 0.0 for _ in range(2)]
        self.frame_fade = [1.0 if rng.random() < 0.55 else rng.uniform(0.0, 0.6) for _ in range(2)]
        if kind != "thin" and rng.random() < 0.45:
            self.camouflage(rng)
        self.sheen = rng.uniform(-0.5, 0.7)
        self.glare = 0.5 if rng.random() < 0.3 else 0.0

    def camouflage(self, rng: Rng):
        """Cell grids brighter than all else; frames and seams narrow and dark, or of the grid's mean colour."""
        self.cell_color = rgb(0.85, 0.87, 0.92) * rng.uniform(0.6, 1.2)
        # Up to a third of a cell, as wide as cameras blur it and renders draw it.
        self.cell_gap = np.exp(rng.uniform(np.log(0.004), np.log(0.05)))
        self.bus_count = int(rng.choice([0, 0, 2, 3]))
        self.gap_ratio = 1.0 if rng.random() < 0.4 else rng.uniform(0.2, 1.0)
        if self.halfcut:
            self.cell_gap *= 0.6
        share = min(0.6, (1 + self.gap_ratio) * self.cell_gap * self.cells[0] / self.size[0])
        grid = self.color * (1 - share) + self.cell_color * share
        r = rng.random()
        self.frame_color = rgb(0.05, 0.05, 0.06) * rng.uniform(0.6, 2) if r < 0.5 else grid * rng.uniform(0.6, 1.1) if r < 0.8 else self.frame_color
        self.frame = rng.uniform(0.004, 0.03)
        self.margin = rng.uniform(0.0, 0.012)
        self.seam = (rng.uniform(0.002, 0.022), rng.uniform(0.002, 0.022))
        self.seam_color = [rgb(0.05, 0.05, 0.06) * rng.uniform(0.6, 2) if rng.random() < 0.8 else grid for _ in range(2)]
        self.streak = [0.0, 0.0]
        self.frame_fade = [1.0 if rng.random() < 0.7 else rng.uniform(0.2, 1.0) for _ in range(2)]

    def footprint(self) -> tuple[float, float]:
        a, b = self.size
        return (b, a) if self.landscape else (a, b)


def bench_texture(s: Style, rng: Rng, cols: int, rows: int, texel: float):
    """RGBA texture (top row first) of a bench and its modules' rectangles in texels (n, 4, 2), and which are present."""
    mw, mh = s.footprint()
    su, sv = s.seam
    length, height = cols * (mw + su) - su, rows * (mh + sv) - sv
    nu, nv = int(np.ceil(length / texel)) + 1, int(np.ceil(height / texel)) + 1
    starts_u, starts_v = np.arange(cols) * (mw + su), np.arange(rows) * (mh + sv)

    def family(fn, starts, span, count):
        c, w = [], []
        for st in starts:
            cc, ww = fn(st)
            c.append(np.ravel(cc))
            w.append(np.broadcast_to(ww, np.shape(np.ravel(cc))))
        return integrate(stripes(span, np.concatenate(c), np.concatenate(w)), texel, count) if c else np.zeros(count, np.float32)

    def axis(starts, m, count, cells, along_short, span, seam):
        inner0 = s.frame + s.margin
        inner = m - 2 * inner0
        seam_c = np.array([st - seam / 2 for st in starts[1:]])
        seam_p = integrate(stripes(span, seam_c, seam), texel, count) if len(seam_c) else np.zeros(count, np.float32)
        wide = seam + 0.03
        wide_p = integrate(stripes(span, seam_c, wide), texel, count) if len(seam_c) else seam_p
        frame_p = family(lambda st: (np.array([st + s.frame / 2, st + m - s.frame / 2]), s.frame), starts, span, count)
        margin_p = family(lambda st: (np.array([st + s.frame + s.margin / 2, st + m - s.frame - s.margin / 2]), s.margin), starts, span, count)
        gap = s.cell_gap * (s.gap_ratio if along_short else 1.0)
        cell_p = family(lambda st: (lines(st + inner0, inner, cells), gap), starts, span, count) if cells > 1 else np.zeros(count, np.float32)
        bus = max(1, s.bus_count) * cells
        bus_p = np.zeros(count, np.float32)
        if s.bus_count and s.kind != "thin" and along_short != s.bus_across:
            bus_p = family(lambda st: (st + inner0 + inner * (np.arange(bus) + 0.5) / bus, s.bus_gap), starts, span, count)
        half_p = np.zeros(count, np.float32)
        if s.halfcut and not along_short:
            half_p = family(lambda st: (np.array([st + m / 2]), s.half_gap), starts, span, count)
        notch_p = np.zeros(count, np.float32)
        if s.chamfer and cells > 1:
            notch_p = family(lambda st: (lines(st + inner0, inner, cells), gap + s.chamfer), starts, span, count)
        return seam_p, wide_p, frame_p, margin_p, cell_p, bus_p, half_p, notch_p

    short_u = not s.landscape
    cu, cv = (s.cells[0], s.cells[1]) if short_u else (s.cells[1], s.cells[0])
    U = axis(starts_u, mw, nu, cu, short_u, length, su)
    V = axis(starts_v, mh, nv, cv, not short_u, height, sv)

    # Base colours per module, then cells.
    tint = np.exp(rng.normal(0, s.module_var, (rows, cols, 1))).astype(np.float32)
    if rng.random() < 0.3:  # strings of another batch
        tint[:, int(rng.integers(cols)) :] *= np.float32(np.exp(rng.normal(0, 0.2)))
    hue = rng.normal(0, s.hue_var, (rows, cols, 3)).astype(np.float32)
    color = np.clip(s.color * tint + hue * s.color.mean() * 4, 0.01, 1)
    iu = np.clip(((np.arange(nu) + 0.5) * texel + su / 2) // (mw + su), 0, cols - 1).astype(int)
    iv = np.clip(((np.arange(nv) + 0.5) * texel + sv / 2) // (mh + sv), 0, rows - 1).astype(int)
    tex = color[iv][:, iu]
    if s.cell_var > 0.01:
        tu = np.clip((np.arange(nu) * texel / mw * cu).astype(int), 0, 10_000)
        tv = np.clip((np.arange(nv) * texel / mh * cv).astype(int), 0, 10_000)
        cells = np.exp(rng.normal(0, s.cell_var, (tv.max() + 1, tu.max() + 1))).astype(np.float32)
        tex = tex * cells[tv][:, tu][..., None]

    layers: list[tuple[np.ndarray, np.ndarray]] = []

    def blend(mask, col):
        if mask.any():
            layers.append((mask, np.asarray(col, np.float32)))

    def flatten():
        # All layers at once: each one's share of the final colour, from the top down, on one channel.
        nonlocal tex
        through = np.ones((nv, nu), np.float32)
        shares = []
        for mask, _ in reversed(layers):
            shares.append(through * mask)
            through *= 1 - mask
        tex *= through[..., None]
        if layers:
            stack = np.stack(shares, axis=-1).reshape(-1, len(shares))
            tex += (stack @ np.stack([c for _, c in reversed(layers)])).reshape(tex.shape)
        layers.clear()

    def union(a, b):
        return 1 - (1 - a)[None, :] * (1 - b)[:, None]

    blend(union(U[5], V[5]), s.bus_color)
    blend(union(U[4], V[4]), s.cell_color)
    if s.chamfer:
        blend(V[7][:, None] * U[7][None, :], s.cell_color)
    blend(union(U[6], V[6]), s.cell_color)
    if s.margin > 0:
        blend(union(U[3], V[3]), s.cell_color)
    # Frames and seams; each direction has its own visibility.
    wave = lambda cell: cv2.resize(
        rng.standard_normal((max(2, int(nv * texel / cell) + 2), max(2, int(nu * texel / cell) + 2))).astype(np.float32),
        (nu, nv), interpolation=cv2.INTER_LINEAR)
    for d in range(2):
        f = (U[2][None, :] if d == 0 else V[2][:, None]) * np.ones((nv, nu), np.float32)
        blend(f * s.frame_fade[d], s.frame_color)
    alpha = np.ones((nv, nu), np.float32)
    for d in range(2):
        one = np.ones((nv, nu), np.float32)
        seam = (U[0][None, :] if d == 0 else V[0][:, None]) * one
        if s.broken[d]:
            n = wave(rng.uniform(0.15, 0.8))
            vis = 1 / (1 + np.exp(-np.clip((n + rng.normal(0.2, 0.5)) * rng.uniform(2, 10), -30, 30)))
            seam_vis = seam * vis
        else:
            seam_vis = seam
        blend(seam_vis, s.seam_color[d])
        if s.streak[d]:
            wide = (U[1][None, :] if d == 0 else V[1][:, None]) * one
            if rng.random() < 0.6:  # lens-shaped light between clamps, at the same place in every module
                m, st, count = (mh, starts_v, nv) if d == 0 else (mw, starts_u, nu)
                c = rng.uniform(0.1, 0.9)
                pos = family(lambda x: (np.array([x + c * m]), rng.uniform(0.15, 0.6) * m), st, (height, length)[d], count)
                bright = (pos[:, None] if d == 0 else pos[None, :]) * one
            else:
                bright = (wave(rng.uniform(0.2, 0.7)) > rng.uniform(0, 1)).astype(np.float32)
            blend(np.clip(wide * bright * rng.uniform(0.4, 1), 0, 1), rgb(0.95, 0.95, 0.92) * rng.uniform(0.8, 1.2))
    flatten()
    # Sky in the glass: a slow gradient, stronger on thin film; dirt along lower edges; droppings.
    if rng.random() < 0.5:
        g = np.linspace(-1, 1, nu, dtype=np.float32) * rng.normal(0, 1) + rng.normal(0, 0.3)
        tex = tex * np.exp(s.sheen * 0.5 * g)[None, :, None] + np.float32(max(0.0, s.sheen) * 0.12)
    if rng.random() < 0.25:
        dust = rgb(0.55, 0.48, 0.38) * rng.uniform(0.6, 1.3)
        f = 1 / (1 + np.exp(-(wave(rng.uniform(0.3, 2)) + rng.normal(-0.5, 0.8)))) * rng.uniform(0.1, 0.7)
        if rng.random() < 0.4:
            v = ((np.arange(nv) * texel) % (mh + sv)) / mh
            f = f * np.clip(v, 0, 1)[:, None] ** rng.uniform(1, 6)
        blend(f.astype(np.float32), dust)
        flatten()
    if s.hatched:
        yy, xx = np.mgrid[:nv, :nu].astype(np.float32)
        a, p = rng.uniform(0, np.pi), rng.uniform(2.5, 9)
        tex = tex * (1 + rng.uniform(0.05, 0.25) * np.sin((xx * np.cos(a) + yy * np.sin(a)) * 2 * np.pi / p + wave(2.0)))[..., None]
    # Glare: an ellipse on the glass, from a haze to full saturation.
    if rng.random() < s.glare:
        yy, xx = np.mgrid[:nv, :nu].astype(np.float32) * np.float32(texel)
        c, r = rng.uniform((0, 0), (length, height)), rng.uniform(0.7, 5, 2)
        d2 = ((xx - c[0]) / r[0]) ** 2 + ((yy - c[1]) / r[1]) ** 2
        g = np.exp(-(d2 ** rng.uniform(0.7, 3)) / 2) * rng.uniform(0.3, 3)
        keep = rng.uniform(0.6, 1.0) if rng.random() < 0.6 else 1.0
        soft = 1 - (1 - keep) * union(np.clip(U[0] + U[2], 0, 1), np.clip(V[0] + V[2], 0, 1))
        tex = tex + (g * soft)[..., None] * rgb(1.0, rng.uniform(0.9, 1), rng.uniform(0.75, 1.0))
    # Missing modules leave a hole with rails.
    present = np.ones((rows, cols), bool)
    if rng.random() < 0.25:
        for _ in range(int(rng.integers(1, 4))):
            j, i = rng.integers(rows), rng.integers(cols)
            n = int(rng.integers(1, 4))
            present[j, i : i + n] = False
    if rng.random() < 0.2:  # a ragged end
        n = int(rng.integers(1, max(2, min(4, cols))))
        present[int(rng.integers(rows)), (slice(0, n) if rng.random() < 0.5 else slice(cols - n, cols))] = False
    hole = ~present[iv][:, iu]
    if hole.any():
        v = (np.arange(nv) * texel % (mh + sv)) / mh
        rail = (np.abs(v - 0.25) < 0.03) | (np.abs(v - 0.75) < 0.03)
        alpha = np.where(hole, rail[:, None] * rng.choice([0.0, 1.0]), alpha).astype(np.float32)
        tex = np.where((hole & rail[:, None])[..., None], rgb(0.6, 0.6, 0.62), tex)
    alpha[(np.arange(nv) * texel) > height] = 0
    alpha[:, (np.arange(nu) * texel) > length] = 0

    quads = []
    for j in range(rows):
        for i in range(cols):
            if present[j, i]:
                x0, y0 = starts_u[i], starts_v[j]
                quads.append([[x0, y0 + mh], [x0 + mw, y0 + mh], [x0 + mw, y0], [x0, y0]])
    return tex, alpha, np.array(quads).reshape(-1, 4, 2), (length, height)


# --- scene ------------------------------------------------------------------------------------------------------


class Camera:
    """World (x east, y north, z up, metres) to pixels of a canvas; looks about downwards at the origin."""

    def __init__(self, rng: Rng, size: int, gsd: float, max_tilt: float):
        f = rng.uniform(2.0, 5.0) * size
        tilt = np.deg2rad(min(abs(rng.normal(0, max_tilt / 2)), max_tilt))
        toward, roll = rng.uniform(0, 2 * np.pi, 2)
        forward = np.array([np.sin(tilt) * np.cos(toward), np.sin(tilt) * np.sin(toward), -np.cos(tilt)])
        self.center = -forward * gsd * f
        x = np.array([np.cos(roll), np.sin(roll), 0.0])
        x -= forward * (x @ forward)
        x /= np.linalg.norm(x)
        self.r = np.stack([x, np.cross(forward, x), forward])
        self.f, self.size = f, size

    def __call__(self, p: np.ndarray) -> np.ndarray:
        q = (np.asarray(p, float) - self.center) @ self.r.T
        z = np.maximum(q[..., 2:], 0.1)
        return self.f * q[..., :2] / z + self.size / 2 - 0.5


def poly_mask(n: int, quads, blur: float = 0.0) -> np.ndarray:
    m = np.zeros((n, n), np.uint8)
    for q in quads:
        cv2.fillPoly(m, [np.clip(np.round(np.asarray(q) * 16), -(1 << 24), 1 << 24).astype(np.int32)], 255, cv2.LINE_AA, 4)
    m = m.astype(np.float32) / 255
    return cv2.GaussianBlur(m, (0, 0), blur) if blur > 0.3 else m


def bench_shadow(rng: Rng, n: int, polys: list[np.ndarray], rows: int, pitch: float, texel: float, onto) -> np.ndarray:
    """Shade 0..1 of benches whose seams let light through, broken here and there; `onto` takes world points to the canvas."""
    shade = poly_mask(n, [onto(p) for p in polys])
    light = np.zeros((n, n), np.uint8)
    widths = [int(v) for v in rng.integers(1, 4, 2)]
    axes = (rng.random() < 0.7, rng.random() < 0.8)
    for p in polys:
        cols = max(1, round(float(np.linalg.norm(p[1] - p[0])) / pitch))
        f, g = np.arange(1, rows)[:, None] / rows, np.arange(1, cols)[:, None] / cols
        along = np.stack([p[0] + (p[3] - p[0]) * f, p[1] + (p[2] - p[1]) * f], axis=1)
        across = np.stack([p[0] + (p[1] - p[0]) * g, p[3] + (p[2] - p[3]) * g], axis=1)
        for some, width, ends in zip(axes, widths, (along, across)):
            if some and len(ends):
                px = np.clip(np.round(onto(ends.reshape(-1, 3)) * 16), -(1 << 24), 1 << 24).astype(np.int32).reshape(-1, 2, 1, 2)
                cv2.polylines(light, list(px), False, 255, width, cv2.LINE_AA, 4)
    light = light.astype(np.float32) / 255 * rng.uniform(0.3, 1.0)
    if rng.random() < 0.6:
        light *= 1 / (1 + np.exp(-np.clip((noise_field(rng, n, rng.uniform(0.15, 1.0) / texel) + rng.normal(0, 0.5)) * rng.uniform(2, 10), -30, 30)))
    shade = shade * (1 - light)
    blur = rng.uniform(0.0, 1.5) * UP
    return cv2.GaussianBlur(shade, (0, 0), blur) if blur > 0.3 else shade


def draw(rng: Rng, size: int, short_side: tuple[float, float], empty: float = 0.06) -> tuple[np.ndarray, np.ndarray]:
    """One picture (size, size, 3) uint8 RGB and its modules' corners (n, 4, 2)."""
    style = Style(rng)
    px = np.exp(rng.uniform(np.log(short_side[0]), np.log(short_side[1])))
    gsd = min(style.size) / px
    n = size * UP
    cam = Camera(rng, n, gsd / UP, 28.0)
    texel = gsd / UP
    x = ground(rng, n, texel)
    extent = size * gsd
    theta = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(theta), np.sin(theta), rng.normal(0, 0.02)])
    axis /= np.linalg.norm(axis)
    flat = np.array([-np.sin(theta), np.cos(theta), 0.0])
    tilt = np.deg2rad(rng.uniform(0, 38) if rng.random() < 0.75 else rng.choice([0.0, rng.uniform(38, 60)]))
    slope = np.cos(tilt) * flat + np.array([0, 0, np.sin(tilt)])
    mw, mh = style.footprint()
    rows = int(rng.choice([1, 2, 3, 4, 5, 6], p=[0.17, 0.27, 0.2, 0.18, 0.1, 0.08]))
    bench_h = rows * (mh + style.seam[1])
    depth = bench_h * np.cos(tilt)
    pitch = depth + (rng.uniform(0.6, 5.0) if rng.random() < 0.85 else rng.uniform(5, 14))
    sun_el, sun_az = np.deg2rad(rng.uniform(12, 75)), rng.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(sun_el) * np.cos(sun_az), np.cos(sun_el) * np.sin(sun_az), np.sin(sun_el)])
    dark = rng.uniform(0.15, 0.75)
    sky = rgb(rng.uniform(0.6, 1.0), rng.uniform(0.8, 1.0), rng.uniform(1.0, 1.45))

    def onto_ground(p):
        return p - np.outer(p[:, 2] / sun[2], sun)

    def shadow(polys, amount=dark):
        nonlocal x
        m = poly_mask(n, polys, rng.uniform(0.0, 2.5) * UP)
        x *= 1 - m[..., None] * (1 - amount * sky)

    # Roads, tracks and trenches.
    if rng.random() < 0.3:
        a = theta + rng.choice([0, np.pi / 2]) + rng.normal(0, 0.1)
        d, w = np.array([np.cos(a), np.sin(a), 0]), rng.uniform(0.3, 5)
        o = np.array([*rng.uniform(-extent / 2, extent / 2, 2), 0])
        nrm = np.array([-d[1], d[0], 0])
        q = np.array([o - d * 99 - nrm * w / 2, o + d * 99 - nrm * w / 2, o + d * 99 + nrm * w / 2, o - d * 99 + nrm * w / 2])
        m = poly_mask(n, [cam(q)], rng.uniform(0.5, 6) * UP)
        a_, b_ = GROUNDS[rng.integers(3, len(GROUNDS))]
        c = a_ + (b_ - a_) * rng.random() + rng.standard_normal((n, n, 1), dtype=np.float32) * 0.04
        x = x + (c - x) * m[..., None]

    def rectangle(center, w, h, angle, z):
        d, e = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
        c = np.array([center[0], center[1], z])
        return np.array([c - d * w / 2 - e * h / 2, c + d * w / 2 - e * h / 2, c + d * w / 2 + e * h / 2, c - d * w / 2 + e * h / 2])

    def distractor():
        """Containers, cars, cabinets, roofs, sheets, pallets, sheds with ribs, tiles."""
        nonlocal x
        kind = rng.choice(["box", "roof", "long", "grid"], p=[0.45, 0.2, 0.2, 0.15])
        w, h = {"box": rng.uniform(0.4, 6, 2), "roof": rng.uniform(3, 15, 2), "long": (rng.uniform(3, 30), rng.uniform(0.1, 0.5)),
                "grid": rng.uniform(2, 10, 2)}[kind]
        z = {"box": rng.uniform(0, 2.6), "roof": rng.uniform(2, 5), "long": rng.uniform(0, 0.5), "grid": rng.uniform(0, 2.0)}[kind]
        angle = theta + rng.choice([0, np.pi / 2, rng.uniform(0, np.pi)])
        q = rectangle(rng.uniform(-extent * 0.7, extent * 0.7, 2), w, h, angle, z)
        base = q.copy()
        base[:, 2] = 0
        shadow([cv2.convexHull(np.concatenate([cam(base), cam(onto_ground(q))]).astype(np.float32))[:, 0]])
        c = rgb(*rng.uniform(0.05, 1, 3)) if rng.random() < 0.4 else rgb(1, 1, 1) * rng.uniform(0.05, 1.1)
        hull = cv2.convexHull(np.concatenate([cam(base), cam(q)]).astype(np.float32))[:, 0]
        lo = np.clip(np.floor(hull.min(axis=0)).astype(int) - 2, 0, n)
        hi = np.clip(np.ceil(hull.max(axis=0)).astype(int) + 3, 0, n)
        if (hi <= lo).any():
            return
        side = int((hi - lo).max())
        view = x[lo[1] : hi[1], lo[0] : hi[0]]
        m = poly_mask(side, [hull - lo])[: view.shape[0], : view.shape[1], None]
        view += (c * rng.uniform(0.4, 0.9) - view) * m
        m = poly_mask(side, [cam(q) - lo])[: view.shape[0], : view.shape[1], None]
        tex = np.ones((64, 64, 3), np.float32) * c
        if kind in ("roof", "grid"):
            step = int(rng.integers(3, 16))
            tex[::step] *= rng.uniform(0.4, 1.5)
            if kind == "grid":
                tex[:, :: int(rng.integers(3, 16))] *= rng.uniform(0.4, 1.5)
        h_, _ = cv2.findHomography(np.array([[0, 0], [64, 0], [64, 64], [0, 64]], float), cam(q) - lo)
        if h_ is None:
            return
        t = cv2.warpPerspective(tex, h_, (view.shape[1], view.shape[0]), flags=cv2.INTER_LINEAR)
        view += (t - view) * m

    for _ in range(int(rng.poisson(0.6))):
        distractor()

    quads_out: list[np.ndarray] = []
    if rng.random() < empty:
        for _ in range(int(rng.integers(0, 5))):
            distractor()
    else:
        # Lines of benches, south to north.
        reach = 0.75 * extent + depth
        offset = rng.uniform(-pitch, pitch)
        k0 = int(np.floor((-reach - offset) / pitch))
        k1 = int(np.ceil((reach - offset) / pitch))
        benches = []
        low = rng.uniform(0.3, 1.3)
        gap = rng.uniform(0.1, 0.6) if rng.random() < 0.5 else rng.uniform(0.6, 4)
        cols = int(rng.integers(2, 26))
        aligned = rng.random() < 0.6
        phase = rng.uniform(-30, 0)
        stop = rng.uniform(-0.3, 0.5) * extent if rng.random() < 0.3 else 1e9  # the plant ends here
        for k in range(k0, k1 + 1):
            if rng.random() < 0.04:
                continue
            t = -reach - 25 + (phase if aligned else rng.uniform(-15, 0))
            while t < reach:
                nc = cols if rng.random() < 0.7 else max(2, cols + int(rng.integers(-4, 5)))
                length = nc * (mw + style.seam[0])
                if t + length > -reach and t < stop:
                    jig = rng.normal(0, 0.06, 2)
                    o = axis * (t + jig[0]) + flat * (k * pitch + offset + jig[1]) + np.array([0, 0, low])
                    benches.append((o, nc))
                t += length + gap + (rng.uniform(2, 8) if rng.random() < 0.08 else 0)
        far = [b for b in benches if np.linalg.norm((b[0] + axis * b[1] * mw / 2)[:2]) < reach + b[1] * mw / 2 + depth]
        polys = []
        for o, nc in far:
            e = axis * nc * (mw + style.seam[0])
            u = slope * bench_h
            polys.append(np.array([o, o + e, o + e + u, o + u]))
        if rng.random() < 0.25:
            shadow([cam(onto_ground(p)) for p in polys])
        else:  # light falls through the seams: a lattice on the ground that is none of modules
            x *= 1 - bench_shadow(rng, n, polys, rows, mw + style.seam[0], texel, lambda p: cam(onto_ground(p)))[..., None] * (1 - dark * sky)
        if rng.random() < 0.4:  # posts, cables, cable trays
            color = rgb(1, 1, 1) * rng.uniform(0.1, 0.9)
            m = np.zeros((n, n), np.uint8)
            for p in polys[:12]:
                f = rng.uniform(0, 1)
                a, b = p[0] + (p[1] - p[0]) * f, p[3] + (p[2] - p[3]) * f
                b = b + flat * rng.uniform(0, pitch)
                a[2] = b[2] = 0
                pa, pb = cam(np.array([a, b]))
                cv2.line(m, tuple(int(v) for v in np.clip(pa, -4000, 4000)), tuple(int(v) for v in np.clip(pb, -4000, 4000)), 255, int(rng.integers(1, 5)), cv2.LINE_AA)
            m = (m.astype(np.float32) / 255)[..., None]
            x *= 1 - m
            x += color * m
        textures: dict = {}
        order = sorted(far, key=lambda b: -np.linalg.norm(b[0] - cam.center))
        for o, nc in order:
            probe = cam(np.array([o, o + axis * nc * mw, o + axis * nc * mw + slope * bench_h, o + slope * bench_h]))
            if (probe.max(axis=0) < 0).any() or (probe.min(axis=0) > n).any():
                continue
            # Cut what cannot be seen: whole columns beyond the canvas.
            ts = np.arange(nc + 1) * (mw + style.seam[0])
            mid = cam(o + np.outer(ts, axis) + slope * bench_h / 2)
            margin = (bench_h + 3 * mw) / texel
            inside = ((mid > -margin) & (mid < n + margin)).all(axis=1)
            if not inside.any():
                continue
            i0, i1 = int(np.argmax(inside)), int(len(inside) - 1 - np.argmax(inside[::-1]))
            i0, i1 = max(0, i0 - 1), min(nc, i1 + 1)
            o, nc = o + axis * i0 * (mw + style.seam[0]), max(1, i1 - i0)
            # Two or three textures serve all benches of a picture, each bench with a tint of its own.
            variant = int(rng.integers(3)) if len(far) > 3 else 0
            if variant not in textures or textures[variant][4] < nc:
                textures[variant] = (*bench_texture(style, rng, nc, rows, texel), nc)
            tex, alpha, quads, (length, height), full = textures[variant]
            if nc < full:
                length = nc * (mw + style.seam[0]) - style.seam[0]
                end = int(length / texel)
                tex, alpha = tex[:, : end + 1], alpha[:, : end + 1].copy()
                alpha[:, end:] = length / texel - end
                quads = quads[quads[:, 1, 0] < length + 1e-6]
            tex = tex * np.float32(np.exp(rng.normal(0, 0.06)))
            # Texture coordinates: u along the axis, v down the slope from its top.
            def world(q):
                return o + q[..., :1] * axis + (height - q[..., 1:]) * slope

            rect = np.array([[0, 0], [length, 0], [length, height], [0, height]])
            h_, _ = cv2.findHomography(rect / texel - 0.5, cam(world(rect)))
            if h_ is None:
                continue
            rgba = np.empty((*alpha.shape, 4), np.float32)
            np.multiply(np.minimum(tex, 4), alpha[..., None], out=rgba[..., :3])
            rgba[..., 3] = alpha
            lo = np.clip(np.floor(cam(world(rect)).min(axis=0)).astype(int) - 2, 0, n)
            hi = np.clip(np.ceil(cam(world(rect)).max(axis=0)).astype(int) + 3, 0, n)
            if (hi <= lo).any():
                continue
            move = np.eye(3)
            move[:2, 2] = -lo
            w = cv2.warpPerspective(rgba, move @ h_, tuple(int(v) for v in hi - lo), flags=cv2.INTER_LINEAR, borderValue=(0, 0, 0, 0))
            view = x[lo[1] : hi[1], lo[0] : hi[0]]
            view *= 1 - w[..., 3:]
            view += w[..., :3]
            if len(quads):
                quads_out.append(cam(world(quads)))
    # Trees and boulders: facets about a centre, with a shadow.
    if rng.random() < 0.3:
        for _ in range(int(rng.integers(1, 5))):
            c, r = rng.uniform(0, n, 2), np.exp(rng.uniform(np.log(0.15), np.log(4.0))) / texel
            k = int(rng.integers(5, 12))
            a = np.linspace(0, 2 * np.pi, k, endpoint=False) + rng.uniform(0, 1, k) * 3 / k
            ring = np.stack([np.cos(a), np.sin(a)], axis=1) * r * rng.uniform(0.75, 1.1, (k, 1))
            push = rng.normal(0, 0.6, 2) * r
            if any(cv2.pointPolygonTest(q.astype(np.float32).reshape(-1, 1, 2), c, False) >= 0 for qs in quads_out for q in qs):
                continue
            shadow([c + push + ring])
            base = (rgb(0.2, 0.28, 0.12) if rng.random() < 0.6 else rgb(0.4, 0.37, 0.33)) * rng.uniform(0.4, 1.6)
            inner = ring * rng.uniform(0.3, 0.7)
            for i in range(k):
                j = (i + 1) % k
                for t in (c + np.array([ring[i], ring[j], inner[j], inner[i]]), c + np.array([inner[i], inner[j], [0, 0]])):
                    lo = np.clip(np.floor(t.min(axis=0)).astype(int) - 2, 0, n)
                    hi = np.clip(np.ceil(t.max(axis=0)).astype(int) + 3, 0, n)
                    if (hi <= lo).any():
                        continue
                    view = x[lo[1] : hi[1], lo[0] : hi[0]]
                    m = poly_mask(int((hi - lo).max()), [t - lo])[: view.shape[0], : view.shape[1], None]
                    view += (base * rng.uniform(0.6, 1.4) - view) * m
    # Bushes, some over the edge of a bench.
    if rng.random() < 0.3:
        for _ in range(int(rng.integers(1, 6))):
            c, r = rng.uniform(0, n, 2), rng.uniform(0.15, 1.0) / texel
            a = np.linspace(0, 2 * np.pi, 24, endpoint=False)
            rr = r * (1 + 0.25 * rng.standard_normal(24))
            q = c + np.stack([np.cos(a), np.sin(a)], axis=1) * rr[:, None]
            lo = np.clip(np.floor(q.min(axis=0)).astype(int) - 3, 0, n)
            hi = np.clip(np.ceil(q.max(axis=0)).astype(int) + 4, 0, n)
            k = int((hi - lo).max())
            if k < 2:
                continue
            m = poly_mask(k, [q - lo], 1.0)[: hi[1] - lo[1], : hi[0] - lo[0], None]
            view = x[lo[1] : hi[1], lo[0] : hi[0]]
            g = rgb(0.16, 0.26, 0.10) * rng.uniform(0.5, 2)
            view += (g * (1 + 0.4 * rng.standard_normal(m.shape, dtype=np.float32)) - view) * m
    image = cv2.resize(np.clip(x, 0, 1).astype(np.float32), (size, size), interpolation=cv2.INTER_AREA)
    quads = np.concatenate(quads_out) if quads_out else np.zeros((0, 4, 2))
    quads = (quads + 0.5) / UP - 0.5
    return (image * 255 + 0.5).astype(np.uint8), quads
