"""Parts of the detector's training: exact corners, labels, warps against the truth, the loss of two views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from trainings.detector.groups import SIDE_PX, block_group, homography_group
from trainings.detector.loss import drawn, peaks, repeat_loss
from trainings.detector.scenes import Sight, read_sights, sights, transfer, write_sights
from trainings.detector.shapes import shape
from trainings.detector.validation import pairs_of, scores, table

from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.synthetic import load_truth

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


def test_groups_of_views_show_one_place(rendered: Path) -> None:
    rng = np.random.default_rng(3)
    pictures = [rng.integers(0, 255, (400, 500)).astype(np.uint8)]
    group = homography_group(pictures, 3, rng)
    assert group.grays.shape == (3, SIDE_PX, SIDE_PX)
    assert group.places.shape == (2, SIDE_PX, SIDE_PX, 2)
    found = [block_group([sights(rendered)], 2, np.random.default_rng(seed)) for seed in range(4)]
    assert any(each is not None for each in found)


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

    for row in table(scores(pairs, fixed, 50)).values():
        # 28 of 256 square pixels lie within 3 px of a grid's points, 3 within 1 px.
        assert row["3px"] < 0.25
        assert row["1px"] < 0.08
