"""Views for neighbours, by geometry: like directions show the ground alike, and no view is larger than needed."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeromatch_cli.data import Camera, FloatArray, Neighbour, Pose, View
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, rotation_z
from aeromatch_cli.geometry.views import (
    common_stretch,
    direction_of,
    intersection,
    nearest_sample,
    tilt_azimuths_rad,
    view_from_ground,
)
from aeromatch_cli.geometry.warps import source_from_view, view_from_source
from aeromatch_cli.strategies.simulators.ground import GroundView
from aeromatch_cli.strategies.simulators.neighbours import NeighbourViews

NADIR = Camera("PINHOLE", 1000, 800, (1000.0, 1000.0, 499.5, 399.5))
LENS = Camera("OPENCV", 1200, 800, (1150.0, 1145.0, 603.2, 391.1, -0.05, 0.01, 1e-3, -5e-4))
GROUND_Z, GSD_M = 12.0, 0.25


def looking(azimuth_deg: float, tilt_deg: float, distance_m: float = 150.0, roll_deg: float = 0.0) -> Pose:
    """A camera that looks at (300, 200) on the ground, towards an azimuth counted from east to north."""
    toward_x = from_omega_phi_kappa(0.0, -tilt_deg, 0.0)
    rotation = rotation_z(roll_deg) @ toward_x @ rotation_z(-azimuth_deg)
    axis = rotation[2]
    return Pose(np.array([300.0, 200.0, GROUND_Z]) - distance_m * axis, rotation, 1.0, 1.0)


def neighbour(pose: Pose, camera: Camera = NADIR) -> Neighbour:
    return Neighbour(camera, pose, 0.5, GROUND_Z)


def views_of(pose: Pose, *others: Pose, camera: Camera = NADIR, **settings: float) -> dict[str, View]:
    strategy = NeighbourViews(**{"min_stretch": 1.6, "far_ground": False, **settings})
    made = strategy(camera, pose, GROUND_Z, GSD_M, [neighbour(other) for other in others])
    return {view.name: view for view in made}


def view_pixels(view: View, camera: Camera, pose: Pose, points_m: FloatArray) -> FloatArray:
    """View pixels of world points, through the camera."""
    assert pose.world_rotation is not None
    seen = project(camera, pose.world_rotation, pose.center_m, points_m)
    return view_from_source(camera, view.undistorted_from_view, seen)


def test_the_helper_looks_where_it_says() -> None:
    axis = np.asarray(looking(30.0, 60.0).world_rotation)[2]
    expected = [np.sin(np.deg2rad(60)) * np.cos(np.deg2rad(30)), np.sin(np.deg2rad(60)) * np.sin(np.deg2rad(30)), -0.5]
    np.testing.assert_allclose(axis, expected, atol=1e-12)


@pytest.mark.parametrize(("other_azimuth_deg", "other_tilt_deg"), [(217.0, 64.0), (34.0, 62.0), (75.0, 5.0)])
def test_like_views_of_two_cameras_show_a_ground_point_at_the_same_pixel(
    other_azimuth_deg: float, other_tilt_deg: float
) -> None:
    pose0, pose1 = looking(36.0, 62.0), looking(other_azimuth_deg, other_tilt_deg, 190.0, roll_deg=130.0)
    made0, made1 = views_of(pose0, pose1), views_of(pose1, pose0, camera=LENS)
    assert len(made0) == 2
    assert made0.keys() == made1.keys()
    points = np.array([[300.0, 200.0, GROUND_Z], [307.0, 204.0, GROUND_Z], [296.5, 188.0, GROUND_Z]])
    for name, view0 in made0.items():
        view1 = made1[name]
        assert view0.north_up
        assert view0.world_direction is not None
        assert view1.world_direction is not None
        np.testing.assert_array_equal(view0.world_direction, view1.world_direction)
        assert view0.gsd_m == view1.gsd_m
        shift = view_pixels(view1, LENS, pose1, points) - view_pixels(view0, NADIR, pose0, points)
        # Both lie on one grid of pixels that is fixed to the world.
        np.testing.assert_allclose(shift, np.broadcast_to(np.round(shift[0]), (3, 2)), atol=1e-6)


def test_ground_from_view_is_where_the_camera_looks() -> None:
    pose = looking(35.0, 62.0)
    for view in views_of(pose, looking(215.0, 62.0)).values():
        xs, ys = np.meshgrid(np.linspace(0, view.width_px - 1, 9), np.linspace(0, view.height_px - 1, 7))
        points_px = np.stack([xs.ravel(), ys.ravel()], axis=1)
        assert view.ground_from_view is not None
        ground = np.column_stack([apply_homography(view.ground_from_view, points_px), np.full(63, GROUND_Z)])
        assert pose.world_rotation is not None
        expected = project(NADIR, pose.world_rotation, pose.center_m, ground)
        found = source_from_view(NADIR, view.undistorted_from_view, points_px)
        np.testing.assert_allclose(found[np.isfinite(found)], expected[np.isfinite(found)], atol=1e-6)


def test_view_from_ground_by_hand() -> None:
    # Tilted by 60 degrees towards the east: east shrinks by 2, and y runs south.
    np.testing.assert_allclose(view_from_ground(direction_of(2, 0.0)), [[0.5, 0.0], [0.0, -1.0]], atol=1e-12)
    np.testing.assert_allclose(view_from_ground(direction_of(0, 0.0)), [[1.0, 0.0], [0.0, -1.0]], atol=1e-12)
    diagonal = view_from_ground(direction_of(2, np.pi / 4))
    np.testing.assert_allclose(diagonal @ [1.0, 1.0], [0.5, -0.5], atol=1e-12)
    np.testing.assert_allclose(diagonal @ [1.0, -1.0], [1.0, 1.0], atol=1e-12)


def test_common_stretch_by_hand() -> None:
    down, east, west, north = (
        np.asarray(looking(a, t).world_rotation)[2] for a, t in ((0, 0), (0, 60), (180, 60), (90, 60))
    )
    assert common_stretch(east, west) == pytest.approx((2.0, 0.0), abs=1e-9)
    assert common_stretch(down, east) == pytest.approx((np.sqrt((1 + 4) / 2), 0.0), abs=1e-9)
    assert common_stretch(east, north)[0] == pytest.approx(1.0, abs=1e-9)
    assert common_stretch(down, down)[0] == pytest.approx(1.0)
    assert common_stretch(north, north) == pytest.approx((2.0, np.pi / 2), abs=1e-9)


@given(stretch=st.floats(1.0, 6.0), azimuth_rad=st.floats(0.0, np.pi, exclude_max=True))
@settings(max_examples=100, deadline=None)
def test_samples_are_near_what_they_stand_for(stretch: float, azimuth_rad: float) -> None:
    level, number = nearest_sample(stretch, azimuth_rad)
    assert abs(np.log2(stretch) * 2.0 - level) <= 0.5 + 1e-9
    azimuths = tilt_azimuths_rad(level)
    apart = abs(azimuths[number] - azimuth_rad)
    if level:
        assert min(apart, np.pi - apart) <= np.deg2rad(36.0) / np.sqrt(2.0) ** level + 1e-9


def test_asift_counts_of_azimuths() -> None:
    assert [len(tilt_azimuths_rad(level)) for level in range(5)] == [1, 4, 5, 8, 10]


@pytest.mark.parametrize("others", [(), ((0.0, 3.0),), ((0.0, 30.0), (90.0, 40.0)), ((180.0, 20.0),)])
def test_neighbours_of_small_stretch_are_served_by_the_ground_view(others: tuple[tuple[float, float], ...]) -> None:
    assert list(views_of(looking(0.0, 10.0), *(looking(*other) for other in others))) == ["ground"]


def test_by_default_only_the_steepest_get_a_view_of_their_own() -> None:
    for tilt_deg, count in ((70.0, 1), (77.0, 2)):
        others = [neighbour(looking(180.0, tilt_deg))]
        assert len(NeighbourViews(far_ground=False)(NADIR, looking(0.0, tilt_deg), GROUND_Z, GSD_M, others)) == count


def test_crossed_obliques_are_served_by_the_ground_view() -> None:
    assert list(views_of(looking(0.0, 65.0), looking(90.0, 65.0))) == ["ground"]


def test_order_of_neighbours_changes_nothing() -> None:
    others = [looking(20.0, 65.0), looking(75.0, 70.0), looking(110.0, 68.0), looking(200.0, 60.0), looking(0.0, 2.0)]
    own = looking(10.0, 8.0)
    expected = views_of(own, *others, max_views=3, min_stretch=1.3)
    assert len(expected) == 3
    for order in itertools.islice(itertools.permutations(others), 0, 120, 17):
        found = views_of(own, *order, max_views=3, min_stretch=1.3)
        assert list(found) == list(expected)
        for name, view in found.items():
            np.testing.assert_array_equal(view.undistorted_from_view, expected[name].undistorted_from_view)
            assert (view.width_px, view.height_px) == (expected[name].width_px, expected[name].height_px)


def test_views_are_bounded_in_number_and_size() -> None:
    others = [looking(azimuth, 66.0) for azimuth in range(0, 180, 20)]
    for most in (1, 2, 4):
        made = views_of(looking(0.0, 0.0), *others, max_views=most, max_megapixels=0.05, min_stretch=1.3)
        assert len(made) == most
        assert all(view.width_px * view.height_px <= 0.05e6 for view in made.values())


def test_views_reach_no_farther_than_the_neighbours_do() -> None:
    own = looking(0.0, 0.0)
    # Both see 150 m x 120 m, 60 m apart: from x = 285 on, less a tenth of the flying height with the margin.
    east = Pose(own.center_m + np.array([60.0, 0.0, 0.0]), own.world_rotation, 1.0, 1.0)
    (whole,) = GroundView()(NADIR, own, GROUND_Z, GSD_M)
    assert (whole.width_px, whole.height_px) == (600, 480)
    for margin, left_m in ((0.0, 285.0), (0.1, 270.0)):
        view = views_of(own, east, margin=margin)["ground"]
        assert view.ground_from_view is not None
        corner = apply_homography(view.ground_from_view, np.array([[-0.5, -0.5]]))[0]
        assert corner[0] == pytest.approx(left_m, abs=GSD_M)
        assert corner[0] + view.width_px * GSD_M == pytest.approx(375.0, abs=GSD_M)
        assert view.height_px == 480


def test_an_image_that_shares_no_ground_keeps_its_whole_ground_view() -> None:
    far = Pose(np.array([5000.0, 0.0, 160.0]), looking(0.0, 0.0).world_rotation, 1.0, 1.0)
    (whole,) = GroundView()(NADIR, looking(0.0, 0.0), GROUND_Z, GSD_M)
    view = views_of(looking(0.0, 0.0), far)["ground"]
    assert (view.width_px, view.height_px) == (whole.width_px, whole.height_px)


def test_a_sliver_of_overlap_keeps_the_whole_ground_view() -> None:
    own = looking(0.0, 0.0)
    east = Pose(own.center_m + np.array([146.0, 0.0, 0.0]), own.world_rotation, 1.0, 1.0)
    (whole,) = GroundView()(NADIR, own, GROUND_Z, GSD_M)
    view = views_of(own, east, margin=0.0)["ground"]
    assert (view.width_px, view.height_px) == (whole.width_px, whole.height_px)


def test_source_is_view_0_on_request() -> None:
    made = views_of(looking(0.0, 60.0), looking(180.0, 60.0), keep_source=True)
    assert list(made) == ["source", "ground", "tilt60-azimuth0"]


def test_intersection_by_hand() -> None:
    square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    for other in (square + 3.0, (square + 3.0)[::-1]):  # whichever way round
        part = intersection(square, other)
        assert part.min(axis=0).tolist() == [3.0, 3.0]
        assert part.max(axis=0).tolist() == [4.0, 4.0]
        assert intersection(square, other, 1.0).min(axis=0).tolist() == [2.0, 2.0]
    assert len(intersection(square, square + 10.0)) == 0
    assert len(intersection(square, square[:0])) == 0
