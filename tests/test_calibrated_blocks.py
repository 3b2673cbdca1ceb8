"""Whole adjustments of simulated tie points, with calibration, against truth (`docs/methods/adjustment.md`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from benchmarks.calibration.accuracy import Found, intersected, judged
from benchmarks.calibration.simulate import HEIGHT_PX, WIDTH_PX, SimulatedBlock, mapped, simulate

from aeromatch_cli.blocks.cameras import FOCAL_SIGMAS
from aeromatch_cli.data import AdjustedBlock, Camera, ControlPoint, FloatArray
from aeromatch_cli.geometry.cameras import focal_px, project
from aeromatch_cli.lab.synthetic.lenses import real_lens
from aeromatch_cli.sfm.block_figures import residuals_of
from aeromatch_cli.sfm.calibration import lens_of
from aeromatch_cli.sfm.mapping import Group, adjust_block
from aeromatch_cli.sfm.shutter import at_once
from aeromatch_cli.strategies.exporters.contents import ExportContents

pytestmark = pytest.mark.slow

# Scenes whose surfaces are made in little time. Flat grass tells a focal length and a height apart least; on farmland,
# from another height, a pixel is large enough that surveyed points are better than one.
SCENE, CONTROL_SCENE, SEED = "grass", "farmland", 3
Start = tuple[ExportContents, list[Group]]


def adjusted(block: SimulatedBlock, start: Start | None = None, **given: Any) -> tuple[AdjustedBlock, dict[str, Any]]:
    """The block adjusted from a first pass of its own matches, unless one is given, and the facts of its one group."""
    contents, groups = start or mapped(block)
    found, [facts] = adjust_block(contents, replace(block.observed, **given), groups, fixed=False)
    return found, facts


def factory_calibrated(block: SimulatedBlock, seed: int) -> SimulatedBlock:
    """With cameras as a manufacturer states them: 0.1 % of the focal length, 5 px of the principal point and 2 % of the
    distortion off."""
    rng, cameras = np.random.default_rng(seed), {}
    for camera_id, true in block.cameras.items():
        params = np.array(true.params)
        params[0] *= 1.0 + 0.001 * rng.standard_normal()
        params[1:3] += 5.0 * rng.standard_normal(2)
        params[3:6] *= 1.0 + 0.02 * rng.standard_normal(3)
        cameras[camera_id] = Camera(true.model, true.width_px, true.height_px, tuple(params.tolist()))
    sigmas = dict.fromkeys(cameras, FOCAL_SIGMAS["XMP calibration"])
    contents = replace(block.contents, block=replace(block.contents.block, cameras=cameras))
    return replace(block, contents=contents, observed=replace(block.observed, cameras=cameras, focal_sigmas=sigmas))


def every_third(block: SimulatedBlock) -> SimulatedBlock:
    kept = set(sorted(block.poses)[::3])
    images = tuple(image for image in block.contents.block.images if image.image_id in kept)
    pairs = tuple(p for p in block.contents.pairs if {p.pair.image_id0, p.pair.image_id1} <= kept)
    poses = {i: pose for i, pose in block.observed.poses.items() if i in kept}
    angles = {i: one for i, one in block.observed.angles.items() if i in kept}
    contents = replace(
        block.contents, block=replace(block.contents.block, images=images), pairs=pairs, positions=poses
    )  # fmt: skip
    return replace(
        block,
        contents=contents,
        observed=replace(block.observed, poses=poses, angles=angles),
        poses={i: pose for i, pose in block.poses.items() if i in kept},
    )


def rolled(block: SimulatedBlock, readout_s: float, speed_m_s: float) -> SimulatedBlock:
    """Seen by a shutter that exposes row by row while the aircraft flies towards the top of its pictures."""
    places, velocities = {}, {}
    for image_id, pose in block.poses.items():
        keypoints, camera = block.keypoints[image_id], block.cameras[block.camera_of[image_id]]
        assert pose.world_rotation is not None
        ahead = -pose.world_rotation[1] * [1.0, 1.0, 0.0]
        velocities[image_id] = speed_m_s * ahead / np.linalg.norm(ahead)
        points_m = block.points_m[keypoints.point]
        still = project(camera, pose.world_rotation, pose.center_m, points_m)
        seen = still
        for _ in range(4):  # a point is exposed with the row that it is seen in
            late_s = readout_s * (seen[:, 1:] / (camera.height_px - 1.0) - 0.5)
            seen = project(camera, pose.world_rotation, pose.center_m, points_m - late_s * velocities[image_id])
        places[image_id] = (keypoints.pixels + np.nan_to_num(seen - still)).astype(np.float32)
    return replace(
        block,
        contents=replace(block.contents, keypoints_px=places.__getitem__),
        observed=replace(block.observed, velocities=velocities),
    )


def residual_px(block: SimulatedBlock, found: AdjustedBlock, keypoints_px: Callable[[str], FloatArray]) -> float:
    """Median over images of mean reprojection errors."""
    rows = residuals_of(found, {}, block.contents.block.images, keypoints_px)
    return float(np.median([row.error_px for row in rows.values()]))


def surveyed(
    block: SimulatedBlock, count: int, off_m: dict[int, FloatArray]
) -> tuple[tuple[ControlPoint, ...], list[int]]:
    """Check points far from each other as control points, and their rows. off_m: errors of some."""
    rng, points_m, sigmas_m = np.random.default_rng(SEED), block.check_points_m, (0.01, 0.01, 0.015)
    seen = {i: np.isfinite(px).all(axis=1) for i, px in block.check_px.items()}
    often = np.sum(list(seen.values()), axis=0) >= 3
    rows = [int(np.argmax(np.where(often, np.linalg.norm((points_m - points_m.mean(axis=0))[:, :2], axis=1), -1.0)))]
    while len(rows) < count:
        apart_m = np.linalg.norm(points_m[:, None, :2] - points_m[rows, :2], axis=2).min(axis=1)
        rows.append(int(np.argmax(np.where(often, apart_m, -1.0))))
    points = []
    for number, row in enumerate(rows):
        position_m = points_m[row] + rng.standard_normal(3) * sigmas_m + off_m.get(number, np.zeros(3))
        pixels = {i: px[row] + 0.5 * rng.standard_normal(2) for i, px in block.check_px.items() if seen[i][row]}
        points.append(ControlPoint(f"gcp{number}", position_m, False, pixels, sigmas_m, 0.5))
    return tuple(points), rows


def check_errors_px(block: SimulatedBlock, found: AdjustedBlock, without: list[int]) -> tuple[float, float]:
    """Medians of the horizontal and vertical errors of check points in the world frame, ground pixels."""
    off_px = (intersected(block, Found.of(found)) - block.check_points_m) / block.gsd_m
    off_px = np.delete(off_px, without, axis=0)
    off_px = off_px[np.isfinite(off_px).all(axis=1)]
    assert len(off_px) >= 20
    return float(np.median(np.hypot(off_px[:, 0], off_px[:, 1]))), float(np.median(np.abs(off_px[:, 2])))


def test_a_factory_calibration_and_exact_positions_are_met_together() -> None:
    block = factory_calibrated(simulate(SCENE, "nadir", 12, "rtk2cm", SEED, tie_points=400), 1)
    found, facts = adjusted(block)
    positions = facts.positions
    assert positions.used == 12
    assert max(positions.rms_sigmas) < 3.0
    assert judged(block, Found.of(found))["focal_percent"] < 0.3
    [(camera_id, camera)] = found.cameras.items()
    values = [facts.calibration[camera_id].parameters[name].value for name in ("f", "cx", "cy", "k1")]
    corner_px = [0.0, 0.5, 0.5, 0.0]  # as camera files count
    np.testing.assert_allclose(lens_of(camera)[:4] + corner_px, values, rtol=1e-9)
    assert abs(focal_px(camera) - focal_px(block.observed.cameras[camera_id])) > 1.0


def test_every_third_image_of_a_block_is_met_as_well() -> None:
    block = every_third(factory_calibrated(simulate(SCENE, "nadir", 36, "rtk2cm", SEED, tie_points=400), 1))
    found, facts = adjusted(block)
    row = judged(block, Found.of(found))
    assert row["oriented"] == facts.positions.used == 12
    assert max(facts.positions.rms_sigmas) < 3.0
    assert row["focal_percent"] < 0.3
    assert row["horizontal_px"] < 1.0
    assert row["height_px"] < 1.5


@pytest.mark.parametrize(("readout_ms", "speed_m_s"), [(0.0, 8.0), (20.0, 10.0), (30.0, 8.0)])
def test_the_read_out_of_a_rolling_shutter_is_found_where_there_is_one(readout_ms: float, speed_m_s: float) -> None:
    """And what the shutter has moved is taken from the keypoints: residuals are those of the measurement (0.3 px)."""
    block = rolled(simulate(SCENE, "cross", 12, "rtk2cm", SEED, tie_points=400), readout_ms / 1000.0, speed_m_s)
    result, facts = adjusted(block)
    [calibration] = facts.calibration.values()
    found = calibration.parameters.get("readout_s")
    if readout_ms == 0.0:
        assert found is None
    else:
        assert found[0] == pytest.approx(readout_ms / 1000.0, rel=0.1)
        assert residual_px(block, result, block.contents.keypoints_px) > 0.8
    cameras = {image_id: result.cameras[block.camera_of[image_id]] for image_id in result.poses}
    assert residual_px(block, result, at_once(result, cameras, block.contents.keypoints_px)) < 0.4


def test_control_points_place_a_block_and_a_wrong_one_is_named() -> None:
    block = simulate(CONTROL_SCENE, "nadir", 12, "gps5m", SEED, tie_points=400)
    start = mapped(block)
    without, _ = adjusted(block, start)
    points, rows = surveyed(block, 3, {})
    with_three, facts = adjusted(block, start, control=points)
    assert facts.control.used == ["gcp0", "gcp1", "gcp2"]
    before, after = check_errors_px(block, without, rows), check_errors_px(block, with_three, rows)
    assert after[0] <= before[0]
    assert after[1] <= before[1]
    raised = tuple(replace(point, position_m=point.position_m + np.array([0.0, 0.0, 200.0])) for point in points)
    lifted, facts = adjusted(block, start, control=raised)
    assert facts.control.used == ["gcp0", "gcp1", "gcp2"]
    heights_m = [np.mean([pose.center_m[2] for pose in one.poses.values()]) for one in (with_three, lifted)]
    assert heights_m[1] - heights_m[0] == pytest.approx(200.0, abs=0.05)
    points, rows = surveyed(block, 5, {1: np.array([0.5, -0.4, 0.6])})
    with_five, facts = adjusted(block, start, control=points)
    assert facts.control.wrong == ["gcp1"]
    assert facts.control.used == ["gcp0", "gcp2", "gcp3", "gcp4"]
    across_px, up_px = check_errors_px(block, with_five, rows)
    assert across_px <= 1.0
    assert up_px <= 1.5


def test_a_real_lens_of_which_exif_tells_the_focal_length_alone_is_calibrated() -> None:
    drawn = real_lens(np.random.default_rng(SEED), WIDTH_PX, HEIGHT_PX)
    params = list(drawn.params)
    params[1] = 0.5 * (WIDTH_PX - 1) + 0.02 * WIDTH_PX
    lens = Camera(drawn.model, WIDTH_PX, HEIGHT_PX, tuple(params))
    block = simulate(SCENE, "cross", 12, "rtk2cm", SEED, tie_points=400, lens=lens)
    found, _ = adjusted(block)
    row = judged(block, Found.of(found))
    assert row["focal_percent"] < 0.1
    assert row["centre_px"] < 1.5
    assert row["horizontal_px"] <= 1.0
    assert row["height_px"] <= 1.5


def test_images_of_a_long_lens_stay_whose_distortion_has_a_parameter_beyond_one() -> None:
    """COLMAP leaves out such cameras by default. This k3 moves the corner of the picture by 1.5 % of its distance."""
    plain = real_lens(np.random.default_rng(SEED), WIDTH_PX, HEIGHT_PX)
    f, cx, cy = 1.5 * plain.params[0], *plain.params[1:3]
    lens = Camera(plain.model, WIDTH_PX, HEIGHT_PX, (f, cx, cy, 0.0, 0.0, 1.6, 0.0, 0.0, 0.0, 0.0))
    block = simulate(SCENE, "cross", 16, "rtk2cm", SEED, tie_points=400, lens=lens, start_camera=lens)
    found, facts = adjusted(block)
    assert len(found.poses) == 16
    assert facts.calibration["1"].parameters["k3"].value == pytest.approx(1.6, abs=0.1)
    assert judged(block, Found.of(found))["height_px"] <= 1.5
