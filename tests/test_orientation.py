"""Judging given poses, resection, placement and terrain, on exact points of a known surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aeromatch_cli.data import FloatArray, Pose
from aeromatch_cli.geometry.cameras import from_colmap, project
from aeromatch_cli.geometry.rotations import angle_between_deg, from_omega_phi_kappa, rotation_z, tilt_deg
from aeromatch_cli.sfm.epipolar_agreement import PairPoints, explained_images, explained_share, grouped_images
from aeromatch_cli.sfm.georeferencing import _COMMON, LOCAL_FLYING_HEIGHT, _common, place, similarity
from aeromatch_cli.sfm.resection import resected

CAMERA = from_colmap("SIMPLE_RADIAL", 1600, 1200, (1500.0, 800.0, 600.0, -0.03))
ROWS, COLUMNS = 3, 4


def surface(xy_m: FloatArray) -> FloatArray:
    """Heights of a hilly terrain, metres."""
    return np.asarray(5.0 * np.sin(xy_m[:, 0] / 20.0) + 3.0 * np.cos(xy_m[:, 1] / 15.0))


def flight(seed: int = 0) -> dict[str, Pose]:
    """Three strips of four images, 80 m above the ground, a few degrees off straight down, strips flown to and fro."""
    rng = np.random.default_rng(seed)
    poses = {}
    for row in range(ROWS):
        for column in range(COLUMNS):
            angles = rng.normal(0.0, 4.0, 2)
            rotation = from_omega_phi_kappa(*angles, 180.0 * (row % 2) + rng.normal(0.0, 5.0))
            center = np.array([25.0 * column, 30.0 * row, 80.0]) + rng.normal(0.0, 2.0, 3)
            poses[f"i{row}{column}"] = Pose(center, rotation, 0.1, 0.1)
    return poses


def matches(poses: dict[str, Pose], noise_px: float = 0.3) -> tuple[list[PairPoints], FloatArray]:
    """Matches of every pair that shares points, with noise; and the points (P, 3)."""
    rng = np.random.default_rng(1)
    xy = rng.uniform([-40, -40], [120, 100], (1500, 2))
    points = np.column_stack([xy, surface(xy)])
    seen = {}
    for image_id, pose in poses.items():
        pixels = project(CAMERA, pose.world_rotation, pose.center_m, points)
        inside = (pixels > 0).all(axis=1) & (pixels < [1599, 1199]).all(axis=1)
        seen[image_id] = (inside, pixels + rng.normal(0.0, noise_px, pixels.shape))
    pairs = []
    ids = sorted(poses)
    for i, id0 in enumerate(ids):
        for id1 in ids[i + 1 :]:
            both = np.flatnonzero(seen[id0][0] & seen[id1][0])
            if len(both) >= 30:
                indices = np.column_stack([both, both])
                pairs.append(PairPoints(id0, id1, seen[id0][1][both], seen[id1][1][both], indices))
    return pairs, points


def limits(poses: dict[str, Pose]) -> tuple[dict[str, object], dict[str, float]]:
    return dict.fromkeys(poses, CAMERA), dict.fromkeys(poses, 3.0)


def test_exact_poses_explain_their_matches() -> None:
    poses = flight()
    pairs, _ = matches(poses)
    cameras, thresholds = limits(poses)
    assert len(pairs) > 20
    assert explained_images(pairs, poses, cameras, thresholds) == set(poses)
    assert min(explained_share(pair, poses, cameras, thresholds) for pair in pairs) > 0.99


def test_a_third_of_the_attitudes_at_random_is_found_out_and_corrected() -> None:
    truth = flight()
    pairs, _ = matches(truth)
    cameras, thresholds = limits(truth)
    rng = np.random.default_rng(5)
    wrong = set(sorted(truth)[::3])
    given = {
        i: replace(pose, world_rotation=from_omega_phi_kappa(*rng.uniform(-180.0, 180.0, 3))) if i in wrong else pose
        for i, pose in truth.items()
    }
    good = explained_images(pairs, given, cameras, thresholds)
    assert good == set(truth) - wrong
    found = resected(pairs, {i: given[i] for i in good}, cameras, thresholds, (0.4, 0.2))
    assert found.keys() == wrong
    for image_id, pose in found.items():
        assert angle_between_deg(pose.world_rotation, truth[image_id].world_rotation) < 0.1
        assert np.linalg.norm(pose.center_m - truth[image_id].center_m) < 0.15
        assert (pose.sigma_position_m, pose.sigma_angle_deg) == (0.4, 0.2)


def test_a_block_flown_backwards_is_not_explained() -> None:
    truth = flight()
    pairs, _ = matches(truth)
    cameras, thresholds = limits(truth)
    # Level cameras turned by 180 degrees about the vertical have the same epipolar lines.
    level = {i: replace(p, world_rotation=from_omega_phi_kappa(0, 0, 0), center_m=p.center_m * [1, 1, 0] + [0, 0, 80])
             for i, p in truth.items()}  # fmt: skip
    exact, _ = matches(level)
    turned = {i: replace(p, world_rotation=p.world_rotation @ np.diag([-1.0, -1.0, 1.0])) for i, p in level.items()}
    assert explained_images(exact, level, cameras, thresholds) == set(level)
    assert explained_images(exact, turned, cameras, thresholds) == set()
    back = {i: replace(p, world_rotation=p.world_rotation @ np.diag([-1.0, -1.0, 1.0])) for i, p in truth.items()}
    assert explained_images(pairs, back, cameras, thresholds) == set()


@pytest.mark.parametrize(("across", "held"), [(40, True), (200, False)])
def test_few_matches_contradict_no_group(across: int, held: bool) -> None:
    """Three images whose poses hold among themselves, and a pair with the others that does not."""
    good = {("a", "b"): True, ("b", "c"): True, ("c", "d"): True, ("x", "y"): True, ("y", "z"): True, ("d", "x"): False}
    matches = dict.fromkeys(good, 130) | {("d", "x"): across}
    assert grouped_images(good, matches) == set("abcd") | (set("xyz") if held else set())


def test_an_image_without_enough_points_is_not_resected() -> None:
    truth = flight()
    pairs, _ = matches(truth)
    cameras, thresholds = limits(truth)
    last = sorted(truth)[-1]
    few = [
        replace(p, points0_px=p.points0_px[:2], points1_px=p.points1_px[:2], indices=p.indices[:2])
        if last in (p.image_id0, p.image_id1)
        else p
        for p in pairs
    ]
    known = {i: pose for i, pose in truth.items() if i != last}
    assert resected(few[:0], known, cameras, thresholds, (1.0, 1.0)) == {}
    lonely = [p for p in few if last not in (p.image_id0, p.image_id1) or "i00" in (p.image_id0, p.image_id1)]
    assert last not in resected(lonely, known, cameras, thresholds, (1.0, 1.0))


def model_of(truth: dict[str, Pose], points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres, rotations and points in a frame that is turned, shifted and scaled."""
    turn = from_omega_phi_kappa(50.0, -20.0, 110.0)
    centers = np.array([pose.center_m for pose in truth.values()])
    rotations = np.array([pose.world_rotation @ turn.T for pose in truth.values()])
    return 0.01 * centers @ turn.T + 3.0, rotations, 0.01 * points @ turn.T + 3.0


