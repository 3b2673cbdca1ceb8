"""Patches of pictures whose gray values say where they are."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from aeromatch_cli.strategies.extractors.pyramid import PATCH_PX, STEP, SUPPORT, cut_patches, levels_of

WIDTH, HEIGHT = 400, 300


def ramps() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pictures (H, W) whose values are x and y."""
    x, y = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    return x, y


def cut(point: tuple[float, float], size_px: float, angle_deg: float) -> NDArray[np.float64]:
    """(32, 32, 2) places that the pixels of a patch come from."""
    place = np.array([point]), np.array([size_px]), np.array([angle_deg])
    return np.stack([cut_patches(levels_of(ramp), *place)[0] for ramp in ramps()], axis=-1).astype(np.float64)


def test_levels_are_half_an_octave_apart_and_lie_where_the_picture_does() -> None:
    for axis, ramp in enumerate(ramps()):
        levels = levels_of(ramp)
        for index, level in enumerate(levels):
            assert level.scale == pytest.approx(STEP**index, rel=0.55 / min(level.gray.shape))
            there = level.to_picture(np.array([[10.0, 7.0]]))
            assert level.gray[7, 10] == pytest.approx(there[0, axis], abs=0.3 / level.scale[0])
            np.testing.assert_allclose(level.from_picture(there), [[10.0, 7.0]], atol=1e-9)
        assert min(levels[-1].gray.shape) >= PATCH_PX > round(HEIGHT * STEP ** len(levels))


@pytest.mark.parametrize("size_px", [5.0, 9.0, 20.0])
@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, -135.0])
def test_a_patch_shows_its_support_around_its_place_along_its_angle(size_px: float, angle_deg: float) -> None:
    point = (201.3, 148.6)
    places = cut(point, size_px, angle_deg)
    step = SUPPORT * size_px / PATCH_PX
    angle = np.deg2rad(angle_deg)
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    grid = np.arange(PATCH_PX) - (PATCH_PX - 1) / 2
    expected = np.array(point) + step * (grid[None, :, None] * along + grid[:, None, None] * across)
    # Area averages of a ramp are the ramp; uneven sizes of levels move them by less than a tenth of their pixels.
    np.testing.assert_allclose(places, expected, atol=0.02 if step <= 1.0 else 0.15 * step)


def test_beyond_the_picture_its_edge_is_repeated() -> None:
    places = cut((3.0, 150.0), 5.0, 0.0)  # a pixel of the patch for one of the picture
    assert places[..., 0].min() == 0.0
    assert (places[:, :10, 0] == 0.0).all()


def test_no_keypoints_have_no_patches() -> None:
    nothing = np.zeros(0)
    assert cut_patches(levels_of(ramps()[0]), np.zeros((0, 2)), nothing, nothing).shape == (0, PATCH_PX, PATCH_PX)
