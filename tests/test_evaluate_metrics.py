"""Thinning, coverage, areas under curves, pose errors: against numbers worked out by hand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeromatch_cli.data import Camera, Pose
from aeromatch_cli.evaluate.metrics import auc, coverage, pose_error_deg, thin
from aeromatch_cli.evaluate.overlap import Texture, read_texture
from aeromatch_cli.evaluate.scores import Conditions, PairScore, class_of
from aeromatch_cli.evaluate.totals import PairRow, by_condition, total
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, rotation_y


def test_thinning_keeps_the_best_of_what_is_close_in_either_image() -> None:
    points0 = np.array([[10, 10], [11.9, 10], [30, 10], [50, 10], [50, 10], [70, 10], [72, 10]], float)
    points1 = np.array([[10, 50], [90, 90], [10, 51], [50, 50], [60, 60], [70, 50], [72, 50]], float)
    scores = np.array([0.5, 0.9, 0.7, 0.8, 0.8, 0.3, 0.2])
    # 1 beats 0 (1.9 px apart in image 0); 2 is 1 px from 0 in image 1, but 0 is gone; of 3 and 4, equal in image 0 and
    # in score, the first stays; 5 and 6 are exactly 2 px apart, which is far enough.
    assert thin(points0, points1, scores).tolist() == [1, 2, 3, 5, 6]
    assert thin(points0, points1, scores, spacing_px=2.1).tolist() == [1, 2, 3, 5]
    assert thin(points0[:0], points1[:0], scores[:0]).tolist() == []


def test_one_to_many_and_many_to_one_are_thinned_to_one() -> None:
    place = np.tile([[5.0, 5.0]], (3, 1))
    spread = np.array([[10.0, 10.0], [20.0, 10.0], [30.0, 10.0]])
    scores = np.array([0.1, 0.3, 0.2])
    assert thin(place, spread, scores).tolist() == [1]
    assert thin(spread, place, scores).tolist() == [1]


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(0, 60))
def test_thinned_matches_are_apart_and_nothing_else_could_stay(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points0, points1 = rng.integers(0, 14, (2, count, 2)).astype(float)
    scores = rng.integers(0, 4, count) / 4
    kept = thin(points0, points1, scores)

    def close(i: int, j: int) -> bool:
        return min(np.linalg.norm(p[i] - p[j]) for p in (points0, points1)) < 2.0

    assert not any(close(i, j) for i in kept for j in kept if i < j)
    for i in set(range(count)) - set(kept.tolist()):
        assert any(close(i, j) and scores[j] >= scores[i] for j in kept)


def test_coverage_of_known_cells() -> None:
    x, y = np.meshgrid(np.arange(0.0, 161.0), np.arange(0.0, 161.0))
    whole = np.column_stack([x.ravel(), y.ravel()])  # 16 cells of 10 px a side
    points = np.array([[0, 0], [9.9, 9.9], [10.1, 0], [159, 159], [160, 160]], float)
    assert coverage(points, whole) == 3 / 256
    assert coverage(points[:0], whole) == 0.0
    # Without its lower right quarter the overlap has 192 cells, and a point there covers none of them.
    corner = whole[~((whole >= 80.0).all(axis=1))]
    assert coverage(points, corner) == 2 / 192
    assert np.isnan(coverage(points, whole[:0]))


def test_area_under_the_curve_by_trapezoids() -> None:
    errors = np.array([2.0, np.nan, 0.5])
    # Up to 1: a triangle to (0.5, 1/3), then level. Up to 3: on to (2, 2/3), then level.
    to_one = 0.5 * 0.5 / 3 + 0.5 / 3
    to_three = 0.5 * 0.5 / 3 + 1.5 * 0.5 + 1.0 * 2 / 3
    np.testing.assert_allclose(auc(errors, (1.0, 3.0)), [to_one, to_three / 3])
    assert auc(np.zeros(4)) == (1.0, 1.0, 1.0, 1.0)
    assert auc(np.full(3, np.nan)) == (0.0, 0.0, 0.0, 0.0)
    assert np.isnan(auc(np.zeros(0))).all()


def test_pose_error_of_a_known_relative_pose() -> None:
    rng = np.random.default_rng(1)
    camera = Camera("SIMPLE_RADIAL", 1000, 750, (900.0, 499.5, 374.5, -0.03))
    pose0 = Pose(np.array([0.0, 0.0, 100.0]), from_omega_phi_kappa(3.0, -2.0, 10.0), 0.0, 0.0)
    pose1 = Pose(np.array([30.0, 5.0, 95.0]), from_omega_phi_kappa(-4.0, 6.0, 100.0), 0.0, 0.0)
    ground = np.column_stack([rng.uniform(-5, 35, (80, 2)), rng.uniform(0, 20, 80)])
    points0, points1 = (project(camera, p.world_rotation, p.center_m, ground) for p in (pose0, pose1))
    rotation, translation = pose_error_deg(points0, points1, camera, camera, pose0, pose1)
    assert rotation < 1e-4
    assert translation < 1e-3
    # Against a pose that is wrong by 2 degrees about its own axis, or stands elsewhere, the angles say by how much.
    turned = Pose(pose1.center_m, rotation_y(2.0) @ pose1.world_rotation, 0.0, 0.0)
    assert pose_error_deg(points0, points1, camera, camera, pose0, turned)[0] == pytest.approx(2.0, abs=1e-3)
    opposite = Pose(2 * pose0.center_m - pose1.center_m, pose1.world_rotation, 0.0, 0.0)
    assert pose_error_deg(points0, points1, camera, camera, pose0, opposite)[1] == pytest.approx(180.0, abs=0.01)
    assert np.isnan(pose_error_deg(points0[:7], points1[:7], camera, camera, pose0, pose1)).all()
    same_place = Pose(pose0.center_m, pose1.world_rotation, 0.0, 0.0)
    assert np.isnan(pose_error_deg(points0, points1, camera, camera, pose0, same_place)[1])


def test_texture_is_the_upper_quartile_of_the_cells_that_hold_overlap() -> None:
    texture = Texture(np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]), 16.0)
    assert texture.over(np.array([[0.0, 0.0], [15.0, 15.0], [40.0, 3.0], [40.0, 20.0]])) == pytest.approx(0.45)
    assert texture.over(np.array([[50.0, 40.0]])) == 0.6  # a rest at the edge belongs to the last cell
    assert np.isnan(texture.over(np.zeros((0, 2))))


def test_texture_is_deviation_over_mean_whatever_exposure_and_size(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    coarse = rng.uniform(40, 160, (50, 80)).repeat(8, axis=0).repeat(8, axis=1)
    coarse[:, :160] = 100.0
    whole = np.array([[float(x), float(y)] for x in range(4, 640, 8) for y in range(4, 400, 8)])
    found = []
    for name, gray in (("lit", coarse), ("dark", coarse / 2), ("large", coarse.repeat(4, axis=0).repeat(4, axis=1))):
        cv2.imwrite(str(tmp_path / f"{name}.png"), gray.astype(np.uint8))
        found.append(read_texture(tmp_path / f"{name}.png"))
    assert found[0].over(whole[whole[:, 0] < 140]) == 0.0
    # Four squares of 8 px in a cell: uniform from 40 to 160 the deviation is 0.35 of the mean, less some smoothing.
    lit = found[0].over(whole[whole[:, 0] > 170])
    assert 0.2 < lit < 0.35
    assert found[1].over(whole[whole[:, 0] > 170]) == pytest.approx(lit, rel=0.03)
    assert found[2].cell_px == 16 * 2560 / 1000


def make_score(errors: list[float], correct: int, possible: float, rotation: float = 1.0) -> PairScore:
    kept = len(errors)
    return PairScore(
        keypoints0=100, keypoints1=100, possible=possible, kept=kept, correct=correct, within_5px=correct, hidden=0,
        unseen=int(np.isnan(errors).sum()), coverage=correct / 10, rotation_error_deg=rotation,
        translation_error_deg=2 * rotation, errors_px=np.array(errors, float),
    )  # fmt: skip


def test_totals_are_sums_shares_of_sums_and_medians_over_pairs() -> None:
    rows = [
        PairRow("a", "b", "verified", Conditions(10.0, 0.5, 0.0, 0.2), make_score([1.0, 2.0, 9.0, np.nan], 2, 4)),
        PairRow("a", "c", "verified", Conditions(35.0, 0.4, 0.3, 0.2), make_score([0.0], 1, 10, 4.0)),
        PairRow("b", "c", "not tried", Conditions(70.0, 0.3, 0.1, 0.2), make_score([], 0, 6, np.nan)),
    ]
    figures = total(rows)
    assert (figures["pairs"], figures["pairs_verified"], figures["pairs_not_tried"]) == (3, 2, 1)
    assert (figures["kept"], figures["correct"], figures["wrong"], figures["unseen"]) == (5, 3, 2, 1)
    assert figures["correctness"] == 3 / 5
    assert figures["recall"] == 3 / 20
    assert figures["mean_error_px"] == 3.0
    assert figures["median_error_px"] == 1.5
    assert figures["coverage"] == pytest.approx(0.1)
    assert figures["rotation_error_deg"] == 2.5
    # Pose errors 2 and 8 and a failure: up to 3 a triangle to (2, 1/3), then level.
    assert figures["auc_3deg"] == pytest.approx((2 / 6 + 1 / 3) / 3)
    classes = {(condition, name): own for condition, name, own in by_condition(rows)}
    assert {k for k in classes if k[0] == "view angle"} == {("view angle", n) for n in ("0-20", "20-40", ">60")}
    assert classes["shadow", ">=20 %"]["pairs"] == 1
    assert classes["difficulty", "hard"]["pairs"] == 2
    assert classes["difficulty", "easy"]["correctness"] == 0.5
    assert np.isnan(total([])["correctness"])
    assert np.isnan(total(rows)["correct_in_shadow"])  # known of none


def test_classes_begin_where_stated() -> None:
    for angle, name in ((0.0, "0-20"), (19.99, "0-20"), (20.0, "20-40"), (40.0, "40-60"), (60.0, ">60")):
        assert Conditions(angle, 0.5, 0.0, 0.1).view_angle_class == name
    for share, name in ((0.0499, "<5 %"), (0.05, "5-20 %"), (0.2, ">=20 %"), (np.nan, "unknown")):
        assert Conditions(0.0, 0.5, share, 0.1).shadow_class == name
    assert class_of(np.nan, (("all", np.inf),)) == "unknown"
    assert [Conditions(a, 0.5, s, 0.1).hard for a, s in ((29.9, 0.19), (30.0, 0.0), (0.0, 0.2), (30.0, np.nan))] == [
        False, True, True, True,
    ]  # fmt: skip
