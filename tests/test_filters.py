"""Filters on synthetic two-view scenes with exact truth."""

from dataclasses import replace

import numpy as np
import poselib
import pytest

from aeromatch_cli.data import Camera, Candidates, Pair, PairGeometry, Pose, Verdict
from aeromatch_cli.geometry.cameras import project, undistort
from aeromatch_cli.geometry.epipolar import fundamental_from_poses, relative_pose, sampson_distance_px
from aeromatch_cli.geometry.rotations import angle_between_deg, from_omega_phi_kappa
from aeromatch_cli.lab.strategies import ARMS
from aeromatch_cli.strategies.filters import FILTERS, apply_chain
from aeromatch_cli.strategies.filters.pose import PoseBand, predicted_sigma_px
from aeromatch_cli.strategies.filters.poselib import Poselib

EVERY = {**FILTERS, **ARMS["filter"]}

CAMERA0 = Camera("RADIAL", 2000, 1500, (1500.0, 999.5, 749.5, -0.05, 0.01))
CAMERA1 = Camera("PINHOLE", 1600, 1200, (1100.0, 1105.0, 805.0, 596.0))
POSE0 = Pose(np.array([0.0, 0.0, 100.0]), from_omega_phi_kappa(3.0, -2.0, 10.0), 5.0, 3.0)
POSE1 = Pose(np.array([30.0, 8.0, 105.0]), from_omega_phi_kappa(-6.0, 9.0, 55.0), 5.0, 3.0)
GEOMETRY = PairGeometry(Pair("a", "b", 0.7, 15.0, "overlap"), CAMERA0, CAMERA1, POSE0, POSE1, 0.0)


def scene(count, outliers=0.0, noise_px=0.5, seed=0):
    """Matches (N, 2) in stored pixels of both images, and which of them are true."""
    rng = np.random.default_rng(seed)
    ground = np.stack([rng.uniform(-60, 80, 20 * count), rng.uniform(-60, 60, 20 * count)], axis=1)
    points_m = np.concatenate([ground, rng.uniform(0, 25, (20 * count, 1))], axis=1)
    sides = []
    for camera, pose in ((CAMERA0, POSE0), (CAMERA1, POSE1)):
        px = project(camera, pose.world_rotation, pose.center_m, points_m)
        px += rng.normal(0, noise_px, px.shape)
        px[((px < 0) | (px > [camera.width_px, camera.height_px])).any(axis=1)] = np.nan
        sides.append(px)
    seen = np.flatnonzero(np.isfinite(sides[0] + sides[1]).all(axis=1))[:count]
    points0, points1 = sides[0][seen], sides[1][seen]
    assert len(points0) == count
    wrong = rng.random(count) < outliers
    points1[wrong] = rng.uniform(0, [CAMERA1.width_px, CAMERA1.height_px], (wrong.sum(), 2))
    return points0, points1, ~wrong


def test_poselib_recovers_the_rotation_among_half_outliers():
    errors_deg = []
    for seed in range(9):
        points0, points1, true = scene(600, outliers=0.5, noise_px=0.3, seed=seed)
        verdict = Poselib()(Candidates(points0, points1), GEOMETRY, seed)
        assert verdict.state == "verified"
        assert verdict.model_kind == "E"
        assert verdict.keep[true].mean() > 0.99
        assert (verdict.keep & ~true).sum() < 0.02 * true.sum() + 10
        errors_deg.append(angle_between_deg(verdict.relative_rotation, relative_pose(POSE0, POSE1)[0]))
    assert np.median(errors_deg) < 0.05
    assert max(errors_deg) < 0.1


def test_poselib_survives_few_inliers():
    points0, points1, true = scene(400, outliers=0.8, seed=5)
    verdict = Poselib()(Candidates(points0, points1), GEOMETRY, 1)
    assert verdict.state == "verified"
    assert verdict.keep[true].mean() > 0.97
    assert angle_between_deg(verdict.relative_rotation, relative_pose(POSE0, POSE1)[0]) < 0.3


