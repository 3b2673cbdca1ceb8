"""Matches that contradict the adjusted block: found in exact blocks, dropped from a workspace's results."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from conftest import PAGE, Site
from test_control import adjusted_truth, cameras
from test_export_colmap import Truth, make_truth

from aeromatch_cli.data import AdjustedBlock, FloatArray, IntArray
from aeromatch_cli.formats.adjusted import read_dropped, write_dropped
from aeromatch_cli.geometry.cameras import project, world_rays
from aeromatch_cli.geometry.epipolar import essential, relative_pose, triangulate
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.sfm.outlier_rejection import Limits, MatchedKeypoints, contradicting
from aeromatch_cli.sfm.two_view_poses import block_of_pair

LIMITS = Limits(epipolar_px=1.5, medians=4.0, third_px=4.0)
WRONG = 12


@pytest.fixture(scope="module")
def truth() -> Truth:
    return make_truth()


def matched(truth: Truth) -> list[MatchedKeypoints]:
    return [
        MatchedKeypoints(p.pair.image_id0, p.pair.image_id1, p.verified, np.full(len(p.verified), 0.5))
        for p in truth.pairs
    ]


def held_together(truth: Truth, groups: list[set[str]]) -> AdjustedBlock:
    """The true block; the images of each group see one point together."""
    block = adjusted_truth(truth)
    tracks = {i: np.array([[0, row]], np.int32) for row, group in enumerate(groups) for i in group}
    poses = {i: pose for i, pose in block.poses.items() if i in tracks}
    return replace(
        block, points_m=np.zeros((len(groups), 3)), errors_px=np.zeros(len(groups)), tracks=tracks, poses=poses
    )


def judged(truth: Truth, keypoints: dict[str, FloatArray], pairs: list[MatchedKeypoints]) -> list[FloatArray]:
    block = held_together(truth, [set(truth.block.poses)])
    found = contradicting(block, cameras(truth), keypoints.__getitem__, pairs, LIMITS)
    assert found.doubtful == []
    # The share that is expected to be right is known also where nothing is dropped for want of probability.
    asked = contradicting(block, cameras(truth), keypoints.__getitem__, pairs, replace(LIMITS, min_probability=1e-9))
    assert found.expected_right == asked.expected_right
    assert found.expected_right is not None
    assert 0.5 < found.expected_right <= 1.0
    return found.masks


def noisy(truth: Truth) -> dict[str, FloatArray]:
    rng = np.random.default_rng(5)
    return {i: k + rng.normal(0.0, 0.3, k.shape) for i, k in truth.keypoints_px.items()}


def test_right_matches_agree_with_the_block(truth: Truth) -> None:
    found = np.concatenate(judged(truth, noisy(truth), matched(truth)))
    assert len(found) > 1000
    assert found.mean() < 0.01


def test_what_the_adjusted_lens_shows_nowhere_contradicts_the_block(truth: Truth) -> None:
    """A lens that folds within the picture: beyond, keypoints have no ray."""
    keypoints = dict(truth.keypoints_px)
    image_id = matched(truth)[0].image_id0
    outside = np.zeros(len(keypoints[image_id]), dtype=bool)
    outside[::7] = True
    keypoints[image_id] = np.where(outside[:, None], np.nan, keypoints[image_id])
    pairs = matched(truth)
    block, limits = held_together(truth, [set(truth.block.poses)]), replace(LIMITS, min_probability=0.5)
    found = contradicting(block, cameras(truth), keypoints.__getitem__, pairs, limits)
    for pair, mask in zip(pairs, found.masks, strict=True):
        if pair.image_id0 == image_id:
            assert mask[outside[pair.indices[:, 0]]].all()
            assert not mask[~outside[pair.indices[:, 0]]].all()


def test_matches_beside_the_epipolar_line_are_found(truth: Truth) -> None:
    pairs = matched(truth)
    wrong = pairs[0].indices.copy()
    wrong[:WRONG, 1] = np.roll(wrong[:WRONG, 1], 1)
    found = judged(truth, noisy(truth), [replace(pairs[0], indices=wrong), *pairs[1:]])
    assert found[0][:WRONG].sum() >= WRONG - 1
    assert found[0][WRONG:].mean() < 0.05


def along_the_line(
    truth: Truth, keypoints: dict[str, FloatArray], indices: IntArray, away: float = 1.15
) -> tuple[FloatArray, IntArray]:
    """Keypoints of img1 with others where it would see the points of WRONG matches at `away` times their distance."""
    pose0, pose1 = truth.block.poses["img0"], truth.block.poses["img1"]
    rays = [
        world_rays(cameras(truth)[i], truth.block.poses[i].world_rotation, keypoints[i][indices[:WRONG, side]])
        for side, i in enumerate(("img0", "img1"))
    ]
    points = triangulate(pose0.center_m, rays[0], pose1.center_m, rays[1])
    points = pose0.center_m + away * (points - pose0.center_m)
    there = project(cameras(truth)["img1"], pose1.world_rotation, pose1.center_m, points)
    more = np.concatenate([keypoints["img1"], there])
    wrong = indices.copy()
    wrong[:WRONG, 1] = len(keypoints["img1"]) + np.arange(WRONG)
    return more, wrong


def test_matches_along_the_epipolar_line_are_found_by_third_images(truth: Truth) -> None:
    """A repeated pattern: nothing in the two images contradicts it."""
    keypoints, pairs = noisy(truth), matched(truth)
    assert (pairs[0].image_id0, pairs[0].image_id1) == ("img0", "img1")
    keypoints["img1"], wrong = along_the_line(truth, keypoints, pairs[0].indices)
    changed = [replace(pairs[0], indices=wrong), *pairs[1:]]
    assert not judged(truth, keypoints, changed[:1])[0].any()
    found = judged(truth, keypoints, changed)
    tied = np.array([sum(k in p.indices[:, 0] for p in pairs[1:5]) > 0 for k in wrong[:WRONG, 0]])
    assert tied.sum() >= WRONG - 3
    assert found[0][:WRONG][tied].all()
    assert np.concatenate([found[0][WRONG:], *found[1:]]).mean() < 0.02


def test_improbable_matches_are_dropped_where_that_is_asked(truth: Truth) -> None:
    """Of one pair alone, keypoints along their epipolar lines, poor scores: less likely, contradicted by nothing. The
    points of this block lie on no surface, so that neighbours speak for none of them."""
    keypoints, pairs = noisy(truth), matched(truth)
    keypoints["img1"], wrong = along_the_line(truth, keypoints, pairs[0].indices)
    scores = np.where(np.arange(len(wrong)) < WRONG, 0.05, 0.6)
    changed = [replace(pairs[0], indices=wrong, scores=scores)]
    block = held_together(truth, [set(truth.block.poses)])
    for limits, least, most in ((LIMITS, 0.0, 0.1), (replace(LIMITS, min_probability=0.35), 0.7, 1.0)):
        found = contradicting(block, cameras(truth), keypoints.__getitem__, changed, limits)
        assert least <= found.masks[0][:WRONG].mean() <= most
        assert found.masks[0][WRONG:].mean() < 0.15
    assert found.expected_right is not None
    assert 0.35 < found.expected_right < 0.9


def test_pairs_that_the_block_does_not_hold_together_are_not_judged(truth: Truth) -> None:
    """img0 is not oriented, img5 by itself."""
    held = held_together(truth, [{"img1", "img2", "img3", "img4"}, {"img5"}])
    pairs = []
    for pair in matched(truth):
        indices = pair.indices.copy()
        indices[:WRONG, 1] = np.roll(indices[:WRONG, 1], 1)
        pairs.append(replace(pair, indices=indices))
    found = contradicting(held, cameras(truth), noisy(truth).__getitem__, pairs, LIMITS)
    assert found.doubtful == []
    for pair, wrong in zip(pairs, found.masks, strict=True):
        assert wrong.shape == (len(pair.indices),)
        together = {pair.image_id0, pair.image_id1} <= {"img1", "img2", "img3", "img4"}
        assert wrong.any() == together


def test_an_image_in_a_wrong_place_is_named_and_its_matches_stay(truth: Truth) -> None:
    block = held_together(truth, [set(truth.block.poses)])
    turn = from_omega_phi_kappa(0.0, 0.0, 20.0)
    poses = {**block.poses, "img2": replace(block.poses["img2"], rotation=block.poses["img2"].rotation @ turn)}
    wrong = replace(block, poses=poses)
    found = contradicting(wrong, cameras(truth), noisy(truth).__getitem__, matched(truth), LIMITS)
    assert found.doubtful == ["img2"]
    assert np.concatenate(found.masks).mean() < 0.01


def test_what_is_dropped_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "dropped.npz"
    assert read_dropped(path) == ({}, 0)
    dropped = {("a", "b"): ("x", np.array([1, 5], np.int32)), ("a", "c"): ("y", np.array([0], np.int32))}
    with path.open("wb") as stream:
        write_dropped(stream, dropped, 15)
    found, least = read_dropped(path)
    assert least == 15
    assert {key: (made_of, rows.tolist()) for key, (made_of, rows) in found.items()} == {
        ("a", "b"): ("x", [1, 5]),
        ("a", "c"): ("y", [0]),
    }


@pytest.mark.slow
def test_export_report_and_evaluation_go_without_what_is_dropped(done_site: Site) -> None:
    """A strict limit drops some matches; a change of it runs no stage before consistency again."""
    outcome = done_site("run", "--set", "consistency.epipolar_px=0.3", *PAGE)
    assert outcome.code == 0
    stages = outcome.facts["stages"]
    assert {stages[name]["done"] for name in ("extract", "match", "filter", "adjust")} == {0}
    facts, before = stages["consistency"]["result"], stages["filter"]["result"]["verified_matches"]
    assert 0 < facts["dropped_matches"] < before / 2
    assert facts["verified_matches"] == before - facts["dropped_matches"]
    assert stages["export"]["result"]["exporters"]["colmap"]["verified_matches"] == facts["verified_matches"]
    assert f"dropped {facts['dropped_matches']} matches that contradict the adjusted block" in outcome.stdout
    model = pycolmap.Reconstruction(done_site.work / "export" / "colmap" / "sparse")
    assert model.num_points3D() == facts["points_left"] <= facts["points"]
    assert model.compute_num_observations() == facts["observations_left"] < facts["observations"]
    length = model.compute_mean_track_length()
    error_px = model.compute_mean_reprojection_error()
    assert facts["reprojection_error_px"] == pytest.approx(error_px, abs=1e-3)
    words = f"in {length:.1f} images each, reprojection error {error_px:.2f} px"
    assert f"{facts['points_left']} of {facts['points']} points are left, {words}" in outcome.stdout
    spread = facts["spread"].values()
    assert all(0 < ninths <= 9 and 0 < points < 1000 for ninths, _, points in spread)
    assert all(ninths + empty <= 9 for ninths, empty, _ in spread)
    assert f"{facts['verified_matches']:,}" in (done_site.work / "report" / "index.html").read_text()
    refused = done_site("run", "--set", "consistency.epipolar_px=0.3", "--set", "consistency.min_matches=100000")
    facts = refused.facts["stages"]["consistency"]["result"]
    exported = refused.facts["stages"]["export"]["result"]["exporters"]["colmap"]
    assert facts["rejected_pairs"] > 0
    assert facts["verified_matches"] == exported["verified_matches"]
    with sqlite3.connect(done_site.work / "export" / "colmap" / "database.db") as database:
        (rows,) = database.execute("SELECT COALESCE(SUM(rows), 0) FROM two_view_geometries").fetchone()
    assert rows == facts["verified_matches"]
    final = done_site.work / "orientation" / "final.npz"
    final.unlink()  # by somebody
    assert done_site("run", "--set", "consistency.epipolar_px=0.3").done() == {"consistency": 10, "export": 1}
    assert final.is_file()
    none = done_site("run", "--set", "consistency=none")
    assert not final.exists()
    assert none.facts["stages"]["export"]["result"]["exporters"]["colmap"]["verified_matches"] == before
    assert not (done_site.work / "orientation" / "dropped.npz").exists()
    assert json.loads((done_site.work / "reports" / "consistency.json").read_text())["result"]["dropped_matches"] == 0


def alone(truth: Truth, keypoints: dict[str, FloatArray], indices: IntArray, sign: float = 1.0) -> AdjustedBlock:
    poses = [truth.block.poses[i] for i in ("img0", "img1")]
    rotation, translation = relative_pose(*poses)
    return block_of_pair(
        ("img0", "img1"), (cameras(truth)["img0"], cameras(truth)["img1"]),
        (keypoints["img0"][indices[:, 0]], keypoints["img1"][indices[:, 1]]),
        sign * essential(rotation, translation), rotation, poses[0].world_rotation,
    )  # fmt: skip


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_pair_by_itself_lies_as_in_the_block_but_for_its_scale(truth: Truth, sign: float) -> None:
    first, second = (truth.block.poses[i] for i in ("img0", "img1"))
    found = alone(truth, noisy(truth), matched(truth)[0].indices, sign)
    base_m = second.center_m - first.center_m
    np.testing.assert_allclose(found.poses["img1"].center_m, base_m / np.linalg.norm(base_m), atol=1e-6)
    np.testing.assert_allclose(found.poses["img1"].rotation, second.world_rotation, atol=1e-9)


def test_improbable_matches_of_a_pair_that_no_block_holds_are_dropped(truth: Truth) -> None:
    keypoints, pairs = noisy(truth), matched(truth)
    keypoints["img1"], wrong = along_the_line(truth, keypoints, pairs[0].indices)
    scores = np.where(np.arange(len(wrong)) < WRONG, 0.05, 0.6)
    pair = replace(pairs[0], indices=wrong, scores=scores, alone=alone(truth, keypoints, wrong))
    nothing = AdjustedBlock.empty()
    limits = replace(LIMITS, min_probability=0.35)
    found = contradicting(nothing, cameras(truth), keypoints.__getitem__, [pair], limits)
    held = contradicting(
        held_together(truth, [set(truth.block.poses)]), cameras(truth), keypoints.__getitem__, [pair], limits
    )
    assert found.masks[0][:WRONG].mean() >= 0.7
    assert found.masks[0][WRONG:].mean() < 0.15
    assert (found.masks[0] == held.masks[0]).mean() > 0.95
    surer = replace(limits, min_expected_right=0.99)
    fewer = contradicting(nothing, cameras(truth), keypoints.__getitem__, [pair], surer)
    assert fewer.expected_right is not None
    assert fewer.masks[0].sum() > found.masks[0].sum()
    assert fewer.expected_right > found.expected_right
    assert not contradicting(nothing, cameras(truth), keypoints.__getitem__, [pair], LIMITS).masks[0].any()
    unknown = replace(pair, alone=None)
    assert not contradicting(nothing, cameras(truth), keypoints.__getitem__, [unknown], limits).masks[0].any()
