"""One two-view geometry by PoseLib, and whether chance alone would give as good a one: what matchers and filters share.

Source: PoseLib (Larsson, https://github.com/PoseLib/PoseLib), LO-RANSAC with non-linear refinement; five points,
Nister, PAMI 2004; number of false alarms, Moisan and Stival, IJCV 2004, equation 10.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, PairGeometry
from aeromatch_cli.geometry.cameras import poselib_camera, undistort, without_skew
from aeromatch_cli.geometry.epipolar import essential, fundamental

# Wrong matches that tell the share of 1 % within a band to a sixth; each match is joined with 16 others at most.
_WRONG, _SHIFTS = 4096, 16
# More rows of squares than any picture has.
_ROWS = 1 << 31
# Models that one minimal sample gives at most: ten essential matrices.
_MODELS_PER_SAMPLE = 10
E_SAMPLE, F_SAMPLE, H_SAMPLE = 5, 7, 4


@dataclass(frozen=True, eq=False)
class TwoView:
    """A relative pose ("E", model on normalised rays) or a fundamental matrix ("F") and its inliers (N,).

    pixel_model: (3, 3) the same on undistorted pixels. rotation: cam1_from_cam0, None for F.
    """

    kind: Literal["E", "F"]
    model: FloatArray
    pixel_model: FloatArray
    rotation: FloatArray | None
    inliers: BoolArray

    @property
    def sample(self) -> int:
        """Matches that define a model."""
        return E_SAMPLE if self.kind == "E" else F_SAMPLE


@dataclass(frozen=True)
class Sampling:
    """How PoseLib searches. threshold_px: largest error of an inlier, undistorted pixels."""

    threshold_px: float
    confidence: float = 0.999
    min_iterations: int = 50
    max_iterations: int = 3000

    def options(self, seed: int, threshold: str = "max_epipolar_error") -> dict[str, Any]:
        """In PoseLib's words, of which the threshold's depends on the model."""
        return {
            threshold: self.threshold_px,
            "success_prob": self.confidence,
            "min_iterations": self.min_iterations,
            "max_iterations": self.max_iterations,
            "seed": seed,
        }


def undistorted(
    points0_px: FloatArray, points1_px: FloatArray, geometry: PairGeometry
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Undistorted pixels (N, 2) of both sides of the matches (M, 2) that have them, and which those are (M,)."""
    points0, points1 = undistort(geometry.camera0, points0_px), undistort(geometry.camera1, points1_px)
    usable = np.asarray(np.isfinite(points0 + points1).all(axis=1))
    return points0[usable], points1[usable], usable


def estimate(
    points0_px: FloatArray,
    points1_px: FloatArray,
    geometry: PairGeometry,
    model: Literal["relative_pose", "fundamental"],
    sampling: Sampling,
    seed: int,
) -> TwoView:
    """The relative pose of known cameras or the fundamental matrix of undistorted pixels (N, 2), 8 matches at least."""
    import poselib

    options = sampling.options(seed)
    if model == "fundamental":
        matrix, info = poselib.estimate_fundamental(points0_px, points1_px, options, {})
        return TwoView("F", np.asarray(matrix), np.asarray(matrix), None, np.asarray(info["inliers"], dtype=bool))
    both = (geometry.camera0, geometry.camera1)
    points = [without_skew(camera, places) for camera, places in zip(both, (points0_px, points1_px), strict=True)]
    pose, info = poselib.estimate_relative_pose(*points, *map(poselib_camera, both), options, {})
    rotation = np.asarray(pose.R)
    matrix = essential(rotation, np.asarray(pose.t))
    pixel_matrix = fundamental(matrix, geometry.camera0, geometry.camera1)
    return TwoView("E", matrix, pixel_matrix, rotation, np.asarray(info["inliers"], dtype=bool))


def chance_errors_px(
    distance_px: Callable[[FloatArray, FloatArray], FloatArray], points0_px: FloatArray, points1_px: FloatArray
) -> FloatArray:
    """Errors of matches that are wrong for certain: points (N, 2) of one match joined with those of another."""
    count = len(points0_px)
    shifts = min(_SHIFTS, count - 1, -(-_WRONG // count))
    others = [np.roll(points1_px, 1 + shift, axis=0) for shift in range(shifts)]
    return distance_px(np.tile(points0_px, (len(others), 1)), np.concatenate(others))


def log10_false_alarms(
    points0_px: FloatArray,
    points1_px: FloatArray,
    inliers: BoolArray,
    wrong_errors_px: FloatArray,
    threshold_px: float,
    sample: int,
) -> float:
    """Decimal logarithm of the number of models that chance gives with as many inliers among the matches (N, 2).

    log10 of (N - s) x models per sample x C(N, n) x C(n, s) x p^(n - s), with s matches in a sample, n inliers, and p
    the share of wrong matches (`chance_errors_px`) within the threshold of this very model: so narrow pictures,
    epipoles and crowded keypoints need no formula. Matches that share a place, a square of twice the threshold, with
    another one in either image are no further evidence.
    """
    chance = ((wrong_errors_px <= threshold_px).sum() + 1) / (len(wrong_errors_px) + 1)
    places = 2.0 * threshold_px
    found = min(_distinct(points0_px[inliers], places), _distinct(points1_px[inliers], places))
    offered = max(found, min(_distinct(points0_px, places), _distinct(points1_px, places)))
    if found <= sample:
        return float("inf")
    tests = np.log10(max(offered - sample, 1) * _MODELS_PER_SAMPLE)
    combinations = _log10_binomial(offered, found) + _log10_binomial(found, sample)
    return float(tests + combinations + (found - sample) * np.log10(chance))


def _distinct(points_px: FloatArray, size_px: float) -> int:
    """How many squares of this size the points (N, 2) lie in."""
    column, row = np.floor(points_px / size_px).astype(np.int64).T
    return len(np.unique(column * _ROWS + row))


def _log10_binomial(n: int, k: int) -> float:
    from math import lgamma, log

    return (lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)) / log(10.0)
