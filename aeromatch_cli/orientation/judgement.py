"""Whether given poses explain the matches of the first pass, and which of them the pictures contradict."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.geometry.cameras import undistort, world_rays
from aeromatch_cli.geometry.epipolar import fundamental_from_poses, sampson_distance_px, triangulate
from aeromatch_cli.geometry.footprints import view_angles_deg

# Given poses explain a block when they are as exact as its matches: this share of them near their epipolar lines...
_EXPLAINED_SHARE = 0.9
# ... and of the matches of every image this share.
_EXPLAINED_IMAGE = 0.6
# Flatter rays give no height.
_MIN_RAY_ANGLE_DEG = 2.0


@dataclass(frozen=True, eq=False)
class PairPoints:
    """Verified matches of two images: stored pixels (M, 2) each."""

    image_id0: str
    image_id1: str
    points0_px: FloatArray
    points1_px: FloatArray


@dataclass(frozen=True)
class Explained:
    """share: of all matches, how many are near the epipolar lines of the given poses; shares: the same by image."""

    share: float
    shares: Mapping[str, float]

    @property
    def holds(self) -> bool:
        """Whether poses as exact as the matches need not be found again."""
        return self.share >= _EXPLAINED_SHARE and all(share >= _EXPLAINED_IMAGE for share in self.shares.values())


def explained(
    pairs: Iterable[PairPoints],
    poses: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
) -> Explained:
    """How well given poses explain verified matches; matches of images without attitude are not explained.

    cameras: by image_id. thresholds_px: by image_id, the error of an exact match in stored pixels.
    """
    good: dict[str, int] = {}
    count: dict[str, int] = {}
    for pair in pairs:
        ids = pair.image_id0, pair.image_id1
        near = 0
        if all(i in poses and poses[i].world_rotation is not None for i in ids):
            matrix = fundamental_from_poses(cameras[ids[0]], poses[ids[0]], cameras[ids[1]], poses[ids[1]])
            sides = [undistort(cameras[i], p) for i, p in zip(ids, (pair.points0_px, pair.points1_px), strict=True)]
            near = int((sampson_distance_px(matrix, *sides) <= max(thresholds_px[i] for i in ids)).sum())
        for image_id in ids:
            good[image_id] = good.get(image_id, 0) + near
            count[image_id] = count.get(image_id, 0) + len(pair.points0_px)
    shares = {i: good[i] / total for i, total in count.items() if total}
    return Explained(sum(good.values()) / max(sum(count.values()), 1), shares)


def triangulated(pairs: Iterable[PairPoints], poses: Mapping[str, Pose], cameras: Mapping[str, Camera]) -> FloatArray:
    """World points (P, 3) of the matches of posed pairs; of rays that meet at too flat an angle none."""
    found: list[FloatArray] = [np.zeros((0, 3))]
    for pair in pairs:
        first, second = poses[pair.image_id0], poses[pair.image_id1]
        if first.world_rotation is None or second.world_rotation is None:
            continue
        rays0 = world_rays(cameras[pair.image_id0], first.world_rotation, pair.points0_px)
        rays1 = world_rays(cameras[pair.image_id1], second.world_rotation, pair.points1_px)
        points = triangulate(first.center_m, rays0, second.center_m, rays1)
        points = points[np.isfinite(points).all(axis=1)]
        found.append(points[view_angles_deg(first.center_m, second.center_m, points) >= _MIN_RAY_ANGLE_DEG])
    return np.concatenate(found)


def attitude_errors_deg(given: Mapping[str, Pose], found: Mapping[str, FloatArray]) -> dict[str, float]:
    """image_id -> angle in degrees between its given attitude and the one found, where both exist."""
    errors = {}
    for image_id, rotation in found.items():
        pose = given.get(image_id)
        if pose is not None and pose.world_rotation is not None:
            cosine = (np.trace(pose.world_rotation @ rotation.T) - 1.0) / 2.0
            errors[image_id] = float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return errors
