"""Guided matching: predicted places and windows against simulated truth, and what they are good for."""

from dataclasses import replace

import numpy as np
import pytest
from make_features import described

from aeromatch_cli.data import Pair, PairGeometry, Pose
from aeromatch_cli.geometry.cameras import from_colmap, project, undistort
from aeromatch_cli.geometry.epipolar import essential, relative_pose
from aeromatch_cli.geometry.prediction import inverse_depths, places_of_heights, search_windows, stereo_of
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Found
from aeromatch_cli.strategies.matchers.descriptors.evidence import most_evident
from aeromatch_cli.strategies.matchers.descriptors.guided import SecondSearch, nearby
from aeromatch_cli.strategies.matchers.descriptors.nearest import Nearest

CAMERA = from_colmap("SIMPLE_RADIAL", 1000, 750, (900.0, 500.0, 375.0, -0.03))
DOWN = np.diag([1.0, -1.0, -1.0])


def turn(vector):
    """Rotation (3, 3) by a rotation vector (3,)."""
    angle = max(float(np.linalg.norm(vector)), 1e-15)
    x, y, z = np.asarray(vector) / angle
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def posed(center, tilt_deg=0.0, heading_deg=0.0, sigma_m=1.0, sigma_deg=0.5):
    rotation = DOWN @ (turn([0, 0, np.deg2rad(heading_deg)]) @ turn([np.deg2rad(tilt_deg), 0, 0])).T
    return Pose(np.array(center, dtype=float), rotation, sigma_m, sigma_deg)


def disturbed(pose, rng):
    rotation = pose.world_rotation @ turn(rng.normal(0, np.deg2rad(pose.sigma_angle_deg), 3))
    return replace(pose, center_m=pose.center_m + rng.normal(0, pose.sigma_position_m, 3), world_rotation=rotation)


def windows(points0, pose0, pose1, *, relief_m=20.0, sigmas=3.0, sigma_px=1.0):
    known = {"relief_m": relief_m, "sigmas": sigmas, "sigma_px": sigma_px}
    return search_windows(points0, CAMERA, pose0, CAMERA, pose1, 0.0, **known)


def pair_of(pose0, pose1, ground_z_m=0.0):
    return PairGeometry(Pair("a", "b", 0.8, 10.0, "overlap"), CAMERA, CAMERA, pose0, pose1, ground_z_m)


def noisy_twins(kinds, rng, noise=12):
    """Two sets of descriptors of things of these kinds (N,): those of one kind differ by noise alone."""
    base = rng.integers(0, 160, (int(kinds.max()) + 1, 128))
    return [
        np.clip(base[kinds] + rng.integers(-noise, noise + 1, (len(kinds), 128)), 0, 255).astype(np.uint8) for _ in "01"
    ]


POSE0, POSE1 = posed((0, 0, 100), 4, 15), posed((25, 8, 105), 8, -20)


def scene(rng, count, height_m=8.0, pose0=POSE0, pose1=POSE1):
    """Pixels (N, 2) in both images of things on hills that both see."""
    xy = rng.uniform([-33, -41], [57, 49], (4 * count, 2))
    z = height_m * np.sin(xy[:, 0] / 25) * np.cos(xy[:, 1] / 30)
    world = np.column_stack([xy, z])
    seen = [project(CAMERA, p.world_rotation, p.center_m, world) for p in (pose0, pose1)]
    inside = np.all([(s > 5).all(axis=1) & (s < [995, 745]).all(axis=1) for s in seen], axis=0)
    return [s[inside][:count] for s in seen]


@pytest.mark.parametrize(("sigma_m", "sigma_deg", "tilt_deg"), [(1, 0.5, 0), (5, 3, 0), (5, 3, 40), (1, 0.3, 45)])
def test_windows_hold_what_the_poses_allow(sigma_m, sigma_deg, tilt_deg):
    rng = np.random.default_rng(1)
    pose0 = posed((0, 0, 100), 5, 20, sigma_m, sigma_deg)
    pose1 = posed((30, 10 - 90 * np.tan(np.deg2rad(tilt_deg)), 110), tilt_deg, -30, sigma_m, sigma_deg)
    world = rng.uniform([-25, -25, -20], [25, 25, 20], (200, 3))
    points0 = project(CAMERA, pose0.world_rotation, pose0.center_m, world)
    true1 = undistort(CAMERA, project(CAMERA, pose1.world_rotation, pose1.center_m, world))
    held = [windows(points0, disturbed(pose0, rng), disturbed(pose1, rng)).contain(true1).mean() for _ in range(100)]
    assert np.mean(held) > 0.97


