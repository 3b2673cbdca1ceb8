"""Keypoints of a rolling shutter as one that exposes all rows at once would see them.

Formats of tie points have one pose an image. While its rows are read the aircraft moves on, so that a keypoint lies
beside where that pose sees its point, by up to the speed times half the read-out time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Camera, FloatArray, IntArray
from aeromatch_cli.geometry.cameras import normalise, project


def at_once(
    adjusted: AdjustedBlock, cameras: Mapping[str, Camera], keypoints_px: Callable[[str], FloatArray]
) -> Callable[[str], FloatArray]:
    """Return image_id -> (K, 2) keypoints as the image's pose alone sees them; the same where no read-out time was
    found.

    cameras: image_id -> adjusted camera. A keypoint without a point of its own lies as far away as the nearest in the
    picture that has one.
    """

    def corrected_px(image_id: str) -> FloatArray:
        found_px, pose = keypoints_px(image_id), adjusted.poses.get(image_id)
        track = adjusted.tracks.get(image_id)
        if pose is None or track is None or not len(track) or not pose.sweep_m.any():
            return found_px
        depths_m = _depths_m(adjusted, pose, track, found_px)
        return _corrected(cameras[image_id], pose, np.asarray(found_px, np.float64), depths_m).astype(found_px.dtype)

    return corrected_px


def _depths_m(adjusted: AdjustedBlock, pose: AdjustedPose, track: IntArray, found_px: FloatArray) -> FloatArray:
    """(K,) distances of all keypoints from the pose's centre along the optical axis."""
    from scipy.spatial import cKDTree

    known_m = (adjusted.points_m[track[:, 1]] - pose.center_m) @ pose.rotation[2]
    nearest = cKDTree(found_px[track[:, 0]]).query(found_px)[1]
    return np.asarray(known_m[nearest])


def _corrected(camera: Camera, pose: AdjustedPose, found_px: FloatArray, depths_m: FloatArray) -> FloatArray:
    """Pixels (K, 2), unchanged where the lens model does not hold or the point lies behind the camera."""
    share = found_px[:, 1] / (camera.height_px - 1.0) - 0.5
    rays = np.column_stack([normalise(camera, found_px), np.ones(len(found_px))])
    from_there_m = depths_m - share * float(pose.rotation[2] @ pose.sweep_m)
    points_m = pose.center_m + share[:, None] * pose.sweep_m + (from_there_m[:, None] * rays) @ pose.rotation
    seen_px = project(camera, pose.rotation, pose.center_m, points_m)
    known = np.isfinite(seen_px).all(axis=1) & (depths_m > 0.0)
    return np.where(known[:, None], seen_px, found_px)
