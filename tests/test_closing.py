"""What a run says at its end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from make_results import filled

from aeromatch_cli.results.stages import BlockResults
from aeromatch_cli.stages.quality import quality_of
from aeromatch_cli.stages.result_summary import closing_lines

NAMES = {i: f"{i}.jpg" for i in "abcd"}
MANY = {str(i): f"{i}.jpg" for i in range(12)}
# Of a group whose four positions are met as stated.
PLACED = {"kind": "positions", "images": 4, "positions": {
    "images": 4, "used": 4, "wrong": [], "rms_m": [0.02, 0.02, 0.03], "rms_sigmas": [1.0, 1.0, 1.0],
    "stated_m": [0.02, 0.02, 0.03], "factors": [1.0, 1.0],
}}  # fmt: skip
LEVEL = {"kind": "level"}


def lines_of(names: Mapping[str, str] = NAMES, **changes: Any) -> list[str]:
    adjusted = {
        "outside": {}, "groups": [PLACED], "images": 4, "positions_given": 4, "track_length": 3.9, "held_by_pairs": 0,
        "reprojection_error_px": 0.2, "ground_pixel_m": 0.05,
    }  # fmt: skip
    found = {
        "filter": {"components": [4], "weakly_tied": [], **changes.get("filter", {})},
        "refine": {"keypoints": 100, "measured": 90},
        "adjust": adjusted | changes.get("adjust", {}),
        "consistency": {"spread": {i: [9, 0, 100] for i in "abcd"} | changes.get("spread", {})}
        | changes.get("consistency", {}),
    }
    results = filled(BlockResults, found | {k: changes[k] for k in ("orient", "pairs") if k in changes})
    quality = quality_of(results, names)
    assert quality is not None
    return closing_lines(quality, results, names)


def test_a_block_against_which_nothing_speaks_is_good() -> None:
    assert lines_of() == [
        "result    good: all 4 images are connected and oriented",
        "          not checked: angles: none are given; control points: none are given; calibration: it was not "
        "adjusted; expected deformation: the block was not adjusted, or has too few points",
    ]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"filter": {"components": [3, 1]}},
            ["bad: 2 groups of images (3, 1) that no verified pair connects: more overlap between them helps"],
        ),
        (
            {"adjust": {"outside": {"b": "few matches"}, "images": 3}},
            ["bad: 3 of 4 images are oriented: not oriented: b.jpg", "aeromatch show WORK b.jpg"],
        ),
        (
            {"adjust": {"groups": [PLACED, PLACED, LEVEL]}},
            ["bad: 2 parts whose scale and place nothing ties", "--poses"],
        ),
        ({"adjust": {"groups": [LEVEL] * 3, "positions_given": 0}}, ["bad: 3 parts whose scale", "--poses"]),
        ({"adjust": {"groups": [LEVEL], "positions_given": 0}}, ["doubtful: shape only: nothing ties the block"]),
        (
            {"adjust": {"groups": [LEVEL], "positions_given": 2}},
            [
                "doubtful: shape only: nothing ties",
                "the 2 given positions are not enough, those (--poses) of three images",
            ],
        ),
        (
            {"adjust": {"groups": [LEVEL]}, "orient": {"models": [{"contradiction": ""}]}},
            ["bad: none of the 4 given positions is used: too few are of images that are oriented together"],
        ),
        (
            {"adjust": {"groups": [LEVEL]}, "orient": {"models": [{"contradiction": "scattered"}]}},
            ["bad: none of the 4 given positions is used, the pictures contradict them: check the coordinate system"],
        ),
        (
            {
                "adjust": {"groups": [LEVEL]},
                "orient": {
                    "models": [{"contradiction": "scattered"}],
                    "images_matched": 4,
                    "by_ground": ["a", "b", "c"],
                },
            },
            ["bad: none of the 4 given positions", "though 3 of 4 images are oriented by a single pair each"],
        ),
        (
            {"filter": {"components": [2, 2]}, "adjust": {"groups": [PLACED, {"kind": "level", "images": 2}]}},
            ["bad: 2 groups", "1 part (2 images) has a frame of its own", "export=colmap writes a model of it"],
        ),
        (
            {
                "filter": {"components": [2, 1, 1]},
                "adjust": {"groups": [{"kind": "level", "images": n} for n in (9, 3, 2)], "positions_given": 0},
            },
            [
                "bad: 3 groups",
                "2 parts (images: 3, 2) have frames of their own",
                "export=colmap writes a model of each",
            ],
        ),
        ({"adjust": {"groups": [PLACED] * 2}}, ["doubtful: 2 parts (images: 4, 4) share too few points"]),
        ({"adjust": {"images": 0}}, ["good: all 4 images are connected", "not checked: orientation: orient=none"]),
        (
            {"adjust": {"images": 0, "remarks": ["not done: no image is oriented"]}},
            ["bad: no image is oriented", "known positions and attitudes (--poses)"],
        ),
        (
            {"adjust": {"images": 0, "remarks": ["not done: killed"], "stopped": "killed"}},
            ["bad: no image is adjusted: killed; the same command tries again"],
        ),
        (
            {"adjust": {"images": 0, "remarks": ["not done"]}, "orient": {"stopped": "the mapper was ended"}},
            ["bad: no image is adjusted: the mapper was ended"],
        ),
        (
            {"consistency": {"components": [3, 1], "weakly_tied": ["d"]}},  # of the final matches
            [
                "bad: 2 groups of images (3, 1) that no verified pair connects, one before the stage consistency "
                "dropped matches: more overlap",
                "weak: d.jpg, with fewer than 50 verified matches",
            ],
        ),
        (
            {"filter": {"components": [3, 1]}, "consistency": {"components": [2, 1, 1]}},
            ["bad: 3 groups of images (2, 1, 1) that no verified pair connects, 2 before the stage consistency"],
        ),
        (
            {"filter": {"components": [3, 1]}, "consistency": {"components": [3, 1]}},
            ["bad: 2 groups of images (3, 1) that no verified pair connects: more overlap between them helps"],
        ),
        ({"filter": {"weakly_tied": ["c"]}}, ["good: all 4", "weak: c.jpg, with fewer than 50 verified matches"]),
        ({"spread": {"d": [9, 0, 3]}}, ["good", "weak: d.jpg, with fewer than 20 points that three images see"]),
        (
            {"spread": {"a": [7, 2, 99]}},
            [
                "good",
                "1 of 4 images (a.jpg) has no point in one or more of the 3 x 3 parts of the picture whose ground "
                "other images show: less evenly tied, which does not change the verdict",
            ],
        ),
    ],
)
def test_what_is_wrong_or_weak_is_named_with_what_to_do(changes: dict[str, Any], expected: list[str]) -> None:
    lines = lines_of(**changes)
    assert lines[0].startswith(f"result    {expected[0].partition(':')[0]}")
    assert all(any(words in line for line in lines) for words in expected), lines


@pytest.mark.parametrize(
    ("positions", "reason", "names", "said"),
    [
        (12, "overlap", MANY, True),
        (12, "position", MANY, True),
        (0, "overlap", MANY, False),  # found poses, of a first pass that compares all or those that look alike
        (12, "exhaustive", MANY, False),
        (4, "overlap", NAMES, False),  # the first pass has compared all pairs
    ],
)
def test_all_pairs_are_advised_where_positions_may_hide_some(
    positions: int, reason: str, names: dict[str, str], said: bool
) -> None:
    block = {"positioned": len(names), "pairs_by_reason": {reason: 9}}
    lines = lines_of(
        names, filter={"components": [3, 1]}, orient={"positions_given": positions}, pairs={"block": block}
    )
    (line,) = [line for line in lines if "groups of images (3, 1)" in line]
    assert ("--set pairs=exhaustive finds pairs that positions hide" in line) == said


def test_an_image_that_could_not_be_read_is_a_fault_of_its_own() -> None:
    lost = {"outside": {"d": "no features: cannot decode image d.jpg"}, "images": 3}
    lines = lines_of(filter={"components": [3], "unread": ["d"]}, adjust=lost, spread={})
    said = "1 of 4 images is not in the block, since the pictures could not be read: replace or remove d.jpg"
    assert lines[0] == f"result    bad: {said}; failures.csv says why"
    assert not any(words in line for line in lines for words in ("weak", "overlap", "groups", "oriented:"))


def test_images_that_could_not_be_read_are_in_no_count_of_oriented_ones() -> None:
    lost = {"outside": {"c": "no pairs", "d": "no features: cannot decode image d.jpg"}, "images": 2}
    lines = lines_of(filter={"components": [2, 1], "unread": ["d"]}, adjust=lost, spread={})
    assert any("2 of 3 images that could be read are oriented: not oriented: c.jpg" in line for line in lines)


def test_a_part_of_a_run_has_no_verdict() -> None:
    assert quality_of(filled(BlockResults, filter={"components": [4]}), NAMES) is None
