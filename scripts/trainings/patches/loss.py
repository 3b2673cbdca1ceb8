"""The loss of descriptors: the hardest negative of the batch, and every negative at once."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

MARGIN = 1.0
TEMPERATURE = 0.06
SOFT = 0.5  # weight of the second term


def descriptor_loss(first: Tensor, second: Tensor, distinct: Tensor) -> Tensor:
    """Of pairs of unit descriptors (B, 128); distinct: (B, B) which of them are negatives of one another.

    Hardest in batch: Mishchuk et al., HardNet, NeurIPS 2017, here with negatives among either side too. The softmax
    over rows and columns, as in the structured losses of L2-Net and GeoDesc, moves every patch from the first step on.
    """
    alike, own = first @ second.T, torch.eye(len(first), dtype=torch.bool, device=first.device)
    others = ~(distinct | own)
    within = [side @ side.T for side in (first, second)]
    negatives = [alike, alike.T, *within]
    hardest = torch.stack([values.masked_fill(~distinct, -1.0).amax(dim=1) for values in negatives]).amax(dim=0)
    apart, too_near = ((2.0 - 2.0 * values).clamp(min=1e-6).sqrt() for values in (alike.diagonal(), hardest))
    triplet = functional.relu(MARGIN + apart - too_near).mean()
    logits, rows = (alike / TEMPERATURE).masked_fill(others, -1e4), torch.arange(len(first), device=first.device)
    soft = functional.cross_entropy(logits, rows) + functional.cross_entropy(logits.T, rows)
    return triplet + SOFT * 0.5 * soft
