"""Mutual nearest neighbours against a brute-force reference."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from aeromatch_cli.data import Features, Pair, PairGeometry
from aeromatch_cli.geometry.cameras import from_colmap
from aeromatch_cli.strategies.matchers import MATCHERS
from aeromatch_cli.strategies.matchers.descriptors import scan
from aeromatch_cli.strategies.matchers.descriptors.assignment import distinct, one_to_one
from aeromatch_cli.strategies.matchers.descriptors.bidirectional import Bidirectional
from aeromatch_cli.strategies.matchers.descriptors.nearest import Nearest
from aeromatch_cli.strategies.matchers.descriptors.scan import Limits, mutual_nearest
from aeromatch_cli.strategies.matchers.descriptors.search import comparable_views

CAMERA = from_colmap("SIMPLE_PINHOLE", 100, 80, (90.0, 50.0, 40.0))
GEOMETRY = PairGeometry(Pair("a", "b", 0.5, 0.0, "overlap"), CAMERA, CAMERA, None, None, None)


def reference(d0, d1, k1, ratio):
    """Every distance in exact integers, every rule by a loop."""
    a, b = d0.astype(np.int64), d1.astype(np.int64)
    squared = ((a[:, None, :] - b[None, :, :]) ** 2).sum(axis=2)
    found = []
    for i in range(len(a)):
        j = int(squared[i].argmin())
        if squared[:, j].min() != squared[i, j] or j in [c for _, c in found]:
            continue
        others = squared[i][k1 != k1[j]]
        passes = len(others) == 0 or (others.min() > 0 and np.sqrt(squared[i, j] / others.min()) < ratio)
        if passes:
            found.append((i, j))
    return found


def descriptors(rng, count, noise, base=None):
    fresh = rng.integers(0, 256, (count, 128))
    if base is not None:
        n = min(count, len(base))
        fresh[:n] = np.clip(base[:n].astype(int) + rng.integers(-noise, noise + 1, (n, 128)), 0, 255)
    return fresh.astype(np.uint8)


def features(described, keypoint_idx=None):
    count = len(described)
    keypoint_idx = np.arange(count) if keypoint_idx is None else np.asarray(keypoint_idx)
    keypoints = np.random.default_rng(0).uniform(0, 80, (int(keypoint_idx.max(initial=-1)) + 1, 2)).astype(np.float32)
    zeros = np.zeros(count, np.float32)
    return Features(
        keypoints_px=keypoints,
        sizes_px=np.ones(len(keypoints), np.float32),
        responses=np.ones(len(keypoints), np.float32),
        descriptors=described,
        descriptor_keypoint_idx=keypoint_idx.astype(np.int32),
        view_idx=np.zeros(count, np.int32),
        view_keypoints_px=keypoints[keypoint_idx],
        view_size_px=zeros,
        view_orientation_deg=zeros,
        view_sizes_px=np.array([[100, 80]], np.int32),
        view_angles_deg=np.zeros(1, np.float32),
        view_directions=np.full((1, 3), np.nan, np.float32),
        view_gsd_m=np.full(1, np.nan, np.float32),
        view_enhanced=np.zeros(1, bool),
    )


@pytest.fixture(params=[True, False], ids=["bytes", "float32"])
def arithmetic(request, monkeypatch):
    """Both ways to multiply; the byte way only where this processor has it."""
    if request.param and not scan._has_integer_product():
        pytest.skip("no byte product on this processor")
    monkeypatch.setattr(scan, "_has_integer_product", lambda: request.param)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 150), st.integers(1, 40), st.sampled_from([5, 60, 120]))
def test_equals_brute_force(seed, count0, count1, noise):
    rng = np.random.default_rng(seed)
    d0 = descriptors(rng, count0, 0)
    d1 = descriptors(rng, count1, noise, d0)
    k1 = np.sort(rng.integers(0, max(1, count1 // 2), count1))
    rows, columns, ratios = mutual_nearest(d0, d1, k1, ratio=0.8)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == reference(d0, d1, k1, 0.8)
    assert (ratios < 0.8).all()


def test_both_arithmetics_are_exact(arithmetic):
    rng = np.random.default_rng(7)
    # Bytes at their limits make the largest sums.
    d0 = np.where(rng.random((300, 128)) < 0.5, 0, 255).astype(np.uint8)
    d1 = d0[:200] ^ (rng.random((200, 128)) < 0.1).astype(np.uint8) * 255
    rows, columns, _ = mutual_nearest(d0, d1, np.arange(200), ratio=0.8)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == reference(d0, d1, np.arange(200), 0.8)
    assert len(rows) > 190


def test_a_byte_product_that_saturates_is_not_used(monkeypatch):
    # As oneDNN multiplies where it is held to AVX2: one side unsigned, neighbours added in 16 bits.
    def saturating(a, b):
        wide0, wide1 = a.numpy().astype(np.int64) + 128, b.numpy().astype(np.int64)
        pairs = wide0[:, 0::2, None] * wide1[None, 0::2] + wide0[:, 1::2, None] * wide1[None, 1::2]
        total = np.clip(pairs, -(2**15), 2**15 - 1).sum(axis=1) - 128 * wide1.sum(axis=0)
        return torch.from_numpy(total.astype(np.int32))

    monkeypatch.setattr(torch.cpu, "_is_vnni_supported", lambda: True)
    monkeypatch.setattr(torch, "_int_mm", lambda a, b: torch.from_numpy(a.numpy().astype(np.int32) @ b.numpy()))
    assert scan._has_integer_product.__wrapped__()
    monkeypatch.setattr(torch, "_int_mm", saturating)
    assert not scan._has_integer_product.__wrapped__()


def test_float_descriptors_are_matched_too():
    rng = np.random.default_rng(3)
    d0 = rng.standard_normal((150, 64)).astype(np.float32)
    d1 = d0[::-1] + 0.05 * rng.standard_normal((150, 64)).astype(np.float32)
    rows, columns, _ = mutual_nearest(d0, d1, np.arange(150), ratio=0.8)
    assert np.array_equal(columns, 149 - rows)
    assert len(rows) == 150


def test_matches_are_one_to_one_in_keypoints():
    rng = np.random.default_rng(1)
    base = descriptors(rng, 60, 0)
    # Every keypoint has two descriptors, and both find their partner.
    first, second = features(base, np.arange(60) // 2), features(descriptors(rng, 60, 8, base), np.arange(60) // 2)
    matches = Nearest()(first, second, GEOMETRY)
    assert np.array_equal(matches.indices, np.stack([np.arange(30)] * 2, axis=1))
    assert matches.indices.dtype == np.int32
    assert matches.view_pairs.shape == (30, 2)
    assert (matches.scores > 0.2).all()
    assert (matches.scores <= 1.0).all()


def test_the_runner_up_is_another_keypoint():
    rng = np.random.default_rng(2)
    base = descriptors(rng, 20, 0)
    twins = np.repeat(base, 2, axis=0)
    assert len(Nearest()(features(base), features(twins, np.arange(40) // 2), GEOMETRY).indices) == 20
    # The same descriptors as keypoints of their own are ambiguous.
    assert len(Nearest()(features(base), features(twins), GEOMETRY).indices) == 0


@pytest.mark.parametrize("matcher", [Nearest(), Bidirectional()])
@pytest.mark.parametrize(("count0", "count1"), [(0, 0), (0, 5), (5, 0), (1, 1)])
def test_few_descriptors_do_no_harm(matcher, count0, count1):
    d = descriptors(np.random.default_rng(0), 5, 0)
    matches = matcher(features(d[:count0]), features(d[:count1]), GEOMETRY)
    assert matches.indices.shape == (min(count0, count1), 2)
    assert matches.scores.shape == (min(count0, count1),)


def test_two_runs_are_equal_to_the_bit(arithmetic):
    rng = np.random.default_rng(5)
    base = descriptors(rng, 500, 0)
    pair = features(base), features(descriptors(rng, 450, 40, base))
    first, second = Nearest()(*pair, GEOMETRY), Nearest()(*pair, GEOMETRY)
    assert np.array_equal(first.indices, second.indices)
    assert np.array_equal(first.scores, second.scores)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8), st.integers(0, 5)), max_size=30))
def test_one_to_one_is_greedy(rows):
    idx0, idx1, costs = (np.array([row[k] for row in rows], dtype=np.int64) for k in range(3))
    expected, used0, used1 = [], set(), set()
    for k in np.argsort(costs, kind="stable").tolist():
        if idx0[k] not in used0 and idx1[k] not in used1:
            expected.append(k)
            used0.add(idx0[k])
            used1.add(idx1[k])
    assert sorted(one_to_one(idx0, idx1, costs.astype(float)).tolist()) == sorted(expected)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 60))
def test_distinct_matches_keep_the_cheapest_of_a_place(seed, count):
    rng = np.random.default_rng(seed)
    places, costs = rng.uniform(0, 4, (count, 4)), rng.integers(0, 9, count).astype(float)
    expected = []
    for k in np.argsort(costs, kind="stable").tolist():
        apart = np.linalg.norm((places[expected] - places[k]).reshape(-1, 2, 2), axis=2).max(axis=1, initial=0.0)
        if not len(expected) or not (apart <= 1.0).any():
            expected.append(k)
    assert distinct(places, costs, 1.0).tolist() == sorted(expected)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 150), st.integers(1, 40))
def test_limits_hide_what_lies_outside(seed, count0, count1):
    rng = np.random.default_rng(seed)
    d0 = descriptors(rng, count0, 0)
    d1 = descriptors(rng, count1, 60, d0)
    forms, places = rng.normal(size=(count0, 2, 3)) * [0.02, 0.02, 1.0], rng.uniform(0, 50, (count1, 2))
    inside = (np.abs(forms @ np.column_stack([places, np.ones(count1)]).T) <= 1.0).all(axis=1)
    rows, columns, ratios = mutual_nearest(d0, d1, np.arange(count1), ratio=1.0, limits=Limits(forms, places))
    squared = np.where(inside, ((d0[:, None].astype(int) - d1[None]) ** 2).sum(axis=2).astype(float), np.inf)
    assert inside[rows, columns].all()
    mutual = [
        (i, int(row.argmin()))
        for i, row in enumerate(squared)
        if np.isfinite(row.min()) and squared[:, row.argmin()].argmin() == i
    ]
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == mutual
    second = np.sort(np.pad(squared[rows], ((0, 0), (0, 1)), constant_values=np.inf), axis=1)[:, 1]
    assert np.allclose(ratios, np.sqrt(squared[rows, columns] / second))


def test_places_that_are_unknown_lie_outside_every_limit():
    d0, d1 = np.eye(2, 128, dtype=np.float32), np.eye(2, 128, dtype=np.float32)
    anywhere = np.zeros((2, 2, 3))
    for forms, places in (
        (anywhere, [[np.nan, 0.0], [0.0, 0.0]]),
        (np.where([[[True]], [[False]]], np.nan, anywhere), [[0.0, 0.0], [0.0, 0.0]]),
        (np.where([[[True]], [[False]]], np.inf, anywhere), [[0.0, 0.0], [0.0, 0.0]]),
    ):
        rows, columns, _ = mutual_nearest(d0, d1, np.arange(2), ratio=0.9, limits=Limits(forms, np.array(places)))
        assert list(zip(rows, columns, strict=True)) == [(1, 1)]


def test_views_of_like_direction_are_compared():
    down, tilted = [0.0, 0.0, -1.0], [np.sin(0.6), 0.0, -np.cos(0.6)]
    one = features(np.zeros((0, 128), np.uint8))

    def seen(directions, gsd_m, angles_deg):
        arrays = (np.array(values, np.float32) for values in (directions, gsd_m, angles_deg))
        named = dict(zip(("view_directions", "view_gsd_m", "view_angles_deg"), arrays, strict=True))
        return replace(one, **named, view_enhanced=np.zeros(len(gsd_m), bool))

    nan = np.nan
    first = seen([tilted, down, tilted], [nan, 0.1, 0.1], [0.0, 34.0, 0.0])
    second = seen([down, down], [nan, 0.2], [0.0, 0.0])
    # Source with source whatever their directions, the ground view with the ground view, the tilted one with none.
    assert comparable_views(first, second, 5.0).tolist() == [[True, False], [False, True], [False, False]]
    assert comparable_views(first, second, 40.0).tolist() == [[True, False], [False, True], [False, True]]
    unknown = seen([[nan] * 3], [nan], [0.0])
    assert comparable_views(first, unknown, 5.0).all()


def test_view_pairs_say_which_views_found_a_match():
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
    matches = Nearest()(replace(features(base), **views), replace(features(base), **views), GEOMETRY)
    assert len(matches.indices) == 40
    assert matches.view_pairs.tolist() == [[0, 0]] * 20 + [[1, 1]] * 20


@pytest.mark.parametrize("same_light", [True, False])
@pytest.mark.parametrize("both_enhanced", [True, False])
def test_a_pair_uses_the_pictures_that_agree(same_light, both_enhanced):
    """40 places as taken and 40 enhanced: those of one kind have equal descriptors in both images."""
    rng = np.random.default_rng(8)
    ground, (border0, border1) = descriptors(rng, 40, 0), (descriptors(rng, 40, 0), descriptors(rng, 40, 0))
    taken0, taken1 = (ground, ground) if same_light else (border0, border1)
    other0, other1 = (border0, border1) if same_light else (ground, ground)

    def image(taken, enhanced):
        views = {
            "view_idx": (np.arange(len(taken) + len(enhanced)) >= len(taken)).astype(np.int32),
            "view_directions": np.array([[0, 0, -1]] * 2, np.float32),
            "view_gsd_m": np.array([0.1, 0.1], np.float32),
            "view_angles_deg": np.zeros(2, np.float32),
            "view_sizes_px": np.array([[100, 80]] * 2, np.int32),
            "view_enhanced": np.array([False, len(enhanced) > 0]),
        }
        return replace(features(np.concatenate([taken, enhanced])), **views)

    # Where nothing is enhanced in image 1, as when it has no shadow, its only picture stands for both.
    second = image(taken1, other1) if both_enhanced else image(ground, ground[:0])
    matches = Nearest()(image(taken0, other0), second, GEOMETRY)
    assert len(matches.indices) == 40
    expected = [0 if same_light else 1, 0 if same_light or not both_enhanced else 1]
    assert matches.view_pairs.tolist() == [expected] * 40


def test_the_table_names_its_classes():
    assert set(MATCHERS) == {"nearest", "bidirectional", "lightglue", "lightglue-learned", "lightglue-aliked", "polar"}
    assert all(MATCHERS[name].model_fields["name"].default == name for name in MATCHERS)


@pytest.mark.parametrize("capable", [True, False])
def test_torch_is_loaded_for_many_products_alone(monkeypatch: pytest.MonkeyPatch, capable: bool) -> None:
    monkeypatch.delitem(sys.modules, "torch")
    monkeypatch.setattr(scan, "_WORK", scan._Work())
    monkeypatch.setattr(scan, "_may_multiply_bytes", lambda: capable)
    pair = 8000 * 8000
    asked = [scan._worth_torch(pair) for _ in range(20)]
    assert asked == [capable and number * pair > 1_000_000_000 for number in range(1, 21)]
    monkeypatch.setitem(sys.modules, "torch", torch)
    assert scan._worth_torch(1)


def test_torch_is_loaded_at_once_where_many_pairs_are_expected(monkeypatch: pytest.MonkeyPatch) -> None:
    """8,000 descriptors an image: 64 million products a pair, a billion after the 16th."""
    monkeypatch.setattr(scan, "_may_multiply_bytes", lambda: True)
    monkeypatch.setattr(scan, "_WORK", scan._Work())
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    assert [scan._worth_torch(64_000_000) for _ in range(16)] == [False] * 15 + [True]
    scan._WORK.products = 0
    scan.expect_comparisons(15)
    assert not scan._worth_torch(64_000_000)
    scan.expect_comparisons(16)
    assert scan._worth_torch(64_000_000)
