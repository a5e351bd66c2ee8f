"""The layout of a whole picture: rows of benches in a field, or arrays on a roof."""

from __future__ import annotations

import cv2
import numpy as np

from ..augment import Rng
from . import clutter
from .bench import bench_shadow, bench_texture
from .canvas import UP, Canvas
from .ground import ground, track
from .patterns import log_uniform, rgb
from .roof import roof
from .style import Style

ROOFS = 0.3  # share of pictures with arrays on roofs
OBLIQUE = 0.3  # share of pictures that may be far off nadir
TILT = (28.0, 48.0)  # largest angle off nadir in degrees, of most pictures and of the oblique ones


class Layout:
    """How the benches of a picture stand: direction, slope, rows, distances in metres."""

    def __init__(self, rng: Rng, style: Style, on_roof: bool):
        self.on_roof = on_roof
        self.theta = rng.uniform(0, 2 * np.pi)
        self.axis = np.array([np.cos(self.theta), np.sin(self.theta), rng.normal(0, 0.005 if on_roof else 0.02)])
        self.axis /= np.linalg.norm(self.axis)
        self.flat = np.array([-np.sin(self.theta), np.cos(self.theta), 0.0])
        tilt = np.deg2rad(rng.uniform(0, 38) if rng.random() < 0.75 else rng.choice([0.0, rng.uniform(38, 60)]))
        if on_roof:
            tilt = 0.0 if rng.random() < 0.75 else np.deg2rad(rng.uniform(5, 18))
        self.slope = np.cos(tilt) * self.flat + np.array([0, 0, np.sin(tilt)])
        self.mw, self.mh = style.footprint()
        self.step = self.mw + style.seam[0]  # from module to module along a row
        weights = [0.17, 0.27, 0.2, 0.18, 0.1, 0.08]
        if style.halfcut and not style.landscape:
            weights = [0.3, 0.38, 0.17, 0.08, 0.04, 0.03]
        self.rows = int(rng.choice([1, 2, 3, 4, 5, 6], p=weights))
        self.height = self.rows * (self.mh + style.seam[1])
        self.depth = self.height * np.cos(tilt)
        self.pitch = self.depth + (rng.uniform(0.6, 5.0) if rng.random() < 0.85 else rng.uniform(5, 14))
        self.low = rng.uniform(0.3, 1.3)
        self.gap = rng.uniform(0.1, 0.6) if rng.random() < 0.5 else rng.uniform(0.6, 4)
        self.cols = int(rng.integers(2, 26))
        self.aligned = rng.random() < 0.6
        self.ragged = 0.07
        if on_roof:
            self.pitch = self.depth + log_uniform(rng, 0.05, 4.0)
            self.low = rng.uniform(0.05, 0.25)
            self.gap = log_uniform(rng, 0.1, 6.0)
            self.cols = int(rng.integers(1, 14))
            self.ragged = rng.choice([0.0, 0.5])

    def benches(self, rng: Rng, extent: float) -> list[tuple[np.ndarray, int]]:
        """Lower left corners and numbers of columns of the benches about the picture, lines from south to north."""
        reach = 0.75 * extent + self.depth
        offset = rng.uniform(-self.pitch, self.pitch)
        k0, k1 = int(np.floor((-reach - offset) / self.pitch)), int(np.ceil((reach - offset) / self.pitch))
        phase = rng.uniform(-30, 0)
        stop = rng.uniform(-0.3, 0.5) * extent if rng.random() < 0.3 else 1e9  # the plant ends here
        skip = 0.2 if self.on_roof else 0.04
        out = []
        for k in range(k0, k1 + 1):
            if rng.random() < skip:
                continue
            t = -reach - 25 + (phase if self.aligned else rng.uniform(-15, 0))
            while t < reach:
                nc = self.cols if rng.random() < 0.7 else max(1 + (not self.on_roof), self.cols + int(rng.integers(-4, 5)))
                length = nc * self.step
                if t + length > -reach and t < stop and (not self.on_roof or rng.random() < 0.8):
                    jig = rng.normal(0, 0.02 if self.on_roof else 0.06, 2)
                    out.append((self.axis * (t + jig[0]) + self.flat * (k * self.pitch + offset + jig[1]) + np.array([0, 0, self.low]), nc))
                t += length + self.gap + (rng.uniform(2, 8) if rng.random() < 0.08 else 0)
        return [b for b in out if np.linalg.norm((b[0] + self.axis * b[1] * self.mw / 2)[:2]) < reach + b[1] * self.mw / 2 + self.depth]

    def outline(self, o: np.ndarray, nc: int) -> np.ndarray:
        """Corners in the world of a bench."""
        e, u = self.axis * nc * self.step, self.slope * self.height
        return np.array([o, o + e, o + e + u, o + u])


def visible_part(c: Canvas, lay: Layout, o: np.ndarray, nc: int) -> tuple[np.ndarray, int] | None:
    """The bench less columns beyond the canvas."""
    probe = c.cam(lay.outline(o, nc))
    if (probe.max(axis=0) < 0).any() or (probe.min(axis=0) > c.n).any():
        return None
    mid = c.cam(o + np.outer(np.arange(nc + 1) * lay.step, lay.axis) + lay.slope * lay.height / 2)
    margin = (lay.height + 3 * lay.mw) / c.texel
    inside = ((mid > -margin) & (mid < c.n + margin)).all(axis=1)
    if not inside.any():
        return None
    i0, i1 = max(0, int(np.argmax(inside)) - 1), min(nc, int(len(inside) - np.argmax(inside[::-1])))
    return o + lay.axis * i0 * lay.step, max(1, i1 - i0)


