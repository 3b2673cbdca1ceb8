"""Which keypoints the other image may show: all that is worth comparing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from aeromatch_cli.data import BoolArray, Features, FloatArray, PairGeometry
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.geometry.planes import plane_distances_px
from aeromatch_cli.geometry.prediction import Windows
from aeromatch_cli.geometry.two_view import H_SAMPLE, Sampling, chance_errors_px, log10_false_alarms
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Found
from aeromatch_cli.strategies.matchers.descriptors.evidence import LOG10_FALSE_ALARMS, MIN_INLIERS

# One plane stands for the ground with all that rises over it: so far beside it, in longer sides of the box of what
# is matched, matches lie, and so far beyond the other picture's keypoints one may seem to lie.
_PLANE_SHARE, _MARGIN_SHARE = 0.02, 0.15


def in_overlap(
    comparison: Comparison, found: Found, windows: Callable[[Features, PairGeometry], Windows | None]
) -> tuple[BoolArray, BoolArray]:
    """Which keypoints (K0,), (K1,) the other image may show: by the plane of the matches found where they have one
    beyond chance, else by the poses, else all.

    windows: where each keypoint of its image may lie in the other one of a geometry.
    """
    geometry = comparison.geometry
    points0, points1 = _undistorted(comparison)
    shown = _by_plane(comparison, found, points0, points1)
    if shown is not None:
        return shown
    forward = comparison.where.windows if comparison.where else windows(comparison.features0, geometry)
    backward = windows(comparison.features1, geometry.turned()) if forward is not None else None
    if forward is None or backward is None:
        return np.ones(len(points0), dtype=bool), np.ones(len(points1), dtype=bool)
    return _meets(forward, points1), _meets(backward, points0)


def strongest(comparison: Comparison, most: int) -> tuple[BoolArray, BoolArray]:
    """Of either image the `most` keypoints with the strongest responses: (K0,), (K1,)."""
    found = []
    for features in (comparison.features0, comparison.features1):
        chosen = np.zeros(len(features.responses), bool)
        chosen[np.argsort(-features.responses, kind="stable")[:most]] = True
        found.append(chosen)
    return found[0], found[1]


def by_plane(comparison: Comparison, found: Found) -> tuple[BoolArray, BoolArray] | None:
    """Which keypoints (K0,), (K1,) the other image may show, by the plane of the matches found; None where chance gives
    as good a one."""
    return _by_plane(comparison, found, *_undistorted(comparison))


def _undistorted(comparison: Comparison) -> tuple[FloatArray, FloatArray]:
    geometry = comparison.geometry
    points0 = undistort(geometry.camera0, comparison.features0.keypoints_px)
    return points0, undistort(geometry.camera1, comparison.features1.keypoints_px)


def _by_plane(
    comparison: Comparison, found: Found, points0_px: FloatArray, points1_px: FloatArray
) -> tuple[BoolArray, BoolArray] | None:
    idx0, idx1 = comparison.keypoints(found)
    plane = _plane(points0_px[idx0], points1_px[idx1])
    if plane is None:
        return None
    back = _turned(plane, points0_px[idx0])
    there0, there1 = apply_homography(plane, points0_px), apply_homography(back, points1_px)
    return _near(there0, points1_px), _near(there1, points0_px)


def _plane(points0_px: FloatArray, points1_px: FloatArray) -> FloatArray | None:
    """The homography (3, 3) of most of the matches (N, 2), positive where they lie; None where chance gives as good."""
    import poselib

    usable = np.asarray(np.isfinite(points0_px + points1_px).all(axis=1))
    if usable.sum() < MIN_INLIERS:
        return None
    points0, points1 = points0_px[usable], points1_px[usable]
    threshold_px = _PLANE_SHARE * _longer_side(points1)
    options = Sampling(threshold_px).options(0, "max_reproj_error")
    matrix, info = poselib.estimate_homography(points0, points1, options, {})
    inliers = np.asarray(info["inliers"], dtype=bool)
    if inliers.sum() < MIN_INLIERS:
        return None
    plane = _positive(np.asarray(matrix), points0[inliers])

    def distance(a: FloatArray, b: FloatArray) -> FloatArray:
        return plane_distances_px(plane[None], a, b)[0]

    errors = chance_errors_px(distance, points0, points1)
    odds = log10_false_alarms(points0, points1, inliers, errors, threshold_px, H_SAMPLE)
    return plane if odds <= LOG10_FALSE_ALARMS else None


def _positive(plane: FloatArray, points_px: FloatArray) -> FloatArray:
    """Of the sign that gives the points (N, 2) a positive third coordinate."""
    return plane * np.sign(np.median(points_px @ plane[2, :2] + plane[2, 2]))


def _turned(plane: FloatArray, points0_px: FloatArray) -> FloatArray:
    there = apply_homography(plane, points0_px)
    return _positive(np.linalg.inv(plane), there[np.isfinite(there).all(axis=1)])


def _box(points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    known = points_px[np.isfinite(points_px).all(axis=1)]
    return known.min(axis=0), known.max(axis=0)


def _longer_side(points_px: FloatArray) -> float:
    low, high = _box(points_px)
    return float((high - low).max())


def _near(there_px: FloatArray, points_px: FloatArray) -> BoolArray:
    """Whether places (N, 2) lie in the box of the points (M, 2) or next to it."""
    low, high = _box(points_px)
    margin = _MARGIN_SHARE * float((high - low).max())
    with np.errstate(invalid="ignore"):
        inside = (there_px >= low - margin) & (there_px <= high + margin)
    return np.asarray(inside.all(axis=1))


def _meets(windows: Windows, points_px: FloatArray) -> BoolArray:
    """Whether each window's box reaches into the box of the points (N, 2); a window of nothing does not."""
    if not np.isfinite(points_px).all(axis=1).any():
        return np.zeros(len(windows.centers_px), dtype=bool)
    low, high = _box(points_px)
    reach = np.einsum("nij,ni->nj", np.abs(windows.axes), windows.halves_px)
    with np.errstate(invalid="ignore"):
        inside = (windows.centers_px + reach >= low) & (windows.centers_px - reach <= high)
    return np.asarray(inside.all(axis=1))
