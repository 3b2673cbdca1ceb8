"""Counts and the words that follow them: one is no plural."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from make_results import filled

from aeromatch_cli.data import Pair
from aeromatch_cli.report.rows import _details
from aeromatch_cli.report.show import _Partner
from aeromatch_cli.results.stages import AdjustResult, ConsistencyResult, FilterResult, MatchResult, OrientResult
from aeromatch_cli.stages import messages, unregistered
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.strategies.filters.gate import shortage
from aeromatch_cli.words import MANY, form, listed, of_images


def test_forms() -> None:
    assert [form(count, "pair") for count in (0, 1, 2)] == ["pairs", "pair", "pairs"]
    assert [form(count, "is", "are") for count in (0, 1, 2)] == ["are", "is", "are"]


def test_lists_name_the_first_and_count_the_rest() -> None:
    assert listed([]) == ""
    assert listed("abcde") == "a, b, c, d, e"
    assert listed(str(number) for number in range(1_006)) == "0, 1, 2, 3, 4 and 1,001 more"
    assert listed(range(11), MANY) == "0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 1 more"
    assert listed(["a and b", "c and d", "e and f"], 2, "; ") == "a and b; c and d; and 1 more"


def test_images_are_counted_and_named_before_the_verb() -> None:
    assert of_images("a", range(1_200)) == "1 of 1,200 images (a)"
    assert of_images("a", "abc", "is", "are") == "1 of 3 images (a) is"
    assert of_images((name for name in "ab"), "abc", "is", "are") == "2 of 3 images (a, b) are"


def _reasons(monkeypatch: pytest.MonkeyPatch, pairs: Mapping[tuple[str, str], bool], oriented: str) -> dict[str, str]:
    """pairs: whether each is verified. oriented: ids of a letter each."""
    names = sorted({image_id for pair in pairs for image_id in pair})
    listed = [Pair(*ids, np.nan, np.nan, "position") for ids in pairs]
    judged = [
        (pair, SimpleNamespace(verdict=SimpleNamespace(state="verified" if pairs[pair.ids] else "rejected")))
        for pair in listed
    ]
    workspace = SimpleNamespace(features=lambda _: Path(__file__))
    images = [SimpleNamespace(image_id=name) for name in names]
    context: Any = SimpleNamespace(block=SimpleNamespace(images=images), pairs=listed, workspace=workspace)
    monkeypatch.setattr(unregistered.BlockState, "of", lambda _: SimpleNamespace(judged_pairs=lambda: judged))
    monkeypatch.setattr(unregistered, "read_keypoints", lambda _: (np.zeros((100, 2)),))
    monkeypatch.setattr(unregistered, "gather_failures", lambda _: [])
    adjusted: Any = SimpleNamespace(poses=dict.fromkeys(oriented))
    return unregistered.unregistered_reasons(context, adjusted)


def test_an_image_with_one_pair_has_no_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = {("a", "b"): True, ("c", "d"): True, ("d", "e"): True, ("e", "f"): False}
    assert _reasons(monkeypatch, pairs, "ab") == {
        "c": "its only verified pair is with an image that is not oriented either",
        "d": "its 2 verified pairs are with images that are not oriented either",
        "e": "its only verified pair is with an image that is not oriented either",
        "f": "its only pair could not be verified",
    }
    found = _reasons(monkeypatch, {("a", "b"): True, ("b", "c"): True}, "b")
    assert found["a"] == "too few points in common with oriented images (1 verified pair)"
    found = _reasons(monkeypatch, {("a", "b"): True, ("a", "c"): False, ("c", "d"): False}, "")
    assert found["a"] == "no image could be oriented (1 verified pair of this one)"
    assert found["c"] == "none of its 2 pairs could be verified"


def test_lines_of_one_match() -> None:
    (line, *_) = messages._filter_lines(filled(FilterResult, verified_matches=1), {}, part=True)
    assert line.endswith("; 1 verified match")
    dropped = ConsistencyResult(verified_matches=1, dropped_matches=1, points=3)
    (line, *_) = messages._consistency_lines(dropped, {})
    assert line == "dropped 1 match that contradicts the adjusted block; 1 verified match is left"
    left = "20 verified matches are left, of which 98.0 % are expected to be right to 3 px"
    for contradicting, words in (
        (0, "dropped 2 matches that are not likely to be right"),
        (1, "dropped 2 matches: 1 contradicts the adjusted block, 1 is not likely to be right"),
        (2, "dropped 2 matches that contradict the adjusted block"),
    ):
        dropped = ConsistencyResult(
            verified_matches=20, dropped_matches=2, contradicting_matches=contradicting, expected_right=0.98
        )
        (line, *_) = messages._consistency_lines(dropped, {})
        assert line == f"{words}; {left}"


def test_a_stage_of_one_item_and_a_pair_of_one_match() -> None:
    (line,) = messages.stage_lines(StageReport("export", items=1, done=1, seconds=0.5), {}, part=False)
    assert line == "export            1 item, 1 done, 0 up to date, 0 failed, 0.5 s"
    assert shortage(1, 1, 15) == "1 inlier of 1 match, 15 needed"
    assert shortage(3, 40, 15) == "3 inliers of 40 matches, 15 needed"
    assert _Partner("a.jpg", 1, "verified", 0.5).words == "a.jpg: 1 match, verified, overlap 50 %"


def test_a_guessed_focal_length_is_named_where_many_positions_are_wrong() -> None:
    pose = SimpleNamespace(world_rotation=None)
    block: Any = SimpleNamespace(
        images=[SimpleNamespace(image_id=name, name=f"{name}.jpg") for name in "abc"],
        poses=dict.fromkeys("abc", pose),
        names={name: f"{name}.jpg" for name in "abc"},
        crs="local",
    )
    found = filled(OrientResult, poses_from="pictures", frame="world", wrong_positions={"a": 40.0, "b": 30.0})
    lines = [line.strip() for line in messages.orientation_lines(found, block, block, {"camera_1"})]
    assert lines[-2:] == [
        "wrong positions given; those that the pictures give are used: a.jpg (40 m), b.jpg (30 m)",
        "the likely cause is the focal length of camera camera_1, which is a guess, since EXIF says too little: give "
        "--cameras FILE",
    ]
    assert "focal length" not in messages.orientation_lines(found, block, block)[-1]


def test_pairs_that_have_enough_matches_after_a_step() -> None:
    found = MatchResult(settled_by={"first": 1, "learned": 0}, not_settled=0)
    assert messages.settled_words(found) == "1 of 1 pair has enough matches after step first, 0 more after learned"
    found = MatchResult(settled_by={"first": 4, "learned": 2}, not_settled=1)
    lacking = "1 has fewer matches, or less of the overlap covered, than the last step asks for"
    enough = "4 of 7 pairs have enough matches after step first, 2 more after learned"
    assert messages.settled_words(found) == f"{enough}; {lacking}"
    assert messages.settled_words(MatchResult()) == ""


def test_stages_of_the_page_count_one_thing() -> None:
    assert list(_details(AdjustResult(images=1, points=2)))[:2] == ["1 image oriented", "2 points"]
    found = ConsistencyResult(verified_matches=1, dropped_matches=1, rejected_pairs=1, points_left=1)
    words = ["1 verified match left", "1 dropped", "1 pair dropped as a whole", "1 point left"]
    assert list(_details(found)) == words
    words = ["2 verified matches left", "2 dropped", "2 pairs dropped as a whole", "2 points left"]
    found = ConsistencyResult(verified_matches=2, dropped_matches=2, rejected_pairs=2, points_left=2)
    assert list(_details(found)) == words
