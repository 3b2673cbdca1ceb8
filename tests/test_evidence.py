"""What steps of a cascade have found of a pair: when it is enough, and what a further step is expected to find."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeromatch_cli.stages.pair_statistics import PairStatistics, columns, expected_number, fitted_weights, log_error
from aeromatch_cli.strategies.steps import GuidedSearch, LearnedFeatures, Step

MANY = 8000
# A pair of a nadir block with enough matches.
USUAL = PairStatistics(700, 0.6, 0.9, 4000, 1200, 20.0)
STEP = LearnedFeatures(below_matches=600, below_coverage=0.7)


class Unforeseen(Step):
    """A step for which no weights have been found."""

    name: str = "unforeseen"


def _short(verified: int, enough: int, percent: int) -> str:
    return f"{verified} verified matches of {enough} that are enough for an overlap of {percent} % of the image"


@pytest.mark.parametrize(
    ("evidence", "reason"),
    [
        (PairStatistics(300, 0.5, 0.9, MANY), ""),
        (PairStatistics(299, 0.5, 0.9, MANY), _short(299, 300, 50)),
        (PairStatistics(60, 0.2, 0.1, MANY), ""),
        (PairStatistics(59, 0.2, 0.1, MANY), _short(59, 60, 20)),
        (PairStatistics(29, 0.01, 1.0, MANY), _short(29, 30, 1)),
        (PairStatistics(900, 0.5, 0.55, MANY), "verified matches in 55 % of the overlap"),
        (PairStatistics(600, np.nan, np.nan, MANY), ""),
        (
            PairStatistics(599, float("nan"), float("nan"), MANY),
            "599 verified matches of 600 that are enough, overlap unknown",
        ),
        (PairStatistics(30, 0.0, np.nan, MANY), "30 verified matches of 600 that are enough, no overlap predicted"),
        # A quarter of 2000 keypoints, a quarter of the matches.
        (PairStatistics(75, 0.5, 0.9, 500), ""),
        (PairStatistics(74, 0.5, 0.9, 500), _short(74, 75, 50)),
    ],
)
def test_a_pair_goes_on_where_it_falls_short_of_its_overlap(evidence: PairStatistics, reason: str) -> None:
    assert evidence.lacks(STEP) == reason


@pytest.mark.parametrize(("keypoints", "nothing"), [(0, True), (29, True), (30, False)])
def test_an_image_without_keypoints_shows_nothing(keypoints: int, nothing: bool) -> None:
    assert PairStatistics(0, 0.5, 0.0, keypoints).shows_nothing == nothing


def test_nothing_is_expected_where_overlap_or_angle_are_unknown_or_the_step_has_no_weights() -> None:
    for unknown in ({"overlap": np.nan}, {"overlap": 0.0}, {"angle_deg": np.nan}):
        assert columns(replace(USUAL, **unknown), 4000) is None
        assert np.isnan(replace(USUAL, **unknown).expected(STEP, 4000))
    assert np.isnan(USUAL.expected(Unforeseen(), 4000))
    assert np.isfinite(USUAL.expected(GuidedSearch(), 4000))


def test_weights_of_an_exact_law_are_found_again() -> None:
    """After = 3 x (verified + 10)^0.5 x (keypoints in the overlap + 10)^0.25."""
    rng = np.random.default_rng(3)
    pairs = [
        PairStatistics(int(n), float(s), 0.9, int(k), 0, float(a))
        for n, s, k, a in zip(
            rng.integers(0, 3000, 400), rng.uniform(0.1, 1, 400), rng.integers(100, 8000, 400),
            rng.uniform(0, 90, 400), strict=True,
        )
    ]  # fmt: skip
    after = [3.0 * (p.verified + 10.0) ** 0.5 * (p.keypoints * p.overlap + 10.0) ** 0.25 - 10.0 for p in pairs]
    known = [columns(pair, 2000) for pair in pairs]
    weights = fitted_weights([one for one in known if one is not None], after)
    assert weights[1:4] == pytest.approx([0.5, 0.25, 0.0], abs=0.01)
    expected = np.array([expected_number(one, weights) for one in known if one is not None])
    assert np.abs(log_error(expected, np.array(after))).max() < 0.03


@given(st.integers(0, 5000), st.floats(0.05, 1.0), st.integers(30, MANY), st.floats(0.0, 90.0))
def test_more_matches_promise_more_after_the_step(verified: int, overlap: float, keypoints: int, angle: float) -> None:
    pair = PairStatistics(verified, overlap, 0.9, keypoints, 0, angle)
    for step in (GuidedSearch(), LearnedFeatures()):
        expected = pair.expected(step, 4000)
        assert 0.0 <= expected < replace(pair, verified=verified + 50).expected(step, 4000)
        assert expected >= (verified if step.own_features else 0)


def test_nothing_is_expected_of_images_that_show_nothing() -> None:
    for keypoints in (0, 29):
        assert np.isnan(replace(USUAL, verified=0, keypoints=keypoints).expected(STEP, 4000))


def test_no_more_keypoints_are_expected_than_a_picture_holds() -> None:
    """One for a hundred pixels: 480 x 360 have 1728, however many are allowed."""
    small = replace(USUAL, verified=300, pixels=480 * 360)
    assert small.expected(STEP, 4000) == small.expected(STEP, 1728) > small.expected(STEP, 1500)


def test_learned_features_are_expected_to_bring_more_where_sift_finds_few_keypoints() -> None:
    """1.4 to 1.9 times as many on rendered ground that SIFT can see, 2.2 and more on farmland, where it has a third of
    the keypoints."""
    gains = [replace(USUAL, keypoints=k).expected(LearnedFeatures(), 2000) / USUAL.verified for k in (4000, 1300)]
    assert 1.3 < gains[0] < 1.9
    assert gains[1] > 1.4 * gains[0]


def test_a_pair_with_enough_takes_a_step_that_is_expected_to_bring_much_more() -> None:
    poor = replace(USUAL, verified=400, keypoints=1500, sought=4000)
    assert not poor.lacks(STEP)
    expected = poor.expected(STEP, 4000)
    gain = expected / poor.verified - 1.0
    asks, rests = (STEP.model_copy(update={"large_gain": gain + off}) for off in (-0.01, 0.01))
    about = float(f"{expected:.2g}")
    assert poor.asks_for(asks, 4000) == f"enough with 400 verified matches, but about {about:.0f} expected after it"
    assert poor.asks_for(rests, 4000) == ""
    # Where the first step finds what it looks for, and in small overlaps, it is enough.
    eager = STEP.model_copy(update={"large_gain": 0.0})
    assert poor.asks_for(eager, 4000)
    for changed in ({"sought": 2000}, {"pixels": 1500 * 75.0}, {"overlap": 0.39}):
        assert replace(poor, **changed).asks_for(eager, 4000) == ""
    # Twice as many as are enough are plenty.
    plenty = replace(poor, verified=2 * poor.enough(STEP))
    assert plenty.asks_for(eager, 4000) == ""


def test_what_a_lacking_pair_is_expected_to_have_is_said() -> None:
    lacking = replace(USUAL, verified=100)
    words = _short(100, 360, 60)
    assert lacking.lacks(STEP) == words
    about = float(f"{lacking.expected(STEP, 4000):.2g}")
    assert lacking.asks_for(STEP, 4000) == f"{words}, about {about:.0f} expected after it"
    assert lacking.asks_for(Unforeseen(below_matches=600), 4000) == words
