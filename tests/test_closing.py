"""What a run says at its end."""

from __future__ import annotations

from typing import Any

import pytest

from aeromatch_cli.stages.closing import closing_lines
from aeromatch_cli.stages.stage_report import StageReport

NAMES = {i: f"{i}.jpg" for i in "abcd"}


def reports(**changes: Any) -> list[StageReport]:
    filtered = {"components": [4], "weakly_tied": [], **changes.get("filter", {})}
    adjusted = {"outside": {}, "groups": [{"kind": "positions"}], "images": 4, **changes.get("adjust", {})}
    spread = {i: [9, 0, 100] for i in "abcd"} | changes.get("spread", {})
    return [
        StageReport("filter", facts=filtered),
        StageReport("adjust", facts=adjusted),
        StageReport("consistency", facts={"spread": spread, **changes.get("consistency", {})}),
    ]


def test_a_sound_block_is_called_so() -> None:
    assert closing_lines(reports(), NAMES) == ["result    sound: all 4 images are connected and oriented"]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"filter": {"components": [3, 1]}},
            ["not sound: 2 groups of images (3, 1) that no verified pair connects", "--set pairs=exhaustive"],
        ),
        (
            {"adjust": {"outside": {"b": "few matches"}}},
            ["not sound: not oriented: b.jpg", "aeromatch show WORK b.jpg"],
        ),
        (
            {"adjust": {"groups": [{"kind": "positions"}, {"kind": "positions"}, {"kind": "level"}]}},
            ["2 parts whose scale and place nothing ties", "--poses"],
        ),
        ({"adjust": {"groups": [{"kind": "level"}] * 3}}, ["3 parts whose scale and place nothing ties", "--poses"]),
        ({"adjust": {"groups": [{"kind": "positions"}] * 2}}, ["sound: all 4 images are connected and oriented"]),
        ({"adjust": {"images": 0}}, ["sound: all 4 images are connected; not oriented, as orient=none asks"]),
        (
            {"adjust": {"images": 0, "remarks": ["not done: no image is oriented"]}},
            ["not sound: no image is oriented", "known positions and attitudes (--poses)"],
        ),
        (
            {"consistency": {"components": [3, 1], "weakly_tied": ["d"]}},  # of the final matches
            ["not sound: 2 groups of images (3, 1)", "weak: d.jpg, with fewer than 50 verified matches"],
        ),
        ({"filter": {"weakly_tied": ["c"]}}, ["sound: all 4", "weak: c.jpg, with fewer than 50 verified matches"]),
        ({"spread": {"d": [9, 0, 3]}}, ["sound", "weak: d.jpg, with fewer than 20 points that three images see"]),
        ({"spread": {"a": [7, 2, 99]}}, ["sound", "parts without a point though other images show them: a.jpg"]),
    ],
)
def test_what_is_wrong_or_weak_is_named_with_what_to_do(changes: dict[str, Any], expected: list[str]) -> None:
    lines = closing_lines(reports(**changes), NAMES)
    assert lines[0].startswith("result    ")
    assert all(any(words in line for line in lines) for words in expected), lines


def test_a_part_of_a_run_says_nothing() -> None:
    assert closing_lines(reports()[:1], NAMES) == []
