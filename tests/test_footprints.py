"""Footprints of known cameras: by hand, by projection, near the horizon."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.geometry.footprints import (
    border_rays,
    clip_half_plane,
    common_gsd_m,
    ground_footprint,
    ground_sampling_distance_m,
    image_footprint,
    polygon_area_m2,
    polygon_centroid_m,
    sees_horizon,
    view_angles_deg,
)
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa

PINHOLE = Camera("PINHOLE", 1000, 800, (1000.0, 1000.0, 499.5, 399.5))
LENS = Camera("OPENCV", 1000, 800, (820.0, 815.0, 503.2, 391.1, -0.08, 0.03, 1e-3, -5e-4))


def pose(omega_deg: float, phi_deg: float, kappa_deg: float, height_m: float = 100.0) -> Pose:
    return Pose(np.array([300.0, 200.0, height_m]), from_omega_phi_kappa(omega_deg, phi_deg, kappa_deg), 1.0, 1.0)


class Slope:
    """A terrain that rises to the north by `rise` metres per metre."""

    def __init__(self, rise: float, base_m: float = 0.0) -> None:
        self.rise, self.base_m = rise, base_m

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        return self.base_m + self.rise * xy_m[:, 1]


def test_nadir_footprint_by_hand() -> None:
    # 80 m above the plane, f = 1000: 0.08 m per px, 1000 x 800 px.
    polygon = ground_footprint(PINHOLE, pose(0, 0, 0), 20.0, 1000.0)
    np.testing.assert_allclose(polygon.min(axis=0), [260.0, 168.0], atol=1e-9)
    np.testing.assert_allclose(polygon.max(axis=0), [340.0, 232.0], atol=1e-9)
    assert polygon_area_m2(polygon) == pytest.approx(80.0 * 64.0)
    np.testing.assert_allclose(polygon_centroid_m(polygon), [300.0, 200.0], atol=1e-9)


@pytest.mark.parametrize("camera", [PINHOLE, LENS])
def test_footprint_border_projects_to_the_image_border(camera: Camera) -> None:
    tilted = pose(25.0, -15.0, 130.0)
    polygon = ground_footprint(camera, tilted, 10.0, 500.0)
    points = np.column_stack([polygon, np.full(len(polygon), 10.0)])
    assert tilted.world_rotation is not None
    pixels = project(camera, tilted.world_rotation, tilted.center_m, points)
    to_edge = np.minimum.reduce(
        [
            np.abs(pixels[:, 0] + 0.5),
            np.abs(pixels[:, 0] - camera.width_px + 0.5),
            np.abs(pixels[:, 1] + 0.5),
            np.abs(pixels[:, 1] - camera.height_px + 0.5),
        ]
    )
    np.testing.assert_allclose(to_edge, 0.0, atol=1e-6)


@given(
    omega_deg=st.floats(-179.0, 179.0),
    phi_deg=st.floats(-85.0, 85.0),
    kappa_deg=st.floats(-180.0, 180.0),
    factor=st.floats(0.2, 8.0),
)
@settings(max_examples=150, deadline=None)
def test_any_attitude_stays_within_the_cut_and_the_image(
    omega_deg: float, phi_deg: float, kappa_deg: float, factor: float
) -> None:
    any_pose = pose(omega_deg, phi_deg, kappa_deg)
    polygon = ground_footprint(PINHOLE, any_pose, 0.0, factor * 100.0)
    distances = np.hypot(*(polygon - any_pose.center_m[:2]).T)
    assert (distances <= factor * 100.0 * (1.0 + 1e-9)).all()
    if len(polygon) == 0:
        return
    assert any_pose.world_rotation is not None
    points = np.column_stack([polygon, np.zeros(len(polygon))])
    pixels = project(PINHOLE, any_pose.world_rotation, any_pose.center_m, points)
    assert ((pixels >= -0.5 - 1e-5) & (pixels <= np.array([999.5, 799.5]) + 1e-5)).all()


def test_footprint_at_the_horizon_is_a_sector_of_the_cut_circle() -> None:
    # Looking level to the north: the lower half of the image sees ground from 100 / 0.4 m to the cut.
    level = pose(90.0, 0.0, 0.0)
    polygon = ground_footprint(PINHOLE, level, 0.0, 500.0)
    relative = polygon - level.center_m[:2]
    assert relative[:, 1].min() == pytest.approx(250.0)
    # The frustum is 1000 px wide at f = 1000: |x| <= y / 2, within the circle.
    half_angle = np.arctan(0.5)
    sector = 500.0**2 * half_angle - 250.0 * 125.0
    assert polygon_area_m2(polygon) == pytest.approx(sector, rel=0.02)
    assert polygon_area_m2(polygon) < sector
    assert sees_horizon(PINHOLE, from_omega_phi_kappa(90.0, 0.0, 0.0))


def test_cut_inside_a_nadir_footprint_is_the_disc() -> None:
    polygon = ground_footprint(PINHOLE, pose(0, 0, 0), 0.0, 10.0)
    assert polygon_area_m2(polygon) == pytest.approx(np.pi * 100.0, rel=0.02)


@pytest.mark.parametrize(
    "blind",
    [
        pose(0.0, 0.0, 0.0, height_m=-1.0),
        pose(180.0, 0.0, 0.0),
        Pose(np.array([0.0, 0.0, 100.0]), None, 1.0, 1.0),
    ],
    ids=["below ground", "looking up", "no attitude"],
)
def test_blind_images_have_no_footprint(blind: Pose) -> None:
    assert ground_footprint(PINHOLE, blind, 0.0, 500.0).shape == (0, 2)
    assert ground_sampling_distance_m(PINHOLE, blind, 0.0) is None
    assert image_footprint(PINHOLE, blind, Slope(0.0)) is None


def test_sampling_distance_along_the_axis() -> None:
    assert ground_sampling_distance_m(PINHOLE, pose(0, 0, 0), 20.0) == pytest.approx(0.08)
    # 60 degrees off nadir: the axis is 100 / cos(60) = 200 m long.
    assert ground_sampling_distance_m(PINHOLE, pose(60.0, 0, 0), 0.0) == pytest.approx(0.2)


def test_sampling_distance_of_a_level_image_is_that_of_its_footprint() -> None:
    level = pose(90.0, 0.0, 0.0)
    middle = polygon_centroid_m(ground_footprint(PINHOLE, level, 0.0, 500.0)) - level.center_m[:2]
    expected = np.sqrt((middle**2).sum() + 100.0**2) / 1000.0
    assert ground_sampling_distance_m(PINHOLE, level, 0.0) == pytest.approx(expected)
    assert 0.25 < expected < 0.5


def test_terrain_height_is_taken_below_the_footprint() -> None:
    tilted = pose(45.0, 0.0, 0.0)
    footprint = image_footprint(PINHOLE, tilted, Slope(0.1, base_m=-20.0))
    assert footprint is not None
    # 0 m below the camera (y = 200). On that plane the footprint's middle lies `north` of it, and 0.1 north higher.
    flat_middle = polygon_centroid_m(ground_footprint(PINHOLE, tilted, 0.0, 500.0))
    assert footprint.ground_z_m == pytest.approx(0.1 * (flat_middle[1] - 200.0))
    assert footprint.ground_z_m > 5.0
    assert footprint.middle_m[2] == footprint.ground_z_m
    assert footprint.tilt_deg == pytest.approx(45.0)
    assert footprint.gsd_m == pytest.approx((100.0 - footprint.ground_z_m) / np.cos(np.deg2rad(45.0)) / 1000.0)


def test_common_sampling_distance_is_the_median() -> None:
    found = {}
    for name, height in (("a", 50.0), ("b", 80.0), ("c", 300.0)):
        footprint = image_footprint(PINHOLE, pose(0, 0, 0, height), Slope(0.0))
        assert footprint is not None
        found[name] = footprint
    assert common_gsd_m(found) == pytest.approx(0.08)
    assert common_gsd_m({}) is None


def test_view_angles_by_hand() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    first = np.array([[0.0, 0.0, 100.0]] * 3)
    second = np.array([[100.0, 0.0, 100.0], [0.0, 0.0, 50.0], [0.0, 3.0, -3.0]])
    np.testing.assert_allclose(view_angles_deg(first, second, points), [45.0, 0.0, 135.0], atol=1e-12)


def test_clip_half_plane_of_a_square() -> None:
    square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
    left = clip_half_plane(square, square[:, 0] - 0.5)
    assert polygon_area_m2(left) == pytest.approx(1.0)
    assert len(clip_half_plane(square, square[:, 0] + 1.0)) == 0
    np.testing.assert_array_equal(clip_half_plane(square, square[:, 0] - 9.0), square)


def test_border_rays_are_shared_and_read_only() -> None:
    rays = border_rays(PINHOLE)
    np.testing.assert_allclose(rays[0], [-0.5, -0.4, 1.0])
    with pytest.raises(ValueError, match="read-only"):
        rays[0, 0] = 1.0