def attitude_errors(truth: dict[str, Pose], rotations: FloatArray) -> list[float]:
    return [
        angle_between_deg(rotation, pose.world_rotation)
        for rotation, pose in zip(rotations, truth.values(), strict=True)
    ]


def test_exact_positions_place_a_model_exactly() -> None:
    truth = flight()
    _, points = matches(truth)
    centers, rotations, moved = model_of(truth, points)
    positions = np.array([pose.center_m for pose in truth.values()])
    found = place(centers, moved, positions, np.full(len(centers), 0.01))
    assert (found.kind, found.trusted, found.agreeing.all()) == ("positions", True, True)
    assert found.scale == pytest.approx(100.0, rel=1e-3)
    assert max(attitude_errors(truth, found.rotations(rotations))) < 0.02
    np.testing.assert_allclose(found.points(centers), positions, atol=0.03)


def test_outliers_among_the_positions_are_left_out() -> None:
    truth = flight()
    _, points = matches(truth)
    centers, rotations, moved = model_of(truth, points)
    positions = np.array([pose.center_m for pose in truth.values()])
    positions[3] += [70.0, -70.0, 0.0]
    found = place(centers, moved, positions, np.full(len(centers), 0.5))
    assert np.flatnonzero(~found.agreeing).tolist() == [3]
    assert found.trusted
    assert max(attitude_errors(truth, found.rotations(rotations))) < 0.3


