"""What is shown of how far a command is."""

from __future__ import annotations

from aeromatch_cli.cli.progress import RUN_STAGES, LineProgress


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
    progress = LineProgress(RUN_STAGES)
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


def test_the_time_to_the_end_is_estimated_from_the_stages_that_did_something(monkeypatch, capsys):
    """Extraction takes 15 shares of 100, what follows 51: after half of it in 10 s (a stage may have further parts, so
    that a half counts for a quarter), 10 / 3.75 x (11.25 + 51) s are left."""
    clock = iter([0.0, 0.0, 10.0, 10.0])
    monkeypatch.setattr("aeromatch_cli.cli.progress.time.monotonic", lambda: next(clock))
    progress = LineProgress(RUN_STAGES)
    progress.start("extract", 2)
    progress.advance()
    assert capsys.readouterr().err.endswith("10 s left; about 3 min to the end\n")


def test_the_end_does_not_come_before_that_of_the_present_part(monkeypatch, capsys):
    """Matching of 1 s, then 100 s for half of a report: 100 s are left of it alone."""
    times = iter([0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 101.0, 101.0])
    monkeypatch.setattr("aeromatch_cli.cli.progress.time.monotonic", lambda: next(times))
    progress = LineProgress(RUN_STAGES)
    progress.start("match", 1)
    progress.advance()
    progress.start("step learned: report", 2)
    progress.advance()
    assert capsys.readouterr().err.endswith("2 min left; about 2 min to the end\n")
