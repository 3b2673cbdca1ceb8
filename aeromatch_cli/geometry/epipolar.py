"""Two-view geometry of calibrated and uncalibrated pairs.

E acts on normalised rays: (u1, v1, 1) E (u0, v0, 1)^T = 0; F on undistorted pixels in the same way.
Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., chapters 9 and 11.
"""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.geometry.cameras import calibration_matrix


def cross_matrix(v: FloatArray) -> FloatArray:
    """(3, 3) matrix of the cross product with v (3,)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def relative_pose(pose0: Pose, pose1: Pose) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) and translation (3,) of cam1_from_cam0. Both poses need an attitude."""
    if pose0.world_rotation is None or pose1.world_rotation is None:
        raise ValueError("a relative pose needs both attitudes")
    rotation = pose1.world_rotation @ pose0.world_rotation.T
    translation = pose1.world_rotation @ (pose0.center_m - pose1.center_m)
    return rotation, translation


def essential(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """E (3, 3) = [t]x R of cam1_from_cam0 (H&Z eq. 9.12), t taken as a unit vector (E has no scale)."""
    return cross_matrix(translation / max(float(np.linalg.norm(translation)), 1e-12)) @ rotation


def fundamental(essential_matrix: FloatArray, camera0: Camera, camera1: Camera) -> FloatArray:
    """F (3, 3) on undistorted pixels from E (H&Z eq. 9.12)."""
    k0, k1 = calibration_matrix(camera0), calibration_matrix(camera1)
    return np.linalg.inv(k1).T @ essential_matrix @ np.linalg.inv(k0)


def fundamental_from_poses(camera0: Camera, pose0: Pose, camera1: Camera, pose1: Pose) -> FloatArray:
    """F (3, 3) on undistorted pixels from known cameras and poses."""
    return fundamental(essential(*relative_pose(pose0, pose1)), camera0, camera1)


def epipolar_lines(matrix: FloatArray, points0_px: FloatArray) -> FloatArray:
    """Lines (N, 3) in image 1, a x + b y + c = 0 with a^2 + b^2 = 1, of undistorted points (N, 2) of image 0."""
    lines = points0_px @ matrix[:, :2].T + matrix[:, 2]
    return lines / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-12)[:, None]


def symmetric_distance_px(matrix: FloatArray, points0_px: FloatArray, points1_px: FloatArray) -> FloatArray:
    """Larger of both point-to-epipolar-line distances (N,), in the unit of the points (N, 2)."""
    lines1 = epipolar_lines(matrix, points0_px)
    lines0 = epipolar_lines(matrix.T, points1_px)
    distance1 = np.abs((lines1[:, :2] * points1_px).sum(axis=1) + lines1[:, 2])
    distance0 = np.abs((lines0[:, :2] * points0_px).sum(axis=1) + lines0[:, 2])
    return np.maximum(distance0, distance1)


def sampson_distance_px(matrix: FloatArray, points0_px: FloatArray, points1_px: FloatArray) -> FloatArray:
    """First-order geometric error (N,), in the unit of the points (H&Z eq. 11.9, square root)."""
    lines1 = points0_px @ matrix[:, :2].T + matrix[:, 2]
    lines0 = points1_px @ matrix[:2, :] + matrix[2, :]
    algebraic = (lines1[:, :2] * points1_px).sum(axis=1) + lines1[:, 2]
    gradient = (lines1[:, :2] ** 2).sum(axis=1) + (lines0[:, :2] ** 2).sum(axis=1)
    return np.abs(algebraic) / np.sqrt(np.maximum(gradient, 1e-24))


def triangulate(center0_m: FloatArray, rays0: FloatArray, center1_m: FloatArray, rays1: FloatArray) -> FloatArray:
    """Mid-points (N, 3) of the shortest segment between two bundles of world rays (N, 3 unit vectors each).

    NaN where the rays are parallel (angle below 0.1 degrees) or meet behind a camera.
    """
    depth0, depth1, sine = ray_depths(center1_m - center0_m, rays0, rays1)
    points = 0.5 * (center0_m + depth0[:, None] * rays0 + center1_m + depth1[:, None] * rays1)
    points[~((depth0 > 0) & (depth1 > 0) & (sine > np.sin(np.deg2rad(0.1))))] = np.nan
    return points


def ray_depths(
    between_m: FloatArray, rays0: FloatArray, rays1: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Along two bundles of rays (N, 3 unit vectors each), where they come nearest to each other: (N,) distances from
    either centre in metres, negative behind it, and the sine of the angle between them, at least 1e-9.

    between_m: (3,) from the first centre to the second. Distances of parallel rays are finite and mean nothing.
    """
    cosine = (rays0 * rays1).sum(axis=1)
    sine2 = np.maximum(1.0 - cosine**2, 1e-18)
    along0, along1 = rays0 @ between_m, rays1 @ between_m
    return (along0 - cosine * along1) / sine2, (cosine * along0 - along1) / sine2, np.sqrt(sine2)