def tilted_block(noise_deg: float) -> tuple[dict[str, Pose], FloatArray, FloatArray, FloatArray, FloatArray]:
    """A flight over ground that falls by 10 degrees: centres, rotations and points of a model, and measured ups."""
    truth = flight()
    _, points = matches(truth)
    points = points + np.column_stack([np.zeros((len(points), 2)), np.tan(np.deg2rad(10.0)) * points[:, 0]])
    centers, rotations, moved = model_of(truth, points)
    rng = np.random.default_rng(2)
    turns = Rotation.from_rotvec(rng.normal(0.0, noise_deg, (len(truth), 3)), degrees=True).as_matrix()
    measured = [turn @ pose.world_rotation[:, 2] for turn, pose in zip(turns, truth.values(), strict=True)]
    ups = np.einsum("nji,nj->ni", rotations, np.array(measured))
    return truth, centers, rotations, moved, ups


def tilts_off(truth: dict[str, Pose], rotations: FloatArray) -> float:
    """Largest angle between up in the block and true up, degrees: turns about the vertical do not count."""
    pairs = zip(truth.values(), rotations, strict=True)
    return max(np.rad2deg(np.arccos(np.clip(r[:, 2] @ p.world_rotation[:, 2], -1, 1))) for p, r in pairs)


@pytest.mark.slow
@pytest.mark.parametrize(("noise_m", "limit_deg"), [(0.05, 0.9), (1.0, 1.5), (7.0, 6.0)])
def test_positions_say_how_good_they_are_and_level_a_block_over_a_slope(noise_m: float, limit_deg: float) -> None:
    """Stated are 5 m. The median of ten blocks; level ground would be 10 degrees off."""
    truth, centers, rotations, points, _ = tilted_block(0.0)
    exact = np.array([pose.center_m for pose in truth.values()])
    off = []
    for seed in range(10):
        positions = exact + np.random.default_rng(seed).normal(0.0, noise_m, exact.shape)
        found = place(centers, points, positions, np.full(len(centers), 5.0))
        assert found.kind == "positions"
        off.append(tilts_off(truth, found.rotations(rotations)))
    assert np.median(off) < limit_deg


def test_errors_that_neighbours_share_are_told_from_those_of_chance() -> None:
    places = np.array([pose.center_m for pose in flight().values()])
    delay = np.column_stack([np.repeat([8.0, -8.0, 8.0], COLUMNS), np.zeros((len(places), 2))])
    assert _common(delay, places) > 0.9
    assert max(_common(np.random.default_rng(k).normal(size=places.shape), places) for k in range(20)) < _COMMON


def test_measured_tilts_level_a_block_over_a_slope() -> None:
    truth, centers, rotations, points, ups = tilted_block(0.5)
    nowhere = np.full((len(centers), 3), np.nan)
    by_terrain = place(centers, points, nowhere, np.full(len(centers), np.nan))
    assert tilts_off(truth, by_terrain.rotations(rotations)) > 8.0
    by_tilts = place(centers, points, nowhere, np.full(len(centers), np.nan), ups)
    assert tilts_off(truth, by_tilts.rotations(rotations)) < 0.6


@pytest.mark.parametrize("lean_deg", [0.0, 14.0])
def test_tilts_that_contradict_the_positions_do_not_count(lean_deg: float) -> None:
    """Over level ground: tilts with an error in common, as that of a list in other units, against positions."""
    truth = flight()
    _, points = matches(truth)
    centers, rotations, moved = model_of(truth, points)
    positions = np.array([pose.center_m for pose in truth.values()])
    positions = positions + np.random.default_rng(4).normal(0.0, 1.0, positions.shape)
    lean = Rotation.from_euler("x", lean_deg, degrees=True).as_matrix()
    measured = np.array([(pose.world_rotation @ lean)[:, 2] for pose in truth.values()])
    in_model = np.einsum("nji,nj->ni", rotations, measured)
    found = place(centers, moved, positions, np.full(len(centers), 1.0), in_model)
    assert tilts_off(truth, found.rotations(rotations)) < 2.0


