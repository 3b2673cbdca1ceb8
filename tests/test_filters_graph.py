"""Neighbourhood consistency on matches whose truth is known: affine patches, two depth layers, houses, chance."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from make_matches import GEOMETRY, chance, houses

from aeromatch_cli.data import Camera, Candidates, Verdict
from aeromatch_cli.geometry.affinities import joint_places, local_support, nearest_matches
from aeromatch_cli.strategies.filters import apply_chain
from aeromatch_cli.strategies.filters.graph import Graph
from aeromatch_cli.strategies.filters.poselib import Poselib

PINHOLE = Camera("SIMPLE_PINHOLE", 1000, 750, (900.0, 500.0, 375.0))
PLAIN = replace(GEOMETRY, camera0=PINHOLE, camera1=PINHOLE)


def patches(count, wrong, seed, noise_px=0.5):
    """Four patches of 450 x 325 px that map by affinities of their own: matches, and which are true."""
    rng = np.random.default_rng(seed)
    points0 = rng.uniform([0, 0], [1000, 750], (count, 2))
    patch = (points0[:, 0] > 500) + 2 * (points0[:, 1] > 375)
    linear = np.eye(2) + rng.uniform(-0.35, 0.35, (4, 2, 2))
    shift = rng.uniform(-80, 80, (4, 2))
    points1 = np.einsum("nij,nj->ni", linear[patch], points0 - [500, 375]) + [500, 375] + shift[patch]
    points1 += rng.normal(0, noise_px, (count, 2))
    true = rng.random(count) >= wrong
    points1[~true] = rng.uniform([0, 0], [1000, 750], ((~true).sum(), 2))
    return points0, points1, true


def kept(points0, points1, **settings_given):
    return Graph(**settings_given)(Candidates(points0, points1), PLAIN, 0).keep


@pytest.mark.parametrize("wrong", [0.2, 0.5, 0.7])
def test_patches_that_move_by_affinities_stay_and_the_wrong_go(wrong):
    for seed in range(5):
        points0, points1, true = patches(1500, wrong, seed)
        keep = kept(points0, points1)
        assert keep[true].mean() > 0.97
        assert keep[~true].mean() < 0.05


@pytest.mark.parametrize("count", [100, 400, 20000])
def test_few_and_many_matches(count):
    points0, points1, true = patches(count, 0.4, seed=1)
    keep = kept(points0, points1)
    assert keep[true].mean() > 0.94
    assert keep[~true].mean() < 0.06


def test_two_layers_that_lie_over_each_other_stay():
    """Street and, 60 px away in image 1, strips of roofs 60 px wide, matches 25 px apart: neighbourhoods see both."""
    rng = np.random.default_rng(2)
    points0 = rng.uniform([0, 0], [1000, 750], (2000, 2))
    roof = points0[:, 0] % 180 < 60
    points1 = points0 * [0.9, 1.1] + np.where(roof[:, None], [60.0, 10.0], 0.0) + rng.normal(0, 0.5, (2000, 2))
    true = rng.random(2000) >= 0.4
    points1[~true] = rng.uniform([0, 0], [1000, 750], ((~true).sum(), 2))
    keep = kept(points0, points1)
    assert keep[true & roof].mean() > 0.92
    assert keep[true & ~roof].mean() > 0.95
    assert keep[~true].mean() < 0.02
    assert kept(points0, points1, min_support_share=0.5)[true & roof].mean() > 0.95


def test_a_strip_of_a_few_matches_on_a_roof_stays():
    """Eight matches along a roof, in the middle of a street that moves otherwise."""
    rng = np.random.default_rng(3)
    street = rng.uniform([0, 0], [1000, 750], (800, 2))
    roof = np.column_stack([np.linspace(480, 520, 8), 375 + rng.uniform(-15, 15, 8)])
    points0 = np.concatenate([street, roof])
    points1 = points0 + np.where(np.arange(808)[:, None] < 800, [0.0, 0.0], [35.0, -8.0]) + rng.normal(0, 0.3, (808, 2))
    keep = kept(points0, points1)
    assert keep[800:].sum() >= 7
    assert keep[:800].mean() > 0.98


def test_what_is_off_by_more_than_the_threshold_among_true_ones_goes():
    rng = np.random.default_rng(4)
    points0, points1, _ = patches(1500, 0.0, seed=4, noise_px=0.3)
    off = rng.random(1500) < 0.05
    angle = rng.uniform(0, 2 * np.pi, off.sum())
    points1[off] += 8.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    keep = kept(points0, points1)
    assert keep[off].mean() < 0.1
    assert keep[~off].mean() > 0.98


def test_before_poselib_the_graph_takes_what_lies_on_the_line_by_chance():
    alone, together = np.zeros(2), np.zeros(2)
    for seed in range(3):
        scene = houses(1400, wrong=0.6, seed=seed)
        for counts, chain in ((alone, [Poselib()]), (together, [Graph(), Poselib()])):
            verdict = apply_chain(chain, scene.candidates, GEOMETRY, seed)
            assert verdict.state == "verified"
            counts += verdict.keep[scene.true].sum(), verdict.keep[~scene.true].sum()
    # The roofs here hold six matches each: some of these have too few neighbours of their own.
    assert together[0] > 0.92 * alone[0]
    assert together[1] < 0.2 * alone[1]


def test_behind_poselib_the_pair_stays_verified():
    scene = houses(1400, wrong=0.6, seed=5)
    verdict = apply_chain([Poselib(), Graph()], scene.candidates, GEOMETRY, 0)
    alone = apply_chain([Poselib()], scene.candidates, GEOMETRY, 0)
    assert verdict.state == "verified"
    assert verdict.model_kind == "E"
    assert verdict.keep[scene.true].sum() > 0.92 * alone.keep[scene.true].sum()
    assert verdict.keep[~scene.true].sum() < 0.2 * alone.keep[~scene.true].sum()
    assert verdict.rejected["graph"] == (alone.keep & ~verdict.keep).sum()


@pytest.mark.parametrize("count", [0, 1, 2, 5, 19])
def test_small_sets_pass_unchanged(count):
    verdict = Graph()(chance(count, 0), GEOMETRY, 0)
    assert verdict.keep.all()
    assert verdict.keep.shape == (count,)
    assert verdict.state == "not verifiable"
    many = {1: "1 match is"}.get(count, f"{count} matches are")
    assert verdict.reason == f"{many} too few to compare with their neighbours"


@pytest.mark.parametrize("count", [60, 2000])
def test_where_next_to_nothing_is_supported_everything_passes(count):
    verdict = Graph()(chance(count, 1), GEOMETRY, 0)
    assert verdict.keep.all()
    assert verdict.state == "not verifiable"
    assert f"of {count} matches move with their neighbours" in verdict.reason


def test_points_without_a_ray_are_dropped():
    points0, points1, _ = patches(300, 0.0, seed=6)
    folding = Camera("SIMPLE_RADIAL", 1000, 750, (900.0, 500.0, 375.0, -0.5))
    points0[:5] = [90000.0, 90000.0]
    keep = Graph()(Candidates(points0, points1), replace(PLAIN, camera0=folding), 0).keep
    assert not keep[:5].any()
    assert keep[5:].any()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.integers(20, 300), st.floats(0.0, 0.8))
def test_neither_the_order_nor_a_shift_of_either_image_matters(seed, count, wrong):
    points0, points1, _ = patches(count, wrong, seed)
    # Whole numbers shift without rounding.
    points0, points1 = np.round(64.0 * points0) / 64.0, np.round(64.0 * points1) / 64.0
    order = np.random.default_rng(seed).permutation(count)
    before = kept(points0, points1)
    assert np.array_equal(kept(points0[order], points1[order]), before[order])
    shifted = kept(points0 + np.array([256.0, -128.0]), points1 + np.array([64.0, 512.0]))
    assert (shifted == before).mean() > 0.98  # a place within rounding of a tie may count otherwise


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(3, 40), st.integers(2, 12))
def test_support_equals_loops(seed, count, neighbours):
    """Every two neighbours, every third one, by loops."""
    rng = np.random.default_rng(seed)
    points0 = rng.uniform(0, 60, (count, 2))
    points1 = points0 @ (np.eye(2) + rng.uniform(-0.2, 0.2, (2, 2))) + rng.normal(0, 1.0, (count, 2))
    around = nearest_matches(joint_places(points0, points1), neighbours)
    support, weights = local_support(points0, points1, around, 3.0)
    expected = np.zeros(count)
    for i in range(count):
        a, b = points0[around[i]] - points0[i], points1[around[i]] - points1[i]
        for first in range(len(a)):
            for second in range(first):
                longer = max(a[first] @ a[first], a[second] @ a[second])
                area0, area1 = (m[second, 0] * m[first, 1] - m[second, 1] * m[first, 0] for m in (a, b))
                if abs(area0) > 0.1 * longer and area0 * area1 > 0.0:
                    affinity = np.linalg.solve(a[[second, first]], b[[second, first]])
                    squared = ((a @ affinity - b) ** 2).sum(axis=1)
                    expected[i] = max(expected[i], np.maximum(1.0 - squared / 9.0, 0.0).sum() - 2.0)
    assert support == pytest.approx(expected, abs=2e-3)
    assert (weights.sum(axis=1) - 2.0)[support > 0] == pytest.approx(support[support > 0], abs=1e-4)


def test_neighbours_of_matches_at_one_place_are_others():
    places = np.concatenate([np.zeros((5, 4)), np.arange(12.0).reshape(3, 4)])
    around = nearest_matches(places, 3)
    assert around.shape == (8, 3)
    assert (around != np.arange(8)[:, None]).all()
    assert nearest_matches(places[:1], 3).shape == (1, 0)


def among_true(places0, places1):
    """600 true matches, and such places besides."""
    rng = np.random.default_rng(5)
    true = rng.uniform([0, 0], [1000, 750], (600, 2))
    there = true + np.array([30.0, 10.0]) + rng.normal(0, 0.5, true.shape)
    return np.concatenate([true, places0]), np.concatenate([there, places1])


def test_what_falls_together_on_one_spot_goes_whichever_image_comes_first():
    rng = np.random.default_rng(0)
    scattered, spot = rng.uniform([300, 200], [550, 450], (100, 2)), rng.uniform([700, 600], [712, 612], (100, 2))
    points0, points1 = among_true(scattered, spot)
    assert kept(points0, points1)[600:].mean() < 0.05
    assert kept(points0, points1)[:600].mean() > 0.98
    assert np.array_equal(kept(points0, points1), kept(points1, points0))


def test_mirrored_neighbourhoods_go():
    there = np.random.default_rng(0).uniform([300, 200], [400, 300], (60, 2))
    assert not kept(*among_true(there, there * [-1, 1] + [1200, 300]))[600:].any()


def test_support_that_cannot_be_had_is_refused():
    with pytest.raises(ValueError, match="min_support 10 is never reached: 12 neighbours support by at most 10"):
        Graph(min_support=10)


class First:
    """Leaves so many of the matches, and says nothing of the pair."""

    name = "first"

    def __init__(self, count):
        self.count = count

    def __call__(self, candidates, geometry, seed):
        return Verdict(keep=np.arange(len(candidates)) < self.count, state="not verifiable")


def test_what_later_filters_leave_must_be_beyond_chance_too():
    candidates = houses(1400, wrong=0.5, seed=5).candidates
    few = apply_chain([Poselib(), First(20)], candidates, GEOMETRY, 0)
    assert few.state == "rejected"
    assert few.reason == "20 inliers of 1400 matches are no more than chance gives"
    assert not few.keep.any()
    assert sum(few.rejected.values()) == 1400
    enough = apply_chain([Poselib(), First(60)], candidates, GEOMETRY, 0)
    assert enough.state == "verified"
    assert enough.keep.sum() == 60
