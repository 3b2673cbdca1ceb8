"""Simulated tie points of the benchmark `calibration`, and its measures: against known truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.calibration.accuracy import Found, judged
from benchmarks.calibration.command import main
from benchmarks.calibration.simulate import (
    HEIGHT_PX,
    WIDTH_PX,
    SimulatedBlock,
    exif_camera,
    perturbed,
    simulate,
)

from aeromatch_cli.files import read_json
from aeromatch_cli.geometry.cameras import distort, focal_px, parameters, project, undistort
from aeromatch_cli.lab.synthetic.lenses import real_lens
from aeromatch_cli.lab.synthetic.receivers import gps_errors_m


@pytest.fixture(scope="module")
def block() -> SimulatedBlock:
    return simulate("grass", "mixed", 9, "rtk2cm", 4, tie_points=300)


def exact(block: SimulatedBlock) -> Found:
    rotations = {i: pose.world_rotation for i, pose in block.poses.items() if pose.world_rotation is not None}
    return Found(block.cameras, rotations, {i: pose.center_m for i, pose in block.poses.items()})


def test_keypoints_are_where_the_true_camera_sees_the_true_points(block: SimulatedBlock) -> None:
    errors, wrong = [], []
    for image_id, keypoints in block.keypoints.items():
        pose, camera = block.poses[image_id], block.cameras[block.camera_of[image_id]]
        assert pose.world_rotation is not None
        places = project(camera, pose.world_rotation, pose.center_m, block.points_m[keypoints.point])
        errors.append(keypoints.pixels - places)
        wrong.append(keypoints.wrong)
    off, bad = np.concatenate(errors), np.concatenate(wrong)
    assert off[~bad].std() == pytest.approx(0.3, abs=0.01)
    assert np.abs(off[~bad].mean(axis=0)).max() < 0.03
    assert bad.mean() == pytest.approx(0.02, abs=0.006)
    away = np.linalg.norm(off[bad], axis=1)
    assert away.min() > 1.5
    assert away.max() < 31.5
    lengths = np.unique(np.concatenate([k.point for k in block.keypoints.values()]), return_counts=True)[1]
    assert lengths.min() == 2
    assert 2.6 < lengths.mean() < 4.0


def test_pairs_point_at_the_same_ground(block: SimulatedBlock) -> None:
    pairs = list(block.contents.pairs)
    assert len(pairs) >= 20
    for item in pairs:
        first, second = block.keypoints[item.pair.image_id0], block.keypoints[item.pair.image_id1]
        assert np.array_equal(first.point[item.verified[:, 0]], second.point[item.verified[:, 1]])


def test_exact_cameras_leave_the_noise_of_the_check_points_alone(block: SimulatedBlock) -> None:
    row = judged(block, exact(block))
    assert row["checked"] >= 40
    assert row["focal_percent"] == row["centre_px"] == 0.0
    # 0.3 px from three rays and more.
    assert row["absolute_horizontal_px"] < 0.4
    assert row["absolute_height_px"] < 0.8


def test_a_shifted_larger_block_is_as_exact_but_for_its_place(block: SimulatedBlock) -> None:
    found = exact(block)
    moved = Found(found.cameras, found.rotations, {i: 1.01 * c + [3.0, 0.0, 0.0] for i, c in found.centers_m.items()})
    row, before = judged(block, moved), judged(block, found)
    assert row["height_px"] == pytest.approx(before["height_px"], abs=0.02)
    assert row["absolute_horizontal_px"] * block.gsd_m == pytest.approx(3.0, abs=0.6)


def test_a_wrong_principal_point_is_said_and_bends(block: SimulatedBlock) -> None:
    found = exact(block)
    [(key, camera)] = found.cameras.items()
    params = list(camera.params)
    params[0] *= 1.02
    params[1] += 40.0
    worse = Found({key: type(camera)(camera.model, WIDTH_PX, HEIGHT_PX, tuple(params))}, found.rotations,
                  found.centers_m)  # fmt: skip
    row = judged(block, worse)
    assert row["centre_px"] == pytest.approx(40.0, abs=1e-6)
    assert row["focal_percent"] == pytest.approx(2.0, abs=0.01)
    assert row["bend_px"] > 5.0 * judged(block, found)["bend_px"]


def test_the_same_seed_gives_the_same_block_whatever_is_known(block: SimulatedBlock) -> None:
    again = simulate("grass", "mixed", 9, "nothing", 4, tie_points=300)
    assert again.observed.poses == {}
    for image_id, keypoints in block.keypoints.items():
        assert np.array_equal(keypoints.pixels, again.keypoints[image_id].pixels)
    other = simulate("grass", "mixed", 9, "nothing", 5, tie_points=300)
    assert other.cameras != again.cameras


def test_observed_positions_and_angles_have_their_errors(block: SimulatedBlock) -> None:
    off_m = np.array([block.observed.poses[i].center_m - pose.center_m for i, pose in block.poses.items()])
    assert np.abs(off_m).max() < 0.15
    drift_m = np.array([gps_errors_m(40, np.random.default_rng(k)) for k in range(200)])
    assert drift_m.std() == pytest.approx(5.1, rel=0.1)
    assert np.diff(drift_m, axis=1).std() == pytest.approx(1.41, rel=0.15)
    _, groups = perturbed(block)
    assert groups[0].kind == "positions"
    assert len(groups[0].images) == 9


def test_real_lenses_are_one_to_one_and_exif_knows_their_focal_length() -> None:
    x, y = np.meshgrid(np.linspace(-0.5, WIDTH_PX - 0.5, 17), np.linspace(-0.5, HEIGHT_PX - 0.5, 13))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    corner, off = [], []
    for seed in range(60):
        lens = real_lens(np.random.default_rng(seed), WIDTH_PX, HEIGHT_PX)
        straight = undistort(lens, pixels)
        np.testing.assert_allclose(distort(lens, straight), pixels, atol=1e-6)
        p = parameters(lens)
        middle = np.array([p["cx"], p["cy"]])
        off.append(np.abs(middle - [1999.5, 1499.5]).max())
        corner.append(np.linalg.norm(straight[0] - pixels[0]) / np.linalg.norm(pixels[0] - middle))
        assert abs(focal_px(exif_camera(lens)) / focal_px(lens) - 1.0) < 0.02
    assert max(off) <= 0.02 * WIDTH_PX
    assert 10.0 < np.median(off) < 40.0
    assert np.quantile(corner, 0.1) < 0.005
    assert 0.03 < max(corner) < 0.08


@pytest.mark.slow
def test_the_command_keeps_its_rows_and_colmap_is_better_with_a_free_principal_point(tmp_path: Path) -> None:
    arguments = [
        "--scenes", "grass", "--flights", "cross", "--images", "12", "--positions", "rtk2cm", "--seeds", "1",
        "--points", "200", "--peers", "colmap,colmap-opencv", "--jobs", "1", "--out", str(tmp_path),
    ]  # fmt: skip
    main(arguments)
    rows = {row["method"]: row for row in map(read_json, (tmp_path / "rows").iterdir())}
    assert len(rows) == 3
    assert rows["colmap-opencv"]["centre_px"] < 0.5 * rows["colmap"]["centre_px"]
    times = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "rows").iterdir()}
    main(arguments)
    assert times == {path.name: path.stat().st_mtime_ns for path in (tmp_path / "rows").iterdir()}