def test_tilts_that_contradict_each_other_or_the_terrain_do_not_count() -> None:
    _, centers, _, points, ups = tilted_block(0.5)
    nowhere, none = np.full((len(centers), 3), np.nan), np.full(len(centers), np.nan)
    expected = place(centers, points, nowhere, none).rotation
    rng = np.random.default_rng(3)
    for wrong in (rng.normal(size=ups.shape), -ups, np.roll(ups, 1, axis=1)):
        unit = wrong / np.linalg.norm(wrong, axis=1, keepdims=True)
        np.testing.assert_allclose(place(centers, points, nowhere, none, unit).rotation, expected)


@pytest.mark.parametrize(
    ("change", "contradiction"),
    [
        (lambda p: p[:, [1, 0, 2]], "mirrored"),
        (lambda p: np.random.default_rng(4).permutation(p), "scattered"),
        (lambda p: p * [-1.0, 1.0, 1.0], "mirrored"),
    ],
    ids=["x and y exchanged", "lines of other images", "mirrored"],
)
def test_positions_of_something_else_are_not_used(change, contradiction: str) -> None:
    truth = flight()
    _, points = matches(truth)
    centers, _, moved = model_of(truth, points)
    positions = change(np.array([pose.center_m for pose in truth.values()]))
    found = place(centers, moved, positions, np.full(len(centers), 0.5))
    assert (found.kind, found.contradiction, found.agreeing.any()) == ("level", contradiction, False)
    assert np.median(found.points(centers)[:, 2]) == pytest.approx(LOCAL_FLYING_HEIGHT, rel=0.05)


@pytest.mark.parametrize("noise_m", [0.5, 5.0, 10.0])
def test_noise_is_no_contradiction(noise_m: float) -> None:
    truth = flight()
    _, points = matches(truth)
    centers, _, moved = model_of(truth, points)
    rng = np.random.default_rng(6)
    positions = np.array([pose.center_m for pose in truth.values()]) + rng.normal(0.0, noise_m, (len(truth), 3))
    assert place(centers, moved, positions, np.full(len(centers), 5.0)).kind == "positions"


def test_one_strip_is_levelled_by_the_terrain() -> None:
    truth = {
        f"i{n}": Pose(np.array([25.0 * n, 0.0, 80.0]), from_omega_phi_kappa(2.0, 1.0, 0.0), 0.1, 0.1) for n in range(6)
    }
    xy = np.random.default_rng(2).uniform([-30, -50], [160, 50], (500, 2))
    points = np.column_stack([xy, np.zeros(len(xy))])
    centers, rotations, moved = model_of(truth, points)
    found = place(centers, moved, np.array([p.center_m for p in truth.values()]), np.full(6, 0.1))
    assert max(attitude_errors(truth, found.rotations(rotations))) < 0.1


def test_without_positions_the_terrain_is_level_and_the_flying_height_is_a_hundred() -> None:
    truth = flight()
    _, points = matches(truth)
    centers, rotations, moved = model_of(truth, points)
    found = place(centers, moved, np.full((len(centers), 3), np.nan), np.full(len(centers), np.nan))
    assert (found.kind, found.trusted, found.agreeing.any()) == ("level", False, False)
    heights = found.points(centers)[:, 2] - np.median(found.points(moved)[:, 2])
    assert np.median(heights) == pytest.approx(LOCAL_FLYING_HEIGHT, rel=0.02)
    tilts = [tilt_deg(rotation) for rotation in found.rotations(rotations)]
    np.testing.assert_allclose(tilts, [tilt_deg(pose.world_rotation) for pose in truth.values()], atol=4.0)


def test_similarity_is_exact() -> None:
    rng = np.random.default_rng(3)
    source = rng.normal(size=(9, 3))
    scale, rotation, shift = similarity(source, 2.5 * source @ rotation_z(40.0).T + [1.0, 2.0, 3.0])
    assert scale == pytest.approx(2.5)
    np.testing.assert_allclose(rotation, rotation_z(40.0), atol=1e-12)
    np.testing.assert_allclose(shift, [1.0, 2.0, 3.0], atol=1e-12)
