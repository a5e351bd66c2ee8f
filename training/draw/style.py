"""The looks of modules."""

from __future__ import annotations

import numpy as np

from ..augment import Rng
from .patterns import log_uniform, rgb

KINDS = {"poly": 0.16, "mono": 0.1, "black": 0.06, "thin": 0.1, "halfcut": 0.51, "shingle": 0.07}

# Width and length in metres of modules with half-cut cells as they are sold, the common ones twice.
HALFCUT_SIZES = [
    (1.002, 1.69), (1.038, 1.755), (1.038, 1.755), (1.048, 1.765), (1.134, 1.722), (1.134, 1.722), (1.134, 1.762), (1.134, 1.903),
    (1.134, 1.961), (1.038, 2.094), (1.134, 2.094), (1.134, 2.278), (1.134, 2.278), (1.134, 2.384), (1.303, 2.172), (1.303, 2.384),
]  # fmt: skip

COLORS = {
    "poly": [rgb(0.14, 0.19, 0.42), rgb(0.22, 0.27, 0.46), rgb(0.20, 0.20, 0.36), rgb(0.28, 0.36, 0.62)],
    "mono": [rgb(0.10, 0.11, 0.18), rgb(0.16, 0.18, 0.27), rgb(0.22, 0.26, 0.36), rgb(0.10, 0.12, 0.14), rgb(0.22, 0.18, 0.27), rgb(0.30, 0.30, 0.33)],
    "black": [rgb(0.06, 0.06, 0.09), rgb(0.11, 0.11, 0.15), rgb(0.13, 0.15, 0.22)],
    "thin": [rgb(0.10, 0.09, 0.10), rgb(0.19, 0.14, 0.19), rgb(0.13, 0.17, 0.18), rgb(0.17, 0.13, 0.10)],
}  # fmt: skip
COLORS["halfcut"] = COLORS["mono"] + COLORS["black"] + [rgb(0.12, 0.17, 0.34), rgb(0.09, 0.12, 0.26), rgb(0.30, 0.32, 0.36)]
COLORS["shingle"] = COLORS["black"] + COLORS["mono"][:3]

WHITE = rgb(0.85, 0.87, 0.9)
BLACK = rgb(0.05, 0.05, 0.06)


