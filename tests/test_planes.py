"""Clusters, planes and local support on scenes of houses, with exact truth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from make_matches import CAMERA0, CAMERA1, POSE0, POSE1, chance, houses

from aeromatch_cli.geometry.cameras import calibration_matrix, undistort
from aeromatch_cli.geometry.epipolar import relative_pose
from aeromatch_cli.geometry.planes import (
    NEIGHBOURS,
    SMALLEST_CLUSTER,
    cluster_places,
    false_alarms,
    fit_planes,
    plane_distances_px,
)


def sides(scene):
    return undistort(CAMERA0, scene.candidates.points0_px), undistort(CAMERA1, scene.candidates.points1_px)


def true_homography(height_m):
    """Of the horizontal plane at this height (Hartley and Zisserman, equation 13.2)."""
    rotation, translation = relative_pose(POSE0, POSE1)
    normal = POSE0.world_rotation @ [0.0, 0.0, 1.0]
    distance = height_m - POSE0.center_m[2]
    middle = rotation + np.outer(translation, normal) / distance
    return calibration_matrix(CAMERA1) @ middle @ np.linalg.inv(calibration_matrix(CAMERA0))


@pytest.mark.parametrize("wrong", [0.2, 0.5, 0.7])
def test_streets_and_roofs_are_found_among_wrong_matches(wrong):
    scene = houses(700, wrong=wrong, seed=1)
    found = fit_planes(*sides(scene), clusters=8)
    kept = (found.labels >= 0) | (found.support >= 1.0)
    assert kept[scene.true].mean() > (0.95 if wrong < 0.6 else 0.9)
    assert kept[~scene.true].mean() < 0.08
    labelled = scene.true & (found.labels >= 0)
    assert labelled[scene.true].mean() > (0.85 if wrong < 0.6 else 0.7)
    assert np.median(found.residuals_px[labelled]) < 1.0


def test_a_plane_maps_the_places_around_its_matches_as_the_true_one():
    scene = houses(800, wrong=0.4, noise_px=0.2, seed=2)
    points0, points1 = sides(scene)
    found = fit_planes(points0, points1, clusters=6)
    truth = {height: true_homography(height)[None] for height in (0.0, 12.0)}
    errors = []
    for plane in range(len(found.homographies)):
        own = scene.true & (found.labels == plane)
        if own.sum() < 12:
            continue
        height = float(np.median(scene.height_m[own]))
        image = np.column_stack([points0[own], np.ones(own.sum())]) @ truth[height][0].T
        errors.append(
            np.median(plane_distances_px(found.homographies[[plane]], points0[own], image[:, :2] / image[:, 2:]))
        )
    assert len(errors) >= 4
    assert max(errors) < 0.3


def test_planes_of_clusters_are_nearer_than_one_plane():
    scene = houses(700, wrong=0.3, seed=3)
    points0, points1 = sides(scene)
    found = fit_planes(points0, points1, clusters=8)
    direct = plane_distances_px(true_homography(0.0)[None], points0, points1)[0]
    assert np.median(found.residuals_px[scene.true]) < 0.5 * np.percentile(direct[scene.true], 75)
    assert np.percentile(found.residuals_px[scene.true], 90) < 0.2 * np.percentile(direct[scene.true], 90)


def test_chance_gives_hardly_a_plane():
    planes = kept = 0
    for seed in range(10):
        candidates = chance(600, seed)
        found = fit_planes(candidates.points0_px, candidates.points1_px, clusters=8)
        planes += len(found.homographies)
        kept = max(kept, ((found.labels >= 0) | (found.support >= 1.0)).sum())
    assert planes <= 2
    assert kept < 15


def test_one_plane_in_one_cluster_is_found_exactly():
    rng = np.random.default_rng(4)
    homography = np.array([[0.9, 0.1, 20.0], [-0.15, 1.1, 5.0], [1e-4, -5e-5, 1.0]])
    points0 = rng.uniform(0, 800, (60, 2))
    image = np.column_stack([points0, np.ones(60)]) @ homography.T
    found = fit_planes(points0, image[:, :2] / image[:, 2:], clusters=1)
    assert (found.labels == 0).all()
    assert found.inliers.tolist() == [60]
    assert np.allclose(found.homographies[0] / found.homographies[0][2, 2], homography, rtol=1e-6, atol=1e-9)
    assert found.residuals_px.max() < 1e-6
    assert (found.support > NEIGHBOURS / 2).mean() > 0.7
    assert (found.support <= NEIGHBOURS - 2).all()


def test_distances_are_the_larger_of_both_directions():
    doubled = np.diag([2.0, 2.0, 1.0])[None]
    points0, points1 = np.array([[10.0, 10.0]]), np.array([[23.0, 24.0]])
    assert plane_distances_px(doubled, points0, points1)[0, 0] == pytest.approx(5.0)
    assert plane_distances_px(np.linalg.inv(doubled), points1, points0)[0, 0] == pytest.approx(5.0)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 5, 6, 7, 9])
@pytest.mark.parametrize("kind", ["spread", "one place", "on a line"])
def test_small_and_degenerate_inputs_give_no_plane(count, kind):
    rng = np.random.default_rng(count)
    points = {
        "spread": rng.uniform(0, 500, (count, 2)),
        "one place": np.full((count, 2), 7.0),
        "on a line": np.outer(np.arange(count), [3.0, 5.0]),
    }[kind]
    found = fit_planes(points, rng.uniform(0, 500, (count, 2)), clusters=4)
    assert found.homographies.shape == (0, 3, 3)
    assert found.labels.tolist() == [-1] * count
    assert found.cluster_idx.shape == found.residuals_px.shape == found.support.shape == (count,)


def test_matches_on_a_line_explain_no_plane_however_many():
    line = np.outer(np.arange(80), [7.0, 3.0])
    found = fit_planes(line, line @ [[0.9, 0.1], [-0.1, 0.9]], clusters=2)
    assert (found.support == 0).all()
    assert np.isfinite(found.homographies).all()


def test_clusters_are_never_too_small_and_their_numbers_have_no_gaps():
    scene = houses(100, seed=5)
    found = fit_planes(*sides(scene), clusters=50)
    used = np.unique(found.cluster_idx)
    assert used.tolist() == list(range(len(used)))
    assert 1 < len(used) <= 100 // SMALLEST_CLUSTER


def test_clusters_are_those_that_are_apart():
    rng = np.random.default_rng(6)
    group = np.repeat([0, 1, 2], 40)
    places = rng.normal(0, 0.2, (120, 4)) + group[:, None] * [3.0, 0.0, 3.0, 1.0]
    for seed in range(5):
        labels = cluster_places(places, 3, seed)
        assert len(set(zip(group.tolist(), labels.tolist(), strict=True))) == 3


def test_false_alarms_follow_the_binomial_tail():
    # Ten matches, six of them explained; each of the seven beyond a proposal has a chance of 1 %: P(X >= 3).
    area = np.array([100 * np.pi * 9.0])
    expected = 10 * 28 * sum(35 * 0.01**3 * 0.99**4 if k == 3 else 35 * 0.01**4 * 0.99**3 for k in (3, 4))
    assert false_alarms(np.array([6]), np.array([10]), 3.0, area)[0] == pytest.approx(expected, rel=1e-3)
    at_least_one = 10 * 28 * (1 - 0.99**7)
    assert false_alarms(np.array([4]), np.array([10]), 3.0, area)[0] == pytest.approx(at_least_one)


def test_the_same_seed_gives_the_same_bits_and_another_one_other_clusters():
    scene = houses(500, seed=8)
    one, same, other = (fit_planes(*sides(scene), clusters=6, seed=seed) for seed in (3, 3, 4))
    for field in ("homographies", "labels", "cluster_idx", "residuals_px", "support"):
        assert np.array_equal(getattr(one, field), getattr(same, field))
    assert not np.array_equal(one.cluster_idx, other.cluster_idx)
    assert ((one.labels >= 0) == (other.labels >= 0)).mean() > 0.93


def test_a_view_of_another_scale_and_turn_changes_nothing():
    scene = houses(600, wrong=0.5, seed=9)
    points0, points1 = sides(scene)
    turn = 0.5 * np.array([[np.cos(2.0), -np.sin(2.0)], [np.sin(2.0), np.cos(2.0)]])
    found = fit_planes(points0, points1 @ turn.T + [900.0, 40.0], clusters=8)
    kept = (found.labels >= 0) | (found.support >= 1.0)
    assert kept[scene.true].mean() > 0.95
    assert kept[~scene.true].mean() < 0.12


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-2000, 5000, width=32)] * 4), max_size=70),
    st.integers(0, 9),
    st.integers(1, 4),
)
def test_whatever_the_matches_labels_and_residuals_agree(rows, clusters, rounds):
    matches = np.array(rows, dtype=np.float64).reshape(-1, 4)
    found = fit_planes(matches[:, :2], matches[:, 2:], clusters=clusters, planes_per_cluster=rounds)
    labelled = found.labels >= 0
    assert (found.labels < len(found.homographies)).all()
    assert (found.residuals_px[labelled] <= 3.0).all()
    assert (found.residuals_px[~labelled] > 3.0).all()
    assert ((found.support >= 0) & (found.support <= NEIGHBOURS - 2 + 1e-5)).all()
    counts = np.bincount(found.plane_cluster_idx, minlength=1)
    assert counts.max() <= rounds
    assert np.isfinite(found.homographies).all()
