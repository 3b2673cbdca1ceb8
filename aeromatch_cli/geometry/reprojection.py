"""Reprojection errors of an adjusted block: how far keypoints lie from where its cameras see their points."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from aeromatch_cli.data import AdjustedBlock, Camera, FloatArray, IntArray, PoseResidual
from aeromatch_cli.geometry.cameras import project

# image_id -> (K, 2) stored pixels that the tracks of a block point into.
KeypointsPx = Callable[[str], FloatArray]


def errors_in_image(block: AdjustedBlock, image_id: str, camera: Camera, keypoints_px: KeypointsPx) -> FloatArray:
    """Return the reprojection errors (n,) of an image's track (n, 2), pixels; NaN where the camera sees the point
    nowhere."""
    pose, track = block.poses[image_id], block.tracks[image_id]
    places_px = project(camera, pose.rotation, pose.center_m, block.points_m[track[:, 1]])
    seen_px = np.asarray(keypoints_px(image_id), np.float64).reshape(-1, 2)[track[:, 0]]
    return np.asarray(np.linalg.norm(places_px - seen_px, axis=1))


def with_errors(block: AdjustedBlock, cameras: Mapping[str, Camera], keypoints_px: KeypointsPx) -> AdjustedBlock:
    """Return the block with the mean reprojection errors of its points in these cameras, by image_id."""
    sums, seen = np.zeros(len(block.points_m)), np.zeros(len(block.points_m))
    for image_id, track in block.tracks.items():
        np.add.at(sums, track[:, 1], errors_in_image(block, image_id, cameras[image_id], keypoints_px))
        np.add.at(seen, track[:, 1], 1.0)
    return replace(block, errors_px=sums / np.maximum(seen, 1.0))


def with_points(
    residual: PoseResidual,
    block: AdjustedBlock,
    image_id: str,
    camera: Camera,
    keypoints_px: KeypointsPx,
    seen: IntArray,
) -> PoseResidual:
    """Return the residuals of an image with the figures of the points that it sees in the block. seen: (P,) images of
    each point."""
    track = block.tracks.get(image_id, np.zeros((0, 2), np.int32))
    if not len(track):
        return replace(residual, error_px=float("nan"), points=0, images_per_point=float("nan"))
    error_px = float(np.mean(errors_in_image(block, image_id, camera, keypoints_px)))
    return replace(residual, error_px=error_px, points=len(track), images_per_point=float(np.mean(seen[track[:, 1]])))