class Style:
    """The look of one plant's modules. Lengths in metres; pairs are along the row, up the slope."""

    def __init__(self, rng: Rng):
        self.kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
        self.halfcut = self.kind == "halfcut" or (self.kind in ("poly", "mono", "black") and rng.random() < 0.15)
        # Fine patterns sampled at a few points per pixel, as renderers do and as sharp lenses nearly do, are noisy.
        self.sampled = rng.random() < 0.25
        self.shape(rng)
        self.paint(rng)
        self.cell_lines(rng)
        self.edges(rng)
        if self.kind in ("poly", "mono", "black") and rng.random() < 0.45:
            self.camouflage(rng)
        if self.halfcut:
            self.halves(rng)
            if rng.random() < 0.3:
                self.harsh_grid(rng)
        if self.kind in ("thin", "shingle") and rng.random() < 0.5:
            self.hide_seams(rng)
        self.sheen = rng.uniform(-0.5, 0.7)
        self.glare = 0.4 if rng.random() < 0.15 else 0.0

    def shape(self, rng: Rng) -> None:
        """Size and number of cells. No module is nearly square, but halves of modules are."""
        if self.kind == "thin":
            w = 0.6 if rng.random() < 0.6 else rng.uniform(0.6, 1.25)
            self.size, self.cells = (w, w * rng.uniform(1.6, 2.05)), (1, 1)
            return
        if self.halfcut:
            w, h = HALFCUT_SIZES[rng.integers(len(HALFCUT_SIZES))]
            jitter = np.exp(rng.normal(0, 0.015, 2))
            self.size = (w * jitter[0], h * jitter[1])
            nx = 6 if rng.random() < 0.9 else 5
            half_cells = max(4, int((self.size[1] / 2 - 0.03) / ((self.size[0] - 0.03) / nx / 2)))
            self.cells = (nx, 2 * half_cells)
            return
        w = rng.uniform(0.98, 1.15) if rng.random() < 0.85 else rng.uniform(0.75, 1.35)
        self.size = (w, w * rng.uniform(1.55, 2.1))
        if self.kind == "shingle":
            self.cells = (int(rng.choice([1, 5, 6])), int(rng.integers(24, 70)))
            return
        nx = int(rng.choice([6, 6, 6, 5, 4]))
        self.cells = (nx, int(round(nx * self.size[1] / self.size[0])))

    def paint(self, rng: Rng) -> None:
        base = COLORS[self.kind]
        self.color = base[rng.integers(len(base))] * np.float32(np.exp(rng.normal(0, 0.25)))
        self.color = np.clip(self.color + rng.normal(0, 0.035, 3).astype(np.float32), 0.02, 1)
        self.module_var = rng.choice([0.02, 0.06, 0.14, 0.25], p=[0.3, 0.35, 0.25, 0.1])
        self.hue_var = rng.choice([0.005, 0.02, 0.05])
        self.cell_var = rng.uniform(0, 0.12) if self.kind == "poly" else rng.uniform(0, 0.03)

    def cell_lines(self, rng: Rng) -> None:
        """Between the cells: back sheet (white, dark) seen through; strength from invisible to harsh."""
        kind = self.kind
        self.cell_color = WHITE * rng.uniform(0.5, 1.1) if rng.random() < 0.65 else self.color * rng.uniform(0.3, 1.5)
        self.cell_gap = rng.uniform(0.002, 0.012) * (1 if kind in ("poly", "mono") else 0.4)
        if kind in ("poly", "mono") and rng.random() < 0.15:
            self.cell_gap = rng.uniform(0.01, 0.022)
        if kind == "shingle":
            self.cell_gap = rng.uniform(0.0005, 0.002)
        self.gap_ratio = 1.0  # gaps across the short side, against those across the long side
        # The cut corners of mono cells leave bright diamonds.
        self.chamfer = rng.uniform(0.01, 0.035) if kind in ("mono", "black") and rng.random() < 0.6 else 0.0
        self.bus_gap = rng.uniform(0.001, 0.003)
        self.bus_count = 0 if kind in ("thin", "shingle") else int(rng.choice([0, 2, 3, 5]))
        self.bus_color = rgb(0.8, 0.82, 0.85) * rng.uniform(0.5, 1.1)
        self.bus_across = rng.random() < 0.3  # busbars across the short side
        self.half_gap, self.half_color, self.half_broken = 0.0, self.cell_color, False
        self.margin = rng.uniform(0.0, 0.03) if kind not in ("thin", "shingle") else 0.0  # back sheet between frame and cells
        self.hatched = rng.random() < 0.08  # moire of the cell grid

    def edges(self, rng: Rng) -> None:
        """Frames and seams."""
        kind = self.kind
        silver = rgb(0.78, 0.79, 0.82) * rng.uniform(0.6, 1.25)
        dark = rgb(0.07, 0.07, 0.08) * rng.uniform(0.5, 2)
        p_black = {"poly": 0.15, "mono": 0.5, "black": 0.9, "thin": 0.7, "halfcut": 0.45, "shingle": 0.7}[kind]
        self.frame_color = dark if rng.random() < p_black else silver
        self.frame = 0.0 if kind == "thin" and rng.random() < 0.6 else rng.uniform(0.008, 0.035)
        self.landscape = rng.random() < (0.25 if self.halfcut else 0.45)
        tight = lambda: float(rng.choice([rng.uniform(0.001, 0.006), rng.uniform(0.006, 0.02), rng.uniform(0.02, 0.05)], p=[0.35, 0.45, 0.2]))
        self.seam = (tight(), tight())
        # What shows in the seam: see-through (dark or ground), bright clamps, rails; broken along its length.
        self.seam_color = []
        for _ in range(2):
            r = rng.random()
            c = BLACK if r < 0.5 else rgb(0.9, 0.9, 0.88) if r < 0.8 else rgb(*rng.uniform(0.1, 0.8, 3))
            self.seam_color.append(c * rng.uniform(0.6, 1.2))
        self.seam_open = [False, False]  # the ground shows through
        self.broken = [rng.random() < 0.45, rng.random() < 0.45]
        self.streak = [rng.uniform(0.0, 0.06) if rng.random() < 0.35 else 0.0 for _ in range(2)]
        self.frame_fade = [1.0 if rng.random() < 0.55 else rng.uniform(0.0, 0.6) for _ in range(2)]

    def camouflage(self, rng: Rng) -> None:
        """Cell grids brighter than all else; frames and seams narrow and dark, or of the grid's mean colour."""
        self.cell_color = rgb(0.85, 0.87, 0.92) * rng.uniform(0.6, 1.2)
        # Up to a third of a cell, as wide as cameras blur it and renders draw it.
        self.cell_gap = log_uniform(rng, 0.004, 0.05)
        self.bus_count = int(rng.choice([0, 0, 2, 3]))
        self.gap_ratio = 1.0 if rng.random() < 0.4 else rng.uniform(0.2, 1.0)
        share = min(0.6, (1 + self.gap_ratio) * self.cell_gap * self.cells[0] / self.size[0])
        grid = self.color * (1 - share) + self.cell_color * share
        r = rng.random()
        self.frame_color = BLACK * rng.uniform(0.6, 2) if r < 0.5 else grid * rng.uniform(0.6, 1.1) if r < 0.8 else self.frame_color
        self.frame = rng.uniform(0.004, 0.03)
        self.margin = rng.uniform(0.0, 0.012)
        self.seam = (rng.uniform(0.002, 0.022), rng.uniform(0.002, 0.022))
        self.seam_color = [BLACK * rng.uniform(0.6, 2) if rng.random() < 0.8 else grid for _ in range(2)]
        self.streak = [0.0, 0.0]
        self.frame_fade = [1.0 if rng.random() < 0.7 else rng.uniform(0.2, 1.0) for _ in range(2)]

    def halves(self, rng: Rng) -> None:
        """Half-cut cells: a gap between the halves, from invisible to brighter than the seams; wires in place of busbars."""
        if rng.random() < 0.75:  # cells of one batch look alike, far more than polycrystalline ones
            self.module_var, self.hue_var, self.cell_var = rng.choice([0.01, 0.03, 0.08]), rng.choice([0.002, 0.008]), 0.0
        faint = self.color + (WHITE - self.color) * np.float32(log_uniform(rng, 0.03, 0.9))
        self.cell_color = faint if rng.random() < 0.75 else self.cell_color
        self.cell_gap = rng.uniform(0.001, 0.004) if rng.random() < 0.8 else rng.uniform(0.004, 0.012)
        self.gap_ratio = rng.uniform(0.4, 1.6)
        self.bus_count, self.bus_gap, self.bus_across = int(rng.choice([0, 5, 9, 12])), rng.uniform(0.0003, 0.0012), False
        self.margin = rng.uniform(0.0, 0.015)
        self.half_gap = log_uniform(rng, 0.006, 0.04)
        r = rng.random()
        self.half_color = WHITE * rng.uniform(0.7, 1.15) if r < 0.7 else faint if r < 0.85 else self.color * rng.uniform(0.3, 1.6)
        self.half_broken = rng.random() < 0.15
        # Seams against gaps: as bright, brighter, or dark between black frames.
        r = rng.random()
        if r < 0.45:
            self.seam_color = [self.half_color * rng.uniform(0.75, 1.1) for _ in range(2)]
            self.frame_color, self.frame = self.half_color * rng.uniform(0.75, 1.1), rng.uniform(0.004, 0.02)
        elif r < 0.7:
            self.frame_color, self.frame = BLACK * rng.uniform(0.6, 2.2), rng.uniform(0.008, 0.03)
            self.seam_color = [BLACK * rng.uniform(0.5, 2) for _ in range(2)]
        self.seam = (rng.uniform(0.004, 0.028), rng.uniform(0.004, 0.028))
        if rng.random() < 0.35:  # rows a hand apart on rails: what lies below shows between them
            self.seam_open = [rng.random() < 0.5, True]
            self.seam = (self.seam[0], log_uniform(rng, 0.015, 0.25))
        self.streak = [0.0 if rng.random() < 0.7 else s for s in self.streak]

    def harsh_grid(self, rng: Rng) -> None:
        """Half-cells parted by gaps as bright as the one between the halves and nearly as wide; frames and seams mostly dark."""
        self.cell_color = WHITE * rng.uniform(0.3, 1.0)
        self.cell_gap, self.gap_ratio = rng.uniform(0.005, 0.017), rng.uniform(0.35, 1.0)
        self.half_color, self.half_gap, self.half_broken = self.cell_color * rng.uniform(0.95, 1.3), self.cell_gap * rng.uniform(1.0, 1.6), False
        self.bus_count, self.margin = 0, 0.0
        self.module_var, self.hue_var = rng.choice([0.03, 0.1, 0.17]), 0.005
        if rng.random() < 0.65:
            self.frame_color = BLACK * rng.uniform(0.6, 2.5)
            self.seam_color = [BLACK * rng.uniform(0.5, 2) for _ in range(2)]
        self.frame = rng.uniform(0.008, 0.036)
        self.frame_fade, self.streak = [1.0, 1.0], [0.0, 0.0]
        self.sampled = rng.random() < 0.6

    def hide_seams(self, rng: Rng) -> None:
        """Frameless glass: seams of a few millimetres, a little darker or brighter than the glass."""
        self.frame = 0.0 if rng.random() < 0.6 else rng.uniform(0.004, 0.012)
        self.frame_color = self.color * rng.uniform(0.4, 1.4)
        self.seam = (rng.uniform(0.004, 0.02), rng.uniform(0.004, 0.02))
        lift = lambda: self.color * rng.uniform(0.2, 0.7) if rng.random() < 0.6 else self.color + WHITE * rng.uniform(0.05, 0.3)
        self.seam_color = [lift(), lift()]
        self.streak = [0.0 if rng.random() < 0.7 else s for s in self.streak]

    def footprint(self) -> tuple[float, float]:
        a, b = self.size
        return (b, a) if self.landscape else (a, b)
