"""A pair that the adjusted block does not hold, as a block of its own: its verified geometry places both cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Camera, FloatArray, Pose
from aeromatch_cli.formats.rows import VerifiedEntry
from aeromatch_cli.geometry.cameras import normalise

# Camera axes (x right, y down, z forward) of a camera that looks straight down, where no attitude is known.
_NADIR = np.diag([1.0, -1.0, -1.0])


def placed_alone(
    block: AdjustedBlock,
    image_id0: str,
    entry: VerifiedEntry,
    cameras: Mapping[str, Camera],
    keypoints_px: Callable[[str], FloatArray],
    pose0: Pose | None,
) -> AdjustedBlock | None:
    """Return `block_of_pair` by what verified a pair; None where the block holds both images, or where that is no
    relative orientation.

    cameras: image_id -> camera of the verification. keypoints_px: (N, 2) of an image. pose0: as far as it is known.
    """
    ids, verdict = (image_id0, entry.image_id1), entry.verdict
    if set(ids) <= block.poses.keys() or verdict.model_kind != "E" or verdict.relative_rotation is None:
        return None
    points = [keypoints_px(image_id)[entry.matches.indices[:, side]] for side, image_id in enumerate(ids)]
    return block_of_pair(
        ids, (cameras[ids[0]], cameras[ids[1]]), (points[0], points[1]), verdict.model, verdict.relative_rotation,
        None if pose0 is None else pose0.world_rotation,
    )  # fmt: skip


def block_of_pair(
    image_ids: tuple[str, str],
    cameras: tuple[Camera, Camera],
    points_px: tuple[FloatArray, FloatArray],
    essential: FloatArray,
    rotation: FloatArray,
    attitude0: FloatArray | None,
) -> AdjustedBlock:
    """Return a block of both images, a unit apart, with one point that ties them.

    points_px: (M, 2) of the verified matches in either image. essential: E (3, 3), x1^T E x0 = 0 on normalised rays.
    rotation: (3, 3) cam1_from_cam0. attitude0: (3, 3) cam_from_world of the first image as far as it is known: heights
    of neighbours are compared along the vertical.
    Source: the translation is E's left null vector (Hartley and Zisserman, Multiple View Geometry, 2nd ed., 9.6.2); of
    its two signs that with more points in front of both cameras holds.
    """
    rotation0 = _NADIR if attitude0 is None else attitude0
    translation = np.linalg.svd(essential.T)[2][-1]
    rays0, rays1 = (
        np.column_stack([normalise(camera, points), np.ones(len(points))])
        for camera, points in zip(cameras, points_px, strict=True)
    )
    if 2 * _in_front(rays0 @ rotation.T, rays1, translation) < len(rays0):
        translation = -translation
    rotation1 = rotation @ rotation0
    unknown = np.full(3, np.nan)
    poses = {
        image_ids[0]: AdjustedPose(np.zeros(3), rotation0, unknown, unknown),
        image_ids[1]: AdjustedPose(-rotation1.T @ translation, rotation1, unknown, unknown),
    }
    tie = np.zeros((1, 2), np.int32)
    return AdjustedBlock({}, poses, np.zeros((1, 3)), np.zeros(1), dict.fromkeys(image_ids, tie))


def _in_front(rays0: FloatArray, rays1: FloatArray, translation: FloatArray) -> int:
    """Count the points that lie in front of both cameras: rays (M, 3) of both in the frame of the second."""
    # x1 = depth1 rays1 = depth0 rays0 + translation; crossed with rays1 and with rays0.
    normal = np.cross(rays0, rays1)
    depth0 = -(np.cross(translation, rays1) * normal).sum(axis=1)
    depth1 = -(np.cross(translation, rays0) * normal).sum(axis=1)
    return int(((depth0 > 0.0) & (depth1 > 0.0)).sum())
