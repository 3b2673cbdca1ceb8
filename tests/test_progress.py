"""What is shown of how far a command is."""

from __future__ import annotations

import json

import pytest

from aeromatch_cli import graph
from aeromatch_cli.cli.progress import JsonProgress, LineProgress, ProgressKind, progress_shown
from aeromatch_cli.executor import SilentProgress


def test_plain_progress_says_percent_and_time_left(capsys):
    progress = LineProgress()
    progress.start("match", 40)
    for _ in range(40):
        progress.advance()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 10
    assert lines[0].startswith("match: 10 % (4/40), ")
    assert lines[-1] == "match: 100 % (40/40), 0 s left"


def test_progress_says_which_stage_of_how_many(capsys):
    progress = LineProgress(graph.RUN)
    for label, total, counts in (
        ("first pass: match", 1, [1]), ("step first: match", 10, [7, 3]), ("step guided: extract", 1, [1]),
        ("read", 1, [1]),
    ):  # fmt: skip
        progress.start(label, total)
        for count in counts:
            progress.advance(count)
    lines = capsys.readouterr().err.splitlines()
    assert [line.rpartition(",")[0] for line in lines] == [
        "1/10 first pass: match: 100 % (1/1)",
        "4/10 step first: match: 70 % (7/10)",
        "4/10 step first: match: 100 % (10/10)",
        "4/10 step guided: extract: 100 % (1/1)",  # it does not go back to the third
        "read: 100 % (1/1)",
    ]


def told(monkeypatch, parts):
    """Seconds to the end as they are told and as they are, after every tenth of every part. parts: labels, items and
    seconds, in order."""
    now = [0.0]
    monkeypatch.setattr("aeromatch_cli.cli.progress.time.monotonic", lambda: now[0])
    monkeypatch.setattr("aeromatch_cli.cli.progress._JSON_EVERY_S", 0.0)
    lines: list[str] = []
    monkeypatch.setattr("aeromatch_cli.cli.progress.printed", lambda line, err: lines.append(line))
    progress = JsonProgress(graph.RUN)
    whole_s = sum(seconds for _, seconds in parts)
    pairs = []
    for label, seconds in parts:
        progress.start(label, 10)
        for _ in range(10):
            now[0] += seconds / 10
            progress.advance()
            pairs.append((json.loads(lines[-1])["progress"]["seconds_left"], whole_s - now[0]))
        progress.stop()
    return pairs


# Of a rendered block whose poses are off, and of one whose poses are those of the flight; one job, seconds.
_FOUND = [
    ("first pass on given poses: extract", 3.8), ("first pass on given poses: match", 0.5),
    ("first pass on given poses: filter", 0.3),
    ("first pass: extract", 8.8), ("first pass: match", 1.3), ("first pass: filter", 0.4),
    ("first pass: global mapping of 8 images", 6.0), ("pairs", 0.1),
]  # fmt: skip
_REST = [
    ("step first: extract", 15.4), ("step first: match", 13.8), ("step first: filter", 1.0),
    ("step guided: match", 0.6), ("extract", 0.1), ("match", 0.2), ("filter", 0.9), ("refine", 0.1), ("refine", 2.4),
    ("adjust", 6.3), ("consistency", 0.8), ("export", 0.5), ("report", 4.4),
]  # fmt: skip


@pytest.mark.parametrize("parts", [[*_FOUND, *_REST], [*_FOUND[:3], *_REST]])
def test_the_time_to_the_end_is_right_to_a_third_from_the_first_tenth_on(monkeypatch, parts):
    pairs = told(monkeypatch, parts)
    whole_s = sum(seconds for _, seconds in parts)
    late = [(left, right) for left, right in pairs if 0.1 * whole_s < right < 0.9 * whole_s]
    assert len(late) > 50
    off = [left / right for left, right in late]
    assert min(off) > 0.7
    assert max(off) < 1.35


def test_the_end_does_not_come_before_that_of_the_present_part(monkeypatch):
    """Matching of 1 s, then 100 s for half of a report: 100 s are left of it alone."""
    pairs = told(monkeypatch, [("match", 1.0), ("step learned: report", 200.0)])
    assert pairs[14][0] == pytest.approx(100.0)


def test_json_progress_is_a_line_for_machines(capsys):
    progress = JsonProgress(graph.RUN)
    progress.start("read", 2)
    progress.advance(2)
    progress.start("step first: match", 3)
    progress.advance()  # within half a second of the line before
    progress.advance(2)
    lines = [json.loads(line)["progress"] for line in capsys.readouterr().err.splitlines()]
    assert [(one["stage"], one["number"], one["done"], one["total"]) for one in lines] == [
        (None, None, 0, 2), (None, None, 2, 2), ("match", 4, 0, 3), ("match", 4, 3, 3),
    ]  # fmt: skip
    assert {one["count"] for one in lines} == {10}
    assert lines[2]["part"] == "step first: match"
    assert [one["seconds_left"] is None for one in lines] == [True, True, True, False]


def test_json_progress_is_shown_even_where_quiet_is_asked_for():
    assert isinstance(progress_shown(ProgressKind.JSON, quiet=True), JsonProgress)
    assert isinstance(progress_shown(ProgressKind.AUTO, quiet=True), SilentProgress)
    assert isinstance(progress_shown(ProgressKind.AUTO, quiet=False), LineProgress)
