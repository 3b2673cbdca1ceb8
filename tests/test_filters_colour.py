"""Colour as evidence: gains, white balance and shadow survive, other colours do not."""

import numpy as np
import pytest

from aeromatch_cli.config import load
from aeromatch_cli.data import Candidates, Pair, PairGeometry
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.strategies.filters.clustered_ransac import dominant_colours
from aeromatch_cli.strategies.filters.colour import Colour, chromaticity_distances

ROOF, LAWN, STREET, WATER = (150, 70, 50), (80, 120, 60), (120, 120, 115), (40, 70, 110)
NOWHERE = PairGeometry(Pair("a", "b", 0.5, 10.0, "overlap"), None, None, None, None, None)


def coloured(colours0, colours1):
    places = np.zeros((len(colours0), 2))
    return Candidates(places, places, np.asarray(colours0, np.uint8), np.asarray(colours1, np.uint8))


def ground(count, seed=0):
    """Colours of places, with the texture and noise of real ones."""
    rng = np.random.default_rng(seed)
    kinds = np.array([ROOF, LAWN, STREET, WATER])[rng.integers(0, 4, count)]
    return kinds * rng.lognormal(0, 0.15, (count, 1)), rng


def seen(colours, rng, gain=(1.0, 1.0, 1.0)):
    return np.clip(colours * gain + rng.normal(0, 2, colours.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("gain", [(1, 1, 1), (1.5, 1.5, 1.5), (0.35, 0.35, 0.35), (1.2, 1.0, 0.75), (0.5, 0.4, 0.6)])
def test_exposure_and_white_balance_cost_nothing(gain):
    colours, rng = ground(400)
    verdict = Colour()(coloured(seen(colours, rng), seen(colours, rng, gain)), NOWHERE, 0)
    assert verdict.keep.mean() >= 0.98
    assert verdict.state == "not verifiable"


def test_lit_against_shadow_costs_nothing():
    colours, rng = ground(400, seed=1)
    light = np.where(rng.random((400, 1)) < 0.4, [0.42, 0.45, 0.5], [1.0, 1.0, 1.0])
    verdict = Colour()(coloured(seen(colours, rng), seen(colours * light, rng)), NOWHERE, 0)
    assert verdict.keep.mean() >= 0.98


def test_other_colours_are_dropped():
    colours, rng = ground(600, seed=2)
    wrong = rng.random(600) < 0.4
    partner = colours.copy()
    partner[wrong] = rng.permutation(colours[wrong])
    kept = Colour()(coloured(seen(colours, rng), seen(partner, rng, (0.7, 0.8, 0.6))), NOWHERE, 0).keep
    assert kept[~wrong].mean() >= 0.98
    assert kept[wrong].mean() < 0.7  # some are of the same kind by chance


def test_gray_pictures_pass():
    grey = np.random.default_rng(3).integers(0, 255, (200, 1)).repeat(3, axis=1)
    assert Colour()(coloured(grey, grey[::-1]), NOWHERE, 0).keep.all()


@pytest.mark.parametrize("count", [0, 1, 7])
def test_few_matches_pass(count):
    colours, rng = ground(count)
    assert Colour()(coloured(seen(colours, rng), seen(colours[::-1], rng)), NOWHERE, 0).keep.all()


def test_without_colours_everything_passes():
    verdict = Colour()(Candidates(np.zeros((30, 2)), np.zeros((30, 2))), NOWHERE, 0)
    assert verdict.keep.all()
    assert verdict.reason == "no colours to compare"


def test_the_distance_is_that_of_log_chromaticities():
    grey = np.full((9, 3), 100, np.uint8)
    other = grey.copy()
    other[0], other[1] = [100, 126, 100], [126, 100, 100]
    distances = chromaticity_distances(grey, other)
    log = np.log((126 + 16) / (100 + 16))
    assert distances[0] == pytest.approx(log * 2 / np.sqrt(6))
    assert distances[1] == pytest.approx(log * np.hypot(1 / np.sqrt(6), 0.5 / np.sqrt(2)))
    assert np.allclose(distances[2:], 0)


def test_colours_are_counted():
    assert dominant_colours(np.array([ROOF] * 50 + [LAWN] * 30 + [WATER] * 20)) == 3
    assert dominant_colours(np.array([ROOF] * 99 + [WATER])) == 1
    assert dominant_colours(np.zeros((0, 3))) == 1


def test_the_filter_needs_colours_and_another_that_verifies():
    with pytest.raises(ConfigError, match=r"extract\.colours"):
        load("default", ["filter=colour+poselib"])
    with pytest.raises(ConfigError, match=r"use colour\+poselib with extract.colours=true"):
        load("default", ["filter=colour", "extract.colours=true"])
    chain = load("default", ["filter=colour+clustered-ransac+epipolar", "extract.colours=true"]).filter
    assert [one.name for one in chain] == ["colour", "clustered-ransac", "epipolar"]
