"""Keypoints of a rolling shutter, without what it has moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Camera, FloatArray
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.sfm.shutter import at_once

CAMERA = Camera("BROWN", 1200, 900, (1000.0, 610.0, 440.0, -0.05, 0.01, 0.0, 1e-4, -2e-4, 0.5, 0.0))
# 30 ms at 12 m/s, obliquely over the picture: 3.6 pixels from 100 m.
SWEEP_M = np.array([0.3, 0.2, 0.01])
UNKNOWN = np.full(3, np.nan)


def seen(sweep_m: FloatArray, tied: int) -> tuple[AdjustedBlock, FloatArray, FloatArray]:
    """A block of one image with 200 keypoints, those of them that a rolling shutter sees, and those of its pose alone.

    tied: how many of them have a point.
    """
    rng = np.random.default_rng(1)
    rotation, center_m = from_omega_phi_kappa(3.0, -2.0, 40.0), np.array([5.0, -3.0, 100.0])
    points_m = np.column_stack([rng.uniform(-30, 40, 200), rng.uniform(-35, 30, 200), rng.normal(0.0, 0.5, 200)])
    exact_px = project(CAMERA, rotation, center_m, points_m)
    rolling_px = exact_px
    for _ in range(5):
        share = rolling_px[:, 1:] / 899.0 - 0.5
        rolling_px = project(CAMERA, rotation, center_m, points_m - share * sweep_m)
    pose = AdjustedPose(center_m, rotation, UNKNOWN, UNKNOWN, sweep_m)
    track = np.column_stack([np.arange(tied), np.arange(tied)]).astype(np.int32)
    return AdjustedBlock({"c": CAMERA}, {"a": pose}, points_m, np.zeros(200), {"a": track}), rolling_px, exact_px


def test_keypoints_with_points_lie_where_the_pose_sees_these() -> None:
    block, rolling_px, exact_px = seen(SWEEP_M, 200)
    assert np.linalg.norm(rolling_px - exact_px, axis=1).max() > 1.5
    found_px = at_once(block, {"a": CAMERA}, lambda _: rolling_px)("a")
    np.testing.assert_allclose(found_px, exact_px, atol=1e-6)


def test_other_keypoints_lie_as_far_away_as_their_neighbours() -> None:
    """Heights differ by half a metre in 100: by 1 % of what is moved."""
    block, rolling_px, exact_px = seen(SWEEP_M, 60)
    found_px = at_once(block, {"a": CAMERA}, lambda _: rolling_px)("a")
    assert np.linalg.norm(found_px - exact_px, axis=1).max() < 0.05


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_shutter_that_exposes_at_once_moves_nothing(dtype: type) -> None:
    block, _, exact_px = seen(np.zeros(3), 200)
    stored_px = exact_px.astype(dtype)
    assert at_once(block, {"a": CAMERA}, lambda _: stored_px)("a") is stored_px
    outside = replace(block, poses={}, tracks={})
    assert at_once(outside, {"a": CAMERA}, lambda _: stored_px)("a") is stored_px
