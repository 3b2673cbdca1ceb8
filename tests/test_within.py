"""--within: durations, and what a run leaves out to end in time."""

from __future__ import annotations

import pytest
from conftest import Site, invoke

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.stages import check, within
from aeromatch_cli.stages.within import Deadline, seconds_of


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90s", 90.0), ("20m", 1200.0), ("1h", 3600.0), ("1h30m", 5400.0), ("0.5h", 1800.0), (" 2 min ", 120.0)],
)
def test_durations(text: str, seconds: float) -> None:
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["20", "", "m", "20 x", "-5m", "0s", "20m later", "1d"])
def test_what_is_no_duration_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="write a duration such as 20m"):
        seconds_of(text)


def test_wrong_durations_and_commands_end_with_code_2(site: Site) -> None:
    assert site("run", "--within", "soon").code == 2
    outcome = site("run", "--within", "20m", "--shard", "1/2")
    assert (outcome.code, "--within" in outcome.facts["error"]) == (2, True)
    assert site("extract", "--within", "20m").code == 2
    assert not site.work.exists()
    assert "--within" in invoke("run", "--help").stdout


@pytest.mark.slow
def test_with_time_enough_a_run_is_what_it_is_without(site: Site) -> None:
    outcome = site("run", "--within", "2h")
    assert (outcome.code, outcome.facts["left_out"]) == (0, [])
    matches = outcome.facts["stages"]["filter"]["result"]["verified_matches"]
    assert site("run").done() == {}  # nothing is left to do
    assert matches > 0


@pytest.mark.slow
def test_a_short_time_leaves_out_and_exports_all_the_same(site: Site) -> None:
    """Nothing fits into a second: sizes and keypoints are halved three times, and the rest is named."""
    outcome = site(
        "run",
        "--within",
        "1s",
        "--set",
        "run.report=true",
        "--set",
        "cascade=guided",
        "--set",
        "extract.keypoints=4000",
    )
    left_out = " ".join(outcome.facts["left_out"])
    assert outcome.code == 0
    assert "more than 500 keypoints per image (of 4000)" in left_out
    assert "step guided" in left_out
    assert "refine" in left_out
    assert "the report page" in left_out
    assert not (site.work / "report" / "index.html").exists()
    assert (site.work / "export" / "colmap" / "database.db").is_file()
    assert outcome.facts["stages"]["filter"]["result"]["verified_matches"] > 0
    assert invoke("report", "--workspace", site.work).code == 0
    page = (site.work / "report" / "index.html").read_text(encoding="utf-8")
    assert "Left out to end in time" in page
    # Without a limit the same workspace gets the rest.
    again = site("run", "--set", "run.report=true", "--set", "cascade=guided", "--set", "extract.keypoints=4000")
    assert "left_out" not in again.facts
    assert again.facts["stages"]["extract"]["done"] > 0
    assert "Left out to end in time" not in (site.work / "report" / "index.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_step_that_does_not_fit_is_left_out_alone(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """A trial that says an hour for every pair of the step: the first step and the measuring stay."""
    real = check.tried_pair

    def slow(context: object, pair: object) -> object:
        tried = real(context, pair)
        step = "guided" in context.scope.part
        return check.TriedPair(tried.image_s, 3600.0 if step else tried.pair_s, tried.verified)

    monkeypatch.setattr(within.check, "tried_pair", slow)
    outcome = site("run", "--within", "1h", "--set", "cascade=guided", "--set", "cascade.guided.below_matches=100000")
    (left_out,) = outcome.facts["left_out"]
    assert left_out.startswith("step guided of ")
    assert outcome.facts["stages"]["match"]["result"]["settled_by"].keys() == {"first"}
    assert outcome.facts["stages"]["refine"]["done"] > 0


def test_a_deadline_counts_what_follows_matching(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    deadline = Deadline("100s")
    monkeypatch.setattr(within.check, "later_s", lambda _, before_s: 0.26 * before_s + 3.0)
    deadline.started -= 40.0
    assert deadline.holds(36.0, None)  # 1.26 * 76 + 3 = 98.8
    assert not deadline.holds(38.0, None)  # 101.3
    assert deadline.words()[0].startswith("within 100s      ended after 40 s; left out: nothing")


@pytest.mark.slow
def test_a_size_that_the_first_pass_does_not_feel_leaves_the_orientation(site: Site) -> None:
    """So that it is not made again where --within reduces the images after it."""
    assert site("orient").facts["stages"]["orient"]["done"] == 5
    assert site("orient", "--max-size", "2000").facts["stages"]["orient"]["done"] == 0
    assert site("orient", "--max-size", "300").facts["stages"]["orient"]["done"] == 5
