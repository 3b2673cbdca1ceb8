"""Adjusted poses beside those given, and reprojection errors of images: against numbers put in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aeromatch_cli.data import AdjustedBlock, AdjustedPose, FloatArray, Image, Pose, PoseResidual
from aeromatch_cli.errors import BrokenFileError
from aeromatch_cli.formats.adjusted import read_residuals, residuals_text
from aeromatch_cli.geometry.cameras import from_colmap, project
from aeromatch_cli.geometry.rotations import rotation_z
from aeromatch_cli.sfm.block_figures import residual_figures, residuals_of

CAMERA = from_colmap("SIMPLE_RADIAL", 1600, 1200, (1500.0, 800.0, 600.0, -0.03))
STRAIGHT_DOWN = np.diag([1.0, -1.0, -1.0])
NAMES = {"a": "one, a.jpg", "b": "b.jpg", "c": "c.jpg", "d": "d.jpg"}
IMAGES = tuple(Image(image_id, name, 1600, 1200, "c") for image_id, name in NAMES.items())
# What is put in: adjusted less given positions, and turns about the vertical of the world.
SHIFTS_M = {"a": [0.3, -0.4, 1.2], "b": [-0.3, 0.4, 0.0], "c": [0.0, 0.0, 0.0]}
TURNS_DEG = {"a": 2.0, "b": -1.0, "c": 0.0}
# By how much every keypoint lies beside its point.
OFFSETS_PX = {"a": [3.0, 4.0], "b": [0.0, 1.0], "c": [0.0, 0.0]}


def block(frames: dict[str, int] | None = None) -> tuple[AdjustedBlock, dict[str, FloatArray]]:
    """Three oriented images of four; a and b see all 40 points, c the first ten; with keypoints."""
    rng = np.random.default_rng(0)
    points_m = np.column_stack([rng.uniform(-30.0, 30.0, (40, 2)), rng.uniform(-5.0, 5.0, 40)])
    poses, tracks, keypoints = {}, {}, {}
    for k, image_id in enumerate("abc"):
        center_m = np.array([20.0 * k - 20.0, 0.0, 100.0])
        count = 10 if image_id == "c" else 40
        poses[image_id] = AdjustedPose(center_m, STRAIGHT_DOWN, np.full(3, 0.01), np.full(3, 0.01))
        # Keypoints are in the reverse order of the points.
        tracks[image_id] = np.column_stack([np.arange(count)[::-1], np.arange(count)]).astype(np.int32)
        places = project(CAMERA, STRAIGHT_DOWN, center_m, points_m[:count]) + OFFSETS_PX[image_id]
        keypoints[image_id] = places[::-1].astype(np.float32)
    return AdjustedBlock({"c": CAMERA}, poses, points_m, np.zeros(40), tracks, frames or {}), keypoints


def given(adjusted: AdjustedBlock) -> dict[str, Pose]:
    """Of every image, the one that is not oriented too; c has no attitude."""
    found = {"d": Pose(np.zeros(3), STRAIGHT_DOWN, 0.5, 0.2)}
    for image_id, pose in adjusted.poses.items():
        # world_from_cam of the adjusted pose = turn . world_from_cam of the given one.
        rotation = None if image_id == "c" else pose.rotation @ rotation_z(TURNS_DEG[image_id])
        found[image_id] = Pose(pose.center_m - SHIFTS_M[image_id], rotation, 0.5, 0.2)
    return found


def made(frames: dict[str, int] | None = None) -> dict[str, PoseResidual]:
    adjusted, keypoints = block(frames)
    return residuals_of(adjusted, given(adjusted), IMAGES, keypoints.__getitem__)


def test_residuals_are_what_was_put_in() -> None:
    found = made()
    assert list(found) == ["a", "b", "c"]
    for image_id, one in found.items():
        np.testing.assert_allclose(one.position_m, SHIFTS_M[image_id], atol=1e-9)
        np.testing.assert_allclose(one.position_sigmas, np.array(SHIFTS_M[image_id]) / 0.5, atol=1e-9)
        assert one.error_px == pytest.approx(np.linalg.norm(OFFSETS_PX[image_id]), abs=1e-3)
    for image_id in "ab":
        np.testing.assert_allclose(found[image_id].rotation_deg, [0.0, 0.0, TURNS_DEG[image_id]], atol=1e-9)
        np.testing.assert_allclose(found[image_id].rotation_sigmas, [0.0, 0.0, TURNS_DEG[image_id] / 0.2], atol=1e-9)
    assert np.isnan(found["c"].rotation_deg).all()
    assert [one.points for one in found.values()] == [40, 40, 10]
    # Ten of the forty points have three images, the others two.
    assert [one.images_per_point for one in found.values()] == pytest.approx([2.25, 2.25, 3.0])


def test_each_axis_counts_in_its_own_stated_deviation() -> None:
    adjusted, keypoints = block()
    poses = {i: replace(pose, sigmas_m=(0.02, 0.05, 0.5)) for i, pose in given(adjusted).items()}
    found = residuals_of(adjusted, poses, IMAGES, keypoints.__getitem__)
    for image_id, one in found.items():
        expected = np.array(SHIFTS_M[image_id]) / [0.02, 0.05, 0.5]
        np.testing.assert_allclose(one.position_sigmas, expected, atol=1e-9)


def test_an_image_in_a_frame_of_its_own_lies_beside_nothing_given() -> None:
    found = made({"a": 1})
    assert np.isnan(found["a"].position_m).all()
    assert np.isnan(found["a"].rotation_sigmas).all()
    assert found["a"].error_px == pytest.approx(5.0, abs=1e-3)
    np.testing.assert_allclose(found["b"].position_m, SHIFTS_M["b"], atol=1e-9)


def test_an_image_without_points_has_no_error() -> None:
    adjusted, keypoints = block()
    tracks = {**adjusted.tracks, "c": np.zeros((0, 2), np.int32)}
    one = residuals_of(replace(adjusted, tracks=tracks), {}, IMAGES, keypoints.__getitem__)["c"]
    assert one.points == 0
    assert np.isnan([one.error_px, one.images_per_point, *one.position_m]).all()


def test_figures_of_all_images() -> None:
    figures = residual_figures(made(), NAMES)
    assert (figures.images, figures.positions, figures.rotations) == (3, 3, 2)
    rms_m = [np.sqrt(0.18 / 3.0), np.sqrt(0.32 / 3.0), np.sqrt(1.44 / 3.0)]
    assert figures.position_m_rms == pytest.approx(rms_m, rel=1e-3)
    assert figures.position_sigmas_rms == pytest.approx([2.0 * one for one in rms_m], rel=1e-3)
    assert figures.position_m_median == pytest.approx([0.3, 0.4, 0.0])
    assert figures.position_m_worst == ("one, a.jpg", pytest.approx(1.3))
    assert figures.rotation_deg_rms == pytest.approx([0.0, 0.0, np.sqrt(2.5)], rel=1e-3)
    assert figures.rotation_deg_worst == ("one, a.jpg", pytest.approx(2.0))
    assert figures.error_px_median == pytest.approx(1.0, abs=1e-3)
    assert figures.error_px_worst == ("one, a.jpg", pytest.approx(5.0, abs=1e-3))


def test_figures_without_anything_given() -> None:
    adjusted, keypoints = block()
    figures = residual_figures(residuals_of(adjusted, {}, IMAGES, keypoints.__getitem__), NAMES)
    assert figures.positions == 0
    assert figures.position_m_rms is None
    assert figures.rotation_deg_worst is None
    assert figures.error_px_median == pytest.approx(1.0, abs=1e-3)
    assert residual_figures({}, NAMES).error_px_median is None


def test_the_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    path, found = tmp_path / "residuals.csv", made({"b": 1})
    path.write_text(residuals_text(found, IMAGES))
    assert path.read_text().splitlines()[0].startswith("image,dx_m,dy_m,dz_m,dx_sigmas")
    again = read_residuals(path, IMAGES)
    assert set(again) == set(found)
    for image_id, one in found.items():
        for name, value in vars(one).items():
            np.testing.assert_allclose(getattr(again[image_id], name), value, atol=1e-6)
    path.write_text("image,dx_m\na.jpg,1\n")
    with pytest.raises(BrokenFileError):
        read_residuals(path, IMAGES)
