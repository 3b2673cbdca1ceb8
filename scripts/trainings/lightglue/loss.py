"""Loss of assignment after every layer, and of the confidence that a layer's assignment is the last one's.

Source: Lindenberger, Sarlin and Pollefeys, ICCV 2023, equations 9 and 10.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch.nn import functional

from aeromatch_cli.nets.lightglue import LightGlue, log_assignment
from trainings.lightglue.batches import Batch
from trainings.lightglue.sides import NONE


@dataclass(frozen=True)
class Loss:
    """What is minimised, and of the last layer: mean log probability of the partners, and of having none."""

    total: torch.Tensor
    partner: float
    none: float


def loss_of(network: LightGlue, batch: Batch, *, confidence: bool) -> Loss:
    """Mean over layers of half the loss of keypoints with and half of those without partner."""
    layers, answers, states = [], [], []
    for index, (x0, x1) in enumerate(network.states(batch.side0, batch.side1)):
        pairs, none0, none1 = log_assignment(network.assignment(index), x0, x1)
        layers.append(_assignment_loss(pairs, none0, none1, batch))
        if confidence:
            answers.append((_answer(pairs, 2, none0), _answer(pairs, 1, none1)))
            states.append((x0, x1))
    total = sum(positive + negative for positive, negative in layers) / (2.0 * len(layers))
    if confidence:
        total = total + _confidence_loss(network, answers, states)
    return Loss(total, float(layers[-1][0].detach()), float(layers[-1][1].detach()))


def _assignment_loss(
    pairs: torch.Tensor, none0: torch.Tensor, none1: torch.Tensor, batch: Batch
) -> tuple[torch.Tensor, torch.Tensor]:
    has = batch.partners0 >= 0
    chosen = pairs.gather(2, batch.partners0.clamp(min=0)[..., None])[..., 0]
    positive = -_mean(chosen, has)
    negative = -0.5 * (_mean(none0, batch.partners0 == NONE) + _mean(none1, batch.partners1 == NONE))
    return positive, negative


def _mean(values: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
    """Mean over pairs of each pair's mean, of (B, K)."""
    weights = which.float()
    return ((values * weights).sum(1) / weights.sum(1).clamp(min=1.0)).mean()


@torch.no_grad()
def _answer(pairs: torch.Tensor, dim: int, none: torch.Tensor) -> torch.Tensor:
    """(B, K): the best partner, NONE where having none is likelier."""
    best = pairs.max(dim)
    return torch.where(best.values > none, best.indices, torch.full_like(best.indices, NONE))


def _confidence_loss(
    network: LightGlue,
    answers: list[tuple[torch.Tensor, torch.Tensor]],
    states: list[tuple[torch.Tensor, torch.Tensor]],
) -> torch.Tensor:
    losses = []
    for index in range(len(states) - 1):
        for side in (0, 1):
            same = (answers[index][side] == answers[-1][side]).float()
            logits = network.confidence(index).logits(states[index][side]).float()
            losses.append(functional.binary_cross_entropy_with_logits(logits, same))
    return torch.stack(losses).mean()
