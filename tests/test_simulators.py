"""Virtual views by geometry: a ground point through the camera and through the view is the same source pixel."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeromatch_cli.data import Camera, FloatArray, Pose, View
from aeromatch_cli.geometry.cameras import normalise, project, undistort
from aeromatch_cli.geometry.footprints import ground_footprint, ground_sampling_distance_m
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.geometry.warps import area_scale, border_px, source_from_view, view_from_source
from aeromatch_cli.images.views import render_view
from aeromatch_cli.lab.strategies import ARMS
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.sift import Sift
from aeromatch_cli.strategies.simulators import SIMULATORS
from aeromatch_cli.strategies.simulators.ground import GroundView

EVERY = {**SIMULATORS, **ARMS["simulate"]}

PINHOLE = Camera("PINHOLE", 1000, 800, (1000.0, 1000.0, 499.5, 399.5))
LENS = Camera("OPENCV", 1000, 800, (820.0, 815.0, 503.2, 391.1, -0.08, 0.03, 1e-3, -5e-4))
WIDE = Camera("OPENCV", 1000, 800, (500.0, 500.0, 499.5, 399.5, -0.25, 0.03, 0.0, 0.0))
GROUND_Z = 12.0


def pose(omega_deg: float, phi_deg: float, kappa_deg: float, height_m: float = 112.0) -> Pose:
    return Pose(np.array([300.0, 200.0, height_m]), from_omega_phi_kappa(omega_deg, phi_deg, kappa_deg), 1.0, 1.0)


def world_from_view(camera: Camera, seen_from: Pose, view: View, points_px: FloatArray) -> FloatArray:
    """World points (N, 3) on the ground of view pixels, from the view's own north-west corner and scale."""
    from aeromatch_cli.geometry.frames import apply_homography
    from aeromatch_cli.geometry.warps import undistorted_from_ground

    inverse = np.linalg.inv(undistorted_from_ground(camera, seen_from, GROUND_Z)) @ view.undistorted_from_view
    xy = apply_homography(inverse / inverse[2, 2], points_px)
    return np.column_stack([xy, np.full(len(xy), GROUND_Z)])


@pytest.mark.parametrize("name", sorted(EVERY))
@pytest.mark.parametrize("known", [(None, GROUND_Z, 0.1), (pose(0, 0, 0), None, 0.1), (pose(0, 0, 0), GROUND_Z, None)])
def test_without_geometry_every_simulator_gives_the_source(
    name: str, known: tuple[Pose | None, float | None, float | None]
) -> None:
    view, *others = EVERY[name]()(LENS, *known)
    assert view.is_source
    assert not others or name == "tilts"
    assert (view.name, view.width_px, view.height_px, view.angle_deg) == ("source", 1000, 800, 0.0)
    np.testing.assert_array_equal(view.undistorted_from_view, np.eye(3))


@pytest.mark.parametrize("name", sorted(EVERY))
def test_simulators_are_frozen_recipes(name: str) -> None:
    recipe = EVERY[name]()
    assert recipe.name == name
    assert hash(recipe) == hash(EVERY[name]())
    with pytest.raises(ValueError, match="Extra inputs"):
        EVERY[name](unknown=1)  # type: ignore[call-arg]


@pytest.mark.parametrize("camera", [PINHOLE, LENS])
@pytest.mark.parametrize("seen_from", [pose(0, 0, 0), pose(25.0, -10.0, 140.0), pose(70.0, 5.0, -30.0)])
def test_view_and_camera_agree_on_ground_points(camera: Camera, seen_from: Pose) -> None:
    (view,) = GroundView(far_ground=False)(camera, seen_from, GROUND_Z, 0.2)
    assert not view.is_source
    xs, ys = np.meshgrid(np.linspace(0, view.width_px - 1, 23), np.linspace(0, view.height_px - 1, 19))
    points = np.stack([xs.ravel(), ys.ravel()], axis=1)
    world = world_from_view(camera, seen_from, view, points)
    assert seen_from.world_rotation is not None
    expected = project(camera, seen_from.world_rotation, seen_from.center_m, world)
    found = source_from_view(camera, view.undistorted_from_view, points)
    seen = np.isfinite(expected).all(axis=1)
    assert seen.sum() > 100
    np.testing.assert_allclose(found[seen], expected[seen], atol=1e-6)
    assert np.isnan(found[~seen]).any(axis=1).all()


