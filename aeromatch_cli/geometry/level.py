"""How the surroundings of a point look in another image, where the ground there is level."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray, PairGeometry
from aeromatch_cli.geometry.cameras import project, world_rays
from aeromatch_cli.geometry.epipolar import ray_depths

# Rays that meet at a smaller angle do not tell where, degrees; then the point lies on the ground.
_LEAST_ANGLE_DEG = 1.0
# Differences are taken over so many pixels to each side.
_REACH_PX = 2.0


def level_affinities(geometry: PairGeometry, points0_px: FloatArray, points1_px: FloatArray) -> FloatArray:
    """(N, 2, 2) pixels of image 1 from pixels of image 0 beside matched stored pixels (N, 2), on a level plane through
    the point where their rays meet. NaN where that plane is not seen. Both attitudes and the ground must be known."""
    pose0, pose1, ground_z_m = geometry.pose0, geometry.pose1, geometry.ground_z_m
    assert pose0 is not None
    assert pose1 is not None
    assert ground_z_m is not None
    rotation0, rotation1 = np.asarray(pose0.world_rotation), np.asarray(pose1.world_rotation)
    below_m = _heights(geometry, points0_px, points1_px) - pose0.center_m[2]

    def seen(step_px: FloatArray) -> FloatArray:
        rays = world_rays(geometry.camera0, rotation0, points0_px + step_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            along_m = below_m / rays[:, 2]
        ground_m = pose0.center_m + rays * np.where(along_m > 0.0, along_m, np.nan)[:, None]
        return project(geometry.camera1, rotation1, pose1.center_m, ground_m)

    sides = [_REACH_PX * axis for axis in np.eye(2)]
    return np.stack([(seen(side) - seen(-side)) / (2.0 * _REACH_PX) for side in sides], axis=2)


def _heights(geometry: PairGeometry, points0_px: FloatArray, points1_px: FloatArray) -> FloatArray:
    """(N,) where the rays of matched pixels meet in front of both cameras, else of the ground; world metres."""
    pose0, pose1, ground_z_m = geometry.pose0, geometry.pose1, geometry.ground_z_m
    assert pose0 is not None
    assert pose1 is not None
    assert ground_z_m is not None
    rays0 = world_rays(geometry.camera0, np.asarray(pose0.world_rotation), points0_px)
    rays1 = world_rays(geometry.camera1, np.asarray(pose1.world_rotation), points1_px)
    depth0, depth1, sine = ray_depths(pose1.center_m - pose0.center_m, rays0, rays1)
    meet = (depth0 > 0.0) & (depth1 > 0.0) & (sine > np.sin(np.deg2rad(_LEAST_ANGLE_DEG)))
    return np.asarray(np.where(meet, pose0.center_m[2] + rays0[:, 2] * depth0, ground_z_m))
