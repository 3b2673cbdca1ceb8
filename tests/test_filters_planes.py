"""Clustered and direct RANSAC, alone and in chains, on scenes of houses with exact truth."""

from dataclasses import replace

import numpy as np
import pytest
from make_matches import CAMERA0, CAMERA1, GEOMETRY, chance, houses

from aeromatch_cli.data import Candidates
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.planes import plane_distances_px
from aeromatch_cli.lab.strategies.homography import Homography
from aeromatch_cli.strategies.filters import apply_chain
from aeromatch_cli.strategies.filters.clustered_ransac import ClusteredRansac
from aeromatch_cli.strategies.filters.epipolar import Epipolar
from aeromatch_cli.strategies.filters.poselib import Poselib


def test_clusters_keep_roofs_and_streets_where_one_plane_keeps_streets():
    scene = houses(1400, wrong=0.5, seed=1)
    clustered = ClusteredRansac()(scene.candidates, GEOMETRY, 0)
    direct = Homography()(scene.candidates, GEOMETRY, 0)
    roof = scene.true & (scene.height_m > 0)
    assert clustered.state == direct.state == "verified"
    assert clustered.keep[scene.true].mean() > 0.93
    assert clustered.keep[roof].mean() > 0.8
    assert direct.keep[roof].mean() < 0.1
    assert direct.keep[scene.true & ~roof].mean() > 0.95
    assert direct.keep[~scene.true].mean() < 0.02


def test_the_model_is_the_largest_plane_and_errors_are_to_the_own_one():
    scene = houses(600, wrong=0.4, noise_px=0.3, seed=3)
    verdict = ClusteredRansac(clusters=6)(scene.candidates, GEOMETRY, 0)
    assert verdict.model_kind == "H"
    points0, points1 = (
        undistort(camera, px)
        for camera, px in ((CAMERA0, scene.candidates.points0_px), (CAMERA1, scene.candidates.points1_px))
    )
    assert (plane_distances_px(verdict.model[None], points0, points1)[0] <= 3.0).sum() > 30
    assert np.nanmedian(verdict.errors_px[verdict.keep & scene.true]) < 0.7
    assert (verdict.errors_px[~verdict.keep & np.isfinite(verdict.errors_px)] > 3.0).all()


def test_a_chain_keeps_what_poselib_keeps_with_half_its_wrong():
    kept, wrong = np.zeros(2), np.zeros(2)
    for seed in range(2):
        scene = houses(1600, wrong=0.5, seed=seed)
        for side, chain in enumerate(([Poselib(threshold_px=3.0)], [ClusteredRansac(), Epipolar()])):
            verdict = apply_chain(chain, scene.candidates, GEOMETRY, seed)
            kept[side] += verdict.keep[scene.true].sum()
            wrong[side] += verdict.keep[~scene.true].sum()
    assert kept[1] >= 0.95 * kept[0]
    assert wrong[1] <= 0.5 * wrong[0]


def test_rough_ground_is_kept_by_local_support():
    scene = houses(800, wrong=0.4, roof_m=3.0, rough_m=0.4, seed=4)
    verdict = apply_chain([ClusteredRansac(), Epipolar()], scene.candidates, GEOMETRY, 0)
    assert verdict.state == "verified"
    assert verdict.model_kind == "E"
    assert verdict.keep[scene.true].mean() > 0.93


def test_too_little_is_left_to_the_filters_after():
    scene = houses(40, wrong=0.2, roof_m=30.0, rough_m=8.0, seed=5)
    alone = ClusteredRansac()(scene.candidates, GEOMETRY, 0)
    assert alone.state == "not verifiable"
    assert alone.keep.all()
    assert apply_chain([ClusteredRansac(), Epipolar()], scene.candidates, GEOMETRY, 0).state == "verified"


@pytest.mark.parametrize("count", [60, 300, 900])
def test_chance_is_not_verified(count):
    for seed in range(5):
        candidates = chance(count, seed)
        assert ClusteredRansac()(candidates, GEOMETRY, seed).state == "not verifiable"
        assert Homography()(candidates, GEOMETRY, seed).state == "rejected"
        chain = apply_chain([ClusteredRansac(), Epipolar()], candidates, GEOMETRY, seed)
        assert chain.state == "rejected"
        assert not chain.keep.any()


@pytest.mark.parametrize("one", [ClusteredRansac(), Homography()])
@pytest.mark.parametrize("count", [0, 1, 5, 14])
def test_too_few_matches_are_not_verifiable(one, count):
    verdict = one(houses(40, wrong=0.0).candidates.take(np.arange(count)), GEOMETRY, 0)
    assert verdict.state == "not verifiable"
    assert verdict.keep.shape == (count,)


@pytest.mark.parametrize("one", [ClusteredRansac(), Homography()])
def test_points_without_a_ray_are_dropped(one):
    scene = houses(200, wrong=0.1)
    points0 = scene.candidates.points0_px.copy()
    points0[:5] = 90000.0
    folding = replace(GEOMETRY, camera0=replace(CAMERA0, params=(850.0, 499.5, 374.5, -0.3, 0.0)))
    verdict = one(Candidates(points0, scene.candidates.points1_px), folding, 0)
    assert not verdict.keep[:5].any()


def test_clusters_follow_the_colours():
    scene = houses(400, wrong=0.2, seed=6)
    colours = np.array([[20, 20, 20], [200, 40, 40], [40, 200, 40], [200, 200, 200]], np.uint8)
    two, four = (colours[np.arange(400) % number] for number in (2, 4))
    for painted, number in ((two, 2), (four, 4)):
        candidates = replace(scene.candidates, colours0=painted, colours1=painted)
        planes, usable = ClusteredRansac().find_planes(candidates, GEOMETRY, 0)
        assert planes.cluster_idx.max() + 1 == number
        assert usable.all()
    assert ClusteredRansac().find_planes(scene.candidates, GEOMETRY, 0)[0].cluster_idx.max() + 1 == 400 // 64
