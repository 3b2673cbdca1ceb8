"""Two-view geometry: exact points have no error, errors and depths by worked numbers."""

from __future__ import annotations

import numpy as np
import pytest

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.geometry.cameras import normalise, project, undistort, world_rays
from aeromatch_cli.geometry.epipolar import (
    cross_matrix,
    epipolar_lines,
    essential,
    fundamental_from_poses,
    relative_pose,
    sampson_distance_px,
    symmetric_distance_px,
    triangulate,
)
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, from_yaw_pitch_roll

CAMERA0 = Camera("OPENCV", 1000, 750, (820.0, 815.0, 503.2, 371.1, -0.08, 0.03, 1e-3, -5e-4))
CAMERA1 = Camera("SIMPLE_RADIAL", 800, 600, (700.0, 399.5, 299.5, -0.05))
POSE0 = Pose(np.array([0.0, 0.0, 100.0]), from_omega_phi_kappa(3.0, -4.0, 12.0), 1.0, 1.0)
POSE1 = Pose(np.array([35.0, -8.0, 110.0]), from_omega_phi_kappa(-5.0, 9.0, -100.0), 1.0, 1.0)


def ground_points(count: int = 200) -> FloatArray:
    rng = np.random.default_rng(11)
    return np.column_stack([rng.uniform(-10, 40, count), rng.uniform(-25, 20, count), rng.uniform(0, 20, count)])


def seen(camera: Camera, pose: Pose) -> FloatArray:
    assert pose.world_rotation is not None
    return project(camera, pose.world_rotation, pose.center_m, ground_points())


def test_cross_matrix_is_the_cross_product() -> None:
    np.testing.assert_array_equal(cross_matrix(np.array([1.0, 2.0, 3.0])) @ [4.0, 5.0, 6.0], [-3.0, 6.0, -3.0])


def test_relative_pose_by_hand() -> None:
    # Both look straight down with north up; camera 1 stands 10 m east: its own frame sees camera 0 10 m to the left.
    nadir = from_omega_phi_kappa(0.0, 0.0, 0.0)
    rotation, translation = relative_pose(
        Pose(np.zeros(3), nadir, 1.0, 1.0), Pose(np.array([10.0, 0.0, 0.0]), nadir, 1.0, 1.0)
    )
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(translation, [-10.0, 0.0, 0.0], atol=1e-15)
    # Camera 1 instead looks north from 10 m south of and level with camera 0: camera 0 lies 10 m ahead of it.
    ahead = Pose(np.array([0.0, -10.0, 0.0]), from_yaw_pitch_roll(0.0, 0.0, 0.0, forward=True), 1.0, 1.0)
    rotation, translation = relative_pose(Pose(np.zeros(3), nadir, 1.0, 1.0), ahead)
    np.testing.assert_allclose(translation, [0.0, 0.0, 10.0], atol=1e-12)
    np.testing.assert_allclose(rotation @ [0.0, 0.0, 1.0], [0.0, 1.0, 0.0], atol=1e-12)  # down stays down


def test_a_relative_pose_needs_both_attitudes() -> None:
    with pytest.raises(ValueError, match="both attitudes"):
        relative_pose(POSE0, Pose(np.zeros(3), None, 1.0, 1.0))


def test_exact_points_satisfy_both_matrices() -> None:
    points0, points1 = seen(CAMERA0, POSE0), seen(CAMERA1, POSE1)
    assert np.isfinite(points0).all()
    assert np.isfinite(points1).all()
    rays0, rays1 = normalise(CAMERA0, points0), normalise(CAMERA1, points1)
    assert symmetric_distance_px(essential(*relative_pose(POSE0, POSE1)), rays0, rays1).max() < 1e-12
    fundamental = fundamental_from_poses(CAMERA0, POSE0, CAMERA1, POSE1)
    plain0, plain1 = undistort(CAMERA0, points0), undistort(CAMERA1, points1)
    assert symmetric_distance_px(fundamental, plain0, plain1).max() < 1e-8
    assert sampson_distance_px(fundamental, plain0, plain1).max() < 1e-8
    # The distortion is large enough that forgetting it would show.
    assert np.median(symmetric_distance_px(fundamental, points0, points1)) > 0.5


