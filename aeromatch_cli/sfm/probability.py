"""This module states how probable it is that a verified match is right, from the adjusted block and the match's
neighbours, and which matches are probable enough to stay.

A logistic model of a few properties that every match has. It was fitted on rendered blocks, whose truth is exact;
`scripts/train probability` fits it again and says how far it can be relied on, on blocks that it has not seen.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.geometry.components import labels_by_name

# Distances count in multiples of the pair's median distance from epipolar lines, which is at least so many pixels: some
# images are held less exactly than others.
_LEAST_UNIT_PX = 0.3
# Beyond these, more says nothing more: images, units.
_MOST_CONFIRMING, _MOST_OFF = 4, 50.0
# A pair whose median distance from the neighbours' heights is more than so many times that of the block's matches, and
# more than so many pixels, is loose: where the light on relief has moved with the sun, keypoints of either image lie on
# what moved, and agree with their neighbours and with third images all the same.
_LOOSE, _LEAST_LOOSE_PX = 1.5, 1.0
# A match that has no neighbours, or lies where their heights are not seen, is as far off as this, pixels.
_NOWHERE_PX = 16.0
# Of as many nearest matches of the pair the one with the second smallest distance counts.
NEIGHBOURS, SUPPORTING = 8, 2
# One for every column of `columns`, as `scripts/train probability` has found them.
WEIGHTS = (4.818, 2.247, 1.148, -0.732, -1.268, -3.094)
# Matches left to a pair without which images fall apart: enough for a relative orientation, few among all others.
_BRIDGING = 30


@dataclass(frozen=True, eq=False)
class MatchEvidence:
    """Holds what is known of the matches of a pair, (M,) each, one at least.

    scores: the matcher's, 0-1. error_px: distance from the epipolar line of the adjusted block. confirming: in how many
    third images their keypoints are matched within a pixel of the point's place. off0_px, off1_px: how far the match
    lies from where it would be at the height of its neighbours (the second nearest of these heights), with the
    neighbours in either image.
    """

    scores: FloatArray
    error_px: FloatArray
    confirming: IntArray
    off0_px: FloatArray
    off1_px: FloatArray

    @property
    def off_px(self) -> FloatArray:
        """(M,) the larger of both distances from the neighbours' heights."""
        return np.asarray(np.minimum(np.maximum(self.off0_px, self.off1_px), _NOWHERE_PX))


def usual_off_px(pairs: Iterable[MatchEvidence]) -> float:
    """Return the median distance of all matches of a block from where they would be at their neighbours' heights."""
    every = [pair.off_px for pair in pairs]
    return float(np.median(np.concatenate(every))) if every else 0.0


def off_neighbours_px(
    center0_m: FloatArray,
    rays0: FloatArray,
    center1_m: FloatArray,
    rays1: FloatArray,
    heights_m: FloatArray,
    focal1_px: float,
) -> FloatArray:
    """Return the distance (M,) in image 1 of each match from where it would be, were it as high as one of its
    neighbours.

    Of the nearest matches in image 0 the one with the second smallest distance counts. rays0, rays1: (M, 3) unit
    vectors in the world from the centres (3,). heights_m: (M,) of the points where they meet.
    """
    from scipy.spatial import cKDTree

    count = min(NEIGHBOURS + 1, len(rays0))
    if count <= SUPPORTING:
        return np.full(len(rays0), _NOWHERE_PX)
    _, near = cKDTree(rays0).query(rays0, k=count)
    with np.errstate(divide="ignore", invalid="ignore"):
        along_m = (heights_m[near[:, 1:]] - center0_m[2]) / rays0[:, None, 2]
        ways = center0_m + rays0[:, None, :] * along_m[..., None] - center1_m
        ways /= np.linalg.norm(ways, axis=2, keepdims=True)
        off_px = np.linalg.norm(ways - rays1[:, None, :], axis=2) * focal1_px
    off_px = np.where((along_m > 0.0) & np.isfinite(off_px), off_px, _NOWHERE_PX)
    return np.asarray(np.sort(off_px, axis=1)[:, SUPPORTING - 1])


