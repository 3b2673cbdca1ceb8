"""Pairs cut to equal numbers of keypoints, turned and scaled at random, as tensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from aeromatch_cli.nets.lightglue import Side, normalised
from aeromatch_cli.strategies.matchers.lightglue.inference import FRAME_PX
from trainings.lightglue.sides import UNKNOWN, Array, Partners, Seen

EXPECTED, SIGMAS = 0.6, (0.003, 0.2)  # share of pairs whose poses are known, and how well
_FEWEST = 8  # partners that tell an affinity


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


def expected(side0: Seen, side1: Seen, truth: Partners, sigma: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Where the keypoints of both are expected on the ground, (N, 2) in units and frame of the first, as poses of this
    error predict: the affinity that fits the partners best, and what an error of the poses adds. Zeros without partners
    enough.

    sigma: of the shift; turn and scale grow with it.
    """
    rows = np.flatnonzero(truth.of0 >= 0)
    if len(rows) < _FEWEST or not np.isfinite(sigma):
        return np.zeros((len(side0.points_px), 2), np.float32), np.zeros((len(side1.points_px), 2), np.float32)
    half = side0.size_px / 2.0
    ground0 = (side0.points_px - half) / half.max()
    known = np.column_stack([side1.points_px, np.ones(len(side1.points_px))])
    affine = np.linalg.lstsq(known[truth.of0[rows]], ground0[rows], rcond=None)[0]
    ground1 = known @ affine
    turn, scale = rng.normal(0.0, min(0.6 * sigma, 0.1)), np.exp(rng.normal(0.0, min(0.4 * sigma, 0.05)))
    cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
    ground1 = ground1 @ np.array([[cosine, sine], [-sine, cosine]]) + rng.normal(0.0, sigma, 2)
    return ground0.astype(np.float32), ground1.astype(np.float32)


def as_side(sides: list[Seen], grounds: list[Array] | None = None) -> Side:
    """Sides of equal length as the network takes them, but for their descriptors, which are as stored: `unit` comes
    after they were moved to the device. grounds: (N, 2) expected places of each."""
    points = torch.from_numpy(np.stack([side.points_px for side in sides]))
    sizes = torch.from_numpy(np.stack([side.size_px for side in sides]))
    scales = torch.from_numpy(np.stack([side.sizes_px for side in sides])) / 2.0
    angles = torch.from_numpy(np.stack([side.angles_rad for side in sides]))
    values = torch.from_numpy(np.stack([side.descriptors for side in sides]))
    places = torch.cat([normalised(points, sizes), scales[..., None], angles[..., None]], dim=-1).float()
    return Side(places, values, None if grounds is None else torch.from_numpy(np.stack(grounds)).float())


def unit(side: Side) -> Side:
    """With descriptors of unit length."""
    values = side.descriptors.float()
    return Side(side.places, values / values.norm(dim=-1, keepdim=True).clamp(min=1.0), side.ground)


def batch_of(pieces: list[tuple[Seen, Seen, Partners]], count: int, rng: np.random.Generator) -> Batch:
    """Pieces of `count` keypoints; one with fewer is filled up by repeating keypoints, whose partners are unknown."""
    filled = [(_filled(s0, count), _filled(s1, count), t) for s0, s1, t in pieces]
    grounds = [expected(s0, s1, t, _sigma(rng), rng) for s0, s1, t in filled]
    of0 = [_padded(t.of0, count) for *_, t in pieces]
    of1 = [_padded(t.of1, count) for *_, t in pieces]
    return Batch(
        as_side([s0 for s0, _, _ in filled], [g0 for g0, _ in grounds]),
        as_side([s1 for _, s1, _ in filled], [g1 for _, g1 in grounds]),
        torch.from_numpy(np.stack(of0)),
        torch.from_numpy(np.stack(of1)),
    )


def _sigma(rng: np.random.Generator) -> float:
    """Of the expected places of a pair; infinite where nothing is expected."""
    return float(np.exp(rng.uniform(*np.log(SIGMAS)))) if rng.random() < EXPECTED else np.inf


def _filled(side: Seen, count: int) -> Seen:
    missing = count - len(side.points_px)
    return side.take(np.concatenate([np.arange(len(side.points_px)), np.arange(missing) % len(side.points_px)]))


def _padded(partners: Array, count: int) -> Array:
    return np.concatenate([partners, np.full(count - len(partners), UNKNOWN, np.int64)])