def test_the_width_of_a_window_is_the_spread_of_the_predictions():
    rng = np.random.default_rng(2)
    pose0, pose1 = posed((0, 0, 100), 5, 20, 0.5, 0.2), posed((30, -60, 110), 35, -30, 0.5, 0.2)
    world = rng.uniform([-20, -20, 0], [20, 20, 0], (12, 3))
    points0 = project(CAMERA, pose0.world_rotation, pose0.center_m, world)
    wanted = windows(points0, pose0, pose1, relief_m=1e-3, sigmas=1.0, sigma_px=0.0)
    moved = [windows(points0, disturbed(pose0, rng), disturbed(pose1, rng)).centers_px for _ in range(500)]
    offsets = np.einsum("nij,knj->kni", wanted.axes, np.array(moved) - wanted.centers_px)
    # The middle of a window between two heights is not the place of the middle height: compare spreads only.
    assert np.allclose(offsets.std(axis=0) / wanted.halves_px, 1.0, atol=0.15)


def test_exact_poses_predict_the_exact_place():
    rng = np.random.default_rng(3)
    pose0, pose1 = posed((0, 0, 100), 5, 20, 1e-9, 1e-9), posed((30, 5, 110), 12, -30, 1e-9, 1e-9)
    world = rng.uniform([-20, -20, 0], [30, 20, 0], (50, 3))
    points0 = project(CAMERA, pose0.world_rotation, pose0.center_m, world)
    true1 = undistort(CAMERA, project(CAMERA, pose1.world_rotation, pose1.center_m, world))
    found = windows(points0, pose0, pose1, relief_m=1e-6, sigma_px=0.01)
    assert np.abs(found.centers_px - true1).max() < 1e-5
    assert found.contain(true1).all()
    assert not found.contain(true1 + 0.2).any()


def test_forms_say_what_contain_says():
    rng = np.random.default_rng(4)
    points0 = rng.uniform([0, 0], [1000, 750], (60, 2))
    found = windows(points0, posed((0, 0, 100), 70, 20), posed((20, 0, 100), 10))
    assert np.isnan(found.centers_px).any()  # some look above the horizon
    points1 = rng.uniform([-200, -200], [1200, 950], (60, 2))
    with np.errstate(invalid="ignore"):
        values = found.forms() @ np.column_stack([points1, np.ones(60)])[:, :, None]
        inside = (np.abs(values[..., 0]) <= 1.0).all(axis=1)
    assert np.array_equal(inside, found.contain(points1))


def test_neighbours_of_one_height_predict_the_place():
    rng = np.random.default_rng(5)
    pose0, pose1 = posed((0, 0, 100), 30, 20), posed((30, 5, 80), 12, -30)
    rotation, translation = relative_pose(pose0, pose1)
    stereo = stereo_of(essential(rotation, translation), rotation, CAMERA, CAMERA, pose0.world_rotation[:, 2])
    heights = rng.uniform(-10, 20, 40)
    points = []
    for pose in (pose0, pose1):
        sides = []
        for part in (0, 1):
            world = np.column_stack([np.random.default_rng(part).uniform(-20, 20, (40, 2)), heights])
            sides.append(undistort(CAMERA, project(CAMERA, pose.world_rotation, pose.center_m, world)))
        points.append(sides)
    (asked0, known0), (asked1, known1) = points
    inverse = inverse_depths(stereo, known0, known1)
    places = places_of_heights(stereo, asked0, known0[:, None], inverse[:, None])[:, 0]
    assert np.abs(places - asked1).max() < 1e-6


def test_rows_that_all_look_alike_are_matched_by_place():
    rng = np.random.default_rng(6)
    pose0, pose1 = posed((0, 0, 100), sigma_m=0.1, sigma_deg=0.05), posed((20, 3, 100), sigma_m=0.1, sigma_deg=0.05)
    x, y = np.meshgrid(np.arange(-20, 40, 3.0), np.arange(-25, 26, 3.0))
    world = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    seen = [project(CAMERA, p.world_rotation, p.center_m, world) for p in (pose0, pose1)]
    twins = noisy_twins(np.zeros(len(world), int), rng)
    sides = [described(s, d) for s, d in zip(seen, twins, strict=True)]
    assert len(Nearest()(*sides, pair_of(pose0, pose1)).indices) == 0
    matches = Nearest(guide_below_matches=9999, guided=True, relief=0.03)(*sides, pair_of(pose0, pose1))
    assert len(matches.indices) > 0.95 * len(world)
    assert np.array_equal(matches.indices[:, 0], matches.indices[:, 1])


