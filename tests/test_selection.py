"""Which features are kept: exact budgets, cells anchored in the world, shares by area, each blob once."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeromatch_cli.data import Camera, View
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.selection import distinct, even_selection
from aeromatch_cli.strategies.extractors.sift import Sift


def texture(width, height, seed=0):
    """Noise with structure at several scales."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for scale in (2, 4, 8, 16):
        coarse = rng.standard_normal((height // scale + 2, width // scale + 2))
        total += scale**0.5 * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 25 * total, 0, 255).astype(np.uint8)


def camera_of(gray):
    height, width = gray.shape
    return Camera("PINHOLE", width, height, (1000.0, 1000.0, (width - 1) / 2, (height - 1) / 2))


def source(gray, valid=None):
    height, width = gray.shape
    return ViewPixels(View("source", width, height, np.eye(3), is_source=True, angle_deg=0.0), gray, valid)


def ground(gray, west=0.0, north=0.0, gsd_m=0.1, valid=None, *, north_up=True):
    """A view of the plane whose top-left pixel is centred at (west, north) metres."""
    height, width = gray.shape
    world = np.array([[gsd_m, 0.0, west], [0.0, -gsd_m, north], [0.0, 0.0, 1.0]])
    down = np.array([0.0, 0.0, -1.0])
    view = View("ground", width, height, np.eye(3), False, 0.0, down, gsd_m, north_up, world)
    return ViewPixels(view, gray, valid)


def blank(width, height):
    return np.zeros((height, width), np.uint8)


def uneven(seed=0):
    """Strong texture on the left third, weak texture elsewhere."""
    gray = texture(600, 300, seed).astype(float)
    gray[:, 200:] = 128 + (gray[:, 200:] - 128) * 0.25
    return np.rint(gray).astype(np.uint8)


def cells_hit(points):
    return len(np.unique((points // 25).astype(int), axis=0))


def test_the_selection_is_more_even_than_the_strongest():
    gray = uneven()
    recipe = {"keypoints": 300, "selection": "response"}
    even, strongest = (Sift(**recipe, per_cell=n)(camera_of(gray), (source(gray),)).keypoints_px for n in (4, 10**6))
    assert cells_hit(even) > 1.5 * cells_hit(strongest)
    assert (even[:, 0] > 200).mean() > 0.5
    assert (strongest[:, 0] > 200).mean() < 0.1


def test_even_selection_by_hand():
    # Two cells of 10 x 10 px, a feature of each comes first; then the stronger of both cells' second ones.
    points = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [11.0, 1.0], [12.0, 2.0]])
    strengths = np.array([5.0, 9.0, 7.0, 1.0, 2.0])
    views, idx = [source(blank(20, 10))], np.zeros(5, np.int64)
    assert even_selection(views, idx, points, strengths, 2, 1).tolist() == [1, 4]
    assert even_selection(views, idx, points, strengths, 4, 2).tolist() == [1, 2, 3, 4]
    assert even_selection(views, idx, points, strengths, 5, 2).tolist() == [0, 1, 2, 3, 4]


def test_cells_get_shares_by_the_area_that_is_seen_of_them():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, [199, 99], (4000, 2))
    valid = np.ones((100, 200), bool)
    valid[:, 125:] = False  # a quarter of the right cell is seen
    points = points[points[:, 0] < 124.5]
    views = [source(blank(200, 100), valid)]
    chosen = even_selection(views, np.zeros(len(points), np.int64), points, np.ones(len(points)), 250, 200)
    assert len(chosen) == 250
    assert (points[chosen, 0] >= 100).sum() == pytest.approx(50, abs=2)


def test_a_stretched_distance_gets_no_more_than_the_picture_has_of_it():
    rng = np.random.default_rng(2)
    points = rng.uniform(0, [199, 399], (8000, 2))
    # Down the view each of its pixels shows less of the picture: 1 at the top, 1 / 27 at the bottom.
    tilted = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 2.0 / 399, 1.0]])
    flat = ground(blank(200, 400))
    view = ViewPixels(replace(flat.view, undistorted_from_view=tilted), flat.gray, None)
    shown = (1.0 + 2.0 * np.linspace(0, 1, 1001)) ** -3.0
    for one, upper in ((flat, 0.5), (view, shown[:500].sum() / shown.sum())):
        chosen = even_selection([one], np.zeros(len(points), np.int64), points, np.ones(len(points)), 1000, 5)
        assert (points[chosen, 1] < 199.5).mean() == pytest.approx(upper, abs=0.03)


