"""This module decides which given poses explain the matches of the first pass, as exactly as these are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Ground, IntArray, Pose
from aeromatch_cli.geometry.cameras import undistort, world_rays
from aeromatch_cli.geometry.components import connected_groups
from aeromatch_cli.geometry.epipolar import fundamental_from_poses, sampson_distance_px, triangulate
from aeromatch_cli.geometry.footprints import view_angles_deg
from aeromatch_cli.geometry.rotations import angle_between_deg

# An image by its id or number, or a pair of images.
N = TypeVar("N", str, tuple[str, str], int)
# Two poses explain the matches of a pair when this share of them lies near its epipolar line and in front of both.
EXPLAINED_SHARE = 0.75
# A pair of fewer matches says nothing of two poses.
MIN_MATCHES = 15
# Matches that contradict a group count from this share of those that hold it together.
_BY_CHANCE = 0.25
# Matches at a flatter angle of intersection may seem to lie behind a camera, and give no height.
_MIN_RAY_ANGLE_DEG = 2.0


@dataclass(frozen=True, eq=False)
class PairPoints:
    """Verified matches of two images: stored pixels (M, 2) each, and the numbers (M, 2) of their keypoints."""

    image_id0: str
    image_id1: str
    points0_px: FloatArray
    points1_px: FloatArray
    indices: IntArray


def explained_share(
    pair: PairPoints, poses: Mapping[str, Pose], cameras: Mapping[str, Camera], thresholds_px: Mapping[str, float]
) -> float:
    """Return the share of a pair's matches that both given poses explain, 0 where one has no attitude."""
    explained = explained_matches(pair, poses, cameras, thresholds_px)
    return float(explained.mean()) if len(explained) else 0.0


def explained_matches(
    pair: PairPoints, poses: Mapping[str, Pose], cameras: Mapping[str, Camera], thresholds_px: Mapping[str, float]
) -> BoolArray:
    """Return which of a pair's matches (M,) both given poses explain, none where one has no attitude.

    A match is explained when it lies near its epipolar line, and its rays do not meet behind a camera: epipolar lines
    alone do not tell a flight from the same flown backwards.
    """
    first, second = poses.get(pair.image_id0), poses.get(pair.image_id1)
    if first is None or second is None or first.world_rotation is None or second.world_rotation is None:
        return np.zeros(len(pair.indices), dtype=bool)
    camera0, camera1 = cameras[pair.image_id0], cameras[pair.image_id1]
    matrix = fundamental_from_poses(camera0, first, camera1, second)
    errors = sampson_distance_px(matrix, undistort(camera0, pair.points0_px), undistort(camera1, pair.points1_px))
    rays0 = world_rays(camera0, first.world_rotation, pair.points0_px)
    rays1 = world_rays(camera1, second.world_rotation, pair.points1_px)
    flat = (rays0 * rays1).sum(axis=1) > np.cos(np.deg2rad(_MIN_RAY_ANGLE_DEG))
    behind = ~flat & ~np.isfinite(triangulate(first.center_m, rays0, second.center_m, rays1)).all(axis=1)
    limit = max(thresholds_px[pair.image_id0], thresholds_px[pair.image_id1])
    return np.asarray((errors <= limit) & ~behind)


def explained_images(
    pairs: Sequence[PairPoints],
    poses: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
) -> set[str]:
    """Return images whose given poses explain what they share with each other.

    thresholds_px: by image_id, the error of an exact match in stored pixels.
    """
    ties = [p for p in pairs if len(p.indices) >= MIN_MATCHES]
    good = {
        (p.image_id0, p.image_id1): explained_share(p, poses, cameras, thresholds_px) >= EXPLAINED_SHARE for p in ties
    }
    return grouped_images(good, {(p.image_id0, p.image_id1): len(p.indices) for p in ties})


def grouped_images(good: Mapping[tuple[str, str], bool], matches: Mapping[tuple[str, str], int]) -> set[str]:
    """Return images grouped by pairs that hold: the largest group, and each further one that contradicts none before
    it.

    good: whether a pair of images holds. matches: how many it has. Few of them across, beside many within a group, are
    of places that look alike.
    """
    taken: set[str] = set()
    for group in connected_groups([ids for ids, holds in good.items() if holds]):
        within = sum(matches[ids] for ids, holds in good.items() if holds and group.issuperset(ids))
        across = [ids for ids in good if len(taken.intersection(ids)) == 1 and len(group.intersection(ids)) == 1]
        if sum(matches[ids] for ids in across) <= _BY_CHANCE * within:
            taken |= group
    return taken


def triangulated(
    pairs: Sequence[PairPoints], poses: Mapping[str, Pose], cameras: Mapping[str, Camera]
) -> list[FloatArray]:
    """Return world points (M, 3) of the matches of every pair; NaN where a pose is unknown or the angle is too flat."""
    found = []
    for pair in pairs:
        found.append(np.full((len(pair.indices), 3), np.nan))
        first, second = poses.get(pair.image_id0), poses.get(pair.image_id1)
        if first is None or second is None or first.world_rotation is None or second.world_rotation is None:
            continue
        rays0 = world_rays(cameras[pair.image_id0], first.world_rotation, pair.points0_px)
        rays1 = world_rays(cameras[pair.image_id1], second.world_rotation, pair.points1_px)
        points = triangulate(first.center_m, rays0, second.center_m, rays1)
        points[view_angles_deg(first.center_m, second.center_m, points) < _MIN_RAY_ANGLE_DEG] = np.nan
        found[-1] = points
    return found


def heights_above_m(given: Ground, terrain: Ground, centers_m: FloatArray) -> tuple[float, float, float]:
    """Return how far a given ground lies above the terrain found, the median deviation from that, and the flying height
    above the terrain: medians, metres.

    centers_m: (N, 3) projection centres, below which both are asked.
    """
    below = terrain.height_m(centers_m[:, :2])
    above = given.height_m(centers_m[:, :2]) - below
    middle = float(np.median(above))
    return middle, float(np.median(np.abs(above - middle))), float(np.median(centers_m[:, 2] - below))


def attitude_errors_deg(given: Mapping[str, Pose], found: Mapping[str, Pose]) -> dict[str, float]:
    """Return image_id -> angle in degrees between its given attitude and the one found, where both exist."""
    errors = {}
    for image_id, pose in found.items():
        before = given.get(image_id)
        if before is None or before.world_rotation is None or pose.world_rotation is None:
            continue
        errors[image_id] = angle_between_deg(before.world_rotation, pose.world_rotation)
    return errors


def position_errors_m(given: Mapping[str, Pose], found: Mapping[str, Pose]) -> dict[str, float]:
    """Return image_id -> distance in metres between its given position and the one found, where both exist."""
    both = given.keys() & found.keys()
    return {i: float(np.linalg.norm(given[i].center_m - found[i].center_m)) for i in sorted(both)}
