"""The texture of a bench: modules with cells, frames, seams, dirt, glare, holes; and the shadow of benches."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..augment import Rng, noise_field
from .canvas import FAR, UP, poly_mask
from .patterns import integrate, lines, rgb, stripes, union
from .style import Style


@dataclass
class Axis:
    """Coverage profiles along one axis of a bench, one value per texel, and where its modules start, in metres."""

    starts: np.ndarray
    module: float  # length of a module along the axis
    span: float
    seam: np.ndarray
    wide: np.ndarray  # seams and 3 cm about them
    frame: np.ndarray
    margin: np.ndarray
    cell: np.ndarray
    bus: np.ndarray
    half: np.ndarray
    notch: np.ndarray


def axis_of(s: Style, starts: np.ndarray, module: float, count: int, texel: float, along_short: bool, seam: float) -> Axis:
    """The profiles of the axis that the modules' short side lies along, or of the other."""
    span = float(starts[-1] + module)
    cells = s.cells[0] if along_short else s.cells[1]
    inset = s.frame + s.margin
    inner = module - 2 * inset
    nothing = np.zeros(count, np.float32)

    def family(offsets, widths) -> np.ndarray:
        """Stripes at the same offsets in every module."""
        c = (starts[:, None] + np.ravel(offsets)[None, :]).ravel()
        return integrate(stripes(span, c, np.tile(np.broadcast_to(widths, np.shape(np.ravel(offsets))), len(starts))), texel, count)

    between = starts[1:] - seam / 2
    gap = s.cell_gap * (s.gap_ratio if along_short else 1.0)
    grid = lines(inset, inner, cells)
    wires = max(1, s.bus_count) * s.cells[0]
    has_wires = s.bus_count and s.kind != "thin" and along_short != s.bus_across
    return Axis(
        starts,
        module,
        span,
        seam=integrate(stripes(span, between, seam), texel, count) if len(between) else nothing,
        wide=integrate(stripes(span, between, seam + 0.03), texel, count) if len(between) else nothing,
        frame=family([s.frame / 2, module - s.frame / 2], s.frame) if s.frame else nothing,
        margin=family([s.frame + s.margin / 2, module - s.frame - s.margin / 2], s.margin) if s.margin else nothing,
        cell=family(grid, gap) if cells > 1 else nothing,
        bus=family(inset + inner * (np.arange(wires) + 0.5) / wires, s.bus_gap) if has_wires else nothing,
        half=family([module / 2], s.half_gap) if s.halfcut and not along_short else nothing,
        notch=family(grid, gap + s.chamfer) if s.chamfer and cells > 1 else nothing,
    )


class Layers:
    """Coats of paint over a texture, flattened at once: each one's share of the final colour, from the top down."""

    def __init__(self, tex: np.ndarray, sampled: Rng | None = None):
        self.tex, self.coats, self.sampled = tex, [], sampled

    def blend(self, mask: np.ndarray, color) -> None:
        if mask.any():
            if self.sampled is not None:  # each texel is one sample: painted or not
                mask = (self.sampled.random(mask.shape, dtype=np.float32) < mask).astype(np.float32)
            self.coats.append((mask, np.asarray(color, np.float32)))

    def flatten(self) -> np.ndarray:
        through = np.ones(self.tex.shape[:2], np.float32)
        shares = []
        for mask, _ in reversed(self.coats):
            shares.append(through * mask)
            through = through * (1 - mask)
        tex = self.tex * through[..., None]
        if self.coats:
            stack = np.stack(shares, axis=-1).reshape(-1, len(shares))
            tex += (stack @ np.stack([c for _, c in reversed(self.coats)])).reshape(tex.shape)
        return tex