def test_views_share_the_budget_by_what_they_show_and_leave_what_they_cannot_use():
    rng = np.random.default_rng(1)
    views = [source(blank(200, 100)), ground(blank(100, 50))]
    idx = np.repeat([0, 1], [3000, 3000])
    points = rng.uniform(0, 1, (6000, 2)) * np.where(idx[:, None] == 0, [199, 99], [99, 49])
    # Whatever the strengths: the second view, a quarter as large, gets a fifth.
    strengths = np.where(idx == 0, 1.0, 1000.0) * rng.uniform(0.5, 1.0, 6000)
    chosen = even_selection(views, idx, points, strengths, 1000, 100)
    assert (idx[chosen] == 1).sum() == pytest.approx(200, abs=5)
    few = np.sort(np.concatenate([np.arange(100), np.arange(3000, 6000)]))
    chosen = even_selection(views, idx[few], points[few], strengths[few], 1000, 100)
    assert np.bincount(idx[few][chosen]).tolist() == [100, 900]


def test_cells_anchored_in_the_world_pick_the_same_points_in_shifted_views():
    rng = np.random.default_rng(2)
    world = rng.uniform([0, -100], [150, 0], (6000, 2))
    strengths = rng.uniform(0, 1, 6000)

    def kept(west, north, *, anchored=True):
        view = ground(blank(1000, 700), west, north)
        if not anchored:
            view = source(blank(1000, 700))
        points = np.column_stack([(world[:, 0] - west) / 0.1, (north - world[:, 1]) / 0.1])
        inside = np.flatnonzero((points >= 0).all(axis=1) & (points < [999, 699]).all(axis=1))
        chosen = even_selection([view], np.zeros(len(inside), int), points[inside], strengths[inside], 700, 30)
        return set(inside[chosen].tolist())

    shared = {i for i, (x, y) in enumerate(world) if 37.3 <= x < 99 and -69 <= y < -11.7}
    first, second = kept(0.0, 0.0) & shared, kept(37.3, -11.7) & shared
    assert len(first & second) > 0.93 * max(len(first), len(second))
    loose = [kept(0.0, 0.0, anchored=False) & shared, kept(37.3, -11.7, anchored=False) & shared]
    assert len(loose[0] & loose[1]) < len(first & second)


def test_a_blob_is_kept_once():
    points = np.array([[5.0, 5.0], [6.0, 5.0], [6.5, 5.5], [20.0, 5.0], [20.5, 5.0], [40.0, 5.0], [40.0, 5.0]])
    sizes = np.array([4.0, 5.0, 15.0, 4.0, 4.0, 3.0, 4.0])
    strengths = np.array([1.0, 2.0, 0.5, 3.0, 3.0, 9.0, 8.0])
    # The third is three times as large as the second; the fifth is as strong as the fourth, which comes first.
    expected = [False, True, True, True, False, True, False]
    assert distinct(points, sizes, strengths, 2.0).tolist() == expected
    assert distinct(points[:0], sizes[:0], strengths[:0], 2.0).tolist() == []