def paint(c: Canvas, style: Style, lay: Layout, o: np.ndarray, made, nc: int) -> np.ndarray:
    """Paints a bench of `nc` columns with a texture of at least as many; its modules' corners in pixels (n, 4, 2)."""
    tex, alpha, quads, (length, height), full = made
    if nc < full:
        length = nc * lay.step - style.seam[0]
        end = int(length / c.texel)
        tex, alpha = tex[:, : end + 1], alpha[:, : end + 1].copy()
        alpha[:, end:] *= length / c.texel - end
        quads = quads[quads[:, 1, 0] < length + 1e-6]
    tex = tex * np.float32(np.exp(c.rng.normal(0, 0.06)))

    def world(q):
        """Texture coordinates: u along the axis, v down the slope from its top."""
        return o + q[..., :1] * lay.axis + (height - q[..., 1:]) * lay.slope

    rect = np.array([[0, 0], [length, 0], [length, height], [0, height]])
    corners = c.cam(world(rect))
    h, _ = cv2.findHomography(rect / c.texel - 0.5, corners)
    found = c.window(corners)
    if h is None or found is None:
        return np.zeros((0, 4, 2))
    view, lo = found
    rgba = np.empty((*alpha.shape, 4), np.float32)
    np.multiply(np.minimum(tex, 4), alpha[..., None], out=rgba[..., :3])
    rgba[..., 3] = alpha
    move = np.eye(3)
    move[:2, 2] = -lo
    w = cv2.warpPerspective(rgba, move @ h, (view.shape[1], view.shape[0]), flags=cv2.INTER_LINEAR, borderValue=(0, 0, 0, 0))
    view *= 1 - w[..., 3:]
    view += w[..., :3]
    return c.cam(world(quads)) if len(quads) else np.zeros((0, 4, 2))


def plant(c: Canvas, style: Style, lay: Layout) -> list[np.ndarray]:
    """Draws all benches with their shadows; their modules' corners in pixels."""
    rng = c.rng
    benches = lay.benches(rng, c.extent)
    outlines = [lay.outline(o, nc) for o, nc in benches]
    if rng.random() < 0.25 or lay.on_roof:
        c.shadow([c.cam(c.onto_ground(p)) for p in outlines])
    else:  # light falls through the seams: a lattice on the ground that is none of modules
        c.shade(bench_shadow(rng, c.n, outlines, lay.rows, lay.step, c.texel, lambda p: c.cam(c.onto_ground(p))))
    if rng.random() < 0.4 and not lay.on_roof:
        clutter.posts(c, outlines, lay.flat, lay.pitch)
    quads, textures = [], {}
    for o, nc in sorted(benches, key=lambda b: -np.linalg.norm(b[0] - c.cam.center)):
        part = visible_part(c, lay, o, nc)
        if part is None:
            continue
        o, nc = part
        # Two or three textures serve all benches of a picture, each bench with a tint of its own.
        variant = int(rng.integers(3)) if len(benches) > 3 else 0
        if variant not in textures or textures[variant][4] < nc:
            textures[variant] = (*bench_texture(style, rng, nc, lay.rows, c.texel, lay.ragged), nc)
        quads.append(paint(c, style, lay, o, textures[variant], nc))
    return quads


def draw(rng: Rng, size: int, short_side: tuple[float, float], empty: float = 0.09) -> tuple[np.ndarray, np.ndarray]:
    """One picture (size, size, 3) uint8 RGB and its modules' corners (n, 4, 2)."""
    style = Style(rng)
    gsd = min(style.size) / log_uniform(rng, *short_side)
    c = Canvas(rng, size, gsd, TILT[int(rng.random() < OBLIQUE)])
    c.x[:] = ground(rng, c.n, c.texel)
    lay = Layout(rng, style, rng.random() < ROOFS)
    if lay.on_roof:
        turned = lay.theta + rng.choice([0, 0, 0, np.pi / 2]) + (0 if rng.random() < 0.8 else rng.uniform(0, np.pi))
        roof(c, turned, wide=rng.random() < 0.5)
    elif rng.random() < 0.3:
        track(c, lay.theta)
    for _ in range(int(rng.poisson(0.7))):
        clutter.distractor(c, lay.theta)
    quads: list[np.ndarray] = []
    if rng.random() < empty:
        if rng.random() < 0.5:
            roof(c, rng.uniform(0, np.pi), wide=rng.random() < 0.4)
        for _ in range(int(rng.integers(0, 6))):
            clutter.distractor(c, lay.theta)
    else:
        quads = plant(c, style, lay)
    if rng.random() < 0.3:
        for _ in range(int(rng.integers(1, 5))):
            clutter.tree(c, quads)
    if rng.random() < 0.3:
        for _ in range(int(rng.integers(1, 6))):
            clutter.bush(c)
    image = cv2.resize(np.clip(c.x, 0, 1).astype(np.float32), (size, size), interpolation=cv2.INTER_AREA)
    corners = np.concatenate(quads) if quads else np.zeros((0, 4, 2))
    return (image * 255 + 0.5).astype(np.uint8), (corners + 0.5) / UP - 0.5