def test_essential_has_unit_baseline_and_swaps_to_its_transpose() -> None:
    forth, back = essential(*relative_pose(POSE0, POSE1)), essential(*relative_pose(POSE1, POSE0))
    np.testing.assert_allclose(np.linalg.svd(forth, compute_uv=False), [1.0, 1.0, 0.0], atol=1e-12)
    sign = np.sign((forth * back.T).sum())
    np.testing.assert_allclose(forth, sign * back.T, atol=1e-12)


def test_errors_of_a_sideways_pair_by_hand() -> None:
    # Sideways motion: epipolar lines are rows; 3 rows off are 3 px from either side and 3 / sqrt(2) by Sampson.
    matrix = essential(np.eye(3), np.array([-1.0, 0.0, 0.0]))
    points0, points1 = np.array([[10.0, 5.0], [1.0, 2.0]]), np.array([[99.0, 8.0], [7.0, 2.0]])
    np.testing.assert_allclose(symmetric_distance_px(matrix, points0, points1), [3.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(sampson_distance_px(matrix, points0, points1), [3.0 / np.sqrt(2.0), 0.0], atol=1e-12)
    lines = epipolar_lines(matrix, points0)
    np.testing.assert_allclose(np.abs(lines), [[0.0, 1.0, 5.0], [0.0, 1.0, 2.0]], atol=1e-12)


def test_errors_of_an_uneven_matrix_by_hand() -> None:
    # line1 = M (0, 3, 1) = (0, 2, -3): distance 1/2. line0 = M^T (0, 1, 1) = (0, -1, 2): distance 1. Sampson 1/sqrt(5).
    matrix = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, -1.0, 0.0]])
    points0, points1 = np.array([[0.0, 3.0]]), np.array([[0.0, 1.0]])
    np.testing.assert_allclose(symmetric_distance_px(matrix, points0, points1), [1.0], atol=1e-12)
    np.testing.assert_allclose(sampson_distance_px(matrix, points0, points1), [1.0 / np.sqrt(5.0)], atol=1e-12)


def test_errors_do_not_depend_on_the_scale_of_the_matrix() -> None:
    matrix = fundamental_from_poses(CAMERA0, POSE0, CAMERA1, POSE1)
    points0 = undistort(CAMERA0, seen(CAMERA0, POSE0)) + np.array([0.7, -0.4])
    points1 = undistort(CAMERA1, seen(CAMERA1, POSE1))
    for function in (symmetric_distance_px, sampson_distance_px):
        reference = function(matrix, points0, points1)
        np.testing.assert_allclose(function(-1000.0 * matrix, points0, points1), reference, rtol=1e-9)
        np.testing.assert_allclose(function(matrix.T, points1, points0), reference, rtol=1e-9)


def test_triangulation_returns_known_points() -> None:
    assert POSE0.world_rotation is not None
    assert POSE1.world_rotation is not None
    rays0 = world_rays(CAMERA0, POSE0.world_rotation, seen(CAMERA0, POSE0))
    rays1 = world_rays(CAMERA1, POSE1.world_rotation, seen(CAMERA1, POSE1))
    points_m = triangulate(POSE0.center_m, rays0, POSE1.center_m, rays1)
    np.testing.assert_allclose(points_m, ground_points(), atol=1e-6)


def test_triangulation_of_skew_rays_is_the_middle_of_the_gap() -> None:
    # Ray 0 runs along x at y = 0, z = 0; ray 1 along y at x = 5, z = 2: closest at (5, 0, 0) and (5, 0, 2).
    rays0, rays1 = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])
    points_m = triangulate(np.zeros(3), rays0, np.array([5.0, -4.0, 2.0]), rays1)
    np.testing.assert_allclose(points_m, [[5.0, 0.0, 1.0]], atol=1e-12)


def test_parallel_rays_and_points_behind_a_camera_have_no_place() -> None:
    down, tilted = np.array([0.0, 0.0, -1.0]), np.array([0.6, 0.0, -0.8])
    rays0 = np.stack([down, down, down])
    rays1 = np.stack([down, tilted, tilted * [-1.0, 1.0, 1.0]])
    points_m = triangulate(np.zeros(3), rays0, np.array([6.0, 0.0, 0.0]), rays1)
    assert np.isnan(points_m[:2]).all()  # parallel; diverging, so that they meet above the cameras
    np.testing.assert_allclose(points_m[2], [0.0, 0.0, -8.0], atol=1e-12)
