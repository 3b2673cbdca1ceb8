"""What verifies a pair: more inliers than chance gives, with every filter that stands on one model."""

from functools import partial

import numpy as np
import pytest
from make_matches import GEOMETRY, POSE0, POSE1, chance, houses

from aeromatch_cli.data import Candidates, Verdict
from aeromatch_cli.geometry.epipolar import relative_pose, sampson_distance_px
from aeromatch_cli.geometry.rotations import angle_between_deg
from aeromatch_cli.geometry.two_view import chance_errors_px, log10_false_alarms
from aeromatch_cli.lab.strategies.magsac import Magsac
from aeromatch_cli.strategies.filters import apply_chain
from aeromatch_cli.strategies.filters.clustered_ransac import ClusteredRansac
from aeromatch_cli.strategies.filters.epipolar import Epipolar
from aeromatch_cli.strategies.filters.poselib import Poselib

GATES = [Poselib(), Poselib(model="fundamental"), Epipolar(), Epipolar(model="fundamental"), Magsac()]


def named(one):
    return f"{one.name} {getattr(one, 'model', '')}"


@pytest.mark.parametrize("one", GATES, ids=named)
@pytest.mark.parametrize("count", [20, 80, 500])
def test_chance_is_rejected_however_many_inliers_it_has(one, count):
    for seed in range(3):
        verdict = one(chance(count, seed), GEOMETRY, seed)
        assert verdict.state == "rejected"
        assert not verdict.keep.any()


def test_many_inliers_among_many_matches_are_no_evidence():
    verdict = Poselib(max_false_alarms=1e300)(chance(500, 1), GEOMETRY, 0)
    assert verdict.state == "verified"
    assert verdict.keep.sum() >= 15
    assert "no more than chance" in Poselib()(chance(500, 1), GEOMETRY, 0).reason


@pytest.mark.parametrize("one", [Poselib(), Epipolar()], ids=named)
@pytest.mark.parametrize(("count", "wrong"), [(22, 0.1), (45, 0.4), (80, 0.6)])
def test_few_true_matches_stay_verified(one, count, wrong):
    for seed in range(4):
        scene = houses(count, wrong=wrong, seed=seed)
        verdict = one(scene.candidates, GEOMETRY, seed)
        assert verdict.state == "verified"
        assert verdict.keep[scene.true].mean() > 0.9


@pytest.mark.parametrize("one", GATES, ids=named)
def test_true_matches_among_as_many_wrong_ones(one):
    scene = houses(600, wrong=0.5, seed=7)
    verdict = one(scene.candidates, GEOMETRY, 0)
    assert verdict.state == "verified"
    assert verdict.keep[scene.true].mean() > 0.97
    assert verdict.keep[~scene.true].mean() < 0.04
    assert np.median(verdict.errors_px[scene.true]) < 0.5


def test_the_band_follows_the_noise_of_the_data():
    kept = {}
    for noise_px in (0.1, 0.4, 1.2):
        scene = houses(600, wrong=0.5, noise_px=noise_px, seed=8)
        verdict = Epipolar(min_band_px=1.0)(scene.candidates, GEOMETRY, 0)
        assert verdict.keep[scene.true].mean() > 0.97
        kept[noise_px] = verdict.errors_px[verdict.keep].max()
    assert kept[0.1] <= 1.0 < kept[0.4] < 2.5 < kept[1.2] <= 4.0
    scene = houses(600, wrong=0.5, noise_px=0.1, seed=8)
    verdict = Epipolar()(scene.candidates, GEOMETRY, 0)
    assert 1.0 < verdict.errors_px[verdict.keep].max() <= 1.5


def test_the_band_leaves_few_matches_together():
    scene = houses(17, wrong=0.0, noise_px=0.2, seed=9)
    points1 = scene.candidates.points1_px.copy()
    points1[:6] += [[1.5, -1.5]]
    strict = Epipolar(sigmas=0.1, min_band_px=0.01)
    verdict = strict(Candidates(scene.candidates.points0_px, points1), GEOMETRY, 0)
    assert verdict.state == "verified"
    assert verdict.keep.sum() >= 15


