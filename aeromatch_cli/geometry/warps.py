"""Plane-induced homographies: how the ground plane looks from a virtual camera (H&Z section 13.1)."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pose, View
from aeromatch_cli.geometry.cameras import calibration_matrix, distort, undistort
from aeromatch_cli.geometry.frames import apply_homography


def undistorted_from_ground(camera: Camera, pose: Pose, ground_z_m: float) -> FloatArray:
    """(3, 3) homography from world (x, y, 1) on the plane z = ground_z_m to undistorted pixels.

    The third homogeneous coordinate is the depth in front of the camera, so it is positive for visible ground.
    """
    if pose.world_rotation is None:
        raise ValueError("a plane-induced homography needs the attitude")
    offset = np.array([0.0, 0.0, ground_z_m]) - pose.center_m
    columns = np.stack([pose.world_rotation[:, 0], pose.world_rotation[:, 1], pose.world_rotation @ offset], axis=1)
    return calibration_matrix(camera) @ columns


def border_px(camera: Camera, per_side: int) -> FloatArray:
    """Stored pixels (4 per_side, 2) around the outer edge of the image, clockwise from the top-left corner."""
    left, top, right, bottom = -0.5, -0.5, camera.width_px - 0.5, camera.height_px - 0.5
    t = np.arange(per_side) / per_side
    xs, ys = left + (right - left) * t, top + (bottom - top) * t
    return np.concatenate(
        [
            np.stack([xs, np.full_like(t, top)], axis=1),
            np.stack([np.full_like(t, right), ys], axis=1),
            np.stack([xs[::-1] + (right - left) / per_side, np.full_like(t, bottom)], axis=1),
            np.stack([np.full_like(t, left), ys[::-1] + (bottom - top) / per_side], axis=1),
        ]
    )


def view_from_source(camera: Camera, undistorted_from_view: FloatArray, points_px: FloatArray) -> FloatArray:
    """View pixels (N, 2) of stored source pixels (N, 2); NaN where the view cannot see them."""
    return apply_homography(np.linalg.inv(undistorted_from_view), undistort(camera, points_px))


def source_from_view(camera: Camera, undistorted_from_view: FloatArray, points_px: FloatArray) -> FloatArray:
    """Stored source pixels (N, 2) of view pixels (N, 2); NaN where the source cannot see them."""
    return distort(camera, apply_homography(undistorted_from_view, points_px))


def ground_beyond(view: View, points: FloatArray) -> BoolArray:
    """Whether undistorted pixels (N, 2) show ground below the horizon that lies outside the box of a ground view."""
    view_from_undistorted = np.linalg.inv(view.undistorted_from_view)
    # Of a ground point the third homogeneous coordinate is one over its depth.
    inverse_depth = points @ view_from_undistorted[2, :2] + view_from_undistorted[2, 2]
    places = apply_homography(view_from_undistorted, points)
    with np.errstate(invalid="ignore"):
        inside = ((places > -0.5) & (places < [view.width_px - 0.5, view.height_px - 0.5])).all(axis=1)
    return np.asarray((inverse_depth > 0.0) & ~inside)


def area_scale(homography: FloatArray, points_px: FloatArray) -> FloatArray:
    """Local linear scale (N,), sqrt |det J|, of a homography at points (N, 2)."""
    points = np.asarray(points_px, dtype=np.float64)
    w = points @ homography[2, :2] + homography[2, 2]
    return np.sqrt(np.abs(np.linalg.det(homography)) / np.abs(w) ** 3)
