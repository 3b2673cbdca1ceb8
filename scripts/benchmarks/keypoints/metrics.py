"""Figures of descriptors: how well they tell places apart, and how well nearest neighbours are ranked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray, IntArray

RECALL, SAME_PX = 0.95, 3.0


def distances(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, M) Euclidean distances of descriptors (N, C) and (M, C)."""
    squares = (first * first).sum(axis=1)[:, None] + (second * second).sum(axis=1) - 2.0 * (first @ second.T)
    return np.sqrt(np.maximum(squares, 0.0))


def false_positive_rate(same: FloatArray, other: FloatArray, recall: float = RECALL) -> float:
    """Share of distances (N,) between different places that the threshold accepts which accepts `recall` of those (M,)
    between one and the same; FPR95 at its default. NaN without any."""
    if not len(same) or not len(other):
        return float("nan")
    threshold = np.sort(same)[int(np.ceil(recall * len(same))) - 1]
    return float((other <= threshold).mean())


def average_precision(scores: FloatArray, correct: BoolArray, possible: int) -> float:
    """Area below precision over recall of answers (N,) taken by score, the largest first; possible: all that could be
    correct. Equal scores come in one step. NaN where nothing is possible."""
    if possible == 0:
        return float("nan")
    order = np.argsort(-scores, kind="stable")
    hits, ends = np.cumsum(correct[order]), np.flatnonzero(np.append(np.diff(scores[order]) != 0, True))
    gained = np.diff(np.concatenate([[0], hits[ends]])) if len(scores) else np.zeros(0)
    precision = hits[ends] / (ends + 1.0) if len(scores) else np.zeros(0)
    return float((gained * precision).sum() / possible)


@dataclass(frozen=True)
class Ranked:
    """Average precision of the nearest neighbours of a pair: by_ratio: those ordered by the ratio of first to second
    distance; by_distance: by the first. right: share of the possible that are right, whatever the order."""

    by_ratio: float
    by_distance: float
    right: float


def nearest_neighbours(
    apart: NDArray[np.float32], partner: IntArray, places1_px: FloatArray, asked: BoolArray
) -> Ranked:
    """Of distances (N, M): every keypoint of side 0 that is asked (N,) has its nearest of side 1 as answer.

    partner: (N,) of side 1, -1 without one. An answer is right where it lies within SAME_PX of the partner, places1_px
    (M, 2): a place may have keypoints of several sizes.
    """
    apart, partner = apart[asked], partner[asked]
    possible = int((partner >= 0).sum())
    if apart.shape[1] < 2 or not possible:
        return Ranked(float("nan"), float("nan"), float("nan"))
    two = np.partition(apart, 1, axis=1)[:, :2].astype(np.float64)
    off = np.linalg.norm(places1_px[apart.argmin(axis=1)] - places1_px[partner], axis=1)
    correct = (partner >= 0) & (off <= SAME_PX)
    by_ratio = average_precision(-two[:, 0] / np.maximum(two[:, 1], 1e-12), correct, possible)
    by_distance = average_precision(-two[:, 0], correct, possible)
    return Ranked(by_ratio, by_distance, float(correct.sum() / possible))