def test_the_model_acts_on_normalised_rays():
    points0, points1, _ = scene(300, noise_px=0.0)
    verdict = Poselib()(Candidates(points0, points1), GEOMETRY, 0)
    normalised = []
    for camera, points in ((CAMERA0, points0), (CAMERA1, points1)):
        k = camera.params if camera.model == "PINHOLE" else (camera.params[0], *camera.params[:3])
        uv = (undistort(camera, points) - k[2:4]) / k[:2]
        normalised.append(np.concatenate([uv, np.ones((len(uv), 1))], axis=1))
    residual = np.einsum("ni,ij,nj->n", normalised[1], verdict.model, normalised[0])
    assert np.abs(residual).max() < 1e-6
    assert verdict.errors_px.max() < 1e-3
    assert np.isfinite(verdict.errors_px).all()


def test_the_fundamental_matrix_acts_on_undistorted_pixels():
    points0, points1, true = scene(400, outliers=0.3, seed=2)
    verdict = Poselib(model="fundamental")(Candidates(points0, points1), GEOMETRY, 0)
    assert verdict.state == "verified"
    assert verdict.model_kind == "F"
    assert verdict.relative_rotation is None
    errors = sampson_distance_px(verdict.model, undistort(CAMERA0, points0), undistort(CAMERA1, points1))
    assert np.median(errors[true]) < 0.5
    assert verdict.keep[true].mean() > 0.97


@pytest.mark.parametrize("count", [15, 30, 60])
def test_random_matches_are_not_verified(count):
    for seed in range(8):
        rng = np.random.default_rng(seed)
        points0 = rng.uniform(0, [2000, 1500], (count, 2))
        points1 = rng.uniform(0, [1600, 1200], (count, 2))
        verdict = Poselib()(Candidates(points0, points1), GEOMETRY, seed)
        assert verdict.state == "rejected"
        assert not verdict.keep.any()
        assert "15 needed" in verdict.reason


@pytest.mark.parametrize("count", [0, 1, 7, 14])
@pytest.mark.parametrize("model", ["relative_pose", "fundamental"])
def test_too_few_matches_are_not_verifiable(count, model):
    points0, points1, _ = scene(20)
    verdict = Poselib(model=model)(Candidates(points0[:count], points1[:count]), GEOMETRY, 0)
    assert verdict.state == "not verifiable"
    assert verdict.keep.shape == (count,)
    assert not verdict.keep.any()
    assert verdict.reason == f"{count} {'match' if count == 1 else 'matches'}, 15 needed"


def test_points_without_a_ray_are_dropped():
    points0, points1, _ = scene(100)
    folding = Camera("SIMPLE_RADIAL", 2000, 1500, (1500.0, 999.5, 749.5, -0.5))
    points0[:5] = [90000.0, 90000.0]
    verdict = Poselib()(Candidates(points0, points1), replace(GEOMETRY, camera0=folding), 0)
    assert not verdict.keep[:5].any()


@pytest.mark.parametrize("name", sorted(EVERY))
def test_two_runs_are_equal_to_the_bit(name):
    points0, points1, _ = scene(300, outliers=0.6, seed=3)
    first, second = (EVERY[name]()(Candidates(points0, points1), GEOMETRY, 11) for _ in range(2))
    assert np.array_equal(first.keep, second.keep)
    assert np.array_equal(first.model, second.model)
    assert np.array_equal(first.errors_px, second.errors_px)


