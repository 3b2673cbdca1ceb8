"""Views: what an image shows of the ground, reduced pictures, colours."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from aeromatch_cli.data import Camera, FloatArray, Pose, View
from aeromatch_cli.geometry.cameras import distort, normalise, project, undistort
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.geometry.warps import undistorted_from_ground
from aeromatch_cli.images.depth import sample_colours
from aeromatch_cli.images.views import render_view, view_maps
from aeromatch_cli.strategies.simulators.ground import GroundView

PINHOLE = Camera("PINHOLE", 640, 480, (700.0, 700.0, 319.5, 239.5))
LENS = Camera("OPENCV", 640, 480, (560.0, 555.0, 323.2, 231.1, -0.08, 0.03, 1e-3, -5e-4))
GROUND_Z = 12.0


def texture(xy_m: FloatArray) -> FloatArray:
    """A smooth ground, gray 28-228; no wave is shorter than 12 m."""
    x, y = xy_m[..., 0], xy_m[..., 1]
    return 128 + 50 * np.cos(0.45 * x + 0.15 * y) + 50 * np.sin(-0.2 * x + 0.4 * y + 1.0)


def photograph(camera: Camera, pose: Pose) -> NDArray[np.uint8]:
    """The texture on the plane z = GROUND_Z as the camera sees it, ray by ray."""
    assert pose.world_rotation is not None
    rows, columns = np.mgrid[: camera.height_px, : camera.width_px]
    uv = normalise(camera, np.stack([columns.ravel(), rows.ravel()], axis=1))
    rays = np.column_stack([uv, np.ones(len(uv))]) @ pose.world_rotation
    reach = (GROUND_Z - pose.center_m[2]) / rays[:, 2]
    ground = pose.center_m[:2] + reach[:, None] * rays[:, :2]
    return np.rint(texture(ground)).astype(np.uint8).reshape(camera.height_px, camera.width_px)


def ground_of(camera: Camera, pose: Pose, view: View) -> FloatArray:
    """World places (H, W, 2) of a view's pixels."""
    rows, columns = np.mgrid[: view.height_px, : view.width_px]
    world = np.linalg.inv(undistorted_from_ground(camera, pose, GROUND_Z)) @ view.undistorted_from_view
    points = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    return apply_homography(world / world[2, 2], points).reshape(view.height_px, view.width_px, 2)


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (20.0, -15.0, 130.0), (40.0, 0.0, -60.0)])
def test_the_ground_view_shows_the_ground(camera: Camera, angles: tuple[float, float, float]) -> None:
    pose = Pose(np.array([300.0, 200.0, 112.0]), from_omega_phi_kappa(*angles), 1.0, 1.0)
    (view,) = GroundView()(camera, pose, GROUND_Z, 0.2)
    picture, seen = render_view(photograph(camera, pose), None, camera, view)
    assert seen is not None
    assert seen.mean() > 0.3
    truth = texture(ground_of(camera, pose, view))
    difference = np.abs(picture.astype(float) - truth)[seen]
    # Rounding twice and linear interpolation between pixels; far ground in a steep view is blurred by its own scale.
    assert np.median(difference) < 0.6
    assert np.quantile(difference, 0.99) < 2.5
    assert not picture[~seen].any()


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_view_maps_are_within_a_fiftieth_of_a_pixel(camera: Camera) -> None:
    pose = Pose(np.array([300.0, 200.0, 112.0]), from_omega_phi_kappa(35.0, -10.0, 60.0), 1.0, 1.0)
    (view,) = GroundView()(camera, pose, GROUND_Z, 0.15)
    map_x, map_y = view_maps(camera, view)
    assert map_x.shape == (view.height_px, view.width_px)
    rows, columns = np.mgrid[: view.height_px, : view.width_px]
    points = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    exact = distort(camera, apply_homography(view.undistorted_from_view, points)).reshape(*map_x.shape, 2)
    inside = (exact >= 0).all(axis=2) & (exact <= (camera.width_px - 1, camera.height_px - 1)).all(axis=2)
    assert inside.mean() > 0.2
    assert np.abs(map_x - exact[..., 0])[inside].max() < 0.02
    assert np.abs(map_y - exact[..., 1])[inside].max() < 0.02
    # The exact map itself: a ground point lies in the view where the photograph has it.
    assert pose.world_rotation is not None
    some = np.column_stack([ground_of(camera, pose, view)[inside][::997], np.full(inside.sum(), GROUND_Z)[::997]])
    np.testing.assert_allclose(
        project(camera, pose.world_rotation, pose.center_m, some), exact[inside][::997], atol=1e-6
    )


