"""Keypoints from heat maps: exact places, scale, light, tiles, and how often the shipped weights find them again."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from trainings.detector.scenes import sights
from trainings.detector.validation import by_heat, by_sift, pairs_of, scores, table

from aeromatch_cli.strategies.extractors.heat import SIZE_PX, heat, heat_keypoints, maxima, refined
from aeromatch_cli.strategies.extractors.pyramid import SUPPORT, levels_of

Gray = NDArray[np.uint8]


def spot(middle_px: tuple[float, float], radius_px: float, side_px: int = 96) -> Gray:
    """A bright disc with a soft edge on dark ground."""
    y, x = np.mgrid[0:side_px, 0:side_px].astype(np.float64)
    away = np.hypot(x - middle_px[0], y - middle_px[1])
    return np.rint(70 + 110 / (1.0 + np.exp((away - radius_px) / 0.4))).astype(np.uint8)


def texture(height: int, width: int, seed: int = 0) -> Gray:
    """Random rectangles, as roofs and fields have corners."""
    rng = np.random.default_rng(seed)
    picture = np.full((height, width), 110.0)
    for _ in range(height * width // 900):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        picture[y : y + int(rng.integers(4, 40)), x : x + int(rng.integers(4, 40))] = rng.uniform(40, 215)
    blurred = cv2.GaussianBlur(picture, (0, 0), 0.8) + rng.normal(0.0, 2.0, picture.shape)
    return np.clip(np.rint(blurred), 0, 255).astype(np.uint8)


def share_within(points0_px: NDArray[np.float64], points1_px: NDArray[np.float64], limit_px: float) -> float:
    """Of the first points, those that have a second one within the limit."""
    away = np.linalg.norm(points0_px[:, None] - points1_px[None], axis=2).min(axis=1)
    return float((away <= limit_px).mean())


def test_top_of_a_gaussian_is_found_below_the_pixel() -> None:
    y, x = np.mgrid[0:21, 0:21].astype(np.float64)
    logits = (2.0 - ((x - 10.3) ** 2 + (y - 9.6) ** 2) / (2 * 1.2**2)).astype(np.float32)
    steps, values = refined(logits, np.array([10]), np.array([10]))
    assert steps[0] == pytest.approx([0.3, -0.4], abs=1e-5)
    assert values[0] == pytest.approx(2.0, abs=0.01)


def test_a_maximum_beats_its_neighbours_in_place_and_leaves_those_of_other_levels() -> None:
    levels = levels_of(texture(128, 128), most=3)
    maps = [np.full(level.gray.shape, -9.0, np.float32) for level in levels]
    for number, (level, logits) in enumerate(zip(levels, maps, strict=True)):
        column, row = np.rint(level.from_picture(np.array([[60.0, 40.0]]))[0]).astype(int)
        logits[row, column] = (0.0, 2.0, 1.0)[number]
    points, sizes, values = maxima(levels, maps)
    assert sizes == pytest.approx(SIZE_PX * 2 ** np.array([0.0, 0.5, 1.0]), rel=0.02)
    assert points == pytest.approx(np.array([[60.0, 40.0]] * 3), abs=0.75)
    assert values == pytest.approx([0.0, 2.0, 1.0], abs=0.02)


class Peaks:
    """Stands for the network: log odds of 2 at chosen pixels of maps of chosen heights, little elsewhere."""

    first = SimpleNamespace(weight=torch.zeros(1))

    def __init__(self, *peaks: tuple[int, int, int]) -> None:
        self.peaks = peaks

    def __call__(self, gray: torch.Tensor) -> torch.Tensor:
        logits = torch.full_like(gray, -9.0)
        for height, row, column in self.peaks:
            if gray.shape[2] == height:
                logits[0, 0, row, column] = 2.0
        return logits


def test_of_equal_heat_the_finer_keypoint_comes_first() -> None:
    picture = texture(128, 128)
    fine, half = levels_of(picture)[0].gray.shape[0], levels_of(picture)[2].gray.shape[0]
    network = Peaks((half, 40, 40), (fine, 30, 100), (fine, 110, 20))
    _, sizes, confidences = heat_keypoints(picture, 10, network=network)
    assert sizes == pytest.approx([SIZE_PX, SIZE_PX, 2 * SIZE_PX], rel=0.02)
    odds = np.log(confidences / (1.0 - confidences))
    assert odds[0] - odds[2] == pytest.approx(2 * 0.6, abs=0.02)  # of log odds for each of two half octaves
    assert len(heat_keypoints(picture, 2, network=network)[0]) == 2


def test_where_a_levels_edge_is_seen_nothing_is_found() -> None:
    picture = texture(128, 128)
    inner, outer = ((row, column) for row, column in ((60, 4), (60, 3)))
    assert len(heat_keypoints(picture, 10, network=Peaks((128, *inner)))[0]) == 1
    assert len(heat_keypoints(picture, 10, network=Peaks((128, *outer)))[0]) == 0


def test_a_patch_shows_48_pixels_of_its_level() -> None:
    assert pytest.approx(48.0) == SIZE_PX * SUPPORT


@pytest.mark.parametrize("middle", [(47.0, 48.0), (47.4, 48.3), (46.75, 44.5)])
def test_a_spot_is_found_at_its_place(middle: tuple[float, float]) -> None:
    points, sizes, confidences = heat_keypoints(spot(middle, 1.5), 10)
    assert np.linalg.norm(points[0] - middle) < 0.25
    assert points.dtype == sizes.dtype == confidences.dtype == np.float64
    assert (np.diff(confidences) <= 0).all()


@pytest.mark.slow
def test_places_move_with_the_picture_below_the_pixel() -> None:
    # Means of 2 x 2 pixels, from the first pixel and from the second: exactly half a pixel apart.
    fine = texture(481, 641, seed=2)
    first, second = (
        cv2.resize(fine[start : 480 + start, start : 640 + start], (320, 240), interpolation=cv2.INTER_AREA)
        for start in (0, 1)
    )
    points0, points1 = (heat_keypoints(each, 200)[0] for each in (first, second))
    away = np.linalg.norm(points0[:, None] - (points1[None] + 0.5), axis=2).min(axis=1)
    same = away < 1.0
    assert same.mean() > 0.75
    assert np.median(away[same]) < 0.2


@pytest.mark.slow
def test_light_changes_few_keypoints() -> None:
    picture = texture(240, 320)
    darker = np.rint(picture * 0.6 + 20).astype(np.uint8)
    first, second = (heat_keypoints(each, 200)[0] for each in (picture, darker))
    assert share_within(first, second, 0.5) > 0.85


@pytest.mark.slow
def test_tiles_change_nothing() -> None:
    picture = texture(400, 500)
    whole, tiled = heat(picture), heat(picture, tile_area_px=70_000)
    assert np.abs(whole - tiled).max() < 1e-4
    assert np.array_equal(heat(picture), whole)


@pytest.mark.slow
def test_more_of_a_rendered_place_is_found_again_than_with_sift(rendered: Path) -> None:
    pairs = pairs_of([sights(rendered)])
    heat_rows, sift_rows = (table(scores(pairs, find, 150)) for find in (by_heat(None), by_sift))
    # Within 3 px 0.756 and 0.680, within 1 px 0.651 and 0.552 when these weights were made; SIFT: 0.571, 0.478 and
    # 0.413, 0.326.
    for angle, row in heat_rows.items():
        assert row["3px"] > 1.25 * sift_rows[angle]["3px"]
        assert row["1px"] > 1.45 * sift_rows[angle]["1px"]


@pytest.mark.slow
def test_budget_border_and_mask() -> None:
    picture = texture(240, 320)
    valid = np.ones(picture.shape, bool)
    valid[:, :100] = False
    points, sizes, _ = heat_keypoints(picture, 50, valid)
    assert len(points) == len(sizes) == 50
    assert (points[:, 0] - 99.0 > sizes).all()
    assert len(heat_keypoints(np.full((64, 64), 90, np.uint8), 50)[0]) == 0
    away = np.linalg.norm(points[:, None] - points[None], axis=2) + 99.0 * np.eye(len(points))
    assert away.min() > 3.0


@pytest.mark.slow
def test_corners_that_show_nothing_are_not_looked_at_and_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    picture, valid = texture(700, 900), np.zeros((700, 900), np.uint8)
    cv2.fillPoly(valid, [np.array([[450, 20], [880, 350], [450, 680], [20, 350]], np.int32)], 1)
    shown = valid.astype(bool)
    there, whole = heat(picture, shown=shown), heat(picture)
    inside = cv2.erode(valid, np.ones((9, 9), np.uint8)).astype(bool)
    assert np.array_equal(there[inside], whole[inside])
    assert (there < -49.0).mean() > 0.15
    found = heat_keypoints(picture, 500, shown)
    monkeypatch.setattr("aeromatch_cli.strategies.extractors.heat._shown", lambda level, valid: None)
    for with_corners, without in zip(heat_keypoints(picture, 500, shown), found, strict=True):
        assert np.array_equal(with_corners, without)
