"""Plane-induced homographies: a known plane seen by known cameras."""

from __future__ import annotations

import numpy as np
import pytest

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.geometry.cameras import project, undistort
from aeromatch_cli.geometry.frames import apply_homography, resize_matrix
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.geometry.warps import (
    area_scale,
    border_px,
    source_from_view,
    undistorted_from_ground,
    view_from_source,
)

PINHOLE = Camera("SIMPLE_PINHOLE", 1000, 750, (1000.0, 499.5, 374.5))
LENS = Camera("OPENCV", 1000, 750, (820.0, 815.0, 503.2, 371.1, -0.08, 0.03, 1e-3, -5e-4))
NADIR = Pose(np.array([500.0, 300.0, 120.0]), from_omega_phi_kappa(0.0, 0.0, 0.0), 1.0, 1.0)
OBLIQUE = Pose(np.array([500.0, 300.0, 120.0]), from_omega_phi_kappa(35.0, -12.0, 70.0), 1.0, 1.0)


def ground_m(z_m: float) -> FloatArray:
    """Points on the plane that the oblique camera sees."""
    xy = np.stack(np.meshgrid(np.linspace(510, 540, 7), np.linspace(340, 380, 7)), axis=-1).reshape(-1, 2)
    return np.column_stack([xy, np.full(len(xy), z_m)])


def test_nadir_homography_by_hand() -> None:
    # 100 m above the plane at f = 1000: 10 px per metre, north up, third coordinate = depth.
    homography = undistorted_from_ground(PINHOLE, NADIR, 20.0)
    pixels = apply_homography(homography, np.array([[500.0, 300.0], [510.0, 300.0], [500.0, 302.0]]))
    np.testing.assert_allclose(pixels, [[499.5, 374.5], [599.5, 374.5], [499.5, 354.5]], atol=1e-9)
    assert (homography @ [510.0, 302.0, 1.0])[2] == pytest.approx(100.0)


@pytest.mark.parametrize("ground_z_m", [0.0, 17.5, -30.0])
def test_homography_of_a_plane_projects_its_points(ground_z_m: float) -> None:
    assert OBLIQUE.world_rotation is not None
    points_m = ground_m(ground_z_m)
    stored = project(LENS, OBLIQUE.world_rotation, OBLIQUE.center_m, points_m)
    plane = apply_homography(undistorted_from_ground(LENS, OBLIQUE, ground_z_m), points_m[:, :2])
    np.testing.assert_allclose(plane, undistort(LENS, stored), atol=1e-7)


def test_ground_behind_the_camera_is_not_seen() -> None:
    level = Pose(np.array([0.0, 0.0, 10.0]), from_omega_phi_kappa(90.0, 0.0, 0.0), 1.0, 1.0)  # looks north
    homography = undistorted_from_ground(PINHOLE, level, 0.0)
    pixels = apply_homography(homography, np.array([[0.0, 100.0], [0.0, -100.0]]))
    np.testing.assert_allclose(pixels[0], [499.5, 374.5 + 100.0], atol=1e-9)
    assert np.isnan(pixels[1]).all()


def test_a_plane_needs_the_attitude() -> None:
    with pytest.raises(ValueError, match="attitude"):
        undistorted_from_ground(PINHOLE, Pose(np.zeros(3), None, 1.0, 1.0), 0.0)


def test_view_and_source_are_inverse_through_the_lens() -> None:
    # A north-up view of the plane z = 0 at 0.25 m per pixel whose first pixel is at (500, 400).
    ground_from_view = np.array([[0.25, 0.0, 500.0], [0.0, -0.25, 400.0], [0.0, 0.0, 1.0]])
    undistorted_from_view = undistorted_from_ground(LENS, OBLIQUE, 0.0) @ ground_from_view
    points_m = ground_m(0.0)
    view_px = np.column_stack([(points_m[:, 0] - 500.0) / 0.25, (400.0 - points_m[:, 1]) / 0.25])
    assert OBLIQUE.world_rotation is not None
    stored = project(LENS, OBLIQUE.world_rotation, OBLIQUE.center_m, points_m)
    np.testing.assert_allclose(source_from_view(LENS, undistorted_from_view, view_px), stored, atol=1e-7)
    np.testing.assert_allclose(view_from_source(LENS, undistorted_from_view, stored), view_px, atol=1e-7)


def test_relief_displacement_by_hand() -> None:
    # Two nadir cameras 100 m above the plane and 30 m apart: a point 20 m above it lands, seen from each, at
    # 100 / 80 of its distance from the camera's foot: the two places are 30 * 20 / 80 = 7.5 m apart; on the plane, 0.
    east = Pose(NADIR.center_m + 30.0 * np.eye(3)[0], NADIR.world_rotation, 1.0, 1.0)
    assert NADIR.world_rotation is not None
    for height_m, parallax_m in ((0.0, 0.0), (20.0, 7.5)):
        point_m = np.array([[512.0, 310.0, 20.0 + height_m]])
        ground = [
            view_from_source(
                LENS,
                undistorted_from_ground(LENS, pose, 20.0),
                project(LENS, NADIR.world_rotation, pose.center_m, point_m),
            )[0]
            for pose in (NADIR, east)
        ]
        np.testing.assert_allclose(ground[0] - ground[1], [parallax_m, 0.0], atol=1e-8)


def test_border_runs_clockwise_along_the_outer_edge() -> None:
    border = border_px(PINHOLE, 4)
    assert border.shape == (16, 2)
    np.testing.assert_allclose(border[[0, 4, 8, 12]], [[-0.5, -0.5], [999.5, -0.5], [999.5, 749.5], [-0.5, 749.5]])
    assert len(np.unique(border, axis=0)) == 16
    x, y = border.T
    on_edge = np.isin(x, (-0.5, 999.5)) | np.isin(y, (-0.5, 749.5))
    assert on_edge.all()
    doubled_area = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
    assert doubled_area == pytest.approx(2 * 1000 * 750)  # positive: clockwise with y down


def test_area_scale_by_hand_and_by_difference() -> None:
    np.testing.assert_allclose(area_scale(resize_matrix(0.25), np.array([[10.0, 20.0]])), [0.25])
    np.testing.assert_allclose(
        area_scale(undistorted_from_ground(PINHOLE, NADIR, 20.0), np.array([[5.0, 6.0]])), [10.0]
    )
    homography, step = undistorted_from_ground(LENS, OBLIQUE, 0.0), 1e-4
    points = ground_m(0.0)[:, :2]
    dx, dy = (
        (apply_homography(homography, points + offset) - apply_homography(homography, points - offset)) / (2 * step)
        for offset in step * np.eye(2)
    )
    determinant = dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]
    np.testing.assert_allclose(area_scale(homography, points), np.sqrt(np.abs(determinant)), rtol=1e-6)
