"""What the report says of the bundle adjustment."""

from __future__ import annotations

from test_report import full, page_of  # noqa: F401

from aeromatch_cli.report.adjustment import Adjustment, adjustment_notices
from aeromatch_cli.stages.stage_report import StageReport


def test_an_adjustment_of_earlier_matches_is_left_out_and_named(full):  # noqa: F811
    told = StageReport("adjust", items=4, done=4)
    told.facts = {"images": 4, "points": 77, "remarks": ["a remark"], "outside": {}, "control": None}
    told.write(full.workspace)
    page = page_of(full)
    assert "Adjustment and points are older than the matches" in page
    assert "a remark" not in page
    assert ">77 in" not in page


def test_control_points_that_say_nothing_are_named():
    control = {"points": 4, "control": 4, "check": 0, "not_measured_in_two_images": ["p3", "p4"], "doubtful": [],
               "rays_do_not_meet": ["p2"], "control_rmse_m": None, "check_rmse_m": None}  # fmt: skip
    (notice,) = adjustment_notices([], Adjustment({"control": control}))
    assert "fewer than 3 control points are measured in two oriented images" in notice.text
    assert "rays do not meet of p2" in notice.text


def test_a_frame_of_its_own_has_no_metres(full):  # noqa: F811
    oriented = StageReport("orient", items=4, done=4)
    oriented.facts = {"frame": "own"}
    oriented.write(full.workspace)
    page = page_of(full)
    assert "x, arbitrary units" in page
    assert "metres" not in page.split('id="settings"')[0].replace("no metre", "")
