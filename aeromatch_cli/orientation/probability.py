"""How probable it is that a verified match is right, by what the adjusted block and its neighbours say of it.

A logistic model of a few properties that every match has. It was fitted on rendered blocks, whose truth is exact;
`scripts/bench probability` fits it again and draws how far it can be relied on, on blocks that it has not seen.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray

# Beyond these, more says nothing more: pixels, images, pixels, degrees.
_MOST_ERROR_PX, _MOST_CONFIRMING, _MOST_OFF_PX, _MOST_ANGLE_DEG = 2.0, 4, 16.0, 60.0
# Of as many nearest matches of the pair, this one's height counts: a match is on the surface of two of them.
NEIGHBOURS, SUPPORTING = 8, 2
# One for every column of `columns`, as `scripts/bench probability` has found them.
WEIGHTS = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class MatchEvidence:
    """What is known of the matches of a pair, (M,) each.

    scores: the matcher's, 0-1. error_px: distance from the epipolar line of the adjusted block. known, confirming: in
    how many third images their keypoints are matched, and in how many of these within a pixel of the point's place.
    off0_px, off1_px: how far the match lies from where it would be at the height of its neighbours (the second nearest
    of these heights), with the neighbours in either image. angle_deg: between both rays.
    """

    scores: FloatArray
    error_px: FloatArray
    known: FloatArray
    confirming: FloatArray
    off0_px: FloatArray
    off1_px: FloatArray
    angle_deg: FloatArray

    def take(self, which: BoolArray) -> MatchEvidence:
        return MatchEvidence(*(getattr(self, field.name)[which] for field in fields(self)))


def off_neighbours_px(
    center0_m: FloatArray,
    rays0: FloatArray,
    center1_m: FloatArray,
    rays1: FloatArray,
    heights_m: FloatArray,
    focal1_px: float,
) -> FloatArray:
    """(M,) distance in image 1 of each match from where it would be, were it as high as one of its neighbours.

    Of the nearest matches in image 0 the one with the second smallest distance counts. rays0, rays1: (M, 3) unit
    vectors in the world from the centres (3,). heights_m: (M,) of the points where they meet.
    """
    from scipy.spatial import cKDTree

    count = min(NEIGHBOURS + 1, len(rays0))
    if count <= SUPPORTING:
        return np.full(len(rays0), _MOST_OFF_PX)
    _, near = cKDTree(rays0).query(rays0, k=count)
    with np.errstate(divide="ignore", invalid="ignore"):
        along_m = (heights_m[near[:, 1:]] - center0_m[2]) / rays0[:, None, 2]
        ways = center0_m + rays0[:, None, :] * along_m[..., None] - center1_m
        ways /= np.linalg.norm(ways, axis=2, keepdims=True)
        off_px = np.linalg.norm(np.cross(ways, rays1[:, None, :]), axis=2) * focal1_px
    off_px = np.where((along_m > 0.0) & np.isfinite(off_px), off_px, _MOST_OFF_PX)
    return np.asarray(np.sort(off_px, axis=1)[:, SUPPORTING - 1])


def columns(evidence: MatchEvidence) -> FloatArray:
    """(M, 9) what the model is linear in."""
    off_px = np.minimum(np.stack([evidence.off0_px, evidence.off1_px]), _MOST_OFF_PX)
    return np.column_stack(
        [
            np.ones(len(evidence.scores)),
            evidence.scores,
            evidence.known == 0,
            np.minimum(evidence.error_px, _MOST_ERROR_PX),
            np.sqrt(np.minimum(evidence.confirming, _MOST_CONFIRMING)),
            (evidence.known > 0) & (evidence.confirming == 0),
            np.log2(1.0 + off_px.max(axis=0)),
            np.log2(1.0 + off_px.min(axis=0)),
            np.minimum(evidence.angle_deg, _MOST_ANGLE_DEG) / _MOST_ANGLE_DEG,
        ]
    ).astype(np.float64)


def probabilities(evidence: MatchEvidence) -> FloatArray:
    """(M,) that the matches are right, to 3 pixels."""
    return np.asarray(1.0 / (1.0 + np.exp(-columns(evidence) @ np.array(WEIGHTS))))


def fitted_weights(values: FloatArray, right: BoolArray) -> FloatArray:
    """Weights of `columns` (M, 9) by maximum likelihood (Newton's method), given which matches (M,) are right."""
    weights = np.zeros(values.shape[1])
    for _ in range(50):
        p = 1.0 / (1.0 + np.exp(-values @ weights))
        curvature = (values.T * (p * (1.0 - p) + 1e-9)) @ values + 1e-2 * np.eye(len(weights))
        step = np.linalg.solve(curvature, values.T @ (right - p))
        weights += step
        if np.abs(step).max() < 1e-8:
            break
    return weights