@pytest.mark.parametrize(
    ("model", "estimator"), [("relative_pose", "estimate_relative_pose"), ("fundamental", "estimate_fundamental")]
)
def test_the_options_and_the_seed_of_the_pair_reach_the_estimator(monkeypatch, model, estimator):
    seen = []

    def recording(*arguments):
        seen.append(arguments[-2])
        return estimate(*arguments)

    estimate = getattr(poselib, estimator)
    monkeypatch.setattr(poselib, estimator, recording)
    points0, points1, _ = scene(100)
    recipe = Poselib(model=model, threshold_px=2.5, confidence=0.99, min_iterations=20, max_iterations=700)
    for seed in (12345, 0):
        assert apply_chain([PoseBand(), recipe], Candidates(points0, points1), GEOMETRY, seed).state == "verified"
    options = {"max_epipolar_error": 2.5, "success_prob": 0.99, "min_iterations": 20, "max_iterations": 700}
    assert seen == [{**options, "seed": 12345}, {**options, "seed": 0}]


def turned(pose, rng):
    """The pose as a sensor with its stated accuracy would report it."""
    angles = rng.normal(0, pose.sigma_angle_deg, 3)
    shift = rng.normal(0, pose.sigma_position_m, 3)
    small = from_omega_phi_kappa(0.0, 0.0, 0.0).T @ from_omega_phi_kappa(*angles)
    return replace(pose, center_m=pose.center_m + shift, world_rotation=pose.world_rotation @ small)


def noisy_poses(seed, sigma_angle_deg, sigma_position_m):
    rng = np.random.default_rng(seed)
    stated = [replace(p, sigma_angle_deg=sigma_angle_deg, sigma_position_m=sigma_position_m) for p in (POSE0, POSE1)]
    return replace(GEOMETRY, pose0=turned(stated[0], rng), pose1=turned(stated[1], rng))


@pytest.mark.parametrize(("sigma_angle_deg", "sigma_position_m"), [(0.1, 0.1), (1.0, 1.0), (3.0, 0.1), (0.1, 4.0)])
def test_the_band_keeps_true_matches_at_the_stated_sigma(sigma_angle_deg, sigma_position_m):
    points0, points1, _ = scene(100, seed=1)
    kept = [
        PoseBand()(Candidates(points0, points1), noisy_poses(seed, sigma_angle_deg, sigma_position_m), 0).keep.mean()
        for seed in range(60)
    ]
    assert np.mean(kept) >= 0.95


def test_the_predicted_sigma_is_the_scatter_of_the_errors():
    points0, points1, _ = scene(40, noise_px=0.0, seed=4)
    undistorted0, undistorted1 = undistort(CAMERA0, points0), undistort(CAMERA1, points1)
    errors = []
    for seed in range(600):
        g = noisy_poses(seed, 0.2, 0.3)
        matrix = fundamental_from_poses(CAMERA0, g.pose0, CAMERA1, g.pose1)
        errors.append(sampson_distance_px(matrix, undistorted0, undistorted1))
    measured = np.sqrt(np.mean(np.square(errors), axis=0))
    stated = [replace(p, sigma_angle_deg=0.2, sigma_position_m=0.3) for p in (POSE0, POSE1)]
    predicted = predicted_sigma_px(undistorted0, undistorted1, CAMERA0, stated[0], CAMERA1, stated[1])
    assert predicted / measured == pytest.approx(np.ones(40), abs=0.12)


def test_the_band_drops_what_is_far_off():
    points0, points1, _ = scene(200, seed=2)
    geometry = replace(
        GEOMETRY,
        pose0=replace(POSE0, sigma_angle_deg=0.1, sigma_position_m=0.1),
        pose1=replace(POSE1, sigma_angle_deg=0.1, sigma_position_m=0.1),
    )
    matrix = fundamental_from_poses(CAMERA0, POSE0, CAMERA1, POSE1)
    lines = undistort(CAMERA0, points0) @ matrix[:, :2].T + matrix[:, 2]
    across = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    assert PoseBand()(Candidates(points0, points1), geometry, 0).keep.all()
    verdict = PoseBand()(Candidates(points0, points1 + 100 * across), geometry, 0)
    assert not verdict.keep.any()
    assert (verdict.errors_px > 30).all()