def test_a_reduced_view_does_not_alias() -> None:
    """Stripes of one pixel seen at a fifth of the scale are gray, not a moire of black and white."""
    stripes = np.zeros((480, 640), np.uint8)
    stripes[:, ::2] = 255
    view = View("x", 128, 96, np.diag([5.0, 5.0, 1.0]), False, 0.0)
    picture, _ = render_view(stripes, None, PINHOLE, view)
    assert np.abs(picture[2:-2, 2:-2].astype(float) - 127.5).max() < 30
    plain = stripes[::5, ::5]
    assert plain.std() > 100  # what a view without filter would show


def test_a_reduced_view_stays_in_place() -> None:
    _, x = np.mgrid[:480, :640].astype(np.float32)
    shift = np.array([[4.0, 0.0, 13.0], [0.0, 4.0, 7.0], [0.0, 0.0, 1.0]])
    picture, seen = render_view(x, None, PINHOLE, View("x", 150, 110, shift, False, 0.0))
    columns = np.broadcast_to(np.arange(150), (110, 150))
    assert seen is not None
    inner = seen & (columns > 1) & (columns < 148)
    assert np.abs(picture - (4.0 * columns + 13.0))[inner].max() < 0.05


def test_masks_are_warped_with_the_picture() -> None:
    valid = np.ones((480, 640), bool)
    valid[:, :320] = False
    shift = np.array([[1.0, 0.0, 100.0], [0.0, 1.0, 50.0], [0.0, 0.0, 1.0]])
    _, seen = render_view(np.full((480, 640), 9, np.uint8), valid, PINHOLE, View("x", 600, 400, shift, False, 0.0))
    assert seen is not None
    expected = np.zeros((400, 600), bool)
    expected[:, 220:540] = True
    np.testing.assert_array_equal(seen, expected)


def test_the_source_view_is_the_source() -> None:
    pixels = np.arange(30 * 40 * 3, dtype=np.uint8).reshape(30, 40, 3)
    view = View("source", 40, 30, np.eye(3), True, 0.0)
    assert render_view(pixels, None, PINHOLE, view) == (pixels, None)


def test_undistort_is_the_inverse_used_here() -> None:
    points = np.array([[0.0, 0.0], [639.0, 479.0], [320.0, 10.0]])
    np.testing.assert_allclose(distort(LENS, undistort(LENS, points)), points, atol=1e-9)


def test_colours_are_averages_around_the_points_in_eight_bits() -> None:
    picture = np.zeros((64, 96, 3), np.uint8)
    picture[:, :48], picture[:, 48:] = (200, 100, 50), (20, 40, 60)
    points = np.array([[10.0, 20.0], [70.0, 20.0], [24.0, 30.0]])
    found = sample_colours(picture, points, np.array([1.0, 9.0, 500.0]))
    np.testing.assert_array_equal(found[:2], [(200, 100, 50), (20, 40, 60)])
    # A blob larger than the picture: the largest square that fits, 64 px, a third of it beyond the edge at 48.
    np.testing.assert_allclose(found[2], 0.75 * np.array([200, 100, 50]) + 0.25 * np.array([20, 40, 60]), atol=1.0)
    gray = sample_colours(picture[..., 0], points, np.ones(3))
    np.testing.assert_array_equal(gray, np.repeat([[200], [20], [200]], 3, axis=1))
    deep = sample_colours(picture.astype(np.uint16) * 100, points, np.ones(3))
    assert deep.dtype == np.uint8
    assert (deep[0, 0], deep[1, 0]) == (255, 0)


@pytest.mark.parametrize("scale", [1.0, 0.8, 0.5, 0.3, 0.125, 0.07])
def test_strips_make_the_same_reduced_picture(scale, monkeypatch):

    from aeromatch_cli.images import scaling

    monkeypatch.setattr(scaling, "_STRIP_PX", 20_000)
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (403, 605)).astype(np.float32), (0, 0), 4.0)
    found = scaling.shrink_in_strips(lambda top, count: picture[top : top + count], (605, 403), scale)
    wanted = scaling.shrink(picture, scale)
    height, width = found.shape
    assert 0 <= wanted.shape[0] - height <= 1
    assert 0 <= wanted.shape[1] - width <= 1
    # An area filter in two steps is a little wider than one in one.
    off = (found - wanted[:height, :width])[1:-1, 1:-1]
    assert off.std() < (0.2 * wanted.std() if scale == 0.07 else 1e-3)
