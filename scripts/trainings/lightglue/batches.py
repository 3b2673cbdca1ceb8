"""Pairs cut to equal numbers of keypoints, turned and scaled at random, as tensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from aeromatch_cli.nets.lightglue import Side, normalised
from aeromatch_cli.strategies.matchers.lightglue.inference import FRAME_PX
from trainings.lightglue.sides import UNKNOWN, Array, Partners, Seen


@dataclass(frozen=True, eq=False)
class Batch:
    """B pairs of K keypoints each. partners: (B, K) int64 of either side, NONE or UNKNOWN without."""

    side0: Side
    side1: Side
    partners0: torch.Tensor
    partners1: torch.Tensor


def piece(
    side0: Seen, side1: Seen, truth: Partners, count: int, rng: np.random.Generator, *, free: bool
) -> tuple[Seen, Seen, Partners]:
    """count keypoints of either side: around a place that both show, or spread over all. free: turned at random.

    The keypoints around a place have a picture of their own, as after culling to an overlap, in half of the cases.
    """
    rows0, rows1 = _rows(side0, side1, truth, count, rng)
    cut = truth.take(rows0, rows1)
    framed = rng.random() < 0.5
    turn = rng.uniform(-np.pi, np.pi) if free else 0.0
    scale = float(np.exp(rng.uniform(np.log(0.6), np.log(1.7))))
    found0 = _framed(side0.take(rows0), framed, turn, scale)
    turn = rng.uniform(-np.pi, np.pi) if free else 0.0
    return found0, _framed(side1.take(rows1), framed, turn, scale), cut


def _rows(side0: Seen, side1: Seen, truth: Partners, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    matched = np.flatnonzero(truth.of0 >= 0)
    if rng.random() < 0.3 or not len(matched):
        rows = [rng.permutation(len(side.points_px))[:count] for side in (side0, side1)]
        return np.sort(rows[0]), np.sort(rows[1])
    anchor = int(matched[rng.integers(len(matched))])
    wide = np.exp(rng.normal(0.0, 0.2, 2))
    places = ((side0, anchor), (side1, int(truth.of0[anchor])))
    rows = []
    for side, middle in places:
        off = rng.normal(0.0, 0.05, 2) * side.size_px
        distance = (np.abs(side.points_px - side.points_px[middle] - off) * wide).max(axis=1)
        rows.append(np.sort(np.argsort(distance, kind="stable")[:count]))
    return rows[0], rows[1]


def _framed(side: Seen, framed: bool, turn: float, scale: float) -> Seen:
    """The side, its picture turned and enlarged, and where `framed` cut to what holds the keypoints."""
    cosine, sine = np.cos(turn), np.sin(turn)
    matrix = np.array([[cosine, -sine], [sine, cosine]], np.float32) * np.float32(scale)
    points = (side.points_px - side.size_px / 2.0) @ matrix.T
    if framed:
        low, high = points.min(axis=0) - FRAME_PX, points.max(axis=0) + FRAME_PX
    else:
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side.size_px / 2.0 @ matrix.T
        low, high = corners.min(axis=0), corners.max(axis=0)
    angles = np.mod(side.angles_rad + turn + np.pi, 2.0 * np.pi) - np.pi
    size = (high - low).astype(np.float32)
    return Seen((points - low).astype(np.float32), side.sizes_px * np.float32(scale), angles.astype(np.float32),
                side.descriptors, size, side.places_px)  # fmt: skip


def as_side(sides: list[Seen]) -> Side:
    """Sides of equal length as the network takes them."""
    points = torch.from_numpy(np.stack([side.points_px for side in sides]))
    sizes = torch.from_numpy(np.stack([side.size_px for side in sides]))
    scales = torch.from_numpy(np.stack([side.sizes_px for side in sides])) / 2.0
    angles = torch.from_numpy(np.stack([side.angles_rad for side in sides]))
    values = torch.from_numpy(np.stack([side.descriptors for side in sides])).float()
    values = values / values.norm(dim=-1, keepdim=True).clamp(min=1.0)
    return Side(torch.cat([normalised(points, sizes), scales[..., None], angles[..., None]], dim=-1).float(), values)


def batch_of(pieces: list[tuple[Seen, Seen, Partners]], count: int) -> Batch:
    """Pieces of `count` keypoints; one with fewer is filled up by repeating keypoints, whose partners are unknown."""
    filled = [(_filled(s0, count), _filled(s1, count), t) for s0, s1, t in pieces]
    of0 = [_padded(t.of0, count) for *_, t in pieces]
    of1 = [_padded(t.of1, count) for *_, t in pieces]
    return Batch(
        as_side([s0 for s0, _, _ in filled]),
        as_side([s1 for _, s1, _ in filled]),
        torch.from_numpy(np.stack(of0)),
        torch.from_numpy(np.stack(of1)),
    )


def _filled(side: Seen, count: int) -> Seen:
    missing = count - len(side.points_px)
    return side.take(np.concatenate([np.arange(len(side.points_px)), np.arange(missing) % len(side.points_px)]))


def _padded(partners: Array, count: int) -> Array:
    return np.concatenate([partners, np.full(count - len(partners), UNKNOWN, np.int64)])