def test_without_poses_or_baseline_everything_passes():
    points0, points1, _ = scene(30, outliers=1.0)
    for geometry in (
        replace(GEOMETRY, pose0=None),
        replace(GEOMETRY, pose1=replace(POSE1, world_rotation=None)),
        replace(GEOMETRY, pose1=replace(POSE1, center_m=POSE0.center_m)),
    ):
        verdict = PoseBand()(Candidates(points0, points1), geometry, 0)
        assert verdict.keep.all()
        assert verdict.state == "not verifiable"
    assert PoseBand()(Candidates(points0[:0], points1[:0]), GEOMETRY, 0).keep.shape == (0,)


def test_a_chain_counts_what_each_filter_dropped():
    points0, points1, true = scene(400, outliers=0.5, seed=6)
    band, chain = PoseBand()(Candidates(points0, points1), GEOMETRY, 0), (PoseBand(), Poselib())
    verdict = apply_chain(chain, Candidates(points0, points1), GEOMETRY, 0)
    assert verdict.state == "verified"
    assert verdict.model_kind == "E"
    assert verdict.rejected["pose"] == (~band.keep).sum()
    assert verdict.rejected["pose"] + verdict.rejected["poselib"] == (~verdict.keep).sum()
    assert verdict.keep[true].mean() > 0.97
    assert np.isfinite(verdict.errors_px[verdict.keep]).all()
    assert np.isnan(verdict.errors_px[~band.keep]).all()
    assert verdict.errors_px[verdict.keep].max() <= 4.0


def test_a_chain_of_one_is_the_filter():
    points0, points1, _ = scene(100, outliers=0.4)
    alone, chained = (
        Poselib()(Candidates(points0, points1), GEOMETRY, 3),
        apply_chain([Poselib()], Candidates(points0, points1), GEOMETRY, 3),
    )
    assert np.array_equal(alone.keep, chained.keep)
    assert np.array_equal(alone.model, chained.model)
    assert np.array_equal(alone.errors_px, chained.errors_px)
    assert chained.rejected == {"poselib": int((~alone.keep).sum())}


def test_a_refusal_keeps_nothing():
    rng = np.random.default_rng(0)
    points0, points1 = rng.uniform(0, 1500, (40, 2)), rng.uniform(0, 1200, (40, 2))
    verdict = apply_chain([Poselib(), PoseBand()], Candidates(points0, points1), GEOMETRY, 0)
    assert verdict.state == "rejected"
    assert not verdict.keep.any()
    assert verdict.rejected == {"poselib": 40}
    assert "inliers of 40 matches" in verdict.reason


def test_a_chain_without_a_model_is_not_verifiable():
    points0, points1, _ = scene(50)
    verdict = apply_chain([PoseBand()], Candidates(points0, points1), GEOMETRY, 0)
    assert verdict.state == "not verifiable"
    assert verdict.keep.all()
    few = apply_chain([PoseBand(), Poselib()], Candidates(points0[:14], points1[:14]), GEOMETRY, 0)
    assert few.state == "not verifiable"
    assert not few.keep.any()
    assert few.rejected == {"pose": 0, "poselib": 14}
    empty = apply_chain([Poselib()], Candidates(points0[:0], points1[:0]), GEOMETRY, 0)
    assert empty.state == "not verifiable"
    assert empty.keep.shape == (0,)


class _DropAll:
    name = "drop"

    def __call__(self, candidates, geometry, seed):
        return Verdict(keep=np.zeros(len(candidates), dtype=bool), state="not verifiable", reason="none fits")


def test_a_verified_pair_that_loses_every_match_is_rejected():
    points0, points1, _ = scene(50)
    verdict = apply_chain([Poselib(), _DropAll()], Candidates(points0, points1), GEOMETRY, 0)
    assert verdict.state == "rejected"
    assert verdict.reason == "drop left no match"
    assert sum(verdict.rejected.values()) == 50