def test_the_order_of_the_list_decides_only_between_equals():
    rng = np.random.default_rng(3)
    points, strengths = rng.uniform(0, [199, 99], (500, 2)), rng.uniform(0, 1, 500)
    views, idx = [source(blank(200, 100))], np.zeros(500, np.int64)
    turned = rng.permutation(500)
    first = even_selection(views, idx, points, strengths, 77, 10)
    second = even_selection(views, idx, points[turned], strengths[turned], 77, 10)
    assert np.array_equal(first, np.sort(turned[second]))


GRAY = texture(240, 160, seed=4)
VALID = np.indices(GRAY.shape).sum(axis=0) < 300


@settings(max_examples=12, deadline=None)
@given(
    st.sampled_from([1, 7, 60, 200]),
    st.sampled_from(["image", "view"]),
    st.sampled_from(["auto", "gradient", "upright"]),
    st.sampled_from(["balanced", "scale", "response"]),
    st.lists(st.sampled_from(["source", "ground", "masked"]), min_size=1, max_size=3),
)
def test_the_budget_is_exact_in_every_combination(budget, of, orientation, selection, kinds):
    made = {"source": source(GRAY), "ground": ground(GRAY), "masked": ground(GRAY, valid=VALID)}
    views = [made[kind] for kind in kinds]
    recipe = Sift(keypoints=budget, budget=of, orientation=orientation, selection=selection, per_cell=20)
    features = recipe(camera_of(GRAY), views)
    counts = np.bincount(features.view_idx, minlength=len(views))
    assert counts.sum() == budget if of == "image" else counts.tolist() == [budget] * len(views)
    assert len(features.descriptors) == len(features.view_orientation_deg) == counts.sum()
    assert np.array_equal(np.unique(features.descriptor_keypoint_idx), np.arange(len(features.keypoints_px)))
    assert (np.diff(features.descriptor_keypoint_idx) >= 0).all()


def test_upright_is_orientation_0_with_one_descriptor_for_each_point():
    recipe = Sift(keypoints=10**6)
    free = recipe(camera_of(GRAY), (ground(GRAY, north_up=False),))
    upright = recipe(camera_of(GRAY), (ground(GRAY),))
    assert (upright.view_orientation_deg == 0).all()
    assert len(upright.descriptors) == len(upright.keypoints_px) < len(free.descriptors)
    assert np.array_equal(upright.keypoints_px, free.keypoints_px)
    forced = recipe.model_copy(update={"orientation": "upright"})(camera_of(GRAY), (ground(GRAY, north_up=False),))
    assert np.array_equal(forced.descriptors, upright.descriptors)
    turned = recipe.model_copy(update={"orientation": "gradient"})(camera_of(GRAY), (ground(GRAY),))
    assert np.array_equal(turned.descriptors, free.descriptors)


def test_the_upright_descriptor_turns_with_the_picture():
    gray = texture(161, 161, seed=6)
    plain, quarter = (
        Sift(orientation="upright", keypoints=10**6)(camera_of(g), (source(g),)) for g in (gray, np.rot90(gray).copy())
    )
    # A quarter turn to the left moves (x, y) to (y, 160 - x); 4 x 4 cells of 8 directions move along.
    moved = np.column_stack([plain.keypoints_px[:, 1], 160 - plain.keypoints_px[:, 0]])
    apart = np.linalg.norm(moved[:, None] - quarter.keypoints_px, axis=2)
    pairs = np.argwhere(apart < 0.01)
    sizes = plain.sizes_px[pairs[:, 0]] / quarter.sizes_px[pairs[:, 1]]
    pairs = pairs[np.abs(sizes - 1) < 0.01]
    assert len(pairs) > 0.5 * len(plain.keypoints_px)
    own = plain.descriptors[pairs[:, 0]].astype(int)
    other = quarter.descriptors[pairs[:, 1]].astype(int)
    # A quarter turn takes the cells of a descriptor to others, and leaves what it adds up to.
    assert np.median(np.linalg.norm(own - other, axis=1)) > 100
    assert np.median(np.abs(np.sort(own, axis=1) - np.sort(other, axis=1)).mean(axis=1)) < 3
