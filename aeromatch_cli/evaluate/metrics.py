"""The measures that need no truth of their own: thinning, coverage, relative pose, area under a curve. Arrays only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from aeromatch_cli.data import BoolArray, Camera, FloatArray, IntArray, Pose
from aeromatch_cli.geometry.cameras import poselib_camera, undistort, without_skew
from aeromatch_cli.geometry.epipolar import relative_pose
from aeromatch_cli.geometry.rotations import angle_between_deg

SPACING_PX = 2.0
GRID_CELLS = 16
AUC_THRESHOLDS_DEG = (1.0, 3.0, 5.0, 10.0)
# The estimator behind every pose error, the same for all methods.
POSE_THRESHOLD_PX, POSE_SEED, _MIN_POSE_MATCHES = 2.0, 0, 8
_POSE_ITERATIONS = (200, 5000)
# A shorter baseline has no direction to be wrong about.
_NO_BASELINE_M = 1e-9


def thin(
    points0_px: FloatArray, points1_px: FloatArray, scores: FloatArray, spacing_px: float = SPACING_PX
) -> IntArray:
    """Indices, ascending, of the matches (M,) that are left when kept ones must be spacing_px apart in both images.

    Greedy, best score first, equal scores in the order given: one-to-one follows, since equal places are 0 px apart.
    """
    from scipy.spatial import cKDTree

    count = len(scores)
    conflicts = []
    for points_px in (points0_px, points1_px):
        near = cKDTree(points_px).query_pairs(spacing_px, output_type="ndarray").reshape(-1, 2)
        apart = np.linalg.norm(points_px[near[:, 0]] - points_px[near[:, 1]], axis=1)
        conflicts.append(near[apart < spacing_px])
    one_way = np.concatenate(conflicts)
    both_ways = np.concatenate([one_way, one_way[:, ::-1]])
    both_ways = both_ways[np.argsort(both_ways[:, 0], kind="stable")]
    starts = np.searchsorted(both_ways[:, 0], np.arange(count + 1))
    dropped, kept = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    for i in np.argsort(-np.asarray(scores, dtype=np.float64), kind="stable"):
        if not dropped[i]:
            kept[i] = True
            dropped[both_ways[starts[i] : starts[i + 1], 1]] = True
    return np.flatnonzero(kept)


def coverage(points_px: FloatArray, overlap_px: FloatArray, cells: int = GRID_CELLS) -> float:
    """Share of the cells of a grid over the overlap that hold at least one point; NaN without overlap.

    overlap_px: (S, 2) samples of the overlap, denser than the grid. The grid of cells x cells divides their bounding
    box evenly; only cells that hold a sample count. points_px: (N, 2) in the same image; those outside the box count
    in the nearest cell.
    """
    if not len(overlap_px):
        return float("nan")
    low = overlap_px.min(axis=0)
    extent = np.maximum(overlap_px.max(axis=0) - low, 1e-9)

    def held(places_px: FloatArray) -> BoolArray:
        grid = np.zeros((cells, cells), dtype=bool)
        column, row = np.clip(np.floor((places_px - low) / extent * cells), 0, cells - 1).astype(int).T
        grid[row, column] = True
        return grid

    region = held(overlap_px)
    return float((held(np.asarray(points_px).reshape(-1, 2)) & region).sum() / region.sum())


def auc(errors_deg: FloatArray, thresholds_deg: Sequence[float] = AUC_THRESHOLDS_DEG) -> tuple[float, ...]:
    """Area under the curve "share of pairs with at most this error", up to each threshold, over the threshold.

    errors_deg: (N,), NaN where a pair has none: it counts as a failure. NaN without pairs. Trapezoids between the
    sorted errors, as Sarlin et al., SuperGlue, CVPR 2020, and all who compare with it.
    """
    if not len(errors_deg):
        return tuple(float("nan") for _ in thresholds_deg)
    errors = np.sort(np.where(np.isnan(errors_deg), np.inf, errors_deg).astype(np.float64))
    share = np.arange(len(errors) + 1) / len(errors)
    errors = np.concatenate([[0.0], errors])
    areas = []
    for threshold in thresholds_deg:
        last = int(np.searchsorted(errors, threshold))
        x = np.concatenate([errors[:last], [threshold]])
        y = np.concatenate([share[:last], [share[last - 1]]])
        areas.append(float(np.trapezoid(y, x) / threshold))
    return tuple(areas)


def pose_error_deg(
    points0_px: FloatArray, points1_px: FloatArray, camera0: Camera, camera1: Camera, pose0: Pose, pose1: Pose
) -> tuple[float, float]:
    """Angle of rotation and angle of translation direction between the pose of the matches and the true one, degrees.

    points (M, 2): stored pixels. PoseLib's relative pose with the true cameras, fixed seed and threshold. (NaN, NaN)
    below 8 usable matches; the second NaN where the images share their projection centre.
    """
    import poselib

    points0, points1 = undistort(camera0, points0_px), undistort(camera1, points1_px)
    usable = np.isfinite(points0).all(axis=1) & np.isfinite(points1).all(axis=1)
    if usable.sum() < _MIN_POSE_MATCHES:
        return float("nan"), float("nan")
    ransac = {
        "max_epipolar_error": POSE_THRESHOLD_PX,
        "seed": POSE_SEED,
        "min_iterations": _POSE_ITERATIONS[0],
        "max_iterations": _POSE_ITERATIONS[1],
    }
    found, _ = poselib.estimate_relative_pose(
        without_skew(camera0, points0[usable]),
        without_skew(camera1, points1[usable]),
        poselib_camera(camera0),
        poselib_camera(camera1),
        ransac,
        {},
    )
    rotation, translation = relative_pose(pose0, pose1)
    return angle_between_deg(np.asarray(found.R), rotation), _direction_angle_deg(np.asarray(found.t), translation)


def _direction_angle_deg(found: FloatArray, true: FloatArray) -> float:
    if np.linalg.norm(true) < _NO_BASELINE_M or np.linalg.norm(found) < _NO_BASELINE_M:
        return float("nan")
    across, along = float(np.linalg.norm(np.cross(found, true))), float(found @ true)
    return float(np.rad2deg(np.arctan2(across, along)))
