"""Weighted binary cross-entropy plus soft Dice, per channel."""

from __future__ import annotations

import torch
import torch.nn.functional as F


def loss_fn(logits: torch.Tensor, target: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    logits = logits.float()
    bce = F.binary_cross_entropy_with_logits(logits, target, weight, reduction="sum") / weight.sum().clamp(min=1)
    p = torch.sigmoid(logits) * (weight > 0)
    t = target * (weight > 0)
    axes = (0, 2, 3)
    dice = 1 - (2 * (p * t).sum(axes) + 50) / ((p * p).sum(axes) + (t * t).sum(axes) + 50)
    return bce + 0.5 * dice.mean()