@pytest.mark.parametrize("with_poses", [True, False])
def test_verified_matches_lead_to_those_that_are_ambiguous(with_poses):
    rng = np.random.default_rng(7)
    seen = scene(rng, 400)
    # Every second thing has three look-alikes elsewhere.
    kinds = np.where(np.arange(400) % 2 == 0, np.arange(400), 1 + 2 * (np.arange(400) % 50))
    sides = [described(s, d) for s, d in zip(seen, noisy_twins(kinds, rng), strict=True)]
    geometry = pair_of(POSE0, POSE1) if with_poses else pair_of(None, None, None)
    plain, guided = (
        Nearest()(*sides, geometry).indices,
        Nearest(guide_below_matches=9999, guided=True)(*sides, geometry).indices,
    )
    assert len(plain) < 280
    assert len(guided) > 380
    assert (guided[:, 0] == guided[:, 1]).mean() > 0.99


def test_wrong_sizes_and_wrong_places_are_refused():
    rng = np.random.default_rng(8)
    seen = scene(rng, 300)
    first, second = (described(s, d) for s, d in zip(seen, noisy_twins(np.arange(300), rng), strict=True))
    sizes, places = second.sizes_px.copy(), second.keypoints_px.copy()
    sizes[240:270] *= 3.0
    angles = rng.uniform(0, 2 * np.pi, 30)
    places[270:] += 15.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    found = Nearest(guide_below_matches=9999, guided=True)(
        first, replace(second, sizes_px=sizes, keypoints_px=places), pair_of(POSE0, POSE1)
    )
    assert (found.indices < 240).all()
    assert len(found.indices) > 220


@pytest.mark.parametrize("radius_px", [0.5, 3.0, 40.0])
def test_nearby_finds_all_within_the_radius(radius_px):
    rng = np.random.default_rng(13)
    places, points = rng.uniform(-20, 120, (80, 3, 2)), rng.uniform([0, 20], [90, 60], (150, 2))
    places[5, 1], points[7] = np.nan, np.nan
    with np.errstate(invalid="ignore"):
        apart = np.linalg.norm(places[:, None] - points[None, :, None], axis=3)
        expected = np.argwhere((apart <= radius_px).any(axis=2))
    assert np.array_equal(np.column_stack(nearby(places, points, radius_px)), expected)


def test_without_a_model_nothing_lies_outside_the_windows():
    rng = np.random.default_rng(9)
    sides = [
        described(rng.uniform([0, 0], [1000, 750], (500, 2)), rng.integers(0, 160, (500, 128), np.uint8))
        for _ in range(2)
    ]
    strategy = Nearest(guide_below_matches=9999, guided=True, ratio=1.0)
    idx0, idx1 = strategy(*sides, pair_of(POSE0, POSE1)).indices.T
    assert len(idx0) > 20
    limits = windows(sides[0].keypoints_px[idx0], POSE0, POSE1, relief_m=30.0, sigma_px=1.5)
    assert limits.contain(undistort(CAMERA, sides[1].keypoints_px[idx1])).all()


def test_chance_is_no_model():
    rng = np.random.default_rng(10)
    sides = [
        described(rng.uniform([0, 0], [1000, 750], (200, 2)), rng.integers(0, 160, (200, 128), np.uint8))
        for _ in range(2)
    ]
    lonely = pair_of(None, None, None)
    plain, guided = (Nearest(guided=g, ratio=1.0)(*sides, lonely) for g in (False, True))
    assert len(plain.indices) > 30
    assert np.array_equal(plain.indices, guided.indices)


def test_twice_the_same_and_much_the_same_from_either_side():
    rng = np.random.default_rng(11)
    seen = scene(rng, 300)
    sides = [described(s, d) for s, d in zip(seen, noisy_twins(np.arange(300) % 150, rng), strict=True)]
    strategy = Nearest(guide_below_matches=9999, guided=True, ratio=0.95)
    first, second = (strategy(*sides, pair_of(POSE0, POSE1)) for _ in range(2))
    assert np.array_equal(first.indices, second.indices)
    assert np.array_equal(first.scores, second.scores)
    back = strategy(*sides[::-1], pair_of(POSE1, POSE0)).indices[:, ::-1]
    common = {tuple(row) for row in first.indices.tolist()} & {tuple(row) for row in back.tolist()}
    assert len(common) >= 0.97 * max(len(first.indices), len(back))


@pytest.mark.parametrize("counts", [(0, 0), (0, 5), (5, 0), (1, 1)])
def test_few_keypoints_do_no_harm(counts):
    rng = np.random.default_rng(12)
    sides = [described(rng.uniform(0, 700, (n, 2)), rng.integers(0, 160, (n, 128), np.uint8)) for n in counts]
    assert len(Nearest(guide_below_matches=9999, guided=True)(*sides, pair_of(POSE0, POSE1)).indices) <= min(counts)


def test_poses_are_read_only_when_guided():
    assert Nearest().reads() == frozenset()
    assert Nearest(guide_below_matches=9999, guided=True).reads() == {"camera", "pose", "sigma", "ground"}


