"""What the report says of the bundle adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from make_results import filled
from test_report import full, page_of  # noqa: F401

from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Block, Camera, Pose
from aeromatch_cli.report.adjustment import (
    Adjustment,
    adjusted_poses,
    adjustment_notices,
    adjustment_rows,
    as_adjusted,
    images_aside,
)
from aeromatch_cli.results.stages import AdjustResult, OrientResult, PairsResult
from aeromatch_cli.sfm.block_figures import block_figures
from aeromatch_cli.stages.stage_report import StageReport


def pose(x_m: float) -> Pose:
    return Pose(np.array([x_m, 0.0, 50.0]), None, 5.0, 180.0)


def moved(x_m: float) -> AdjustedPose:
    return AdjustedPose(np.array([x_m, 0.0, 50.0]), np.diag([1.0, -1.0, -1.0]), np.full(3, 0.1), np.full(3, 0.1))


def test_an_adjustment_of_earlier_matches_is_left_out_and_named(full):  # noqa: F811
    told = StageReport("adjust", items=4, done=4)
    told.result = AdjustResult(images=4, points=77, remarks=["a remark"])
    told.write(full.workspace)
    page = page_of(full)
    assert "Adjustment and points are older than the matches" in page
    assert "a remark" not in page
    assert ">77 in" not in page


def test_control_points_that_say_nothing_are_named():
    control = {"points": 4, "control": 4, "check": 0, "not_measured_in_two_images": ["p3", "p4"], "doubtful": [],
               "rays_do_not_meet": ["p2"], "control_rmse_m": None, "check_rmse_m": None}  # fmt: skip
    (notice,) = adjustment_notices([], Adjustment(filled(AdjustResult, control=control)))
    assert "fewer than 3 control points are measured in two oriented images" in notice.text
    assert "rays do not meet of p2" in notice.text


def test_a_frame_of_its_own_has_no_metres(full):  # noqa: F811
    oriented = StageReport("orient", items=4, done=4)
    oriented.result = filled(OrientResult, frame="own")
    oriented.write(full.workspace)
    page = page_of(full)
    assert "x, arbitrary units" in page
    assert "metres" not in page.split('id="settings"')[0].replace("no metre", "")


def test_pixels_on_the_ground_are_those_of_the_summary(full):  # noqa: F811
    """Views have one common size for all images, those in frames of their own among them."""
    first = StageReport("pairs", items=5, done=5)
    first.result = filled(PairsResult, images=4, block={"metric": True, "gsd_m": 0.0484})
    first.write(full.workspace)
    views = replace(full, block=replace(full.block, gsd_m=0.0515))
    assert "0.0484 m" in page_of(views)
    assert "0.0515 m" not in page_of(views)


def test_the_page_shows_the_block_as_it_was_adjusted():
    """Image b was left out by the first pass; c has a group of its own, whose frame is none of the block's."""
    given = {"a": pose(1.0), "c": pose(3.0), "d": pose(4.0)}
    block = Block((), {}, given, "local", (0.0, 0.0, 0.0), ConstantGround(0.0), "stated", 0.1)
    adjusted = replace(AdjustedBlock.empty(), poses={i: moved(10.0 + k) for k, i in enumerate("abc")}, frames={"c": 1})
    shown = as_adjusted(block, adjusted, in_world=True)
    assert {i: one.center_m[0] for i, one in shown.poses.items()} == {"a": 10.0, "b": 11.0, "d": 4.0}
    assert shown.ground is block.ground
    own = as_adjusted(block, replace(adjusted, frames={"a": 1, "b": 1, "c": 2}), in_world=False)
    assert {i: one.center_m[0] for i, one in own.poses.items()} == {"a": 10.0, "b": 11.0}
    assert own.ground is None
    # The largest group counts. Whether d belongs to it is not known.
    held = as_adjusted(block, replace(adjusted, frames={"a": 2, "b": 1, "c": 2}), in_world=False)
    assert {i: one.center_m[0] for i, one in held.poses.items()} == {"a": 10.0, "c": 12.0}
    assert held.ground is block.ground
    alone = replace(adjusted, poses={i: adjusted.poses[i] for i in "ac"}, frames={"a": 1, "c": 1})
    one = as_adjusted(block, alone, in_world=False)
    assert {i: one.center_m[0] for i, one in one.poses.items()} == {"a": 10.0, "c": 12.0, "d": 4.0}
    assert {i: one.center_m[0] for i, one in adjusted_poses(adjusted).items()} == {"a": 10.0, "b": 11.0, "c": 12.0}


def test_without_adjustment_the_page_leaves_out_images_in_other_frames():
    """As where the adjustment has failed: c, and d and e, were oriented in frames of their own."""
    given = {i: pose(float(k)) for k, i in enumerate("abcde")}
    frames = {"c": 1, "d": 2, "e": 2}
    block = Block((), {}, given, "EPSG:32617", (0.0, 0.0, 0.0), ConstantGround(0.0), "stated", 0.1, frames=frames)
    assert images_aside(block, None, in_world=True) == {"c", "d", "e"}
    assert sorted(as_adjusted(block, None, in_world=True).poses) == ["a", "b"]
    own = replace(block, poses={i: given[i] for i in "cde"}, crs="local", metric=False)
    assert sorted(as_adjusted(own, None, in_world=False).poses) == ["d", "e"]
    # Of an adjustment that holds a alone, nothing is known of c in the world.
    adjusted = replace(AdjustedBlock.empty(), poses={"a": moved(10.0)})
    assert sorted(as_adjusted(block, adjusted, in_world=True).poses) == ["a", "b"]


def test_cameras_count_from_the_corner_of_the_first_pixel_in_files_and_on_the_page():
    """A principal point in the middle of 800 x 600 px is 400, 300 there, and 399.5, 299.5 in the workspace."""
    camera = Camera("PINHOLE", 800, 600, (700.0, 700.0, 399.5, 299.5))
    figures = block_figures(replace(AdjustedBlock.empty(), cameras={"1": camera}), [], [])
    told = AdjustResult(**figures | {"points": 1, "reprojection_error_px": 0.2})
    assert told.as_json()["cameras"] == {"1": ["PINHOLE", 800, 600, [700.0, 700.0, 400.0, 300.0]]}
    assert adjustment_rows(Adjustment(told))[-1] == (
        "Cameras after the adjustment (cx, cy from the corner of the first pixel, as in COLMAP)",
        "1: PINHOLE, 800 x 600 px, 700, 700, 400, 300",
    )


def test_check_points_alone_are_told_of_the_block_as_it_is():
    control = {"points": 4, "control": 0, "check": 4, "not_measured_in_two_images": [], "doubtful": [],
               "control_rmse_m": None, "check_rmse_m": None, "residuals": {"p1": [2.0, 3.0, 4.0]}}  # fmt: skip
    inside = {"used": [], "wrong": [], "exchanged": [], "held_out": "check points", "kept": True,
              "held_out_rms_m": [2.0, 3.0, 4.0], "without_rms_m": [2.0, 3.0, 4.0]}  # fmt: skip
    found = filled(AdjustResult, images=9, points=1, control=control, groups=[{"control": inside}])
    assert adjustment_rows(Adjustment(found))[-1] == (
        "Control: 0 control points, 4 check points",
        "the block as it is: RMSE at check points x 2.000, y 3.000, z 4.000 m",
    )
    assert adjustment_notices([], Adjustment(found)) == []
