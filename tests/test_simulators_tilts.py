"""Tilts without poses: every view maps back to the source exactly, and is sharp without aliasing."""

from __future__ import annotations

import numpy as np
import pytest

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.warps import area_scale, source_from_view, view_from_source
from aeromatch_cli.images.views import render_view
from aeromatch_cli.lab.strategies.tilts import Tilts

PINHOLE = Camera("PINHOLE", 400, 300, (380.0, 380.0, 199.5, 149.5))
LENS = Camera("OPENCV", 400, 300, (380.0, 378.0, 203.2, 141.1, -0.08, 0.03, 1e-3, -5e-4))


def inner_points(camera: Camera) -> FloatArray:
    xs, ys = np.meshgrid(np.linspace(0, camera.width_px - 1, 9), np.linspace(0, camera.height_px - 1, 7))
    return np.stack([xs.ravel(), ys.ravel()], axis=1)


@pytest.mark.parametrize("camera", [PINHOLE, LENS])
def test_every_view_shows_the_whole_image_and_maps_back(camera: Camera) -> None:
    views = Tilts(levels=3, rotations=4)(camera, None, None, None)
    assert len(views) == 1 + 3 + 4 + 5 + 8
    assert len({view.name for view in views}) == len(views)
    points = inner_points(camera)
    for view in views[1:]:
        inside = view_from_source(camera, view.undistorted_from_view, points)
        assert (inside >= -1.5).all()
        assert (inside <= np.array([view.width_px, view.height_px]) + 0.5).all()
        np.testing.assert_allclose(source_from_view(camera, view.undistorted_from_view, inside), points, atol=1e-6)


def test_tilts_shrink_one_axis_by_their_factor() -> None:
    source, *views = Tilts(levels=2)(PINHOLE, None, None, None)
    assert source.is_source
    for view in views:
        shrinks = np.linalg.svd(view.undistorted_from_view[:2, :2])[1]
        tilt = 2.0 if view.name.startswith("tilt2") else np.sqrt(2.0)
        np.testing.assert_allclose(shrinks, [tilt, 1.0], atol=1e-9)
        assert np.cos(np.deg2rad(view.angle_deg)) == pytest.approx(1.0 / tilt)
        assert view.world_direction is None
    assert (views[0].width_px, views[0].height_px) == (int(400 / np.sqrt(2.0)), 300)


def test_a_quarter_turn_is_exact() -> None:
    _, turned, *_ = Tilts(levels=0, rotations=4)(PINHOLE, None, None, None)
    pixels = np.random.default_rng(5).integers(0, 255, (300, 400), dtype=np.uint8)
    picture, seen = render_view(pixels, None, PINHOLE, turned)
    assert seen is not None
    assert seen.all()
    np.testing.assert_array_equal(picture, np.rot90(pixels, -1))


def test_views_are_bounded() -> None:
    for view in Tilts(levels=1, rotations=3, max_megapixels=0.05)(LENS, None, None, None)[1:]:
        assert view.width_px * view.height_px <= 0.05e6
        assert float(area_scale(view.undistorted_from_view, np.zeros((1, 2)))[0]) > 1.0


def test_tilted_views_do_not_alias() -> None:
    # Stripes of 2.5 px become 1.25 px in a tilt of 2 across them: nothing of them may be left but a flat gray.
    stripes = np.tile(127.0 + 100.0 * np.sin(2.0 * np.pi * np.arange(400) / 2.5), (300, 1)).astype(np.uint8)
    views = {view.name: view for view in Tilts(levels=2)(PINHOLE, None, None, None)[1:]}
    across, _ = render_view(stripes, None, PINHOLE, views["tilt2-0"])
    assert across[:, 10:-10].std() < 5.0
    # Along stripes nothing is lost (of 8 px, which resampling leaves alone).
    wide = np.tile(127.0 + 100.0 * np.sin(2.0 * np.pi * np.arange(300) / 8.0), (400, 1)).T.astype(np.uint8)
    along, _ = render_view(wide, None, PINHOLE, views["tilt2-0"])
    assert along[10:-10, 10:-10].std() > 50.0
