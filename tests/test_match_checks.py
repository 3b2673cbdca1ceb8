"""What a matcher returns is looked at before it is stored: no later stage meets indices that lead nowhere."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest
from conftest import UNORIENTED, Site

from aeromatch_cli.data import Matches
from aeromatch_cli.formats.tables import read_csv
from aeromatch_cli.stages import match

SETTINGS = UNORIENTED


def scores_are_missing(matches: Matches) -> Matches:
    return replace(matches, scores=matches.scores[:-1])


def views_are_missing(matches: Matches) -> Matches:
    return replace(matches, view_pairs=matches.view_pairs[:-2])


def keypoints_are_not_there(matches: Matches) -> Matches:
    indices = matches.indices.copy()
    indices[0, 1] = 10**6
    return replace(matches, indices=indices)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (scores_are_missing, "match=nearest returned 1 matches, but 0 scores and 1 pairs of views"),
        (views_are_missing, "match=nearest returned 1 matches, but 1 scores and 0 pairs of views"),
        (keypoints_are_not_there, r"match=nearest returned keypoints that are not there \(of \d+ and \d+\)"),
    ],
)
def test_matches_that_no_stage_could_use_are_a_failure_of_the_pair(
    site: Site, monkeypatch: pytest.MonkeyPatch, spoil: Any, words: str
) -> None:
    """Of the first pair alone; the others are matched."""
    plain = match.compared

    def spoilt(*arguments: Any) -> Matches:
        found = plain(*arguments)
        if arguments[2].pair.ids != ("suburb_0001_jpg", "suburb_0002_jpg"):
            return found
        one = Matches(found.indices[:1], found.scores[:1], found.view_pairs[:1])
        return spoil(one)

    monkeypatch.setattr(match, "compared", spoilt)
    monkeypatch.setattr(match, "matched_in_batches", lambda *_: {})
    outcome = site("run", "--executor", "serial")
    assert outcome.code == 1
    ((stage, item, reason),) = (row.values() for row in read_csv(site.work / "failures.csv"))
    assert (stage, item) == ("match", "suburb_0001.jpg and suburb_0002.jpg")
    assert re.fullmatch(rf"{words}: the matcher has a fault", reason)
    monkeypatch.undo()
    assert site("run", "--executor", "serial").code == 0