def test_epipolar_finds_the_rotation():
    scene = houses(500, wrong=0.5, noise_px=0.2, seed=10)
    verdict = Epipolar()(scene.candidates, GEOMETRY, 0)
    assert angle_between_deg(verdict.relative_rotation, relative_pose(POSE0, POSE1)[0]) < 0.1


def test_magsac_is_the_same_whatever_ran_before_it():
    scene = houses(400, wrong=0.6, seed=11)
    first = Magsac()(scene.candidates, GEOMETRY, 0)
    Magsac()(houses(300, wrong=0.3, seed=12).candidates, GEOMETRY, 1)
    second = Magsac()(scene.candidates, GEOMETRY, 5)
    assert np.array_equal(first.keep, second.keep)
    assert np.array_equal(first.model, second.model)


@pytest.mark.parametrize("one", GATES, ids=named)
@pytest.mark.parametrize("count", [0, 3, 6, 14])
def test_too_few_matches_are_not_verifiable(one, count):
    verdict = one(houses(20, wrong=0.0).candidates.take(np.arange(count)), GEOMETRY, 0)
    assert verdict.state == "not verifiable"
    assert verdict.reason == f"{count} matches, 15 needed"


@pytest.mark.parametrize("one", GATES, ids=named)
def test_one_place_many_times_verifies_nothing(one):
    places = np.full((40, 2), 200.0)
    assert one(Candidates(places, places), GEOMETRY, 0).state == "rejected"


def test_false_alarms_of_a_known_case():
    # Pictures of 100 rows whose epipolar lines are rows: a wrong match is within one row of its own with a chance of
    # 2 %, and thirty of 200 are: C(200, 30) = 10^35.61, C(30, 5) = 10^5.15, ten models of each of 195 samples.
    rng = np.random.default_rng(0)
    rows = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    points0, points1 = (np.column_stack([50.0 * rng.permutation(200), rng.uniform(0, 100, 200)]) for _ in range(2))
    points1[:30, 1] = points0[:30, 1]
    distance = partial(sampson_distance_px, rows)
    wrong = chance_errors_px(distance, points0, points1)
    assert np.mean(wrong <= np.sqrt(0.5)) == pytest.approx(0.02, abs=0.006)
    found = log10_false_alarms(points0, points1, np.arange(200) < 30, wrong, np.sqrt(0.5), 5)
    assert found == pytest.approx(35.61 + 5.15 + np.log10(1950) + 25 * np.log10(0.02), abs=3.0)


def test_copies_of_a_match_are_no_further_evidence():
    scene = houses(60, wrong=0.5, noise_px=0.2, seed=13)
    verdict = Poselib()(scene.candidates, GEOMETRY, 0)
    few = np.flatnonzero(verdict.keep)[:9]
    wrong = np.flatnonzero(~verdict.keep)
    copied = scene.candidates.take(np.concatenate([np.repeat(few, 4), wrong]))
    assert Poselib()(copied, GEOMETRY, 0).state == "rejected"


class _KeepFew:
    name = "few"

    def __init__(self, count):
        self.count = count

    def __call__(self, candidates, geometry, seed):
        keep = np.arange(len(candidates)) < self.count
        return Verdict(keep=keep, state="not verifiable", reason="a limit")


@pytest.mark.parametrize("judge", [Poselib(), ClusteredRansac(), Poselib(min_inliers=20)])
@pytest.mark.parametrize("after", [[], [Poselib(min_inliers=40)]], ids=["last", "before another"])
def test_a_pair_left_with_fewer_matches_than_verify_it_is_rejected(judge, after):
    given = houses(60, wrong=0.0, seed=13).candidates
    short = judge.min_inliers - 3
    verdict = apply_chain([judge, _KeepFew(short), *after], given, GEOMETRY, 0)
    assert verdict.state == "rejected"
    assert verdict.reason == f"{short} inliers of 60 matches, {judge.min_inliers} needed"
    assert not verdict.keep.any()
    assert verdict.relative_rotation is None
    assert sum(verdict.rejected.values()) == 60
    enough = apply_chain([judge, _KeepFew(30)], given, GEOMETRY, 0)  # beyond chance, too
    assert enough.state == "verified"
    assert enough.keep.sum() == 30
