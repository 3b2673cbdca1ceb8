"""Two workspaces side by side: which is better, and which have nothing to be compared by."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from conftest import invoke
from make_results import filled

from aeromatch_cli.data import Image
from aeromatch_cli.report import compare as compared
from aeromatch_cli.report.compare import Judged, Standing, as_facts, criteria, verdict_lines
from aeromatch_cli.results.stages import BlockResults

SOUND = Standing("good", 12, 12, 0.05, frozenset({"c1", "c2"}), 3, 50_000, Judged("A", 800, 0.04))


@pytest.mark.parametrize(
    ("changes", "better", "words"),
    [
        ({}, "neither", "they differ in nothing that counts"),
        ({"matches": 48_000, "empty": 3, "check_m": 0.053}, "neither", "nothing that counts"),
        ({"matches": 40_000}, "first", "verified matches, 50,000 in the first and 40,000 in the second"),
        ({"check_m": 0.02, "matches": 40_000}, "second", "points, 0.050 m in the first and 0.020 m in the second"),
        # Other check points tell nothing of which is better.
        ({"check_m": 0.02, "checks": frozenset({"c1"})}, "neither", ""),
        ({"check_m": None, "checks": frozenset()}, "neither", ""),
        ({"empty": 9}, "first", "parts of images without points, 3 in the first and 9 in the second"),
        ({"oriented": 10, "check_m": 0.01, "matches": 90_000}, "first", "images oriented, 12 in the first and 10"),
        # A block in a frame of its own: no scale, north or place.
        ({"georeferenced": 0, "matches": 90_000}, "first", "scale, north and place, 12 in the first and 0 in"),
        ({"verdict": "doubtful", "oriented": 12, "check_m": 0.01}, "first", "result, good in the first and doubtful"),
        ({"verdict": None, "oriented": None, "georeferenced": None, "matches": 60_000}, "second", "verified matches"),
        # Truth outranks the verdict, but that of another block says nothing.
        ({"verdict": "bad", "judged": Judged("A", 900, 0.02)}, "second", "`aeromatch evaluate`, 800 in the first and"),
        ({"verdict": "bad", "judged": Judged("A", 801, 0.02)}, "second", "evaluate`, 4.0 % in the first and 2.0 % in"),
        ({"verdict": "bad", "judged": Judged("B", 900, 0.02)}, "first", "result, good in the first and bad in"),
    ],
)  # fmt: skip
def test_the_gravest_difference_decides(changes: dict[str, object], better: str, words: str) -> None:
    found = criteria(SOUND, dataclasses.replace(SOUND, **changes))  # type: ignore[arg-type]
    assert as_facts(found)["better"] == better
    first = verdict_lines(found)[0]
    assert first.startswith(f"better      {better if better == 'neither' else f'the {better}'}: ")
    assert words in first


def test_what_speaks_the_other_way_is_said() -> None:
    found = criteria(SOUND, dataclasses.replace(SOUND, oriented=10, check_m=0.01, empty=9))
    assert verdict_lines(found) == [
        "better      the first: images oriented, 12 in the first and 10 in the second",
        "            and the first in: parts of images without points, 3 in the first and 9 in the second",
        "            but the second in: error at check points, 0.050 m in the first and 0.010 m in the second",
    ]


def side(
    *names: str, width_px: int = 1000, time: str = "", matches: int = 100, frame: str = "world", **found: Any
) -> compared._Side:
    images = {name: Image(name.replace(".", "_"), name, width_px, 750, "1", time=time) for name in names}
    matched = {(names[0], names[1]): matches}
    return compared._Side({}, images, matched, {}, filled(BlockResults, found), dict.fromkeys(names, frame), "good")


def outcome_of(monkeypatch: pytest.MonkeyPatch, first: compared._Side, second: compared._Side):
    sides = {Path("A"): first, Path("B"): second}
    monkeypatch.setattr(compared, "_side", sides.__getitem__)
    return invoke("compare", "A", "B", "--json")


def test_blocks_of_other_images_are_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    outcome = outcome_of(monkeypatch, side("a.jpg", "b.jpg", "c.jpg"), side("a.jpg", "x.jpg", "y.jpg"))
    assert outcome.code == 2
    assert "A and B are workspaces of different images, 1 have one name in both" in outcome.stderr
    assert "2 only in A: b.jpg, c.jpg; 2 only in B: x.jpg, y.jpg" in outcome.stderr


@pytest.mark.parametrize("other", [{"width_px": 640}, {"time": "2024-05-02T10:00:00"}])
def test_other_pictures_of_the_same_names_are_refused(monkeypatch: pytest.MonkeyPatch, other: dict[str, int]) -> None:
    """DJI_0001.JPG is in every folder."""
    first = side("a.jpg", "b.jpg", time="2024-05-01T10:00:00")
    outcome = outcome_of(monkeypatch, first, side("a.jpg", "b.jpg", **{"time": "2024-05-01T10:00:00", **other}))
    assert outcome.code == 2
    assert "those named a.jpg, b.jpg have another size or time of capture" in outcome.stderr


def test_of_blocks_that_share_most_images_these_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = side("a.jpg", "b.jpg", "c.jpg"), side("a.jpg", "b.jpg", matches=200)
    outcome = outcome_of(monkeypatch, first, second)
    assert outcome.code == 0, outcome.stderr
    assert outcome.facts["better"] == "second"
    assert "only in the first: c.jpg" in outcome.stdout
    assert "settings    the same" in outcome.stdout
    oriented = next(one for one in outcome.facts["criteria"] if one["what"] == "images oriented")
    assert (oriented["first"], oriented["second"], oriented["better"]) == ("2", "2", "neither")


def test_a_block_in_a_frame_of_its_own_is_worse_than_one_in_the_world(monkeypatch: pytest.MonkeyPatch) -> None:
    names = "a.jpg", "b.jpg", "c.jpg"
    outcome = outcome_of(monkeypatch, side(*names, frame="own 1"), side(*names))
    words = "better      the second: images with scale, north and place, 0 in the first and 3 in the second"
    assert words in outcome.stdout.splitlines()
    assert outcome.facts["better"] == "second"


def test_what_is_compared_is_the_block_as_it_is_exported_and_what_was_left_out_is_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    adjusted = {"images": 3, "points": 800, "track_length": 3.0, "reprojection_error_px": 0.54}
    final = {"points_left": 700, "observations_left": 2030, "reprojection_error_px": 0.43}
    names = "a.jpg", "b.jpg", "c.jpg"
    first = side(*names, adjust=adjusted, consistency=final, pairs={"left_out": ["the step learned"]})
    outcome = outcome_of(monkeypatch, first, side(*names, adjust=adjusted))  # that of an earlier version
    lines = outcome.stdout.splitlines()
    assert "left out    in the first, to end in time (run --within): the step learned" in lines
    assert "points      700 and 800 (+14.3 %)" in lines
    assert "error px    0.43 and 0.54 (+25.6 %)" in lines
