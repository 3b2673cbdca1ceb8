"""Parts of the detector's training: exact corners, labels, warps against the truth, the loss of two views."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from trainings.detector.groups import SIDE_PX, Group, block_group, homography_group
from trainings.detector.loss import drawn, peaks, repeat_loss
from trainings.detector.scenes import Sight, read_sights, sights, transfer, write_sights
from trainings.detector.shapes import shape
from trainings.detector.validation import pairs_of, scores, table

from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.lab.synthetic import load_truth

pytestmark = pytest.mark.slow


def test_shapes_have_corners_that_can_be_seen() -> None:
    counts = []
    for seed in range(12):
        pixels, corners = shape(96, np.random.default_rng(seed))
        assert pixels.shape == (96, 96)
        assert ((corners > 0) & (corners < 95)).all()
        counts.append(len(corners))
    assert np.mean(counts) > 4


def test_labels_have_their_tops_where_they_were_drawn() -> None:
    points = np.array([[20.3, 30.0], [40.75, 12.4], [60.2, 50.6]])
    found = peaks(drawn([points], 80), 5)[0]
    assert len(found) == 3
    away = np.linalg.norm(found[:, None] - points[None], axis=2).min(axis=1)
    assert away.max() < 0.02


def test_views_know_where_another_shows_the_same(rendered: Path, tmp_path: Path) -> None:
    write_sights(tmp_path / "views.npz", sights(rendered))
    views, truth = read_sights(tmp_path / "views.npz"), load_truth(rendered)
    first, second = views[0], views[1]
    height, width = first.gray.shape
    places = np.random.default_rng(0).uniform(0, [width - 1, height - 1], (400, 2))
    there = transfer(first, second, places)
    points = first.points_m(places)
    seen = np.isfinite(there[:, 0])
    assert seen.mean() > 0.3
    camera, pose = truth.cameras[first.name], truth.poses[first.name]
    assert pose.world_rotation is not None
    source = project(camera, pose.world_rotation, pose.center_m, points[seen])
    exact = truth.surface_points(first.name, source)
    assert np.median(np.linalg.norm(exact - points[seen], axis=1)) < 0.05 * first.gsd_m


def likeness(group: Group, number: int, moved_px: float) -> float:
    """Correlation of the first view with what another shows at the places given, or so far beside them; without what
    light and shade do over many pixels."""
    places, there = group.places[number - 1], group.grays[number].astype(np.float32)
    seen = np.isfinite(places[..., 0])
    assert seen.mean() >= 0.2
    there -= cv2.GaussianBlur(there, (0, 0), 8.0)
    first = group.grays[0].astype(np.float32)
    first -= cv2.GaussianBlur(first, (0, 0), 8.0)
    moved = cv2.remap(there, np.nan_to_num(places) + np.float32([moved_px, 0.0]), None, cv2.INTER_LINEAR)
    return float(np.corrcoef(first[seen], moved[seen])[0, 1])


def test_groups_of_views_show_one_place(rendered: Path) -> None:
    rng = np.random.default_rng(3)
    spots = cv2.GaussianBlur(rng.normal(0.0, 1.0, (400, 500)), (0, 0), 4.0)
    pictures = [cv2.normalize(spots, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)]
    groups = [homography_group(pictures, 3, rng) for _ in range(4)]
    assert all(group.grays.shape == (3, SIDE_PX, SIDE_PX) for group in groups)
    assert all(group.places.shape == (2, SIDE_PX, SIDE_PX, 2) for group in groups)
    # Light and blur differ between views.
    alike = [likeness(group, number, 0.0) for group in groups for number in (1, 2)]
    beside = [likeness(group, number, 12.0) for group in groups for number in (1, 2)]
    assert min(alike) > 0.3 > 0.15 > max(beside)
    views = sights(rendered)
    drawn_groups = [block_group([views], 2, np.random.default_rng(seed)) for seed in range(12)]
    found = [group for group in drawn_groups if group is not None]
    assert len(found) >= 3
    alike, beside = [likeness(group, 1, 0.0) for group in found], [likeness(group, 1, 12.0) for group in found]
    assert min(alike) > 0.3 > 0.15 > max(beside)


def test_the_same_heat_repeats_and_other_heat_does_not() -> None:
    points = np.random.default_rng(0).uniform(10, 134, (60, 2))
    heat = drawn([points], SIDE_PX).clamp(1e-3, 0.999)
    logits = torch.log(heat / (1 - heat))
    y, x = torch.meshgrid(torch.arange(SIDE_PX), torch.arange(SIDE_PX), indexing="ij")
    here = torch.stack([x, y], dim=-1)[None].float()
    seen = torch.ones_like(heat)
    same = repeat_loss(logits, logits, here, seen)
    moved = repeat_loss(logits, logits.roll(5, dims=3), here, seen)
    assert float(same[2]) > 2 * float(moved[2])
    assert same[0] < moved[0]


def test_scores_count_points_one_to_one(rendered: Path) -> None:
    pairs = pairs_of([sights(rendered)])
    grid: dict[str, NDArray[np.float64]] = {}

    def fixed(sight: Sight) -> NDArray[np.float64]:
        if sight.name not in grid:
            y, x = np.mgrid[4 : sight.gray.shape[0] : 16, 4 : sight.gray.shape[1] : 16].astype(np.float64)
            grid[sight.name] = np.column_stack([x.ravel(), y.ravel()])
        return grid[sight.name]

    rows = table(scores(pairs, fixed, 50))
    assert len(rows) >= 2
    for row in rows.values():
        # 28 of 256 square pixels lie within 3 px of a grid's points, 3 within 1 px.
        assert 0.03 < row["3px"] < 0.25
        assert 0.0 < row["1px"] < 0.08


def test_the_same_points_are_found_again_once_each(rendered: Path) -> None:
    pair = pairs_of([sights(rendered)])[0]
    height, width = pair.view0.gray.shape
    places = np.random.default_rng(0).uniform(4.0, [width - 4.0, height - 4.0], (400, 2))
    there = transfer(pair.view0, pair.view1, places)
    seen = np.isfinite(there[:, 0])
    places, there = places[seen], there[seen]
    assert len(places) > 50
    (score,) = scores([pair], lambda sight: places if sight is pair.view0 else there, 50)
    assert score.keypoints == 50
    assert min(score.repeated) >= 48
    assert score.error_px < 0.01
    twice = np.repeat(places, 2, axis=0)
    (score,) = scores([pair], lambda sight: twice if sight is pair.view0 else there, 50)
    assert (score.keypoints, score.repeated) == (50, (25, 25))
