"""What works on undistorted pixels with cameras of every kind: skew, affinity and fisheye lenses leave no trace."""

from __future__ import annotations

import numpy as np
import pytest

from aeromatch_cli.data import Camera, FloatArray, Pair, PairGeometry, Pose
from aeromatch_cli.evaluate.metrics import pose_error_deg
from aeromatch_cli.geometry.cameras import BROWN, FISHEYE, focal_px, normalise, parameters, project, undistort
from aeromatch_cli.geometry.epipolar import fundamental_from_poses, relative_pose, sampson_distance_px
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.geometry.prediction import homogeneous
from aeromatch_cli.geometry.rotations import angle_between_deg, from_omega_phi_kappa
from aeromatch_cli.geometry.two_view import Sampling, estimate, undistorted
from aeromatch_cli.geometry.warps import source_from_view, undistorted_from_ground, view_from_source
from aeromatch_cli.sfm.focal import with_focal_length
from aeromatch_cli.sfm.resection import _resection

# A skew of 60 px for each unit downwards is more than any lens has: left out, it would turn rays by degrees.
LENSES = [
    Camera(BROWN, 1000, 750, (900.0, 509.5, 369.5, -0.1, 0.05, -0.02, 1e-3, -2e-3, 20.0, 60.0)),
    Camera(FISHEYE, 1000, 750, (600.0, 610.0, 509.5, 369.5, -0.02, 0.006, -0.003, 5e-4)),
]
POSE0 = Pose(np.array([0.0, 0.0, 100.0]), from_omega_phi_kappa(3.0, -2.0, 10.0), 0.1, 0.1)
POSE1 = Pose(np.array([30.0, 5.0, 95.0]), from_omega_phi_kappa(-4.0, 6.0, 100.0), 0.1, 0.1)


def ground() -> FloatArray:
    rng = np.random.default_rng(1)
    return np.column_stack([rng.uniform(-5, 35, (80, 2)), rng.uniform(0, 20, 80)])


def places(camera: Camera, pose: Pose) -> FloatArray:
    return project(camera, np.asarray(pose.world_rotation), pose.center_m, ground())


@pytest.mark.parametrize("camera", LENSES, ids=lambda camera: camera.model)
def test_relative_pose_of_exact_matches(camera: Camera) -> None:
    geometry = PairGeometry(Pair("a", "b", 0.7, 15.0, "overlap"), camera, camera, POSE0, POSE1, 0.0)
    points0, points1, usable = undistorted(places(camera, POSE0), places(camera, POSE1), geometry)
    assert usable.all()
    found = estimate(points0, points1, geometry, "relative_pose", Sampling(1.0), seed=0)
    assert found.rotation is not None
    assert found.inliers.all()
    assert angle_between_deg(found.rotation, relative_pose(POSE0, POSE1)[0]) < 1e-3
    assert sampson_distance_px(found.pixel_model, points0, points1).max() < 1e-3
    known = fundamental_from_poses(camera, POSE0, camera, POSE1)
    assert sampson_distance_px(known, points0, points1).max() < 1e-6
    errors = pose_error_deg(places(camera, POSE0), places(camera, POSE1), camera, camera, POSE0, POSE1)
    assert max(errors) < 1e-2


@pytest.mark.parametrize("camera", LENSES, ids=lambda camera: camera.model)
def test_resection_of_exact_points(camera: Camera) -> None:
    found = _resection(places(camera, POSE1), ground(), camera, 1.0, (0.1, 0.1))
    assert found is not None
    np.testing.assert_allclose(found.center_m, POSE1.center_m, atol=1e-3)
    assert angle_between_deg(np.asarray(found.world_rotation), np.asarray(POSE1.world_rotation)) < 1e-3


@pytest.mark.parametrize("camera", LENSES, ids=lambda camera: camera.model)
def test_views_and_rays(camera: Camera) -> None:
    plane = ground() * [1.0, 1.0, 0.0] + [0.0, 0.0, 7.0]
    homography = undistorted_from_ground(camera, POSE0, 7.0)
    seen = project(camera, np.asarray(POSE0.world_rotation), POSE0.center_m, plane)
    np.testing.assert_allclose(source_from_view(camera, homography, plane[:, :2]), seen, atol=1e-8)
    np.testing.assert_allclose(view_from_source(camera, homography, seen), plane[:, :2], atol=1e-6)
    np.testing.assert_allclose(apply_homography(homography, plane[:, :2]), undistort(camera, seen), atol=1e-6)
    rays = homogeneous(camera, undistort(camera, seen))
    np.testing.assert_allclose(rays[:, :2], normalise(camera, seen), atol=1e-9)


def test_another_focal_length_keeps_the_shape_of_pixels() -> None:
    camera = with_focal_length(LENSES[0], 2.0 * focal_px(LENSES[0]))
    p = parameters(camera)
    assert (p["fx"], p["fy"], p["skew"]) == pytest.approx((1840.0, 1800.0, 120.0))
    assert (p["cx"], p["k1"]) == (509.5, -0.1)
