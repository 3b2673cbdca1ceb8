"""Whether given poses agree with the pictures within their own standard deviations.

Poses that are only inexact explain no match to a pixel, and are still better than none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Pair, PairGeometry, Pose
from aeromatch_cli.geometry.rotations import angle_between_deg
from aeromatch_cli.geometry.two_view import Sampling, estimate, undistorted
from aeromatch_cli.sfm.epipolar_agreement import MIN_MATCHES, PairPoints, grouped_images

# Relative poses may differ by so many standard deviations, and by so many degrees at least.
_SIGMAS, _LEAST_DEG = 3.0, 10.0
_MOST = 0.6
# A baseline whose direction is no better known than this says nothing.
_UNKNOWN_DEG = 90.0


def consistent_images(
    pairs: Sequence[PairPoints],
    poses: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
) -> set[str]:
    """Return images whose poses agree with the relative poses of their matches, as inexact as they are.

    Images that no match judges are among them where most others are. cameras, thresholds_px (error of an exact match,
    stored pixels): by image_id. Grouped as `explained_images` are.
    """
    known = {i for i, pose in poses.items() if pose.world_rotation is not None}
    judged = set[str]()
    agree: dict[tuple[str, str], bool] = {}
    matches: dict[tuple[str, str], int] = {}
    for pair in pairs:
        ends = pair.image_id0, pair.image_id1
        if len(pair.indices) >= MIN_MATCHES and known.issuperset(ends):
            judged.update(ends)
            agree[ends] = _agrees(pair, poses, cameras, thresholds_px)
            matches[ends] = len(pair.indices)
    good = grouped_images(agree, matches)
    if len(good) >= _MOST * len(judged):
        return good | (known - judged)
    return good


def _agrees(
    pair: PairPoints, poses: Mapping[str, Pose], cameras: Mapping[str, Camera], thresholds_px: Mapping[str, float]
) -> bool:
    ids = pair.image_id0, pair.image_id1
    geometry = PairGeometry(Pair(*ids, np.nan, np.nan, ""), cameras[ids[0]], cameras[ids[1]], None, None, None)
    points0, points1, usable = undistorted(pair.points0_px, pair.points1_px, geometry)
    if usable.sum() < MIN_MATCHES:
        return False
    sampling = Sampling(max(thresholds_px[i] for i in ids))
    found = estimate(points0, points1, geometry, "relative_pose", sampling, 0)
    assert found.rotation is not None
    first, second = (poses[i] for i in ids)
    rotation0, rotation1 = np.asarray(first.world_rotation), np.asarray(second.world_rotation)
    limit_deg = max(_LEAST_DEG, _SIGMAS * float(np.hypot(first.sigma_angle_deg, second.sigma_angle_deg)))
    if angle_between_deg(found.rotation, rotation1 @ rotation0.T) > limit_deg:
        return False
    base_m = rotation1 @ (first.center_m - second.center_m)
    off_m = _SIGMAS * float(np.hypot(first.sigma_position_m, second.sigma_position_m))
    limit_deg += float(np.rad2deg(np.arctan2(off_m, np.linalg.norm(base_m))))
    return limit_deg >= _UNKNOWN_DEG or _angle_deg(_translation(found.model, found.rotation), base_m) <= limit_deg


def _translation(essential: FloatArray, rotation: FloatArray) -> FloatArray:
    """Direction (3,) of the translation of an essential matrix [t]x R."""
    cross = essential @ rotation.T
    return np.array([cross[2, 1], cross[0, 2], cross[1, 0]])


def _angle_deg(one: FloatArray, other: FloatArray) -> float:
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)))