def test_pairs_with_ample_matches_are_not_searched_again():
    """Ambiguous places are added by the second search alone; where the first was ample there is none."""
    rng = np.random.default_rng(3)
    first, second = (described(s, d) for s, d in zip(scene(rng, 200), noisy_twins(np.arange(200), rng), strict=True))
    plain = Nearest(ratio=0.6)(first, second, pair_of(POSE0, POSE1))
    assert len(plain.indices) >= 30
    settled = Nearest(ratio=0.6, guide_below_matches=30, guided=True)(first, second, pair_of(POSE0, POSE1))
    np.testing.assert_array_equal(settled.indices, plain.indices)


def test_a_search_goes_on_from_the_matches_of_a_plain_one(monkeypatch):
    """The same as from nothing, without another scan."""
    rng = np.random.default_rng(3)
    kinds = np.concatenate([np.arange(400), np.arange(100)])  # some twice: told apart by their places alone
    first, second = (described(s, d) for s, d in zip(scene(rng, 500), noisy_twins(kinds, rng), strict=True))
    geometry = pair_of(POSE0, POSE1)
    plain = Nearest()(first, second, geometry)
    guided = Nearest(guided=True, guide_below_matches=9999)
    whole = guided(first, second, geometry)
    assert len(whole.indices) > len(plain.indices) >= 100
    monkeypatch.setattr(Nearest, "scan", lambda *_: pytest.fail("scanned"))
    again = guided.again(first, second, geometry, plain)
    np.testing.assert_array_equal(again.indices, whole.indices)
    np.testing.assert_allclose(again.scores, whole.scores, atol=1e-6)


@pytest.mark.parametrize(("probability", "stays"), [(0.9, True), (0.005, False)])
def test_matches_that_only_a_network_sees_stay_where_place_and_size_agree(probability, stays):
    rng = np.random.default_rng(9)
    seen = scene(rng, 400)
    first, second = noisy_twins(np.arange(400), rng)
    second[300:] = 160 - np.minimum(first[300:], 160)  # as different as things can look
    sides = [described(s, d) for s, d in zip(seen, (first, second), strict=True)]
    # A network found all of them, and takes half of these for each other.
    columns = np.arange(400)
    columns[350:] = np.roll(columns[350:], 1)
    costs = np.where(np.arange(400) < 300, 0.05, 1.0 - probability)
    again = SecondSearch(Comparison(*sides, pair_of(POSE0, POSE1), np.ones((1, 1), bool)))
    plain, kept = (again(Found(np.arange(400), columns, costs), keep=keep) for keep in (False, True))
    assert (plain.rows < 300).all()
    added = kept.rows[len(plain.rows) :]
    assert (added < 350).mean() >= 0.95 if stays else len(added) == 0
    assert len(added) > 45 or not stays
    assert np.array_equal(kept.rows[: len(plain.rows)], plain.rows)
    assert len(np.unique(kept.rows)) == len(kept.rows) == len(np.unique(kept.columns))


@pytest.mark.parametrize(("more_right", "more_wrong", "taken"), [(60, 40, True), (2, 150, False)])
def test_of_two_sets_of_matches_the_one_with_more_evidence_counts(more_right, more_wrong, taken):
    rng = np.random.default_rng(4)
    seen = scene(rng, 400)
    columns = np.arange(400)
    columns[100:] = rng.permutation(columns[100:])
    columns[100 : 100 + more_right] = np.arange(100, 100 + more_right)
    comparison = Comparison(*(described(s, np.zeros((400, 128), np.uint8)) for s in seen), pair_of(POSE0, POSE1),
                       np.ones((1, 1), bool))  # fmt: skip
    few = Found(np.arange(70, 140), np.concatenate([np.arange(70, 100), rng.integers(200, 400, 40)]), np.full(70, 0.5))
    rows = np.arange(70, 100 + more_right + more_wrong)
    many = Found(rows, columns[rows], np.full(len(rows), 0.5))
    best = most_evident(comparison, [many, few])
    assert len(best.rows) > 70 if taken else set(best.rows) <= set(few.rows)
    assert len(np.unique(best.columns)) == len(best.columns)


def test_without_any_evidence_the_first_set_stays():
    rng = np.random.default_rng(5)
    seen = [rng.uniform(0, [1000, 750], (100, 2)) for _ in "01"]
    comparison = Comparison(*(described(s, np.zeros((100, 128), np.uint8)) for s in seen), pair_of(POSE0, POSE1),
                       np.ones((1, 1), bool))  # fmt: skip
    first, second = (Found(np.arange(n), np.arange(n), np.full(n, 0.5)) for n in (100, 50))
    assert np.array_equal(most_evident(comparison, [first, second]).rows, first.rows)
