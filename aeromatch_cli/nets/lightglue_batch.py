"""LightGlue on several pairs of pictures at once, for a GPU: one pair alone leaves most of it idle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from aeromatch_cli.nets.lightglue import Code, Layer, LightGlue, Side, mutual_best


@dataclass(frozen=True, eq=False)
class _State:
    """One side of B pairs, filled up to N keypoints. x: (B, N, dim).

    there: (B, N) bool, the keypoints that are left.
    """

    x: Tensor
    code: Code
    there: Tensor

    def of(self, pairs: Tensor) -> _State:
        return _State(self.x[pairs], self.code.at(pairs), self.there[pairs])


@dataclass(frozen=True, eq=False)
class _Batch:
    """The pairs that are not answered yet. numbers: (B,) which they are; totals: (B,) keypoints they began with."""

    state0: _State
    state1: _State
    numbers: Tensor
    totals: Tensor

    def of(self, pairs: Tensor) -> _Batch:
        """Those of a mask (B,)."""
        if bool(pairs.all()):
            return self
        return _Batch(self.state0.of(pairs), self.state1.of(pairs), self.numbers[pairs], self.totals[pairs])

    def with_keypoints(self) -> _Batch:
        """Those that have some left on both sides."""
        return self.of(self.state0.there.any(1) & self.state1.there.any(1))

    def through(self, layer: Layer) -> _Batch:
        """After one more layer."""
        one, other = self.state0, self.state1
        x0, x1 = layer.through(one.x, other.x, (one.code, other.code), one.there, other.there)
        return replace(self, state0=replace(one, x=x0), state1=replace(other, x=x1))


def batches(sizes: Sequence[tuple[int, int]], most: int) -> list[list[int]]:
    """Positions of pairs of (M, N) keypoints, those of similar size together.

    A batch, filled up to its largest sides, has at most so many keypoints; a larger pair is alone.
    """
    found: list[list[int]] = []
    height = width = 0
    for position in sorted(range(len(sizes)), key=lambda i: (-sum(sizes[i]), i)):
        grown = max(height, sizes[position][0]), max(width, sizes[position][1])
        if found and (len(found[-1]) + 1) * sum(grown) <= most:
            found[-1].append(position)
            height, width = grown
        else:
            found.append([position])
            height, width = sizes[position]
    return found


@torch.inference_mode()
def match_batch(
    network: LightGlue,
    sides0: Sequence[Side],
    sides1: Sequence[Side],
    *,
    threshold: float,
    depth_confidence: float,
    width_confidence: float,
) -> list[tuple[Tensor, Tensor]]:
    """The result of `LightGlue.match` for each pair alone, up to rounding: sides of one picture each (B = 1).

    A pair leaves after the layer where it would stop alone. Pruned keypoints are hidden from the others but stay in the
    batch: that saves nothing, and gives the same matches.
    """
    answers = [(torch.zeros((0, 2), dtype=torch.int64), torch.zeros(0))] * len(sides0)
    batch = _begun(network, sides0, sides1)
    last = len(network.transformers) - 1
    for index, layer in enumerate(network.layers):
        batch = batch.with_keypoints()
        if not len(batch.numbers):
            break
        batch = batch.through(layer)
        states = (batch.state0, batch.state1)
        certain = [torch.ones_like(state.there) for state in states]
        done = torch.full_like(batch.numbers, index == last, dtype=torch.bool)
        if index < last and depth_confidence > 0.0:
            certain = [network.certain(index, state.x) for state in states]
            uncertain = sum((state.there & ~sure).sum(1) for state, sure in zip(states, certain, strict=True))
            done = 1.0 - uncertain / batch.totals > depth_confidence
        for position in torch.nonzero(done).flatten().tolist():
            answers[int(batch.numbers[position])] = _answer(network, index, batch, position, threshold)
        if index < last and width_confidence > 0.0:
            state0, state1 = (
                replace(state, there=state.there & network.staying(index, state.x, sure, width_confidence))
                for state, sure in zip(states, certain, strict=True)
            )
            batch = replace(batch, state0=state0, state1=state1)
        batch = batch.of(~done)
    return answers


def _begun(network: LightGlue, sides0: Sequence[Side], sides1: Sequence[Side]) -> _Batch:
    """Of sides with places (1, N, P) and descriptors (1, N, C), before the first layer."""
    state0, state1 = _filled_up(network, sides0), _filled_up(network, sides1)
    totals = state0.there.sum(1) + state1.there.sum(1)
    return _Batch(state0, state1, torch.arange(len(sides0), device=totals.device), totals)


def _filled_up(network: LightGlue, sides: Sequence[Side]) -> _State:
    counts = [side.places.shape[1] for side in sides]
    longest = max(counts)

    def joined(parts: Sequence[Tensor]) -> Tensor:
        """(1, N, C) each to (B, longest, C), zeros after the last."""
        return torch.cat([torch.nn.functional.pad(part, (0, 0, 0, longest - part.shape[1])) for part in parts])

    # What is expected of one pair is so of all.
    expected = [side.ground for side in sides if side.ground is not None]
    ground = joined(expected) if len(expected) == len(sides) else None
    whole = Side(joined([side.places for side in sides]), joined([side.descriptors for side in sides]), ground)
    device = whole.places.device
    there = torch.arange(longest, device=device) < torch.tensor(counts, device=device)[:, None]
    return _State(*network.begin(whole), there)


def _answer(network: LightGlue, index: int, batch: _Batch, position: int, threshold: float) -> tuple[Tensor, Tensor]:
    """Index pairs (K, 2) int64 and scores (K,) of one pair of the batch, after layer `index`."""
    states = (batch.state0, batch.state1)
    kept0, kept1 = (torch.nonzero(state.there[position]).squeeze(1) for state in states)
    x0, x1 = (s.x[position : position + 1, kept] for s, kept in zip(states, (kept0, kept1), strict=True))
    rows, columns, scores = mutual_best(network.assignment(index), x0, x1)
    good = scores > threshold
    return torch.stack([kept0[rows[good]], kept1[columns[good]]], dim=1), scores[good]
