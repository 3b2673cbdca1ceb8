"""How significantly matches support one relative pose (a contrario), and which of several sets supports it most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.epipolar import sampson_distance_px
from aeromatch_cli.geometry.two_view import Sampling, TwoView, chance_errors_px, estimate, log10_false_alarms
from aeromatch_cli.strategies.matchers.descriptors.assignment import one_to_one
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Found

# Fewer matches support no model, whatever the odds that chance gives it.
MIN_INLIERS = 12
LOG10_FALSE_ALARMS = -3.0
_MODEL_PX = 4.0
_TRIALS = 16


@dataclass(frozen=True, eq=False)
class Evidence:
    """model: its inliers are among the matches (N,) given.

    log10_false_alarms: how many models as good are expected among random matches.
    """

    model: TwoView
    log10_false_alarms: float

    @property
    def beyond_chance(self) -> bool:
        return self.log10_false_alarms <= LOG10_FALSE_ALARMS


def evidence_of(
    comparison: Comparison, found: Found, places0_px: FloatArray, places1_px: FloatArray
) -> Evidence | None:
    """Of matches in which no keypoint occurs twice; None where too few agree. places: (K0, 2), (K1, 2) undistorted."""
    idx0, idx1 = comparison.keypoints(found)
    usable: BoolArray = np.asarray(np.isfinite(places0_px[idx0] + places1_px[idx1]).all(axis=1))
    if usable.sum() < MIN_INLIERS:
        return None
    points0, points1 = places0_px[idx0[usable]], places1_px[idx1[usable]]
    model = estimate(points0, points1, comparison.geometry, "relative_pose", Sampling(_MODEL_PX), 0)
    if model.inliers.sum() < MIN_INLIERS:
        return None

    def distance(a: FloatArray, b: FloatArray) -> FloatArray:
        return sampson_distance_px(model.pixel_model, a, b)

    if comparison.where is None:
        errors = chance_errors_px(distance, points0, points1)
    else:
        # A wrong match lies anywhere in its window.
        windows = comparison.where.windows.take(idx0)
        wrong0, wrong1 = np.tile(places0_px[idx0], (_TRIALS, 1)), windows.sample(_TRIALS, np.random.default_rng(0))
        seen = np.isfinite(wrong0 + wrong1).all(axis=1)
        errors = distance(wrong0[seen], wrong1[seen])
    odds = log10_false_alarms(points0, points1, model.inliers, errors, _MODEL_PX, model.sample)
    inliers: BoolArray = np.zeros(len(usable), dtype=np.bool_)
    inliers[usable] = model.inliers
    return Evidence(replace(model, inliers=inliers), odds)


def most_evident(comparison: Comparison, sets: Sequence[Found]) -> Found:
    """The set whose matches, each keypoint once, support a model farthest beyond chance; the first where none does."""
    geometry = comparison.geometry
    places0 = undistort(geometry.camera0, comparison.features0.keypoints_px)
    places1 = undistort(geometry.camera1, comparison.features1.keypoints_px)
    singles = [found.take(one_to_one(*comparison.keypoints(found), found.costs)) for found in sets]
    best, most = singles[0], 0.0
    for single in singles:
        evidence = evidence_of(comparison, single, places0, places1)
        if evidence is not None and evidence.log10_false_alarms < most:
            best, most = single, evidence.log10_false_alarms
    return best