def columns(evidence: MatchEvidence, usual_px: float) -> FloatArray:
    """Return the columns (M, 6) in which the model is linear: one, score, confirmations by third images, those of the
    whole pair, distance from the neighbours' heights, and how loose the pair is. usual_px: `usual_off_px` of the block.

    Confirmations of the pair are their mean: what no third image confirms is doubtful where third images confirm most
    others, not where none shows the ground. Means over the nearest 8 to 32 matches tell no more."""
    unit_px = max(float(np.median(evidence.error_px)), _LEAST_UNIT_PX)
    off = evidence.off_px / unit_px
    tight_px = max(_LOOSE * usual_px, _LEAST_LOOSE_PX)
    loose = float(np.log2(max(float(np.median(evidence.off_px)), tight_px) / tight_px))
    confirmed = np.sqrt(np.minimum(evidence.confirming, _MOST_CONFIRMING))
    return np.column_stack(
        [
            np.ones(len(off)),
            evidence.scores,
            confirmed,
            np.full(len(off), confirmed.mean()),
            np.log2(1.0 + np.minimum(off, _MOST_OFF)),
            np.full(len(off), loose),
        ]
    ).astype(np.float64)


def stated(values: FloatArray) -> FloatArray:
    """Return the probabilities (M,) of matches with such `columns` (M, 6)."""
    return _logistic(values @ np.array(WEIGHTS))


def probabilities(evidence: MatchEvidence, usual_px: float) -> FloatArray:
    """Return the probabilities (M,) that the matches of a pair are right, to 3 pixels. usual_px: `usual_off_px` of the
    block."""
    return stated(columns(evidence, usual_px))


def fitted_weights(values: FloatArray, right: BoolArray) -> FloatArray:
    """Return the weights of `columns` (M, 6) by maximum likelihood (Newton's method), given which matches (M,) are
    right."""
    weights = np.zeros(values.shape[1])
    for _ in range(50):
        p = _logistic(values @ weights)
        curvature = (values.T * (p * (1.0 - p) + 1e-9)) @ values + 1e-2 * np.eye(len(weights))
        step = np.linalg.solve(curvature, values.T @ (right - p))
        weights += step
        if np.abs(step).max() < 1e-8:
            break
    return weights


def _logistic(values: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + np.exp(-values)))


def least_probability(
    likely: Iterable[FloatArray | None], least: float, expected_right: float, most_given_up: float
) -> float:
    """Return the probability from which on matches stay: `least`, or more where the mean of those would be less than
    `expected_right`; no larger share of them is given up for that than `most_given_up`. likely: probabilities (M,) of
    the matches of every pair."""
    every = np.concatenate([np.zeros(0), *(p for p in likely if p is not None)])
    falling = -np.sort(-every[every >= least])
    means = np.cumsum(falling) / np.arange(1, len(falling) + 1)
    enough = max(int((means >= expected_right).sum()), math.ceil((1.0 - most_given_up) * len(falling)))
    return least if enough == len(falling) else float(falling[max(0, enough - 1)])


def probable_enough(
    ends: Sequence[tuple[str, str]], likely: Sequence[FloatArray | None], least: float, min_matches: int
) -> list[BoolArray | None]:
    """Return, for every pair, which of its matches (M,) are as probable as asked; None where no probabilities are
    known.

    Where images that pairs have tied would fall apart by that, the pairs between the parts keep their best 30 matches:
    a block whose flights lie a few pixels off each other is worth more than flights that nothing connects. ends: image
    ids. likely: probabilities (M,). min_matches: a pair with fewer ties nothing.
    """
    keep = [None if p is None else p >= least for p in likely]
    tied = [both for both, mask in zip(ends, keep, strict=True) if mask is None or mask.sum() >= min_matches]
    part = labels_by_name(sorted({image_id for both in ends for image_id in both}), tied)
    for n, (both, p) in enumerate(zip(ends, likely, strict=True)):
        if p is not None and len(p) >= min_matches and part[both[0]] != part[both[1]]:
            best = np.zeros(len(p), dtype=bool)
            best[np.argsort(-p, kind="stable")[: max(_BRIDGING, min_matches)]] = True
            keep[n] = best | (p >= least)
    return keep
