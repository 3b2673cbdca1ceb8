"""The verdict on a block: every criterion by its figure."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest
from make_results import filled

from aeromatch_cli.results.stages import ConsistencyResult
from aeromatch_cli.sfm.quality.finding import Finding, Quality, QualityInput, plain
from aeromatch_cli.sfm.quality.judgement import judged
from aeromatch_cli.stages.quality import _contradicted

CALIBRATED = {"images": 12, "correlations": [], "parameters": {
    "f": [3010.0, 1.0, 3000.0, 30.0], "cx": [2005.0, 0.4, 1999.5, 80.0], "k1": [-0.01, 0.001, 0.0, 0.05],
}}  # fmt: skip
GROUP: dict[str, Any] = {
    "kind": "positions", "images": 12, "sigma_px": 0.3, "mounts": {}, "flights": [],
    "positions": {
        "images": 12, "used": 12, "wrong": [], "rms_m": [0.02, 0.02, 0.03], "rms_sigmas": [1.0, 1.0, 1.0],
        "stated_m": [0.02, 0.02, 0.03], "factors": [1.0, 1.0],
    },
    "calibration": {"camera_1": CALIBRATED},
    "heights": {"metric": True, "sigma": 0.05, "bowl": 0.06, "tilt": 0.03, "reach": 100.0, "pixel": 0.03},
}  # fmt: skip
ADJUSTED: dict[str, Any] = {
    "images": 12, "points": 3000, "track_length": 3.4, "held_by_pairs": 0, "reprojection_error_px": 0.3,
    "ground_pixel_m": 0.03, "positions_given": 12, "outside": {}, "control": None, "groups": [GROUP],
    "residuals": {"rotation_sigmas_median": [0.7, 0.7, 0.7], "rotation_deg_median": [0.7, 0.7, 0.7]},
}  # fmt: skip


def judged_with(group: dict[str, Any] | None = None, **evidence: Any) -> Quality:
    """The sound block with changes. group: of its only group, evidence: `adjust` and fields of `QualityInput`."""
    adjusted = deepcopy(ADJUSTED) | evidence.pop("adjust", {})
    if group is not None:
        adjusted["groups"] = [deepcopy(GROUP) | group]
    return judged(
        filled(QualityInput, {"images": 12, "adjust": adjusted, "components": [12], "refined": True, **evidence})
    )


def found(quality: Quality, what: str) -> Finding:
    (finding,) = [one for one in quality.findings if one.what == what]
    return finding


def positions(**changes: Any) -> dict[str, Any]:
    return {"positions": GROUP["positions"] | changes}


def apart(height_m: float, scatter_m: float) -> dict[str, Any]:
    """Two flights with GPS of 5 m, the heights of one above those of the other."""
    scatter = {"scatter_m": [scatter_m] * 3}
    flights = [
        {"flight": "A", "images": 7, "mean_m": [0.0, 0.0, -0.3 * height_m], **scatter},
        {"flight": "B", "images": 5, "mean_m": [0.0, 0.0, 0.7 * height_m], **scatter},
    ]
    return positions(stated_m=[5.0, 5.0, 5.0], flights=flights)


def flight(**found: Any) -> dict[str, Any]:
    return {"flights": [{"flight": "B", "images": 6, "step_m": 0.0, **found}]}


def lens(**parameters: list[float]) -> dict[str, Any]:
    return {"calibration": {"camera_1": {**CALIBRATED, "parameters": CALIBRATED["parameters"] | parameters}}}


def heights(**changes: float) -> dict[str, Any]:
    return {"heights": GROUP["heights"] | changes}


NONE_USED = {"rms_m": None, "rms_sigmas": None}
TURNED = {"rotation_sigmas_median": [5.0, 5.0, 0.1], "rotation_deg_median": [5.0, 5.0, 0.1]}
CONTROL = {
    "points": 5, "control": 3, "check": 2, "doubtful": [], "check_rmse_m": [0.02, 0.02, 0.03],
    "control_rmse_m": [0.01, 0.01, 0.01], "sigmas_m": [0.025, 0.025, 0.042426],
}  # fmt: skip
# Of the adjustment with control points: check points are met to 37.5 cm in height.
INSIDE = {
    "used": ["P1", "P2", "P3"], "wrong": [], "exchanged": [], "held_out": "check points",
    "held_out_rms_m": [0.02, 0.02, 0.375], "without_rms_m": [0.02, 0.02, 0.5], "kept": True,
}  # fmt: skip


def test_a_sound_block_is_good_and_every_criterion_has_its_number() -> None:
    quality = judged_with()
    assert quality.verdict == "good"
    assert not quality.faults
    assert quality.unchecked == ("control points: none are given",)
    values = {one.what: one.value for one in quality.findings}
    assert values["positions horizontally"] == pytest.approx(1.0)
    assert values["reprojection error"] == pytest.approx(0.3)
    assert values["bowl"] == pytest.approx(2.0)  # 0.06 m of 0.03 m
    assert values["tilt"] == pytest.approx(0.0172, abs=1e-4)  # 0.03 m over 100 m
    assert values["angles"] == pytest.approx(0.7 / 0.6745)
    assert values["calibration"] == pytest.approx(1.0 / 3.0)  # 10 px of 30 px: the largest change


@pytest.mark.parametrize(
    ("changes", "what", "value", "level"),
    [
        # Positions stated as 2 cm and missed by 0.5 m.
        ({"group": positions(rms_sigmas=[25.0, 25.0, 1.0])}, "positions horizontally", 25.0, "bad"),
        ({"group": positions(rms_sigmas=[1.0, 1.0, 3.0])}, "positions vertically", 3.0, "doubtful"),
        ({"group": positions(rms_sigmas=[0.1, 0.1, 0.1])}, "positions vertically", 0.1, "good"),
        ({"group": positions(used=11, wrong=["a"])}, "wrong positions", 1 / 12, "doubtful"),
        ({"group": positions(used=7, wrong=list("abcde"))}, "wrong positions", 5 / 12, "bad"),
        # The factory's focal length is 1964 px to 1 %, the adjusted one 2480 px.
        ({"group": lens(f=[2480.0, 1.0, 1964.0, 19.64])}, "calibration", 26.27, "bad"),
        ({"group": lens(k1=[0.2, 0.001, -0.01, 0.05])}, "calibration", 4.2, "doubtful"),
        ({"group": lens(b1=[9.0, 0.1, 0.0, 0.6])}, "affinity", 15.0, "doubtful"),
        ({"group": lens(b1=[0.3, 0.1, 0.0, 0.6])}, "affinity", 0.5, "good"),
        ({"group": lens(readout_s=[0.03, 0.001, 0.0, 0.03])}, "rolling shutter", 0.03, "good"),
        ({"group": lens(readout_s=[0.5, 0.001, 0.0, 0.03])}, "rolling shutter", 0.5, "doubtful"),
        ({"group": heights(bowl=0.3)}, "bowl", 10.0, "doubtful"),
        ({"group": heights(sigma=0.3)}, "heights", 10.0, "doubtful"),
        ({"group": heights(sigma=9.0) | positions(stated_m=[5.0] * 3)}, "heights", 300.0, "good"),
        ({"group": heights(tilt=5.0)}, "tilt", 2.862, "doubtful"),
        ({"group": flight(step_m=14.9)}, "step of heights", 14.9 / 0.03, "doubtful"),
        ({"group": flight(shift_x=[1.0, 0.01])}, "shift of a flight", 50.0, "doubtful"),
        ({"adjust": {"control": CONTROL}, "group": {"control": INSIDE}}, "check points", 8.839, "bad"),
        ({"group": apart(14.9, 0.5)}, "flights apart", 2.98, "doubtful"),
        ({"group": apart(4.9, 0.5)}, "flights apart", 0.98, "good"),
        ({"group": flight(lag_s=[0.5, 0.01])}, "delay of positions", 0.5, "doubtful"),
        ({"group": {"mounts": {"camera_1": {"lever_z": [0.2, 0.01]}}}}, "antenna", 0.2, "good"),
        ({"adjust": {"reprojection_error_px": 2.32}}, "reprojection error", 2.32, "bad"),
        ({"adjust": {"reprojection_error_px": 0.8}}, "reprojection error", 0.8, "doubtful"),
        ({"adjust": {"reprojection_error_px": 0.8}, "refined": False}, "reprojection error", 0.8, "good"),
        ({"adjust": {"reprojection_error_px": 2.0}, "reduced": 4.0}, "reprojection error", 0.5, "good"),
        ({"adjust": {"track_length": 2.0}}, "images per point", 2.0, "doubtful"),
        ({"adjust": {"held_by_pairs": 12}}, "held by pairs", 1.0, "bad"),
        ({"adjust": {"outside": {"a": ""}, "images": 11}}, "oriented images", 1 / 12, "doubtful"),
        ({"adjust": {"outside": dict.fromkeys("abcd", ""), "images": 8}}, "oriented images", 1 / 3, "bad"),
        ({"components": [8, 4]}, "connection", 1 / 3, "bad"),
        ({"components": [11, 1]}, "connection", 1 / 12, "doubtful"),
        ({"adjust": {"residuals": TURNED}}, "angles", 5.0 / 0.6745, "bad"),
        ({"orient": {"stays": True, "images_matched": 12, "given_poses_explained": 3}}, "kept poses", 0.75, "bad"),
        ({"adjust": {"control": CONTROL}}, "check points", 0.8, "good"),
        ({"adjust": {"control": CONTROL | {"check_rmse_m": [0.02, 0.02, 0.5]}}}, "check points", 11.785, "bad"),
        ({"adjust": {"control": CONTROL | {"doubtful": ["P1"]}}}, "wrong control points", 0.2, "doubtful"),
    ],
)  # fmt: skip
def test_one_fault_decides_with_its_number(changes: dict[str, Any], what: str, value: float, level: str) -> None:
    quality = judged_with(**changes)
    finding = found(quality, what)
    assert finding.value == pytest.approx(value, rel=1e-3)
    assert finding.level == quality.verdict == level
    if level != "good":
        assert quality.findings[0].what == what
        assert ": " in finding.sentence, "the remedy follows"


@pytest.mark.parametrize(
    ("changes", "not_tried", "words"),
    [
        ({}, None, "but its read-out time, tried where velocities are known, does not explain it"),
        ({}, "orient=given", "and its read-out time was not tried: orient=given"),
        ({"readout_s": [0.03, 0.001, 0.0, 0.03]}, None, "a part of the rolling shutter may be in it"),
    ],
)
def test_the_remedy_for_affinity_says_what_was_tried_and_says_it_once(
    changes: dict[str, Any], not_tried: str | None, words: str
) -> None:
    def camera(b2: float) -> dict[str, Any]:
        return CALIBRATED | {
            "parameters": CALIBRATED["parameters"] | {"k1": [0.0] * 4, "b2": [b2, 0.1, 0.0, 0.1]} | changes
        }

    group = {"calibration": {"camera_1": camera(0.8), "camera_2": camera(1.1), "camera_3": camera(0.2)}}
    quality = judged_with(group=group, adjust={"readout_not_tried": not_tried})
    doubtful, good = [one for one in quality.findings if one.what == "affinity"]
    assert (doubtful.value, doubtful.level) == (pytest.approx(11.0), "doubtful")
    assert doubtful.sentence.count(words) == 1
    for known in ("camera_1: b2 0.8 ", "camera_2: b2 1.1 "):
        assert known in doubtful.sentence
    assert (good.value, good.level) == (pytest.approx(2.0), "good")
    assert "camera_3: b2 0.2 " in good.sentence
    assert "square" not in good.sentence


def test_a_single_pair_does_not_tell_what_is_wrong() -> None:
    pair = {"images": 2, "components": [2]}
    group = {"kind": "given", "images": 2} | positions(images=2, used=0, wrong=["a", "b"], **NONE_USED)
    words = (
        "2 of 2 given positions are not used: with the angles and the focal length they do not fit the pictures, and a "
        "single pair does not tell which of these is wrong; "
    )
    finding = found(judged_with(group=group, adjust={"images": 2}, **pair), "wrong positions")
    tell = "a third image that overlaps both, or control points, tell"
    assert (finding.level, finding.sentence) == ("doubtful", words + tell)
    finding = found(judged_with(group=group, adjust={"images": 2, "guessed_cameras": ["c"]}, **pair), "wrong positions")
    guess = (
        "the likely cause is the focal length of camera c, which is a guess, since EXIF says too little: give "
        "--cameras FILE"
    )
    assert (finding.level, finding.sentence) == ("doubtful", words + guess)


def test_two_positions_are_too_few_to_be_wrong() -> None:
    group = {"kind": "given", "images": 2} | positions(images=2, used=0, **NONE_USED)
    quality = judged_with(group=group, adjust={"images": 2}, images=2, components=[2])
    finding = found(quality, "wrong positions")
    assert (finding.level, finding.sentence) == (
        "good",
        "2 given positions are too few to take part in the adjustment, which takes three: scale, north and place are "
        "those of the given poses",
    )


def test_a_guessed_focal_length_is_named_where_many_positions_do_not_fit() -> None:
    guessed = {"guessed_cameras": ["camera_1"]}
    guess = (
        "the likely cause is the focal length of camera camera_1, which is a guess, since EXIF says too little: give "
        "--cameras FILE"
    )
    quality = judged_with(group=positions(used=7, wrong=list("abcde")), adjust=guessed)
    assert found(quality, "wrong positions").sentence == (
        "5 of 12 given positions contradict the pictures and are not used: a, b, c, d, e; "
        f"{guess}; otherwise check which position belongs to which image"
    )
    one = judged_with(group=positions(used=11, wrong=["a"]), adjust=guessed)
    assert "focal length" not in found(one, "wrong positions").sentence
    off = judged_with(group=positions(rms_sigmas=[25.0, 25.0, 1.0]), adjust=guessed)
    assert found(off, "positions horizontally").sentence.endswith(f"or correct their cause; {guess}")


def test_the_step_between_two_flights_is_said_with_its_size() -> None:
    assert (
        judged_with(group=flight(step_m=14.93))
        .faults[0]
        .sentence.startswith(
            "heights of flight B (6 images) lie 14.9 m above those of the others, which was taken out: check"
        )
    )


def test_parts_that_share_no_points_are_as_exact_as_their_positions() -> None:
    for stated_m in (0.02, 5.0):
        parts = [deepcopy(GROUP) | positions(stated_m=[stated_m] * 3, used=n, images=n) | {"images": n} for n in (8, 4)]
        quality = judged_with(adjust={"groups": parts})
        assert found(quality, "parts").value == pytest.approx(stated_m / 2.0 / 0.03)  # the smaller one has four images
        assert quality.verdict == "doubtful"


@pytest.mark.parametrize(("name", "verdict"), [("cx", "doubtful"), ("f", "bad")])
def test_a_block_of_unknown_tilt_does_not_tell_the_principal_point(name: str, verdict: str) -> None:
    group = lens(**{name: [1100.0, 1.0, 1000.0, 10.0]})
    assert judged_with(group=group).verdict == "bad"
    quality = judged_with(group=group | heights(tilt=5.0))
    assert found(quality, "calibration").level == quality.verdict == verdict


def test_the_setting_that_holds_a_calibration_is_named() -> None:
    whole = dict.fromkeys(("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1", "b2"), "adjust.calibration=given")
    quality = judged_with(adjust={"held_by": whole, "reprojection_error_px": 0.9})
    assert "calibration: adjust.calibration=given holds all parameters" in quality.unchecked
    assert found(quality, "reprojection error").sentence.endswith(
        "; adjust.calibration=given holds all parameters of cameras as stated, which may be wrong"
    )
    assert "adjust." not in found(judged_with(adjust={"reprojection_error_px": 0.9}), "reprojection error").sentence
    partly = judged_with(adjust={"held_by": {"f": "adjust.hold"}})
    finding = found(partly, "calibration")
    assert finding.sentence.startswith("calibration of camera camera_1: cx 2005.0 where 1999.5 +- 80.0 is known")
    assert finding.sentence.endswith("(adjust.hold holds f)")


@pytest.mark.parametrize(("stays", "remedy"), [(True, "let the pictures find them (orient=global), and "), (False, "")])
def test_what_is_in_use_is_no_remedy(stays: bool, remedy: str) -> None:
    quality = judged_with(adjust={"reprojection_error_px": 2.32}, orient={"stays": stays})
    sentence = found(quality, "reprojection error").sentence
    assert f": poses or cameras do not fit the matches: {remedy}check --cameras and --poses" in sentence


def test_a_shift_that_is_not_significant_is_none() -> None:
    quality = judged_with(group=flight(shift_x=[1.0, 0.5], shift_y=[0.0, 0.5], shift_z=[0.0, 0.5]))
    assert quality.verdict == "good"


def test_flights_that_scatter_as_much_as_they_lie_apart_are_not_apart() -> None:
    assert not [one for one in judged_with(group=apart(14.9, 8.0)).findings if one.what == "flights apart"]


def test_a_block_that_nothing_ties_to_the_ground_has_a_shape_only() -> None:
    quality = judged_with(group={"kind": "level", "positions": None}, adjust={"positions_given": 0, "residuals": None})
    assert quality.verdict == "doubtful"
    assert quality.faults[0].sentence.startswith("shape only")
    assert "angles: none are given" in quality.unchecked
    assert quality.unchecked.count("positions: none are given") == 1


@pytest.mark.parametrize(("inside", "verdict"), [(None, "doubtful"), (INSIDE | {"held_out_rms_m": [0.02] * 3}, "good")])
def test_control_points_hold_a_block_only_where_they_took_part(inside: dict[str, Any] | None, verdict: str) -> None:
    group = {"kind": "level", "positions": None, "control": inside}
    quality = judged_with(group=group, adjust={"positions_given": 0, "residuals": None, "control": CONTROL})
    assert quality.verdict == verdict
    assert [one.what for one in quality.faults] == ["ground"] * (verdict == "doubtful")
    assert quality.unchecked.count("positions: none are given") == 1


@pytest.mark.parametrize(("without_m", "level"), [(0.03, "good"), (0.5, "doubtful")])
def test_control_points_that_were_left_out_are_good_where_they_agree(without_m: float, level: str) -> None:
    inside = INSIDE | {
        "used": [], "kept": False, "held_out_rms_m": [0.02, 0.02, 0.04], "without_rms_m": [0.02, 0.02, without_m]
    }  # fmt: skip
    quality = judged_with(group={"control": inside}, adjust={"control": CONTROL})
    assert found(quality, "control points").level == quality.verdict == level
    agreed = "control points agree with the block to x 0.020, y 0.020, z 0.030 m and were not needed"
    assert (found(quality, "control points").sentence == agreed) is (level == "good")


def test_flights_are_named_once_and_large_numbers_have_no_powers_of_ten() -> None:
    flights = {"flights": [{"flight": "flight 2", "images": 6, "step_m": 14.93}]}
    assert judged_with(group=flights).faults[0].sentence.startswith("heights of flight 2 (6 images) lie 14.9 m")
    sentence = found(judged_with(group=heights(bowl=112.0)), "bowl").sentence
    assert "(112 m)" in sentence
    beyond = found(judged_with(group=heights(bowl=5e4)), "bowl").sentence
    assert "may lie many times farther than the block extends above or below" in beyond
    assert [plain(value) for value in (112.3, 9.99, 2.86, 0.034)] == ["112", "10", "2.9", "0.034"]


def test_positions_of_which_none_is_used_are_bad() -> None:
    quality = judged_with(group={"kind": "level", "positions": None})
    assert (quality.verdict, quality.faults[0].what) == ("bad", "positions")
    assert "none of the 12 given positions" in quality.faults[0].sentence


def test_lengths_of_a_frame_without_metres_are_no_metres() -> None:
    known = heights(bowl=0.3)["heights"]
    for metric in (True, False):
        group = {"kind": "level", "positions": None, "heights": known | {"metric": metric}}
        bowl = found(judged_with(group=group, adjust={"positions_given": 0, "ground_pixel_m": None}), "bowl")
        assert bowl.value == pytest.approx(10.0)
        assert ("0.3 m" in bowl.sentence) is metric


def test_what_json_gets_is_plain() -> None:
    facts = judged_with(group=heights(bowl=0.3)).as_facts()
    assert facts["verdict"] == "doubtful"
    assert facts["findings"][0] == {
        "what": "bowl", "value": 10.0, "limit": 5.0, "level": "doubtful",
        "sentence": "the middle of the block may lie 10.0 ground pixels (0.3 m) above or below its border: straight "
        "views from one height do not determine it; two strips across, images from another height, or three control "
        "points determine it",
    }  # fmt: skip


@pytest.mark.parametrize(("share", "verdict"), [(0.16, "good"), (0.3, "doubtful"), (0.7, "bad")])
def test_matches_that_the_block_contradicts_count(share: float, verdict: str) -> None:
    quality = judged_with(contradicted=share)
    assert quality.verdict == verdict
    assert found(quality, "contradicted matches").value == share


def test_images_of_which_most_matches_contradict_the_block_are_named() -> None:
    quality = judged_with(contradicted=0.0, contradicting=["a", "b"])
    assert quality.verdict == "doubtful"
    assert "of 2 of 12 images contradict the adjusted block (a, b)" in quality.faults[0].sentence


@pytest.mark.parametrize(("parts", "verdict"), [([12], "good"), ([10, 2], "good"), ([6, 6], "doubtful")])
def test_parts_that_single_points_tie_are_doubtful(parts: list[int], verdict: str) -> None:
    assert judged_with(adjust={"tied_parts": parts}).verdict == verdict


def test_flights_of_a_camera_with_calibrations_of_their_own_are_named() -> None:
    flights = [{"flight": "B", "images": 6, "change": {"f": 12.04, "cx": -3.0}, "worth": 4.0}]
    calibration = {"calibration": {"1": {**CALIBRATED, "flights": flights}}}
    [fault] = judged_with(group=calibration).faults
    assert fault.level == "doubtful"
    assert "has another calibration in flight B (6 images)" in fault.sentence
    assert "f by +12.0 px, cx by -3.0 px, cy by +0.0 px" in fault.sentence


def test_parts_of_equal_size_are_told_apart_by_an_image() -> None:
    first = deepcopy(GROUP) | {"images": 6, "first_image": "a"}
    second = first | heights(bowl=0.453, tilt=5.0, sigma=0.9) | {"first_image": "b"}
    quality = judged_with(adjust={"groups": [first, second]}, names={"a": "DJI_1.JPG", "b": "IMG_7.JPG"})
    part = "the part of 6 images with IMG_7.JPG"
    assert f"the middle of {part} may lie 15.1 ground pixels (0.45 m)" in found(quality, "bowl").sentence
    assert found(quality, "tilt").sentence.startswith(f"{part} may be tilted by 2.86 degrees")
    assert f"heights of {part} are exact to 30.0 ground pixels" in found(quality, "heights").sentence
    # Of a result by an earlier version no image is known.
    quality = judged_with(adjust={"groups": [first, second | {"first_image": ""}]})
    assert "the middle of the part of 6 images may lie" in found(quality, "bowl").sentence


def test_measured_angles_are_no_remedy_where_there_are_some() -> None:
    tilted = heights(tilt=5.0)
    assert "measured angles" not in found(judged_with(group=tilted), "tilt").sentence
    assert "measured angles" in found(judged_with(group=tilted, adjust={"residuals": None}), "tilt").sentence


def test_errors_of_positions_are_of_x_and_y_together_as_in_the_table_and_say_what_they_leave_out() -> None:
    # x 0.117, y 0.447, z 0.165 m: XY 0.462 m.
    off = positions(rms_m=[0.117, 0.447, 0.165], rms_sigmas=[0.0234, 0.0894, 0.033], stated_m=[5.0, 5.0, 5.0])
    quality = judged_with(group=off)
    across, up = (found(quality, f"positions {name}") for name in ("horizontally", "vertically"))
    assert across.value == pytest.approx(0.0654, abs=1e-4)  # root mean square of both axes, as before
    assert across.sentence == (
        "positions are met horizontally to 0.462 m (root mean square in XY, without drifts, shifts and delays of "
        "flights and antenna offsets), 0.1 times what is stated, 5 m along each axis"
    )
    assert up.sentence == (
        "positions are met vertically to 0.165 m (root mean square in Z, without drifts, shifts and delays of "
        "flights and antenna offsets), 0.0 times what is stated, 5 m"
    )


@pytest.mark.parametrize(
    ("contradicting", "share"),
    [(5, 0.05), (None, 0.3)],
    ids=["unlikely matches speak against no block", "of a result that does not tell them apart all count"],
)
def test_only_what_contradicts_the_block_speaks_against_it(contradicting: int | None, share: float) -> None:
    found = ConsistencyResult(verified_matches=70, dropped_matches=30, contradicting_matches=contradicting)
    assert _contradicted(found) == pytest.approx(share)
