"""The terrain of the first pass, on points of known surfaces with wrong ones among them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from aeromatch_cli.data import FloatArray, IntArray, Pose
from aeromatch_cli.geometry.cameras import from_colmap, project
from aeromatch_cli.sfm.dem import (
    GroundPoints,
    Terrain,
    _height_sigmas_m,
    ground_points,
    terrain_of,
    terrains_of,
)
from aeromatch_cli.sfm.epipolar_agreement import PairPoints

CAMERA = from_colmap("PINHOLE", 1000, 800, (900.0, 900.0, 500.0, 400.0))
STRAIGHT_DOWN = np.diag([1.0, -1.0, -1.0])
LOW_M, HIGH_M = np.array([0.0, 0.0]), np.array([240.0, 180.0])


def surface(xy_m: FloatArray) -> FloatArray:
    """Heights of a hilly terrain, metres."""
    return np.asarray(5.0 * np.sin(xy_m[:, 0] / 20.0) + 3.0 * np.cos(xy_m[:, 1] / 15.0))


def with_tower(xy_m: FloatArray) -> FloatArray:
    """The same, with a tower of 30 m x 30 m, 40 m high, and a cliff of 30 m."""
    tower = (np.abs(xy_m - [60.0, 90.0]) <= 15.0).all(axis=1)
    return np.asarray(surface(xy_m) + 40.0 * tower + 30.0 * (xy_m[:, 0] > 170.0))


def centers_m(height_m: float) -> FloatArray:
    """Of twelve images above the area."""
    x, y = np.meshgrid([30.0, 90.0, 150.0, 210.0], [30.0, 90.0, 150.0])
    return np.column_stack([x.ravel(), y.ravel(), np.full(12, height_m)])


def shown(rng: np.random.Generator, of: Callable[[FloatArray], FloatArray], count: int = 3000) -> GroundPoints:
    """Points of a surface, to 0.2 m, each by one of twelve pairs."""
    xy = rng.uniform(LOW_M, HIGH_M, (count, 2))
    points_m = np.column_stack([xy, of(xy) + rng.normal(0.0, 0.2, count)])
    return GroundPoints(points_m, np.full(count, 0.3), rng.integers(0, 12, count))


def heights_at(terrain: Terrain, xy_m: FloatArray) -> FloatArray:
    """Those of the nearest cells."""
    columns = np.rint((xy_m[:, 0] - terrain.west_m) / terrain.cell_m).astype(int)
    rows = np.rint((terrain.north_m - xy_m[:, 1]) / terrain.cell_m).astype(int)
    return np.asarray(terrain.heights_m[rows, columns])


def made(points: GroundPoints, height_m: float) -> Terrain:
    terrain = terrain_of(points, centers_m(height_m))
    assert terrain is not None
    return terrain


def places(margin_m: float = 5.0) -> FloatArray:
    x, y = np.meshgrid(np.arange(margin_m, HIGH_M[0] - margin_m, 3.0), np.arange(margin_m, HIGH_M[1] - margin_m, 3.0))
    return np.column_stack([x.ravel(), y.ravel()])


def joined(points: GroundPoints, wrong_m: FloatArray, sigmas_m: float, pair_idx: IntArray) -> GroundPoints:
    return GroundPoints(
        np.concatenate([points.points_m, wrong_m]),
        np.concatenate([points.sigmas_m, np.full(len(wrong_m), sigmas_m)]),
        np.concatenate([points.pair_idx, pair_idx]),
    )


def test_the_terrain_follows_the_surface_whatever_single_points_say() -> None:
    rng = np.random.default_rng(4)
    points = shown(rng, surface, 4000)
    points.points_m[:200, 2] += rng.uniform(-60.0, 60.0, 200)
    terrain = made(points, 80.0)
    errors = np.abs(heights_at(terrain, places()) - surface(places()))
    assert np.median(errors) < 0.4
    assert errors.max() < 2.5
    assert terrain_of(points.take(slice(5)), centers_m(80.0)) is None


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("flying_m", "spike_m"), [(100.0, 20.0), (100.0, 60.0), (120.0, 80.0), (120.0, 106.0)])
def test_a_wrong_pair_lifts_no_ground(seed: int, flying_m: float, spike_m: float) -> None:
    """Three dozen points of one pair, more than the right ones of the place; one of the places lies in the corner."""
    rng = np.random.default_rng(seed)
    points = shown(rng, surface)
    for pair, middle in enumerate([rng.uniform([40.0, 40.0], [200.0, 140.0]), np.array([234.0, 174.0])]):
        xy = np.minimum(middle + rng.uniform(-6.0, 6.0, (36, 2)), HIGH_M)
        wrong_m = np.column_stack([xy, surface(xy) + spike_m + rng.normal(0.0, 0.3, 36)])
        points = joined(points, wrong_m, 0.3, np.full(36, pair))
    errors = np.abs(heights_at(made(points, flying_m), places()) - surface(places()))
    assert np.median(errors) < 0.5
    assert errors.max() < 3.0


@pytest.mark.parametrize("seed", range(3))
def test_near_parallel_rays_lift_no_ground(seed: int) -> None:
    """However many pairs show them: heights that are known to 15 m say nothing beside those known to 0.3 m."""
    rng = np.random.default_rng(seed)
    points = shown(rng, surface)
    xy = rng.uniform([100.0, 60.0], [130.0, 90.0], (120, 2))
    wrong_m = np.column_stack([xy, surface(xy) + rng.normal(25.0, 15.0, 120)])
    points = joined(points, wrong_m, 15.0, rng.integers(0, 12, 120))
    errors = np.abs(heights_at(made(points, 110.0), places()) - surface(places()))
    assert errors.max() < 3.0


@pytest.mark.parametrize("height_m", [95.0, 110.0, -500.0])
def test_points_beside_the_cameras_or_far_below_are_no_ground(height_m: float) -> None:
    """Whatever shows them."""
    rng = np.random.default_rng(0)
    points = shown(rng, surface)
    xy = rng.uniform([100.0, 60.0], [130.0, 90.0], (120, 2))
    wrong_m = np.column_stack([xy, np.full(120, height_m)])
    points = joined(points, wrong_m, 0.3, rng.integers(0, 12, 120))
    errors = np.abs(heights_at(made(points, 110.0), places()) - surface(places()))
    assert errors.max() < 3.0


@pytest.mark.parametrize("seed", range(6))
def test_a_tower_and_a_cliff_that_several_pairs_show_stay(seed: int) -> None:
    rng = np.random.default_rng(seed)
    terrain = made(shown(rng, with_tower), 110.0)
    xy = places()
    # A cell is about 8 m wide, and smoothed: beside a step its height lies between those of the sides.
    inside = (np.abs(xy - [60.0, 90.0]) <= 4.0).all(axis=1)
    outside = ~(np.abs(xy - [60.0, 90.0]) <= 35.0).all(axis=1) & (np.abs(xy[:, 0] - 170.0) > 20.0)
    errors = np.abs(heights_at(terrain, xy) - with_tower(xy))
    assert errors[inside].max() < 12.0
    assert errors[outside].max() < 3.0


def test_ground_of_one_pair_is_judged_by_itself() -> None:
    rng = np.random.default_rng(0)
    points = shown(rng, with_tower)
    alone = GroundPoints(points.points_m, points.sigmas_m, np.zeros(len(points), int))
    inside = np.array([[60.0, 90.0], [200.0, 90.0]])
    np.testing.assert_allclose(heights_at(made(alone, 110.0), inside), with_tower(inside), atol=12.0)


def test_flights_that_lie_apart_have_a_terrain_each() -> None:
    points, centers = shown(np.random.default_rng(1), surface), centers_m(80.0)
    away = np.array([100_000.0, 0.0, 500.0])
    far = GroundPoints(points.points_m + away, points.sigmas_m, points.pair_idx).take(slice(400))
    parts = [
        (points.take(slice(1400)), centers[:6]),
        (far, centers + away),
        (points.take(slice(1400, None)), centers[6:]),
    ]
    found = terrains_of(parts)
    assert len(found) == 2
    assert found[0].cell_m < 10.0  # both halves of the flight here
    whole = made(points, 80.0)
    assert found[0].heights_m.shape == whole.heights_m.shape
    assert np.median(found[1].heights_m) == pytest.approx(500.0, abs=5.0)
    assert found[1].west_m > 99_000.0


def test_standard_deviations_of_heights_are_those_of_noisy_rays() -> None:
    """Straight down 100 m, with a base of 20 m: by simulation."""
    rng = np.random.default_rng(0)
    centers = [np.array([0.0, 0.0, 100.0]), np.array([20.0, 0.0, 100.0])]
    poses = {name: Pose(center, STRAIGHT_DOWN, 0.1, 0.1) for name, center in zip("ab", centers, strict=True)}
    truth_m = np.repeat([[10.0, 15.0, 0.0]], 20_000, axis=0)
    seen = [project(CAMERA, STRAIGHT_DOWN, c, truth_m) + rng.normal(0.0, 0.5, (20_000, 2)) for c in centers]
    pair = PairPoints("a", "b", seen[0], seen[1], np.zeros((20_000, 2), int))
    found = ground_points([pair], poses, dict.fromkeys("ab", CAMERA), dict.fromkeys("ab", 50.0))
    expected_m = _height_sigmas_m(truth_m[:1], centers, [0.5 / 900.0] * 2)[0]
    assert len(found) == 20_000
    assert found.points_m[:, 2].std() == pytest.approx(expected_m, rel=0.05)
    assert expected_m == pytest.approx(100.0 * 0.5 / 900.0 * np.sqrt(2.0) * 5.0, rel=0.06)


def test_matches_that_the_poses_contradict_show_no_ground() -> None:
    rng = np.random.default_rng(0)
    centers = {"a": np.array([100.0, 90.0, 110.0]), "b": np.array([125.0, 90.0, 110.0])}
    poses = {name: Pose(center, STRAIGHT_DOWN, 0.1, 0.1) for name, center in centers.items()}
    xy = rng.uniform([90.0, 60.0], [135.0, 120.0], (200, 2))
    points_m = np.column_stack([xy, surface(xy)])
    seen = {name: project(CAMERA, STRAIGHT_DOWN, center, points_m) for name, center in centers.items()}
    seen["b"][:40] += [0.0, 25.0]  # beside the epipolar line
    pair = PairPoints("a", "b", seen["a"], seen["b"], np.zeros((200, 2), int))
    found = ground_points([pair], poses, dict.fromkeys("ab", CAMERA), dict.fromkeys("ab", 2.0))
    np.testing.assert_allclose(found.points_m, points_m[40:], atol=1e-6)
