"""What polar searches and reads at most: poses that say little, more grid points than OpenCV takes in one picture."""

import numpy as np
import pytest
from make_ground import errors, pair

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
