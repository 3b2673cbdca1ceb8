"""scripts/bench oblique: peers on rectified views, pairs by view angle, and the goals of hand-made rows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from benchmarks import scenes
from benchmarks.methods import oblique
from benchmarks.peers import base, ground, table
from conftest import HEIGHT, WIDTH, Site

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.evaluate import Conditions
from aeromatch_cli.lab.opening import open_truth

pytestmark = pytest.mark.slow

Row = dict[str, Any]


def pair(view_angle_deg: float, number: int) -> Any:
    condition = "hard" if view_angle_deg >= 30 else "easy"
    return scenes.JudgedPair((f"{number:03}", "x"), condition, Conditions(view_angle_deg, 0.5, 0.0, 0.1))


def test_pairs_are_chosen_by_view_angle_and_large_angles_fill_up() -> None:
    angles = [5.0] * 10 + [25.0] + [50.0] * 10 + [70.0] * 10
    pool = [pair(angle, number) for number, angle in enumerate(angles)]
    found = scenes.chosen(pool, scenes.Selection("angles", 12, 0), np.random.default_rng(0))
    classes = [one.conditions.view_angle_class for one in found]
    assert {name: classes.count(name) for name in classes} == {"0-20": 3, "20-40": 1, "40-60": 3, ">60": 5}


def test_unseen_parts_are_filled_from_beside_and_draw_no_keypoints() -> None:
    picture = np.zeros((6, 8, 3), np.uint8)
    picture[:, :4] = [10, 20, 30]
    picture[0, 3] = [200, 0, 0]
    seen = np.zeros((6, 8), bool)
    seen[:, :4] = True
    out = ground.filled(picture, seen)
    assert (out[:, :4] == picture[:, :4]).all()
    assert (out[3:, 4:] == [10, 20, 30]).all()
    assert (out[0, 4] == [200, 0, 0]).all()
    points = np.array([[0.0, 3.0], [3.4, 3.0], [6.0, 3.0]])
    assert ground.away_from_unseen(points, seen, 1.5).tolist() == [True, False, False]
    assert ground.away_from_unseen(points, np.ones_like(seen), 1.5).all()


def scene_of(site: Site) -> Any:
    cameras = open_truth(site.root).cameras
    names = tuple(sorted(cameras))
    return base.Scene("suburb", site.images, site.poses, site.root / "block.json", cameras, (names[:2],))


def test_peers_on_rectified_views_answer_in_stored_pixels(site: Site) -> None:
    scene, options = scene_of(site), base.Options(150, "image", 1, 0, None)
    truth = open_truth(site.root)
    method = table.method("opencv-sift@ground")(scene, options)
    names = scene.pairs[0]
    sides = [method.features(name) for name in names]
    for side in sides:
        assert len(side.places_px) == len(side.descriptors) == 150
        assert (side.places_px >= -0.5).all()
        assert (side.places_px <= [WIDTH - 0.5, HEIGHT - 0.5]).all()
    found = method.match(*names, *sides)
    answer = found.keypoints0_px, found.keypoints1_px, found.points0_px, found.points1_px, found.scores
    score = truth.judge(names[0], names[1], *answer)
    assert score.correct >= 20
    assert score.median_error_px < 1.0
    with pytest.raises(ConfigError, match="budget"):
        table.method("opencv-sift@ground")(scene, base.Options(150, "view", 1, 0, None))


def row(method: str, spec: str, at: str, correct: int, **more: Any) -> Row:
    return {
        "method": method, "spec": spec, "scene": "city", "pair": at, "view_angle_deg": 50.0, "possible": 100,
        "kept": correct + 1, "correct": correct, "coverage": correct / 100, "median_error_px": 1.0, "poses": "exact",
        **more,
    }  # fmt: skip


def test_oblique_goals_worked_by_hand() -> None:
    rows = [
        row("SIFT", "opencv-sift", "a", 10, median_error_px=0.5),
        row("SIFT", "opencv-sift", "b", 0, kept=0, median_error_px=None),
        row("aliked", "aliked", "a", 12), row("aliked", "aliked", "b", 4),
        row("SIFT@ground", "opencv-sift@ground", "a", 20), row("SIFT@ground", "opencv-sift@ground", "b", 10),
        row("fusion", "fusion", "a", 30, median_error_px=0.4), row("fusion", "fusion", "b", 10, median_error_px=9.0),
        row("fusion (noisy poses)", "fusion", "a", 99, poses="noisy"),
    ]  # fmt: skip
    found = oblique.oblique_goals(rows, "fusion")
    assert (found.pairs, found.correct) == (2, 40)
    assert found.on_source == oblique.Best("aliked", 16)
    assert found.on_rectified == oblique.Best("SIFT@ground", 30)
    assert found.over_source == pytest.approx(40 / 16)
    assert found.over_rectified == pytest.approx(40 / 30)
    assert found.correctness == pytest.approx(40 / 42)
    assert (found.recall, found.recall_of_peers) == (pytest.approx(0.2), pytest.approx(0.15))
    assert (found.coverage, found.coverage_of_peers) == (pytest.approx(0.2), pytest.approx(0.15))
    assert (found.median_error_px, found.sift_error_px) == (0.4, 0.5)  # of pair b SIFT has none
    assert found.missed() == []
    text = oblique.oblique_table(rows)
    line = "| rendered blocks | 40-60 | `fusion` | 2 | 40 | `aliked` 16 | 2.50 x | `SIFT@ground` 30 | 1.33 x | 95.2 % |"
    assert line in text
    assert "| rendered blocks | >40 | `fusion`" in text
    assert "noisy" not in text


def test_goals_that_are_missed_are_named_and_unknown_ones_are_not() -> None:
    real = {"possible": None, "scene": "lewis"}
    rows = [row("SIFT", "opencv-sift", "a", 30, **real), row("fusion", "fusion", "a", 40, kept=80, **real)]
    found = oblique.oblique_goals(rows, "fusion")
    assert math.isnan(found.over_rectified)
    assert math.isnan(found.recall)
    assert found.missed() == ["source", "correctness"]
    assert "| real blocks | 40-60 | `fusion` |" in oblique.oblique_table(rows)
    easy = [one | {"view_angle_deg": 30.0} for one in rows]
    assert oblique.oblique_table(easy) == "No preset has a pair above 40 degrees."
