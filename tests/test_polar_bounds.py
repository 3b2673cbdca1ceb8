"""What polar searches and reads at most: poses that say little, more grid points than OpenCV takes in one picture."""

import numpy as np
import pytest
from make_ground import errors, pair

from aeromatch_cli.data import Camera, View
from aeromatch_cli.errors import ItemError
from aeromatch_cli.images.views import render_view
from aeromatch_cli.strategies.extractors.pyramid import cut_patches, levels_of
from aeromatch_cli.strategies.matchers.polar.affine import Windows
from aeromatch_cli.strategies.matchers.polar.level import bilinear_at, level_of
from aeromatch_cli.strategies.matchers.polar.points import searched
from aeromatch_cli.strategies.matchers.polar.pyramid import Pyramid
from aeromatch_cli.strategies.matchers.polar.registration import _EFFORTS, SCALES, Prior, register


@pytest.mark.parametrize("effort", _EFFORTS)
def test_poses_that_say_nothing_are_searched_over_half_a_turn_and_a_factor_of_two(effort) -> None:
    ratio = (SCALES[1] / SCALES[0]) ** (1.0 / (effort.scales - 1))
    vague = Prior(np.eye(3), 40.0, 4.0, 5000.0).search(0.1, effort.turn_step_deg, ratio)
    assert np.abs(vague.turns_rad).max() <= np.pi + np.deg2rad(effort.turn_step_deg)
    assert 0.5 / ratio <= vague.scales.min() <= 0.5 < 2.0 <= vague.scales.max() <= 2.0 * ratio
    # Pixels that are transformed: side 1 is turned on a square canvas that holds its diagonal at the smallest scale.
    canvas = 1.25 * effort.size_px / vague.scales.min()
    assert len(vague.turns_rad) * len(vague.scales) * (0.85 * (effort.size_px + canvas)) ** 2 < 2.5e8


def test_a_prior_within_the_bounds_is_searched_as_far_as_it_says() -> None:
    search = Prior(np.eye(3), np.deg2rad(20.0), 0.3, 50.0).search(0.1, 8.0, 1.1)
    assert np.rad2deg(search.turns_rad) == pytest.approx([-24.0, -16.0, -8.0, 0.0, 8.0, 16.0, 24.0])
    assert search.scales == pytest.approx(1.1 ** np.arange(-4, 5.0))


def test_a_pair_of_vague_poses_is_registered() -> None:
    first, second, truth = pair(-101.0, 1.22, (90.0, 110.0), seed=3)
    # Positions to a third of the flying height, at three standard deviations of both.
    prior = Prior(np.eye(3), np.deg2rad(600.0), 1.41, 3000.0)
    found = register(Pyramid(first.reduced, second.reduced, 720), prior)
    assert found.accepted, found.reason
    assert found.fit is not None
    assert errors(found.matrix, truth, found.fit.middle_px / found.scale)[0] < 0.03


@pytest.mark.slow
def test_more_places_than_opencv_takes_in_one_picture_are_read() -> None:
    ramp = np.add.outer(10.0 * np.arange(50.0), np.arange(60.0)).astype(np.float32)
    rng = np.random.default_rng(1)
    places = rng.uniform([0.0, 0.0], [59.0, 49.0], (33_000 * 256 + 17, 2))
    found = bilinear_at(ramp, places)
    assert found.shape == (len(places),)
    assert np.abs(found - places @ [1.0, 10.0]).max() < 0.2  # OpenCV reads at multiples of a 32nd of a pixel


@pytest.mark.slow
def test_more_than_eleven_thousand_grid_points_are_searched_for() -> None:
    picture = np.random.default_rng(2).uniform(0.0, 255.0, (300, 400)).astype(np.float32)
    level = level_of(picture, None, 1.0, even=False)
    across, down = np.meshgrid(np.linspace(40.0, 360.0, 120), np.linspace(40.0, 260.0, 100))
    places = np.stack([across.ravel(), down.ravel()], axis=1)
    start = Windows.start(places, places + np.array([2.0, -1.0]), np.repeat(np.eye(2)[None], len(places), axis=0))
    found = searched(level, level, start, 10, 4)
    assert found.matched.sum() == len(places) == 12_000
    assert np.abs(found.places1_px - places).max() < 0.05


def test_an_image_too_long_for_opencv_is_named_with_a_remedy() -> None:
    long = np.zeros((40, 40_000), np.uint8)
    camera = Camera("PINHOLE", 40_000, 40, (9000.0, 9000.0, 19999.5, 19.5))
    view = View("x", 64, 32, np.array([[1.0, 0.0, 30_000.0], [0.0, 1.0, 2.0], [0.0, 0.0, 1.0]]), False, 0.0)
    with pytest.raises(ItemError, match=r"40,000 px long .* --max-size 32766"):
        render_view(long, None, camera, view)
    with pytest.raises(ItemError, match=r"40,000 px long .* --max-size 32766"):
        cut_patches(levels_of(long), np.array([[35_000.0, 20.0]]), np.array([5.0]), np.array([0.0]))
    # What is reduced beforehand is short enough.
    reduced = View("x", 64, 32, np.array([[2.0, 0.0, 30_000.0], [0.0, 2.0, -12.0], [0.0, 0.0, 1.0]]), False, 0.0)
    assert render_view(long, None, camera, reduced)[0].shape == (32, 64)
