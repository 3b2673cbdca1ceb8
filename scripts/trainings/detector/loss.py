"""What the detector is trained for.

Labels: Gaussians around corners (stage 1) or around the maxima of the heat averaged over views (stage 2, adaptation).
Repeatability: the heat of a view names keypoints softly, and what counts is how many of them the other view names at
their exact place, again softly, so that place and rank both learn from it.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from aeromatch_cli.strategies.extractors.heat import refined

SIGMA_PX = 1.2  # of a label's Gaussian
_REACH_PX = 4
# Keypoints compete within a square of so many pixels; the sharper, the more the largest one stands for all.
WINDOW_PX, SHARPNESS = 5, 3.0
# A view has a budget of one keypoint per so many pixels.
BUDGET_PX2 = 400.0
# How soft the line is between keypoints within the budget and beyond it, in log odds.
_SOFT = 0.6
# Of a pair's agreement: within about one pixel, and within about two and a half.
_TIGHT_PX, _LOOSE_PX, _TIGHT_SHARE = 0.8, 2.2, 0.6
Points = NDArray[np.float64]


def drawn(points: list[Points], side_px: int) -> Tensor:
    """Heat (N, 1, side, side) of N pictures: the largest of the Gaussians around points (M, 2), x and y."""
    heat = np.zeros((len(points), side_px, side_px), np.float32)
    window = np.arange(-_REACH_PX, _REACH_PX + 1)
    for image, places in zip(heat, points, strict=True):
        if len(places):
            pixel = np.rint(places).astype(int)
            xs, ys = pixel[:, 0, None] + window, pixel[:, 1, None] + window
            off_x, off_y = xs - places[:, 0, None], ys - places[:, 1, None]
            values = np.exp(-(off_y[:, :, None] ** 2 + off_x[:, None, :] ** 2) / (2.0 * SIGMA_PX**2))
            rows, columns = np.broadcast_arrays(ys[:, :, None], xs[:, None, :])
            ok = (rows >= 0) & (rows < side_px) & (columns >= 0) & (columns < side_px)
            np.maximum.at(image, (rows[ok], columns[ok]), values[ok].astype(np.float32))
    return torch.from_numpy(heat)[:, None]


def label_loss(logits: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Binary cross entropy (Gaussians outweigh the far larger background), per weighted pixel."""
    loss = F.binary_cross_entropy_with_logits(logits, target, reduction="none")
    return (loss * weight * (1.0 + 8.0 * target)).sum() / weight.sum().clamp(min=1.0)


def peaks(heat: Tensor, count: int) -> list[Points]:
    """The at most `count` largest maxima (M, 2) of each heat map (N, 1, H, W), refined below the pixel."""
    found = []
    tops = F.max_pool2d(heat, 5, stride=1, padding=2)
    for values, top in zip(heat[:, 0].cpu().numpy(), tops[:, 0].cpu().numpy(), strict=True):
        peak = (values == top) & (values > 1e-3)
        peak[:2], peak[-2:], peak[:, :2], peak[:, -2:] = False, False, False, False
        y, x = np.nonzero(peak)
        order = np.argsort(-values[y, x], kind="stable")[:count]
        y, x = y[order], x[order]
        steps, _ = refined(np.log(np.maximum(values, 1e-6)), x, y)
        found.append(np.column_stack([x, y]) + steps)
    return found


def at(maps: Tensor, places: Tensor) -> Tensor:
    """Bilinear values (N, 1, h, w) of maps (N, 1, H, W) at places (N, h, w, 2), x and y in pixels; 0 outside."""
    size = torch.tensor([maps.shape[-1], maps.shape[-2]], dtype=places.dtype, device=places.device)
    return F.grid_sample(maps, (places + 0.5) / size * 2.0 - 1.0, align_corners=False)


def named(logits: Tensor, inside: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Share (N, 1, H, W) of each pixel in being a keypoint of its window, how surely it is within the budget, and
    which pixels are maxima.

    inside: (N, 1, H, W) where keypoints count; one per BUDGET_PX2 of it is within the budget.
    """
    bounded = 8.0 * torch.tanh(logits / 8.0) * SHARPNESS
    raised = torch.exp(bounded)
    around = F.avg_pool2d(raised, WINDOW_PX, stride=1, padding=WINDOW_PX // 2) * WINDOW_PX**2
    share = raised / around
    with torch.no_grad():
        top = F.max_pool2d(logits, 5, stride=1, padding=2)
        peak = (logits == top) & (inside > 0.5)
        candidates = torch.where(peak, logits, logits.new_tensor(-1e3)).flatten(1)
        counts = (inside.sum(dim=(1, 2, 3)) / BUDGET_PX2).long().clamp(min=1)
        best = candidates.topk(int(counts.max()), dim=1).values
        line = best.gather(1, counts[:, None] - 1).clamp(min=-8.0)[:, :, None, None]
    return share, torch.sigmoid((logits - line) / _SOFT), peak.float()


def repeat_loss(logits0: Tensor, logits1: Tensor, places: Tensor, seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Loss of rank, loss of place, and the soft repeatability, of views 0 and 1.

    places: (N, H, W, 2) of view 0's pixels in view 1. seen: (N, 1, H, W) 1 where view 1 shows them, else 0.
    """
    share0, within0, peak0 = named(logits0, seen)
    share1, within1, peak1 = named(logits1, torch.ones_like(logits1))
    near = torch.cat([share1 * within1, (peak1 * within1).detach()], dim=1)
    near = F.conv2d(near, _tolerance().to(near.device).expand(2, 1, -1, -1), padding=_REACH_PX, groups=2)
    again, truly = at(near, places).clamp(max=1.0).split(1, dim=1)
    mass = seen * share0
    # Rank: log odds of maxima become those of being found again. What is near the budget's line counts most.
    weight = peak0 * (0.1 + within0.detach())
    rank = F.binary_cross_entropy_with_logits(logits0, truly.detach(), reduction="none")
    rank = (rank * weight).sum() / weight.sum().clamp(min=1.0)
    chosen = (mass * within0).sum(dim=(1, 2, 3))
    repeated = (mass * within0 * again).sum(dim=(1, 2, 3)) / chosen.clamp(min=4.0)
    return rank, 1.0 - repeated.mean(), repeated.mean().detach()


def _tolerance() -> Tensor:
    """(1, 1, 9, 9) how much a keypoint so far off still counts."""
    steps = torch.arange(-_REACH_PX, _REACH_PX + 1.0)
    square = steps[:, None] ** 2 + steps[None, :] ** 2
    tight = torch.exp(-square / (2.0 * _TIGHT_PX**2))
    loose = torch.exp(-((square / _LOOSE_PX**2) ** 2))
    return (_TIGHT_SHARE * tight + (1.0 - _TIGHT_SHARE) * loose)[None, None]
