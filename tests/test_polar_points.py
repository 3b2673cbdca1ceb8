"""Least-squares tie points against known shifts, over relief, masks and outliers."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from make_ground import Shot, pair

from aeromatch_cli.data import Camera, Features, Pair, PairGeometry
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.grid import Grid
from aeromatch_cli.strategies.matchers.polar import Measured, Polar
from aeromatch_cli.strategies.matchers.polar.points import agreed
from aeromatch_cli.strategies.simulators.none import source_view

CAMERA = Camera("PINHOLE", 720, 540, (700.0, 700.0, 359.5, 269.5))
GEOMETRY = PairGeometry(Pair("a", "b", float("nan"), float("nan"), "name"), CAMERA, CAMERA, None, None, None)


def grid(image: Shot, points: int = 800) -> Features:
    gray = image.pixels.astype(np.uint8)
    return Grid(points=points)(CAMERA, [ViewPixels(source_view(CAMERA), gray, image.valid)])


def test_points_are_measured_to_a_few_hundredths_of_a_pixel_both_ways():
    first, second, truth = pair(40.0, 0.95, (80.0, 50.0), seed=12, gain=0.9, offset=10.0)
    sides = grid(first), grid(second)
    matches = Polar()(*sides, GEOMETRY, (first, second))
    assert ((matches.indices < 0).sum(axis=1) == 1).all()
    assert matches.remark == ""
    ways = (truth, np.linalg.inv(truth))
    for side, (features, way) in enumerate(zip(sides, ways, strict=True)):
        rows = np.flatnonzero(matches.indices[:, side] >= 0)
        own, there = (matches.points0_px, matches.points1_px)[:: 1 - 2 * side]
        assert np.array_equal(own[rows], features.keypoints_px[matches.indices[rows, side]])
        ends = apply_homography(way, features.keypoints_px)
        visible = ((ends >= 12.0) & (ends <= np.array([707.0, 527.0]))).all(axis=1)
        assert len(rows) > 0.9 * visible.sum()
        off = np.linalg.norm(there[rows] - apply_homography(way, own[rows]), axis=1)
        assert np.median(off) < 0.06
        assert np.percentile(off, 95) < 0.2


@pytest.mark.parametrize(("turn_deg", "scale"), [(12.0, 1.05), (200.0, 0.85)])
def test_the_similarity_of_the_tie_points_is_right_to_a_hundredth_of_a_pixel(turn_deg: float, scale: float):
    first, second, truth = pair(turn_deg, scale, (50.0, 20.0), seed=18)
    polar = Polar()
    found = polar.registered(first, second, GEOMETRY)
    points = polar.measured(found, *(grid(shot, 150).keypoints_px for shot in (first, second)))
    matrix = points.similarity()
    shared = points.points0_px.mean(axis=0, keepdims=True)
    off_px = np.linalg.norm(apply_homography(matrix, shared) - apply_homography(truth, shared))
    assert off_px < 0.01
    assert abs(np.rad2deg(np.angle((matrix[0, 0] + 1j * matrix[1, 0]) / (truth[0, 0] + 1j * truth[1, 0])))) < 0.002
    gross = replace(
        points, points1_px=points.points1_px + np.where(np.arange(len(points.indices)) % 10 == 0, 5.0, 0.0)[:, None]
    )
    again = gross.similarity()
    assert np.linalg.norm(apply_homography(again, shared) - apply_homography(truth, shared)) < 0.01
    with pytest.raises(ValueError, match="two tie points, there are 1"):
        Measured(points.indices[:1], *(getattr(points, name)[:1] for name in (
            "points0_px", "points1_px", "correlations", "sigmas_px"))).similarity()  # fmt: skip


def test_the_order_of_the_images_makes_no_difference_to_where_points_lie():
    first, second, _ = pair(12.0, 1.05, (50.0, 20.0), seed=18)
    sides = grid(first, 300), grid(second, 300)
    one = Polar()(*sides, GEOMETRY, (first, second))
    other = Polar()(*sides[::-1], GEOMETRY, (second, first))
    found, turned = ({tuple(row): place for row, place in zip(rows, places, strict=True)} for rows, places in (
        (one.indices.tolist(), np.hstack([one.points0_px, one.points1_px])),
        (other.indices[:, ::-1].tolist(), np.hstack([other.points1_px, other.points0_px])),
    ))  # fmt: skip
    assert len(found.keys() ^ turned.keys()) <= 0.03 * len(found)
    off = [np.abs(found[row] - turned[row]).max() for row in found.keys() & turned.keys()]
    assert np.percentile(off, 95) < 0.02


@pytest.mark.parametrize(("noise", "blur_px"), [(2.0, 0.0), (8.0, 0.0), (4.0, 1.5)])
def test_sigmas_are_as_large_as_errors(noise, blur_px):
    first, second, truth = pair(15.0, 1.02, (60.0, 30.0), seed=19, noise=noise)
    if blur_px:
        first, second = (Shot(cv2.GaussianBlur(side.pixels, (0, 0), blur_px)) for side in (first, second))
    found = Polar().registered(first, second, GEOMETRY)
    points = Polar().measured(found, grid(first).keypoints_px, np.zeros((0, 2)))
    off = np.linalg.norm(points.points1_px - apply_homography(truth, points.points0_px), axis=1)
    assert 0.5 < np.sqrt(np.mean((off / points.sigmas_px) ** 2)) < 1.6


def test_relief_is_followed_point_by_point():
    first, second, truth = pair(10.0, 1.0, (60.0, 0.0), seed=13)
    # Hills move the ground along x by up to 6 px.
    y, x = np.mgrid[0:540, 0:720].astype(np.float32)
    hills = 6.0 * np.sin(x / 130.0) * np.cos(y / 110.0)
    moved = cv2.remap(second.pixels, x + hills, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    other = Shot(moved.astype(np.float32))
    matches = Polar()(grid(first), grid(other), GEOMETRY, (first, other))
    flat = apply_homography(truth, matches.points0_px)
    # What stands at (x, y) stood at (x + hills, y).
    found = matches.points1_px + np.column_stack(
        [6.0 * np.sin(matches.points1_px[:, 0] / 130.0) * np.cos(matches.points1_px[:, 1] / 110.0), np.zeros(len(flat))]
    )
    off = np.linalg.norm(found - flat, axis=1)
    assert len(off) > 700
    assert np.median(off) < 0.1
    assert np.percentile(off, 95) < 0.4


def test_nothing_is_measured_where_one_side_is_masked():
    first, second, truth = pair(0.0, 1.0, (40.0, 0.0), seed=14)
    valid = np.ones(second.pixels.shape, bool)
    valid[:, :300] = False
    masked = replace(second, valid=valid)
    matches = Polar()(grid(first), grid(masked), GEOMETRY, (first, masked))
    assert len(matches.indices) > 400
    assert matches.points1_px[:, 0].min() > 300.0
    off = np.linalg.norm(matches.points1_px - apply_homography(truth, matches.points0_px), axis=1)
    assert off.max() < 0.5


def test_a_smaller_working_size_measures_as_well_as_its_pixels_allow():
    first, second, truth = pair(12.0, 1.05, (60.0, 30.0), seed=17)
    half = tuple(replace(side, finest=0.5) for side in (first, second))
    matches = Polar()(grid(first, 400), grid(second, 400), GEOMETRY, half)
    off = np.linalg.norm(matches.points1_px - apply_homography(truth, matches.points0_px), axis=1)
    assert len(off) > 300
    assert np.median(off) < 0.15


@pytest.mark.parametrize(("settings", "said"), [
    ({"min_scale": 1.3, "max_scale": 0.8}, "larger than max_scale"), ({"window_px": 30}, "give 31"),
])  # fmt: skip
def test_settings_that_cannot_be_are_refused(settings, said):
    with pytest.raises(ValueError, match=said):
        Polar(**settings)


def test_one_scale_alone_may_be_asked_for():
    first, second, _ = pair(10.0, 1.0, (40.0, 0.0), seed=3)
    assert Polar(min_scale=1.0, max_scale=1.0).registered(first, second, GEOMETRY).registration.accepted


@pytest.mark.slow
def test_a_pair_that_is_not_registered_has_no_points_and_a_remark():
    first, _, _ = pair(0.0, 1.0, (0.0, 0.0), seed=15)
    _, second, _ = pair(0.0, 1.0, (0.0, 0.0), seed=16)
    features = grid(first)
    matches = Polar()(features, features, GEOMETRY, (first, second))
    assert len(matches.indices) == 0
    assert matches.remark


def test_without_rasters_it_says_what_it_needs():
    first, _, _ = pair(0.0, 1.0, (0.0, 0.0), seed=15)
    features = grid(first, 20)
    with pytest.raises(ValueError, match="needs both rasters"):
        Polar()(features, features, GEOMETRY)


def test_neighbours_outvote_what_contradicts_them():
    rng = np.random.default_rng(0)
    places = rng.uniform(0.0, 1000.0, (300, 2))
    shifts = 0.01 * places + 0.1 * rng.standard_normal((300, 2))
    wrong = rng.choice(300, 60, replace=False)
    shifts[wrong] += rng.uniform(3.0, 20.0, (60, 2))
    expected, good = agreed(places, shifts, np.ones(300, bool), 1.0)
    right = np.setdiff1d(np.arange(300), wrong)
    assert not good[wrong].any()
    assert good[right].mean() > 0.95
    assert np.median(np.linalg.norm(expected - 0.01 * places, axis=1)) < 0.2


def test_few_points_have_nobody_to_agree_with():
    places = np.random.default_rng(1).uniform(0.0, 100.0, (8, 2))
    assert not agreed(places, np.zeros((8, 2)), np.ones(8, bool), 1.0)[1].any()
