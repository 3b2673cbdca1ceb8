"""Calibration, residuals over the picture and expected heights on the page."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from make_results import filled

from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Camera, FloatArray, Image
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.report.adjustment import surveyed_rows
from aeromatch_cli.report.calibration import camera_sections, heights_sections
from aeromatch_cli.results.adjustment import Control
from aeromatch_cli.results.stages import AdjustResult

CAMERA = Camera("PINHOLE", 800, 600, (700.0, 700.0, 399.5, 299.5))
IMAGES = [Image(i, f"{i}.jpg", 800, 600, "1") for i in "ab"]
KNOWN = {"f": 690.0, "cx": 399.5, "cy": 299.5}
ADJUSTED: dict[str, Any] = {"ground_pixel_m": 0.1, "groups": [{
    "calibration": {"1": {"images": 2, "correlations": [["f", "k1", -0.95]], "parameters": {
        "f": [700.0, 0.5, 690.0, 20.0], "cx": [400.0, 0.0, 400.0, 16.0], "cy": [300.0, 0.0, 300.0, 16.0],
        "k1": [0.0, 0.001, 0.0, 0.05],
    }}},
    "heights": {"metric": True, "sigma": 0.15, "bowl": 0.4, "tilt": 0.2, "reach": 90.0, "pixel": 0.1,
                "points": [[0.0, 0.0, 0.1], [50.0, 10.0, 0.15], [20.0, 60.0, 0.2]]},
}]}  # fmt: skip


def block(off_px: FloatArray) -> tuple[AdjustedBlock, dict[str, FloatArray]]:
    """Two images that look straight down on 2,000 points, which they have measured `off_px` beside their places."""
    rng = np.random.default_rng(1)
    points_m = np.column_stack([rng.uniform(-50.0, 50.0, 2000), rng.uniform(-38.0, 38.0, 2000), np.zeros(2000)])
    down = np.diag([1.0, -1.0, -1.0])
    poses = {
        i: AdjustedPose(np.array([x, 0.0, 100.0]), down, np.zeros(3), np.zeros(3)) for i, x in (("a", 0.0), ("b", 5.0))
    }
    keypoints = {i: project(CAMERA, pose.rotation, pose.center_m, points_m) + off_px for i, pose in poses.items()}
    rows = np.arange(2000, dtype=np.int32)
    tracks = {i: np.column_stack([rows, rows]) for i in poses}
    return AdjustedBlock({"1": CAMERA}, poses, points_m, np.zeros(2000), tracks), keypoints


def test_a_camera_has_its_parameters_beside_what_was_known() -> None:
    adjusted, keypoints = block(np.zeros(2))
    (section,) = camera_sections(filled(AdjustResult, ADJUSTED), adjusted, IMAGES, keypoints.__getitem__)
    assert section.words == "2 images, PINHOLE, 800 x 600 px"
    assert section.rows[0] == ("f, focal length", "px", "700.00", "0.50", "690.00", "20.00", "+0.5", "k1 -0.95")
    assert section.rows[1] == ("cx, principal point", "px", "400.00", "held", "400.00", "16.00", "", "")


def test_a_setting_that_holds_a_parameter_is_named() -> None:
    adjusted, keypoints = block(np.zeros(2))
    found = filled(AdjustResult, ADJUSTED, held_by={"cx": "adjust.hold"})
    (section,) = camera_sections(found, adjusted, IMAGES, keypoints.__getitem__)
    assert [row[3] for row in section.rows] == ["0.50", "held by adjust.hold", "held", "0.001000"]


def test_fields_show_what_the_calibration_does_and_what_remains() -> None:
    adjusted, keypoints = block(np.array([0.3, -0.4]))
    (section,) = camera_sections(filled(AdjustResult, ADJUSTED), adjusted, IMAGES, keypoints.__getitem__)
    (moved, moved_words), (remaining, remaining_words) = section.fields
    # 10 px more in a focal length of 700 px move the middle of the outermost cell, 465.0 px away, by 10 / 700 of that.
    assert float(re.findall(r"up to ([\d.]+) px", moved_words)[0]) == pytest.approx(465.0 * 10 / 700, abs=0.06)
    assert float(re.findall(r"up to ([\d.]+) px", remaining_words)[0]) == pytest.approx(0.5, abs=0.005)
    assert all(drawn.startswith("<svg") for drawn in (moved, remaining))
    # Names of cameras are long: that of the panel is enough, and the title ends before the arrow of the scale.
    assert re.search(r">adjusted less known before; arrows enlarged [\d.]+ times<", moved)
    assert re.search(r">means of residuals; arrows enlarged [\d.]+ times<", remaining)


def test_expected_errors_of_heights_are_in_metres_only_where_there_are_metres() -> None:
    [group] = ADJUSTED["groups"]
    in_own = {"heights": group["heights"] | {"metric": False}}
    [world], [own] = (heights_sections(filled(AdjustResult, groups=[one]), {}) for one in (group, in_own))
    assert world.title == "Expected errors of heights"
    assert "median 0.150 m (1.5 ground pixels)" in world.words
    assert "may lie 0.400 m (4.0 ground pixels) above or below its border" in world.words
    assert "median 1.5 ground pixels" in own.words
    assert "metres" in world.plan
    assert "metres" not in own.plan
    assert heights_sections(AdjustResult(images=0), {}) == []


def test_expected_errors_of_heights_are_shown_of_every_part_by_name() -> None:
    [group] = ADJUSTED["groups"]
    groups = [group | {"images": 3, "first_image": i} for i in ("a", "b")]
    groups[1] |= {"heights": group["heights"] | {"metric": False, "bowl": 1.51}}
    first, second = heights_sections(filled(AdjustResult, groups=groups), {"a": "a.jpg", "b": "b.jpg"})
    assert first.title == "Expected errors of heights in the part of 3 images with a.jpg"
    assert "The middle of the part of 3 images with a.jpg may lie 0.400 m (4.0 ground pixels)" in first.words
    assert "The middle of the part of 3 images with b.jpg may lie 15.1 ground pixels" in second.words


def test_surveyed_points_have_metres_pixels_and_sigmas() -> None:
    control = {
        "residuals": {"P1": [0.02, -0.01, 0.06], "P2": [0.0, 0.0, 0.3]}, "checks": ["P2"],
        "point_sigmas_m": {"P1": [0.02, 0.02, 0.03], "P2": [0.02, 0.02, 0.03]}, "ground_pixel_m": 0.1,
        "image_residuals_px": {"P1": {"a": [0.3, -0.4], "b": [0.0, 0.0]}, "P2": {}},
    }  # fmt: skip
    assert surveyed_rows(filled(Control, control)) == [
        ("P1", "control", "+0.020", "-0.010", "+0.060", "0.6", "2.0", "2", "0.35"),  # of 0.5 and 0 px
        ("P2", "check", "+0.000", "+0.000", "+0.300", "3.0", "10.0", "0", ""),
    ]
