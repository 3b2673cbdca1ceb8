"""The ratio test from either image, against loops over every distance."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_nearest import GEOMETRY, descriptors, features

from aeromatch_cli.strategies.matchers.descriptors.bidirectional import Bidirectional
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Where
from aeromatch_cli.strategies.matchers.descriptors.nearest import Nearest


def squared_distances(d0, d1):
    return ((d0[:, None].astype(np.int64) - d1[None].astype(np.int64)) ** 2).sum(axis=2).astype(float)


def reference(squared, k0, k1, ratio):
    """Every rule by a loop: {(row, column): larger ratio}. squared: (D0, D1), infinite where a pair is not allowed."""

    def ratio_of(distances, keypoints, at):
        others = distances[keypoints != keypoints[at]]
        second = others.min(initial=np.inf)
        return 0.0 if np.isinf(second) else 1.0 if second == 0 else np.sqrt(distances[at] / second)

    found = {}
    for i in range(len(squared)):
        j = int(squared[i].argmin())
        if np.isfinite(squared[i, j]) and squared[:, j].argmin() == i:
            larger = max(ratio_of(squared[i], k1, j), ratio_of(squared[:, j], k0, i))
            if larger < ratio:
                found[i, j] = larger
    return found


def scanned(strategy, first, second, where=None):
    found = strategy.scan(Comparison(first, second, GEOMETRY, np.ones((1, 1), bool), where))
    return {(int(i), int(j)): cost for i, j, cost in zip(found.rows, found.columns, found.costs, strict=True)}


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 150), st.integers(1, 40), st.sampled_from([5, 60, 120]))
def test_equals_brute_force(seed, count0, count1, noise):
    rng = np.random.default_rng(seed)
    d0 = descriptors(rng, count0, 0)
    d1 = descriptors(rng, count1, noise, d0)
    k0, k1 = (np.unique(rng.integers(0, c // 2 + 1, c), return_inverse=True)[1] for c in (count0, count1))
    k0, k1 = np.sort(k0), np.sort(k1)
    expected = reference(squared_distances(d0, d1), k0, k1, 0.85)
    assert scanned(Bidirectional(), features(d0, k0), features(d1, k1)) == pytest.approx(expected)


class _Forms:
    """Windows that are known by their linear forms alone."""

    def __init__(self, forms):
        self._forms = forms

    def forms(self):
        return self._forms


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 150), st.integers(1, 60))
def test_windows_hide_rivals_of_either_image(seed, count0, count1):
    rng = np.random.default_rng(seed)
    d0 = descriptors(rng, count0, 0)
    d1 = descriptors(rng, count1, 100, d0)
    forms, places = rng.normal(size=(count0, 2, 3)) * [0.02, 0.02, 1.0], rng.uniform(0, 50, (count1, 2))
    inside = (np.abs(forms @ np.column_stack([places, np.ones(count1)]).T) <= 1.0).all(axis=1)
    squared = np.where(inside, squared_distances(d0, d1), np.inf)
    expected = reference(squared, np.arange(count0), np.arange(count1), 0.9)
    found = scanned(Bidirectional(ratio=0.9), features(d0), features(d1), Where(_Forms(forms), places))
    assert found == pytest.approx(expected)


def test_a_thing_that_image_0_has_twice_is_no_match():
    """What image 1 shows once is unambiguous from image 0, and only from there."""
    rng = np.random.default_rng(2)
    base = descriptors(rng, 30, 0)
    twins = np.concatenate([descriptors(rng, 30, 5, base), descriptors(rng, 10, 5, base)])
    matches = [one()(features(twins), features(base), GEOMETRY).indices for one in (Nearest, Bidirectional)]
    assert [len(m) for m in matches] == [30, 20]
    assert matches[1].tolist() == [[k, k] for k in range(10, 30)]


def test_the_result_does_not_depend_on_which_image_comes_first():
    rng = np.random.default_rng(6)
    base = descriptors(rng, 300, 0)
    first, second = features(base), features(descriptors(rng, 300, 90, base)[::-1])
    there = Bidirectional()(first, second, GEOMETRY)
    back = Bidirectional()(second, first, GEOMETRY)
    assert len(there.indices) > 200
    assert sorted(map(tuple, there.indices.tolist())) == sorted((i, j) for j, i in back.indices.tolist())
    assert sorted(there.scores.tolist()) == sorted(back.scores.tolist())


def test_learned_descriptors_as_bytes_match_like_themselves():
    """round(128 + 256 d), clipped, of unit vectors keeps their distances."""
    rng = np.random.default_rng(3)
    unit = rng.standard_normal((400, 128))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    other = unit[::-1] + 0.05 * rng.standard_normal((400, 128))
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    of_floats, of_bytes = (
        Bidirectional()(*(features(store(d)) for d in (unit, other)), GEOMETRY)
        for store in (
            lambda d: d.astype(np.float32),
            lambda d: np.clip(np.round(128 + 256 * d), 0, 255).astype(np.uint8),
        )
    )
    assert np.array_equal(of_floats.indices, of_bytes.indices)
    assert of_bytes.indices.tolist() == [[k, 399 - k] for k in range(400)]
    assert np.abs(of_floats.scores - of_bytes.scores).max() < 0.02


def test_matches_of_several_views_are_one_to_one():
    rng = np.random.default_rng(4)
    base = descriptors(rng, 40, 0)
    views = {
        "view_idx": (np.arange(40) >= 20).astype(np.int32),
        "view_directions": np.array([[0, 0, -1], [0.6, 0, -0.8]], np.float32),
        "view_gsd_m": np.array([0.1, 0.1], np.float32),
        "view_angles_deg": np.array([0.0, 37.0], np.float32),
        "view_sizes_px": np.array([[100, 80]] * 2, np.int32),
        "view_enhanced": np.zeros(2, bool),
    }
    side = replace(features(base), **views)
    matches = Bidirectional()(side, side, GEOMETRY)
    assert matches.indices.tolist() == [[k, k] for k in range(40)]
    assert matches.view_pairs.tolist() == [[0, 0]] * 20 + [[1, 1]] * 20
