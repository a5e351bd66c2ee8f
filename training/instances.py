"""The instance network's targets, loss and decoding (layout: `net.Instances`, that of YOLOv8-seg)."""

from __future__ import annotations

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from .net import Instances
from .postprocess import Box, blob, middle, suppress
from .targets import SHIFT, shrink

CELL = Instances.CELL
PROTO = 4  # pixels per pixel of the prototypes
POSITIVE, IGNORED = 0.4, 0.7  # an anchor is a module's within this share of the face, neither way within that
WINDOW = 28  # side of the window, in pixels of the prototypes, in which a mask is learned
MASKS = 48  # masks learned per step
SCORE = 0.4
GROW = 2.0  # pixels by which a box is grown before its mask is cut
SIZE_RANGE = (0.4, 2.2)


def make_targets(quads: np.ndarray, ignore: list[np.ndarray], size: int) -> tuple[np.ndarray, np.ndarray]:
    """Per anchor (6, h, w): 1, 0 or -1 (module, none, unknown), the box's cx, cy, w, h in pixels, the module's number;
    and the map of module numbers (size, size), 0 for none and -1 for unknown."""
    quads = quads[np.isfinite(quads).all(axis=(1, 2))]
    quads = quads[(quads.max(axis=1) > 0).all(axis=1) & (quads.min(axis=1) < size - 1).all(axis=1)]
    n = size // CELL
    cells = np.zeros((6, n, n), np.float32)
    ids = np.zeros((size, size), np.int32)
    fixed = lambda q: [np.round(q * (1 << SHIFT)).astype(np.int32)]
    if ignore:
        cover = np.zeros((size, size), np.uint8)
        for p in ignore:
            cv2.fillPoly(cover, fixed(p), 1, cv2.LINE_8, SHIFT)
        ids[cover > 0] = -1
        cells[0][cv2.resize(cover, (n, n), interpolation=cv2.INTER_AREA) > 0] = -1
    to_cells = lambda q: (q + 0.5) / CELL - 0.5
    for q in to_cells(shrink(quads, IGNORED)):
        cv2.fillConvexPoly(cells[0], fixed(q)[0], -1.0, cv2.LINE_8, SHIFT)
    for k, q in enumerate(quads, 1):
        cv2.fillConvexPoly(ids, fixed(q)[0], k, cv2.LINE_8, SHIFT)
    yy, xx = (np.mgrid[:n, :n] + 0.5) * CELL
    for k, q in enumerate(quads, 1):
        q = q + 0.5  # corners of pixels at whole numbers from here on
        c, lo, hi = q.mean(axis=0), q.min(axis=0), q.max(axis=0)
        if not (0 <= c[0] < size and 0 <= c[1] < size):
            continue
        own = np.zeros((n, n), np.uint8)
        inner = to_cells(c - 0.5 + (q - c) * POSITIVE)
        # Cells whose middle lies within; the one at the centre in any case.
        x0, y0 = np.maximum(np.floor(inner.min(axis=0)).astype(int), 0)
        x1, y1 = np.minimum(np.ceil(inner.max(axis=0)).astype(int) + 1, n)
        for y in range(y0, y1):
            for x in range(x0, x1):
                own[y, x] = cv2.pointPolygonTest(inner.astype(np.float32), (float(x), float(y)), False) >= 0
        own[int(c[1]) // CELL, int(c[0]) // CELL] = 1
        new = own > 0
        # Where two modules share a cell the nearer one has it.
        taken = new & (cells[0] > 0)
        d = (xx - c[0]) ** 2 + (yy - c[1]) ** 2
        new &= ~(taken & ((xx - cells[1]) ** 2 + (yy - cells[2]) ** 2 < d))
        for i, v in enumerate((1, c[0], c[1], hi[0] - lo[0], hi[1] - lo[1], k)):
            cells[i][new] = v
    return cells, ids


def loss_fn(raw: tuple[torch.Tensor, torch.Tensor], cells: torch.Tensor, ids: torch.Tensor) -> torch.Tensor:
    """Focal cross-entropy of the score, box, and mask within the box."""
    head, proto = raw[0].float(), raw[1].float()
    state = cells[:, 0]
    p = torch.sigmoid(head[:, 0])
    target = (state > 0).float()
    known = (state >= 0).float()
    found = target.sum().clamp(min=1)
    bce = F.binary_cross_entropy_with_logits(head[:, 0], target, reduction="none")
    score = (bce * (target - p).abs() ** 2 * known).sum() / found
    n, y, x = torch.nonzero(state > 0, as_tuple=True)
    if len(n) == 0:
        return score
    out0, out1 = Instances.decode(head, proto)
    out = out0.unflatten(2, head.shape[2:])[n, :, y, x]
    t = cells[n, :, y, x]
    size = (t[:, 3] * t[:, 4]).sqrt()
    center = (out[:, 0:2] - t[:, 1:3]).abs().sum(1) / size
    log = (out[:, 2:4].clamp(min=1).log() - t[:, 3:5].clamp(min=1).log()).abs().sum(1)
    box = F.smooth_l1_loss(4 * center, torch.zeros_like(center), beta=0.2) + log.mean()
    pick = torch.randperm(len(n), device=n.device)[:MASKS]
    n, t, coef = n[pick], t[pick], out[pick, 5:]
    # Windows of prototypes and of module numbers about the box.
    x0 = torch.div(t[:, 1], PROTO).round().long() - WINDOW // 2
    y0 = torch.div(t[:, 2], PROTO).round().long() - WINDOW // 2
    k = torch.arange(WINDOW, device=n.device)
    gx, gy = x0[:, None] + k, y0[:, None] + k
    h, w = out1.shape[2:]
    inside = ((gx >= 0) & (gx < w))[:, None, :] & ((gy >= 0) & (gy < h))[:, :, None]
    gx, gy = gx.clamp(0, w - 1), gy.clamp(0, h - 1)
    protos = out1[n[:, None, None], :, gy[:, :, None], gx[:, None, :]]
    logits = (protos * coef[:, None, None, :]).sum(-1)
    numbers = ids[n].unfold(1, PROTO, PROTO).unfold(2, PROTO, PROTO)
    numbers = numbers[torch.arange(len(n), device=n.device)[:, None, None], gy[:, :, None], gx[:, None, :]]
    share = (numbers == t[:, 5, None, None, None, None]).float().mean((-1, -2))
    known = (numbers >= 0).float().mean((-1, -2)) * inside
    px, py = (gx + 0.5) * PROTO, (gy + 0.5) * PROTO
    within = ((px - t[:, 1:2]).abs() < t[:, 3:4] / 2 + PROTO)[:, None, :] & ((py - t[:, 2:3]).abs() < t[:, 4:5] / 2 + PROTO)[:, :, None]
    weight = known * within
    mask = F.binary_cross_entropy_with_logits(logits, share, weight, reduction="none").sum((1, 2)) / weight.sum((1, 2)).clamp(min=1)
    return score + box + 2.0 * mask.mean()


def boxes(out0: np.ndarray, out1: np.ndarray) -> list[Box]:
    """Boxes from `output0` [37, A] and `output1` [32, h, w] of one image, pixel centres at whole numbers."""
    order = np.argsort(-out0[4])
    order = order[out0[4][order] > SCORE]
    h, w = out1.shape[1:]
    accepted: list[tuple[np.ndarray, int, int]] = []
    found: list[Box] = []
    masses: list[float] = []
    for a in order:
        cx, cy, bw, bh, score = out0[:5, a]
        if any(inside(m, cx, cy, x0, y0) for m, x0, y0 in accepted):
            continue
        lo = np.maximum(np.floor((np.array([cx - bw / 2, cy - bh / 2]) - GROW) / PROTO).astype(int) - 1, 0)
        hi = np.minimum(np.ceil((np.array([cx + bw / 2, cy + bh / 2]) + GROW) / PROTO).astype(int) + 1, (w, h))
        if (hi - lo < 2).any():
            continue
        logits = np.tensordot(out0[5:, a].astype(np.float64), out1[:, lo[1] : hi[1], lo[0] : hi[0]].astype(np.float64), 1)
        fine = cv2.resize(np.clip(logits, -20, 20).astype(np.float32), None, fx=PROTO, fy=PROTO, interpolation=cv2.INTER_LINEAR)
        x0, y0 = lo[0] * PROTO, lo[1] * PROTO
        yy, xx = np.mgrid[: fine.shape[0], : fine.shape[1]]
        box = (np.abs(xx + x0 + 0.5 - cx) < bw / 2 + GROW) & (np.abs(yy + y0 + 0.5 - cy) < bh / 2 + GROW)
        mask = (fine > 0) & box
        if mask.sum() < 12:
            continue
        accepted.append((fine, x0, y0))
        b = blob(mask.astype(np.float32), mask, x0, y0)
        phi = (np.angle(b.fourth) - np.pi) / 4
        axes = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
        u, v = (np.sqrt(12) * b.root @ axes).T
        if np.hypot(*v) > np.hypot(*u):
            u, v = v, -u
        found.append(Box(b.center, u, v, float(score)))
        masses.append(b.mass)
    if not found:
        return []
    median = middle(np.array(masses))
    return suppress([b for b, m in zip(found, masses) if SIZE_RANGE[0] * median < m < SIZE_RANGE[1] * median])


def inside(logits: np.ndarray, cx: float, cy: float, x0: int, y0: int) -> bool:
    """Whether a point lies on an accepted mask."""
    x, y = int(cx) - x0, int(cy) - y0
    return 0 <= x < logits.shape[1] and 0 <= y < logits.shape[0] and logits[y, x] > 0