def test_nadir_view_by_hand() -> None:
    # 100 m above ground, 0.1 m per px; the view at 0.2 m per px covers 100 m x 80 m in 500 x 400 px.
    (view,) = GroundView()(PINHOLE, pose(0, 0, 90.0), GROUND_Z, 0.2)
    # kappa = 90: the image's x axis points north, so that the view is higher than wide.
    assert (view.width_px, view.height_px) == (400, 500)
    assert view.angle_deg == pytest.approx(0.0, abs=1e-6)
    world = world_from_view(PINHOLE, pose(0, 0, 90.0), view, np.array([[0.0, 0.0], [399.0, 0.0], [0.0, 499.0]]))
    expected = [[260.1, 249.9, GROUND_Z], [339.9, 249.9, GROUND_Z], [260.1, 150.1, GROUND_Z]]
    np.testing.assert_allclose(world, expected, atol=1e-9)


@given(
    omega_deg=st.floats(-100.0, 100.0),
    kappa_deg=st.floats(-180.0, 180.0),
    gsd_m=st.floats(0.02, 1.0),
    factor=st.floats(1.0, 6.0),
)
@settings(max_examples=100, deadline=None)
def test_view_is_bounded_and_within_the_cut(omega_deg: float, kappa_deg: float, gsd_m: float, factor: float) -> None:
    seen_from = pose(omega_deg, 0.0, kappa_deg)
    strategy = GroundView(max_distance_factor=factor, max_megapixels=1.5, far_ground=False)
    (view,) = strategy(PINHOLE, seen_from, GROUND_Z, gsd_m)
    if view.is_source:
        return
    assert view.width_px * view.height_px <= 1.5e6
    w, h = view.width_px - 0.5, view.height_px - 0.5
    corners = np.array([[-0.5, -0.5], [w, -0.5], [w, h], [-0.5, h]])
    inverse = np.linalg.inv(_undistorted_from_world(seen_from)) @ view.undistorted_from_view
    ground = np.column_stack([corners, np.ones(4)]) @ inverse.T
    reach = np.abs(ground[:, :2] / ground[:, 2:] - seen_from.center_m[:2]).max()
    assert reach <= factor * 100.0 * (1.0 + 1e-9)


def _undistorted_from_world(seen_from: Pose) -> FloatArray:
    from aeromatch_cli.geometry.warps import undistorted_from_ground

    return undistorted_from_ground(PINHOLE, seen_from, GROUND_Z)


def test_points_behind_the_camera_are_masked() -> None:
    # Looking south 60 degrees from nadir; a view made by hand that reaches 300 m to the north of the camera.
    seen_from = pose(-60.0, 0.0, 0.0)
    (view,) = GroundView(far_ground=False)(PINHOLE, seen_from, GROUND_Z, 0.5)
    north_px = np.array([[view.width_px / 2.0, -y / 0.5] for y in (300.0, 400.0)])
    assert np.isnan(source_from_view(PINHOLE, view.undistorted_from_view, north_px)).all()
    inside = source_from_view(PINHOLE, view.undistorted_from_view, np.array([[view.width_px / 2.0, 5.0]]))
    assert np.isfinite(inside).all()


def test_view_is_never_finer_than_the_image() -> None:
    seen_from = pose(0, 0, 0)
    assert ground_sampling_distance_m(PINHOLE, seen_from, GROUND_Z) == pytest.approx(0.1)
    (view,) = GroundView()(PINHOLE, seen_from, GROUND_Z, 0.01)
    assert (view.width_px, view.height_px) == (1000, 800)
    (finer,) = GroundView(max_magnification=1.25)(PINHOLE, seen_from, GROUND_Z, 0.01)
    assert (finer.width_px, finer.height_px) == (1250, 1000)