def base_colors(s: Style, rng: Rng, u: Axis, v: Axis, texel: float, nu: int, nv: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour per module and cell (nv, nu, 3), and each texel's column and row."""
    rows, cols = len(v.starts), len(u.starts)
    tint = np.exp(rng.normal(0, s.module_var, (rows, cols, 1))).astype(np.float32)
    if rng.random() < 0.3:  # strings of another batch
        tint[:, int(rng.integers(cols)) :] *= np.float32(np.exp(rng.normal(0, 0.2)))
    hue = rng.normal(0, s.hue_var, (rows, cols, 3)).astype(np.float32)
    color = np.clip(s.color * tint + hue * s.color.mean() * 4, 0.01, 1).astype(np.float32)
    su, sv = s.seam
    iu = np.clip(((np.arange(nu) + 0.5) * texel + su / 2) // (u.module + su), 0, cols - 1).astype(int)
    iv = np.clip(((np.arange(nv) + 0.5) * texel + sv / 2) // (v.module + sv), 0, rows - 1).astype(int)
    tex = color[iv][:, iu]
    if s.cell_var > 0.01:
        cu, cv = s.cells[::-1] if s.landscape else s.cells
        tu = np.clip((np.arange(nu) * texel / u.module * cu).astype(int), 0, 10_000)
        tv = np.clip((np.arange(nv) * texel / v.module * cv).astype(int), 0, 10_000)
        cells = np.exp(rng.normal(0, s.cell_var, (tv.max() + 1, tu.max() + 1))).astype(np.float32)
        tex = tex * cells[tv][:, tu][..., None]
    return tex, iu, iv


class Bench:
    """Paints one texture."""

    def __init__(self, s: Style, rng: Rng, cols: int, rows: int, texel: float):
        self.s, self.rng, self.texel = s, rng, texel
        mw, mh = s.footprint()
        su, sv = s.seam
        starts_u, starts_v = np.arange(cols) * (mw + su), np.arange(rows) * (mh + sv)
        self.length, self.height = cols * (mw + su) - su, rows * (mh + sv) - sv
        self.nu, self.nv = int(np.ceil(self.length / texel)) + 1, int(np.ceil(self.height / texel)) + 1
        self.u = axis_of(s, starts_u, mw, self.nu, texel, not s.landscape, su)
        self.v = axis_of(s, starts_v, mh, self.nv, texel, s.landscape, sv)

    def wave(self, cell: float) -> np.ndarray:
        """Smooth noise, `cell` metres from bump to bump."""
        shape = (max(2, int(self.nv * self.texel / cell) + 2), max(2, int(self.nu * self.texel / cell) + 2))
        return cv2.resize(self.rng.standard_normal(shape, dtype=np.float32), (self.nu, self.nv), interpolation=cv2.INTER_LINEAR)

    def patchy(self, cell: float, mean: float) -> np.ndarray:
        """1 here, 0 there, in soft patches."""
        n = self.wave(cell) + self.rng.normal(mean, 0.5)
        return 1 / (1 + np.exp(-np.clip(n * self.rng.uniform(2, 10), -30, 30)))

    def along(self, name: str, d: int) -> np.ndarray:
        """A profile of one of the axes over the whole texture."""
        p = getattr((self.u, self.v)[d], name)
        return np.broadcast_to(p[None, :] if d == 0 else p[:, None], (self.nv, self.nu))

    def cells(self, layers: Layers) -> None:
        s, u, v = self.s, self.u, self.v
        layers.blend(union(u.bus, v.bus), s.bus_color)
        layers.blend(union(u.cell, v.cell), s.cell_color)
        if s.chamfer:
            layers.blend(v.notch[:, None] * u.notch[None, :], s.cell_color)
        if s.half_gap:
            half = union(u.half, v.half)
            layers.blend(half * self.patchy(self.rng.uniform(0.15, 0.6), 0.4) if s.half_broken else half, s.half_color)
        if s.margin > 0:
            layers.blend(union(u.margin, v.margin), s.cell_color)

    def seams(self, layers: Layers, alpha: np.ndarray) -> None:
        """Frames and seams; each direction has its own visibility."""
        s, rng = self.s, self.rng
        for d in range(2):
            layers.blend(self.along("frame", d) * s.frame_fade[d], s.frame_color)
        for d in range(2):
            seam = self.along("seam", d)
            if s.seam_open[d]:
                alpha *= 1 - seam
                continue
            layers.blend(seam * self.patchy(rng.uniform(0.15, 0.8), 0.2) if s.broken[d] else seam, s.seam_color[d])
            if s.streak[d]:
                self.streaks(layers, d)

    def streaks(self, layers: Layers, d: int) -> None:
        """Light at seams, in places."""
        rng = self.rng
        if rng.random() < 0.6:  # lens-shaped light between clamps, at the same place in every module
            other = (self.v, self.u)[d]
            c = other.starts + rng.uniform(0.1, 0.9) * other.module
            count = (self.nv, self.nu)[d]
            pos = integrate(stripes(other.span, c, rng.uniform(0.15, 0.6) * other.module), self.texel, count)
            bright = pos[:, None] if d == 0 else pos[None, :]
        else:
            bright = (self.wave(rng.uniform(0.2, 0.7)) > rng.uniform(0, 1)).astype(np.float32)
        layers.blend(np.clip(self.along("wide", d) * bright * rng.uniform(0.4, 1), 0, 1), rgb(0.95, 0.95, 0.92) * rng.uniform(0.8, 1.2))

    def weather(self, tex: np.ndarray) -> np.ndarray:
        """Sky in the glass: a slow gradient, stronger on thin film; dirt, most along lower edges; moire."""
        s, rng = self.s, self.rng
        if rng.random() < 0.5:
            g = np.linspace(-1, 1, self.nu, dtype=np.float32) * rng.normal(0, 1) + rng.normal(0, 0.3)
            tex = tex * np.exp(s.sheen * 0.5 * g)[None, :, None] + np.float32(max(0.0, s.sheen) * 0.12)
        if rng.random() < 0.3:
            dust = rgb(0.55, 0.48, 0.38) * rng.uniform(0.6, 1.3)
            f = 1 / (1 + np.exp(-(self.wave(rng.uniform(0.3, 2)) + rng.normal(-0.3, 0.9)))) * rng.uniform(0.1, 0.85)
            if rng.random() < 0.4:
                sv = s.seam[1]
                v = ((np.arange(self.nv) * self.texel) % (self.v.module + sv)) / self.v.module
                f = f * np.clip(v, 0, 1)[:, None] ** rng.uniform(1, 6)
            tex = tex + (dust - tex) * f[..., None].astype(np.float32)
        if s.hatched:
            yy, xx = np.mgrid[: self.nv, : self.nu].astype(np.float32)
            a, p = rng.uniform(0, np.pi), rng.uniform(2.5, 9)
            tex = tex * (1 + rng.uniform(0.05, 0.25) * np.sin((xx * np.cos(a) + yy * np.sin(a)) * 2 * np.pi / p + self.wave(2.0)))[..., None]
        return tex

    def glare(self, tex: np.ndarray) -> np.ndarray:
        """An ellipse on the glass, from a haze to full saturation."""
        s, rng, u, v = self.s, self.rng, self.u, self.v
        yy, xx = np.mgrid[: self.nv, : self.nu].astype(np.float32) * np.float32(self.texel)
        c, r = rng.uniform((0, 0), (self.length, self.height)), rng.uniform(0.7, 5, 2)
        d2 = ((xx - c[0]) / r[0]) ** 2 + ((yy - c[1]) / r[1]) ** 2
        g = np.exp(-(d2 ** rng.uniform(0.7, 3)) / 2) * rng.uniform(0.3, 3)
        keep = rng.uniform(0.6, 1.0) if rng.random() < 0.6 else 1.0
        soft = 1 - (1 - keep) * union(np.clip(u.seam + u.frame, 0, 1), np.clip(v.seam + v.frame, 0, 1))
        return tex + (g * soft)[..., None] * rgb(1.0, rng.uniform(0.9, 1), rng.uniform(0.75, 1.0))

    def holes(self, tex: np.ndarray, alpha: np.ndarray, iu: np.ndarray, iv: np.ndarray, ragged: float):
        """Missing modules leave a hole with rails, ends are ragged; which modules are there."""
        rng = self.rng
        rows, cols = len(self.v.starts), len(self.u.starts)
        present = np.ones((rows, cols), bool)
        if rng.random() < 0.25:
            for _ in range(int(rng.integers(1, 4))):
                j, i = rng.integers(rows), rng.integers(cols)
                present[j, i : i + int(rng.integers(1, 4))] = False
        for _ in range(3):
            if rng.random() < ragged:
                n = int(rng.integers(1, max(2, min(5, cols))))
                present[int(rng.integers(rows)), (slice(0, n) if rng.random() < 0.5 else slice(cols - n, cols))] = False
        hole = ~present[iv][:, iu]
        if hole.any():
            v = (np.arange(self.nv) * self.texel % (self.v.module + self.s.seam[1])) / self.v.module
            rail = (np.abs(v - 0.25) < 0.03) | (np.abs(v - 0.75) < 0.03)
            alpha = np.where(hole, rail[:, None] * rng.choice([0.0, 1.0]), alpha).astype(np.float32)
            tex = np.where((hole & rail[:, None])[..., None], rgb(0.6, 0.6, 0.62), tex)
        return tex, alpha, present

    def quads(self, present: np.ndarray) -> np.ndarray:
        """Corners (n, 4, 2) of the modules that are there, in metres along the row and down the slope."""
        mw, mh = self.u.module, self.v.module
        out = [
            [[x0, y0 + mh], [x0 + mw, y0 + mh], [x0 + mw, y0], [x0, y0]]
            for j, y0 in enumerate(self.v.starts)
            for i, x0 in enumerate(self.u.starts)
            if present[j, i]
        ]
        return np.array(out).reshape(-1, 4, 2)


def bench_texture(s: Style, rng: Rng, cols: int, rows: int, texel: float, ragged: float = 0.07):
    """Colour and opacity of a bench (top row first), its modules' corners in metres (n, 4, 2), its length and height."""
    b = Bench(s, rng, cols, rows, texel)
    tex, iu, iv = base_colors(s, rng, b.u, b.v, texel, b.nu, b.nv)
    layers = Layers(tex, rng if s.sampled else None)
    alpha = np.ones((b.nv, b.nu), np.float32)
    b.cells(layers)
    b.seams(layers, alpha)
    tex = b.weather(layers.flatten())
    if rng.random() < s.glare:
        tex = b.glare(tex)
    tex, alpha, present = b.holes(tex, alpha, iu, iv, ragged)
    alpha[(np.arange(b.nv) * texel) > b.height] = 0
    alpha[:, (np.arange(b.nu) * texel) > b.length] = 0
    return tex, alpha, b.quads(present), (b.length, b.height)


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
                px = np.clip(np.round(onto(ends.reshape(-1, 3)) * 16), -FAR, FAR).astype(np.int32).reshape(-1, 2, 1, 2)
                cv2.polylines(light, list(px), False, 255, width, cv2.LINE_AA, 4)
    light = light.astype(np.float32) / 255 * rng.uniform(0.3, 1.0)
    if rng.random() < 0.6:
        patches = noise_field(rng, n, rng.uniform(0.15, 1.0) / texel) + rng.normal(0, 0.5)
        light *= 1 / (1 + np.exp(-np.clip(patches * rng.uniform(2, 10), -30, 30)))
    shade = shade * (1 - light)
    blur = rng.uniform(0.0, 1.5) * UP
    return cv2.GaussianBlur(shade, (0, 0), blur) if blur > 0.3 else shade
