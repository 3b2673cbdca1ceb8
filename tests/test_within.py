"""--within: durations, and what a run leaves out to end in time."""

from __future__ import annotations

import pytest
from conftest import Site, invoke

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.stages import check, within
from aeromatch_cli.stages.within import Deadline, seconds_of


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("90s", 90.0), ("20m", 1200.0), ("1h", 3600.0), ("1h30m", 5400.0), ("0.5h", 1800.0), (" 2 min ", 120.0),
        ("30 sec", 30.0), ("5mins", 300.0), ("2 hours", 7200.0), ("1 hour 1 minute", 3660.0),
    ],
)  # fmt: skip
def test_durations(text: str, seconds: float) -> None:
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["20", "", "m", "20 x", "-5m", "20m later", "1d", "1h30", "5\u0665m"])
def test_what_is_no_duration_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="write a number with its unit, as in 20m"):
        seconds_of(text)


def test_no_time_at_all_is_refused() -> None:
    with pytest.raises(ConfigError, match="give a second or more"):
        seconds_of("0m")


def test_wrong_durations_and_commands_end_with_code_2(site: Site) -> None:
    assert site("run", "--within", "soon").code == 2
    assert site("run", "--within", "").code == 2  # as of an unset variable
    outcome = site("run", "--within", "20m", "--shard", "1/2")
    assert (outcome.code, "--within" in outcome.facts["error"]) == (2, True)
    assert site("extract", "--within", "20m").code == 2
    assert not site.work.exists()
    assert "--within" in invoke("run", "--help").stdout


@pytest.mark.slow
def test_with_time_enough_a_run_is_what_it_is_without(site: Site) -> None:
    outcome = site("run", "--within", "2h")
    assert (outcome.code, outcome.facts["left_out"]) == (0, [])
    assert site("run", "--within", "2h").facts["left_out"] == []  # of a run that has nothing to do
    assert not (site.work / "asked.yaml").exists()
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
    assert "500 keypoints per image instead of 4000" in left_out
    assert "without the step guided" in left_out
    assert outcome.facts["stages"]["orient"]["done"] == 5  # this run made it, before it was reduced
    assert "refine" in left_out
    assert "the report page" in left_out
    assert not (site.work / "report" / "index.html").exists()
    assert (site.work / "export" / "colmap" / "database.db").is_file()
    assert outcome.facts["stages"]["filter"]["result"]["verified_matches"] > 0
    assert invoke("report", "--workspace", site.work).code == 0
    page = (site.work / "report" / "index.html").read_text(encoding="utf-8")
    assert "Reduced to end in time" in page
    # Without a limit the workspace alone says what was asked for, and gets the rest.
    again = invoke("run", site.work, "--json")
    assert again.code == 0
    assert "left_out" not in again.facts
    assert again.facts["stages"]["extract"]["done"] > 0
    assert "keypoints: 4000" in (site.work / "config.yaml").read_text(encoding="utf-8")
    assert not (site.work / "asked.yaml").exists()
    assert "Reduced to end in time" not in (site.work / "report" / "index.html").read_text(encoding="utf-8")


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
    assert left_out.startswith("without the step guided, for ")
    assert outcome.facts["stages"]["match"]["result"]["settled_by"].keys() == {"first"}
    assert outcome.facts["stages"]["refine"]["done"] > 0


def test_a_deadline_counts_what_follows_matching(monkeypatch: pytest.MonkeyPatch) -> None:
    deadline = Deadline("100s")
    monkeypatch.setattr(within.check, "later_s", lambda _, share: 20.0 * share)
    deadline.started -= 40.0
    assert deadline.holds(29.0, None)  # 40 + 29 + 20 of 90 that are planned
    assert not deadline.holds(31.0, None)
    assert deadline.holds(31.0, None, 0.5)
    assert deadline.line().startswith("within 100s      ended after 40 s; nothing was left out")


def test_what_has_no_less_to_give_is_not_reduced(site: Site) -> None:
    """A grid of few points on small images: nothing is said to be left out."""
    asked = ("--set", "extract=grid", "--set", "extract.points=400", "--set", "filter=poselib")
    outcome = site("run", "--within", "1s", "--set", "match=polar", *asked)
    assert outcome.code == 0
    assert outcome.facts["left_out"] == []


@pytest.mark.slow
def test_a_size_that_the_first_pass_does_not_feel_leaves_the_orientation(site: Site) -> None:
    """So that it is not made again where --within reduces the images after it."""
    assert site("orient").facts["stages"]["orient"]["done"] == 5
    assert site("orient", "--max-size", "2000").facts["stages"]["orient"]["done"] == 0
    assert site("orient", "--max-size", "300").facts["stages"]["orient"]["done"] == 5