def test_far_ground_is_not_enlarged_beyond_the_stretch() -> None:
    seen_from = pose(72.0, 0.0, 0.0)
    wide, tight = (GroundView(max_stretch=most, far_ground=False) for most in (50.0, 2.0))
    far = np.array([[0.0, 0.0]])
    for strategy, within in ((wide, False), (tight, True)):
        (view,) = strategy(PINHOLE, seen_from, GROUND_Z, 0.1)
        far = np.array([[view.width_px / 2.0, 0.0]])  # the northern edge, straight ahead
        enlargement = 1.0 / float(area_scale(view.undistorted_from_view, far)[0])
        assert (enlargement <= 2.0 * (1.0 + 1e-6)) is within
    cut = ground_footprint(PINHOLE, seen_from, GROUND_Z, 500.0)
    (view,) = tight(PINHOLE, seen_from, GROUND_Z, 0.1)
    own_gsd = ground_sampling_distance_m(PINHOLE, seen_from, GROUND_Z)
    assert own_gsd is not None
    assert view.height_px * own_gsd < 0.8 * np.ptp(cut[:, 1])


def test_source_is_view_0_on_request() -> None:
    source, ground = GroundView(keep_source=True)(PINHOLE, pose(20.0, 0, 0), GROUND_Z, 0.2)
    assert source.is_source
    assert not ground.is_source
    assert ground.angle_deg == pytest.approx(20.0)


@pytest.mark.parametrize("blind", [pose(180.0, 0, 0), pose(0, 0, 0, height_m=5.0), pose(0, 0, 0, height_m=13.0)])
def test_images_without_ground_keep_the_source(blind: Pose) -> None:
    # Looking up; below the ground; so low that nothing of the view is left at this scale.
    (view,) = GroundView()(PINHOLE, blind, GROUND_Z, 0.5)
    assert view.is_source


@pytest.mark.parametrize("camera", [PINHOLE, LENS])
def test_distant_ground_is_looked_at_as_the_image_shows_it(camera: Camera) -> None:
    """Together with the ground view every place on the ground is seen, no place twice, and the sky not at all."""
    seen_from = pose(72.0, 5.0, -30.0)
    far, near = GroundView()(camera, seen_from, GROUND_Z, 0.2)
    assert (far.name, near.name, far.is_source, far.angle_deg, far.gsd_m) == ("far", "ground", False, 0.0, None)
    pixels = np.tile(np.arange(camera.width_px) % 200, (camera.height_px, 1)).astype(np.uint8)
    picture, seen = render_view(pixels, None, camera, far)
    assert seen is not None
    rows, columns = np.nonzero(seen)
    source_px = source_from_view(camera, far.undistorted_from_view, np.column_stack([columns, rows]))
    own = (source_px[:, 0] % 200 > 2) & (source_px[:, 0] % 200 < 196)
    assert np.abs(picture[rows, columns][own] - source_px[own, 0] % 200).max() <= 1.0
    places = np.random.default_rng(0).uniform([20.0, 20.0], [camera.width_px - 21, camera.height_px - 21], (4000, 2))
    assert seen_from.world_rotation is not None
    below = (np.column_stack([normalise(camera, places), np.ones(len(places))]) @ seen_from.world_rotation)[:, 2] < 0.0
    near_px = view_from_source(camera, near.undistorted_from_view, places)
    in_near = below & (near_px > 0.0).all(axis=1) & (near_px < [near.width_px - 1, near.height_px - 1]).all(axis=1)
    far_px = np.rint(view_from_source(camera, far.undistorted_from_view, places)).astype(int)
    inside = ((far_px >= 0) & (far_px < [far.width_px, far.height_px])).all(axis=1)
    in_far = np.zeros(len(places), bool)
    in_far[inside] = seen[far_px[inside, 1], far_px[inside, 0]]
    assert (in_near ^ in_far)[below].mean() > 0.98  # the mask is exact to some pixels
    assert in_far[~below].mean() < 0.02
    assert 0.1 < in_far.mean() < 0.6


def test_distant_ground_has_no_view_where_it_is_little_or_not_wanted() -> None:
    steep = pose(72.0, 0.0, 0.0)
    assert [view.name for view in GroundView()(PINHOLE, pose(30.0, 0, 0), GROUND_Z, 0.2)] == ["ground"]
    assert [view.name for view in GroundView(far_ground=False)(PINHOLE, steep, GROUND_Z, 0.2)] == ["ground"]
    assert [view.name for view in GroundView(keep_source=True)(PINHOLE, steep, GROUND_Z, 0.2)] == ["source", "ground"]


