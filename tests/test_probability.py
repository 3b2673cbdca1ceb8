"""How probable it is that a verified match is right: what tells it, and the weights found from examples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aeromatch_cli.data import FloatArray
from aeromatch_cli.sfm.probability import (
    WEIGHTS,
    MatchEvidence,
    columns,
    fitted_weights,
    least_probability,
    off_neighbours_px,
    probabilities,
    usual_off_px,
)

# Score, error, confirming, off either way: eleven usual matches of a pair; the first one is changed.
USUAL = MatchEvidence(*(np.full(11, value) for value in (0.5, 0.3, 2.0, 0.5, 0.5)))
USUAL_PX = 0.5


def probability(**changed: float) -> float:
    first = np.arange(11) == 0
    values = {key: np.where(first, value, getattr(USUAL, key)) for key, value in changed.items()}
    return float(probabilities(replace(USUAL, **values), USUAL_PX)[0])


def test_the_usual_match_is_right() -> None:
    assert probability() > 0.95


@pytest.mark.parametrize(
    "changed",
    [
        {"scores": 0.05},
        {"confirming": 0.0},
        {"off0_px": 8.0},
        {"off1_px": 8.0},
    ],
)
def test_what_speaks_against_a_match_makes_it_less_probable(changed: dict[str, float]) -> None:
    assert probability(**changed) < probability() - 0.001


def test_a_doubtful_match_without_support_falls_below_the_least_probability_of_auto() -> None:
    assert probability(scores=0.05, confirming=0.0, off0_px=6.0, off1_px=6.0) < 0.5


def test_what_no_third_image_confirms_is_doubtful_only_where_others_are_confirmed() -> None:
    """Two images whose ground no third one shows: nothing can confirm any of their matches."""
    lone = replace(USUAL, confirming=np.zeros(11))
    assert probabilities(lone, USUAL_PX)[0] > probability(confirming=0.0) + 0.01


def test_distances_count_by_what_is_usual_in_the_pair() -> None:
    rough = replace(USUAL, off0_px=np.full(11, 2.0), error_px=np.full(11, 1.2))
    np.testing.assert_allclose(probabilities(rough, 2.0), probabilities(USUAL, USUAL_PX), atol=1e-3)


def test_a_pair_that_is_looser_than_the_block_is_doubtful_as_a_whole() -> None:
    """Keypoints on shadows of another hour: neighbours and third images agree to a pixel or two."""
    rough = replace(USUAL, off0_px=np.full(11, 3.0), error_px=np.full(11, 1.8))
    assert usual_off_px([USUAL, USUAL, rough]) == 0.5
    assert probabilities(rough, 0.5).max() < 0.7
    assert usual_off_px([]) == 0.0


def two_views(heights_m: FloatArray) -> tuple[FloatArray, ...]:
    """Centres 20 m apart, 100 m up, and unit rays to points of these heights on a grid."""
    side = int(np.sqrt(len(heights_m)))
    x, y = np.meshgrid(np.linspace(-30, 30, side), np.linspace(-30, 30, side))
    points = np.column_stack([x.ravel(), y.ravel(), heights_m])
    centers = np.array([-10.0, 0.0, 100.0]), np.array([10.0, 0.0, 100.0])
    rays = [(points - center) / np.linalg.norm(points - center, axis=1, keepdims=True) for center in centers]
    return centers[0], rays[0], centers[1], rays[1]


def test_a_match_on_the_surface_of_its_neighbours_is_where_they_put_it() -> None:
    rng = np.random.default_rng(0)
    heights_m = np.zeros(144)
    wrong = rng.choice(144, 10, replace=False)
    heights_m[wrong] = 9.0
    off_px = off_neighbours_px(*two_views(heights_m), heights_m, 1000.0)
    # 9 m of 100 m at a base of 20 m: 1000 * 20 * (1 / 91 - 1 / 100) = 19.8 px in the middle of an image.
    assert off_px[wrong].min() > 10.0
    right = np.setdiff1d(np.arange(144), wrong)
    np.testing.assert_allclose(off_px[right], 0.0, atol=1e-6)


def test_too_few_matches_have_no_neighbours() -> None:
    heights_m = np.zeros(1)
    assert off_neighbours_px(*two_views(heights_m), heights_m, 1000.0).tolist() == [16.0]


def test_weights_are_found_again() -> None:
    rng = np.random.default_rng(3)
    values = np.column_stack([np.ones(40_000), rng.normal(size=(40_000, 3))])
    true = np.array([1.0, -0.5, 2.0, 0.0])
    right = rng.random(40_000) < 1.0 / (1.0 + np.exp(-values @ true))
    np.testing.assert_allclose(fitted_weights(values, right), true, atol=0.06)


def test_there_is_a_weight_for_every_column() -> None:
    assert columns(USUAL, USUAL_PX).shape == (11, len(WEIGHTS))


def test_the_least_probability_rises_until_as_many_are_expected_to_be_right() -> None:
    likely = [np.array([0.99, 0.86, 0.94]), None, np.array([0.93, 0.5, 0.92])]
    kept = lambda expected: least_probability(likely, 0.85, expected, 0.4)  # noqa: E731
    assert kept(0.0) == kept(0.927) == 0.85  # the mean of the five is 0.928
    assert kept(0.93) == 0.92  # of four 0.945
    assert kept(0.95) == 0.93  # of three 0.9533
    assert kept(0.96) == 0.93  # of two 0.965, but two fifths of the five are given up at most


def test_the_least_probability_rises_no_farther_than_it_may() -> None:
    """Else nothing would be left of images without third ones."""
    assert least_probability([np.full(40, 0.9)], 0.85, 0.985, 0.15) == 0.9
    assert least_probability([np.linspace(0.86, 0.96, 11)], 0.85, 0.985, 0.2) == pytest.approx(0.88)
    assert least_probability([np.linspace(0.86, 0.96, 11)], 0.85, 0.985, 1.0) == pytest.approx(0.96)
    assert least_probability([None], 0.85, 0.985, 0.93) == 0.85