def test_distant_ground_has_keypoints_of_its_own_as_many_for_each_pixel() -> None:
    gray = np.random.default_rng(0).integers(0, 256, (PINHOLE.height_px, PINHOLE.width_px), dtype=np.uint8)
    views = GroundView()(PINHOLE, pose(72.0, 0.0, 0.0), GROUND_Z, 0.2)
    pictures = [ViewPixels(view, *render_view(gray, None, PINHOLE, view)) for view in views]
    far_px = 0 if pictures[0].valid is None else int(pictures[0].valid.sum())
    found = np.bincount(Sift(keypoints=500)(PINHOLE, pictures).view_idx, minlength=2)
    assert found[1] == 500
    assert found[0] == round(500 * far_px / (gray.size - far_px))
    assert 50 < found[0] < 300


@pytest.mark.slow
@pytest.mark.parametrize("keypoints", [1, 2, 5, 40])
def test_a_sliver_of_distant_ground_may_have_no_keypoint(keypoints: int) -> None:
    gray = np.random.default_rng(0).integers(0, 256, (PINHOLE.height_px, PINHOLE.width_px), dtype=np.uint8)
    views = GroundView()(PINHOLE, pose(62.0, 0.0, 0.0), GROUND_Z, 0.2)
    pictures = [ViewPixels(view, *render_view(gray, None, PINHOLE, view)) for view in views]
    assert pictures[0].valid is not None
    pictures[0] = replace(pictures[0], valid=pictures[0].valid & (np.arange(pictures[0].gray.shape[0]) < 30)[:, None])
    found = np.bincount(Sift(keypoints=keypoints)(PINHOLE, pictures).view_idx, minlength=2)
    far_px = int(pictures[0].valid.sum())
    assert list(found) == [round(keypoints * far_px / (gray.size - far_px)), keypoints]


@settings(max_examples=40, deadline=None)
@given(st.floats(50.0, 90.0), st.floats(-180.0, 180.0), st.floats(0.2, 8.0), st.sampled_from([PINHOLE, LENS, WIDE]))
def test_views_of_distant_ground_are_bounded(
    omega_deg: float, kappa_deg: float, megapixels: float, camera: Camera
) -> None:
    strategy = GroundView(max_megapixels=megapixels)
    for view in strategy(camera, pose(omega_deg, 5.0, kappa_deg), GROUND_Z, 0.2):
        if view.is_source:
            continue
        assert view.width_px * view.height_px <= megapixels * 1e6
        if view.beyond is not None:  # a pixel is none of a finer picture, and the box lies within the image
            outline = undistort(camera, border_px(camera, 50))
            corners = np.array([[-0.5, -0.5], [view.width_px - 0.5, view.height_px - 0.5]])
            places = apply_homography(view.undistorted_from_view, corners)
            assert view.undistorted_from_view[0, 0] >= 1.0
            assert (places > outline.min(axis=0) - 1.0).all()
            assert (places < outline.max(axis=0) + 1.0).all()


@pytest.mark.slow
def test_distant_ground_does_not_tell_how_views_are_reduced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Distant ground full of blobs beside near ground with fine ones: that goes back to full size all the same."""
    monkeypatch.setattr("aeromatch_cli.strategies.extractors.reduction.LEAST_PX", 1000)
    rng = np.random.default_rng(0)
    gray = np.full((PINHOLE.height_px, PINHOLE.width_px), 128, np.uint8)
    gray[:350] = cv2.resize(rng.integers(0, 256, (50, 143), dtype=np.uint8), (1000, 350), interpolation=cv2.INTER_CUBIC)
    gray[640:720] = rng.integers(0, 256, (80, 1000), dtype=np.uint8)
    found = {}
    for far_ground in (False, True):
        views = GroundView(far_ground=far_ground)(PINHOLE, pose(72.0, 0.0, 0.0), GROUND_Z, 0.05)
        pictures = [ViewPixels(view, *render_view(gray, None, PINHOLE, view)) for view in views]
        features = Sift(keypoints=500, pixels_per_keypoint=900.0)(PINHOLE, pictures)
        found[far_ground] = int((features.view_idx == len(views) - 1).sum())
    assert found[True] == found[False]
    assert found[True] > 250
