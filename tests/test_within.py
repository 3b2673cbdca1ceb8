"""--within: durations, what a run leaves out to end in time, and that nothing asked for or made is lost by it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Sequence

import numpy as np
import pytest
from conftest import IMAGES, PAGE, Site, contents, invoke

from aeromatch_cli.config import Settings, load
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.executor import Executor
from aeromatch_cli.stages import extract, match, timing, within
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.pairs import prepare
from aeromatch_cli.stages.timing import TriedPair
from aeromatch_cli.stages.within import Deadline, fitting, seconds_of

SMALLEST = 500  # keypoints


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("90s", 90.0), ("20m", 1200.0), ("1h", 3600.0), ("1h30m", 5400.0), ("0.5h", 1800.0), (" 2 min ", 120.0),
        ("30 sec", 30.0), ("5mins", 300.0), ("2 hours", 7200.0), ("1 hour 1 minute", 3660.0), ("3 hrs 2 secs", 10802.0),
    ],
)  # fmt: skip
def test_durations(text: str, seconds: float) -> None:
    assert seconds_of(text) == seconds


@pytest.mark.parametrize(
    "text",
    ["20", "", "m", "20 x", "-5m", "20m later", "1d", "1h30", "5\u0665m", "20ms", "20 ms", "5hs", "9ss", "1h20ms"],
)
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
    for command in ("extract", "check"):
        outcome = site(command, "--within", "20m")
        assert outcome.facts["error"] == f"--within belongs to `aeromatch run`, not to {command}"
        assert "--within" not in invoke(command, "--help").stdout
    assert not site.work.exists()
    assert "--within" in invoke("run", "--help").stdout


# --- the plan -----------------------------------------------------------------------------------------------------


def _deadline(text: str, spent_s: float = 0.0) -> Deadline:
    deadline = Deadline(text)
    deadline.started -= spent_s
    return deadline


def test_one_rule_says_what_fits() -> None:
    deadline = _deadline("100s", spent_s=40.0)
    assert deadline.holds(49.9)  # of the 90 that are planned for
    assert not deadline.holds(50.1)
    assert deadline.line() == "within 100s      ended after 40 s; nothing was left out"
    assert deadline.is_kept
    assert deadline.is_worth(5.0)
    assert not deadline.is_worth(4.9)
    late = _deadline("100s", spent_s=130.0)
    assert late.line() == "within 100s      ended after 130 s, 30 s late; nothing was left out".replace(
        "130 s", "2 min"
    )
    assert not late.is_kept


def test_the_time_counts_from_the_start_of_the_process(done_site: Site) -> None:
    began_s = time.monotonic()
    slow_start = "import time, aeromatch_cli; time.sleep(5); from aeromatch_cli.cli import main; main()"
    command = [sys.executable, "-c", slow_start, "run", str(done_site.work / "config.yaml"), "--within", "1h"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    taken_s = time.monotonic() - began_s
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("within")]
    said_s = float(re.findall(r"ended after (\d+) s", line)[0])
    assert 5.0 <= said_s <= taken_s + 0.5


def _tried(image_s: float, pair_s: float, keypoints: float = 4000.0) -> TriedPair:
    return TriedPair(image_s, pair_s, keypoints, (np.zeros((0, 2)), np.zeros((0, 2))))


def _context(site: Site, *changes: str) -> Context:
    settings = load(str(site.work / "config.yaml"), changes)
    return prepare(settings, Executor("serial"))[0]


class _Plan:
    """Plans with a trial of known seconds; nothing else takes time. tried: pairs that were."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, first_pass_s: float = 0.0) -> None:
        self.tried = 0
        self.found: TriedPair | None = None
        monkeypatch.setattr(within, "tried_pair", self._try)
        monkeypatch.setattr(within, "_later_s", lambda *_: 0.0)
        monkeypatch.setattr(within, "_least_s", lambda _: first_pass_s)

    def _try(self, *_: object, keep: bool) -> TriedPair | None:
        assert keep
        self.tried += 1
        return self.found

    def __call__(self, context: Context, deadline: Deadline, found: TriedPair | None) -> Settings | None:
        self.found = found
        return fitting(context, deadline)


def _keypoints(settings: Settings | None) -> int | None:
    return None if settings is None else int(settings.extract.keypoints)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("pair_s", "keypoints"),
    # 10 pairs in 90 s: those with a half of the keypoints take a quarter as long.
    [(8.9, None), (9.1, 2000), (35.0, 2000), (37.0, 1000), (145.0, 500), (1000.0, 500)],
)
def test_keypoints_are_halved_until_their_pairs_fit(
    done_site: Site, monkeypatch: pytest.MonkeyPatch, pair_s: float, keypoints: int | None
) -> None:
    context, plan = _context(done_site, "extract.keypoints=4000"), _Plan(monkeypatch)
    assert len(context.pairs) == 10
    deadline = _deadline("100s")
    assert _keypoints(plan(context, deadline, _tried(0.0, pair_s))) == keypoints
    assert deadline.short is (pair_s == 1000.0)
    assert plan.tried == 1


def test_keypoints_that_cost_little_stay(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images below 1,600 pixels cannot be reduced, and fewer keypoints save nothing of their seconds."""
    context, plan = _context(done_site, "extract.keypoints=4000"), _Plan(monkeypatch)
    deadline = _deadline("100s")
    assert plan(context, deadline, _tried(image_s=100.0, pair_s=0.5)) is None
    assert (deadline.left_out, deadline.short) == ([], True)


def test_images_shrink_to_no_less_than_those_of_the_first_pass(
    done_site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = _context(done_site, "extract.keypoints=450", "orient.size_px=200")
    plan, sizes = _Plan(monkeypatch), []
    for image_s in (17.0, 35.0, 44.0, 1000.0):  # 5 images in 90 s
        found = plan(context, _deadline("100s"), _tried(image_s, 0.0))
        sizes.append(None if found is None else found.block.max_size_px)
    assert sizes == [None, 226, 200, 200]  # a half of the pixels of 320 x 240; 160 would be a quarter


def test_without_time_for_the_images_none_is_tried(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    context, plan = _context(done_site, "extract.keypoints=4000"), _Plan(monkeypatch, first_pass_s=91.0)
    deadline = _deadline("100s")
    assert _keypoints(plan(context, deadline, _tried(0.0, 0.0))) == SMALLEST
    assert (deadline.short, plan.tried) == (True, 0)
    assert deadline.plan() == (
        "within           100s is likely too short; to end as early as it can: 500 keypoints per image instead of 4000"
    )


def test_a_pair_that_cannot_be_read_reduces_nothing(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    context, plan = _context(done_site, "extract.keypoints=4000"), _Plan(monkeypatch)
    assert plan(context, _deadline("1s"), None) is None
    assert plan.tried == 1


def test_what_is_on_file_costs_nothing(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = _Plan(monkeypatch)
    slow = _tried(image_s=1000.0, pair_s=1000.0)
    context = _context(done_site)
    assert plan(context, _deadline("1s"), slow) is None
    assert plan.tried == 0
    # Other matches of the same features: reducing would find these anew.
    assert plan(_context(done_site, "match.ratio=0.7"), _deadline("1s"), slow) is None
    assert plan.tried == 0
    # One of five images is to be made again: its 10 seconds, and no more, are counted; the matches are still there.
    context.workspace.features(context.pairs[0].image_id0).unlink()
    context = _context(done_site)
    assert plan(context, _deadline("12s"), _tried(image_s=10.0, pair_s=1000.0)) is None
    assert plan.tried == 1
    # And where there is no time for it, all with fewer keypoints would take longer.
    assert plan(context, _deadline("5s"), _tried(image_s=10.0, pair_s=1.0)) is None


def test_reduced_results_on_file_are_found_again(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of 500 keypoints is there already: it costs nothing, and a half, 1,000, would fit only if it were as well."""
    assert done_site("run", "--set", "extract.keypoints=500").code == 0
    context, plan = _context(done_site, "extract.keypoints=4000"), _Plan(monkeypatch)
    assert _keypoints(plan(context, _deadline("100s"), _tried(image_s=100.0, pair_s=100.0))) == SMALLEST


def test_a_trial_is_kept_where_nothing_is_on_file(done_site: Site) -> None:
    context = _context(done_site)
    first, second = context.pairs[0].ids
    before = context.workspace.features(second).read_bytes()
    context.workspace.features(first).unlink()
    tried = timing.tried_pair(context, context.pairs[0], keep=True)
    assert tried is not None
    assert tried.image_s > 0.0
    assert context.workspace.features(second).read_bytes() == before
    assert "extract" not in done_site("run").done()  # it is what a run makes
    other = _context(done_site, "extract.keypoints=300")
    tried = timing.tried_pair(other, other.pairs[0], keep=True)
    assert tried is not None
    assert tried.keypoints == 300.0
    assert context.workspace.features(second).read_bytes() == before  # of other settings: left as it is


def test_the_page_goes_before_the_measuring(done_site: Site) -> None:
    """5 images of 400 keypoints: 0.2 + 5 (0.02 + 0.01) s are measured, 1.5 + 5 (0.06 + 0.04) s adjusted; 3 s page."""
    context = _context(done_site, "run.report=true", "refine.max_shift_px=2.5")
    measuring_s, adjusting_s = timing.measuring_s(context, 400.0), timing.adjusting_s(context, 400.0)
    assert (measuring_s, adjusting_s) == (pytest.approx(0.35), pytest.approx(2.0))
    assert timing.page_s(context) == 3.0
    deadline = _deadline("5s", spent_s=2.1)  # 4.5 are planned for
    assert within.measured_in_time(context, deadline) is context
    assert not within.page_in_time(context, deadline)
    assert deadline.left_out == ["without the report page (`aeromatch report` makes it)"]
    late = _deadline("100s", spent_s=200.0)
    assert within.measured_in_time(context, late) is context  # less than 5 s are not worth it
    later = _deadline("5s", spent_s=2.2)
    assert within.measured_in_time(context, later).settings.least_squares is None
    assert later.left_out == ["without the least-squares measuring of tie points (refine)"]
    assert "max_shift_px: 2.5" in (done_site.work / "asked.yaml").read_text(encoding="utf-8")


def test_measurements_on_file_stay(done_site: Site) -> None:
    context = _context(done_site)
    assert within.measured_in_time(context, _deadline("1s", spent_s=60.0)) is context


# --- runs ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_with_time_enough_a_run_is_what_it_is_without(site: Site, finished: object) -> None:
    outcome = site("run", "--within", "2h")
    assert (outcome.code, outcome.facts["left_out"]) == (0, [])
    assert outcome.counts("extract") == (IMAGES - 2, 2, 0)  # the trial's are there by then
    assert site("run", "--within", "2h").facts["left_out"] == []  # of a run that has nothing to do
    assert not (site.work / "asked.yaml").exists()
    assert site("run").done() == {}  # nothing is left to do
    known = contents(Site(finished).work)  # type: ignore[arg-type]
    kinds = ("features/", "matches/", "verified/", "refined/", "orientation/adjusted")
    same = [name for name in known if name.startswith(kinds)]
    found = contents(site.work)
    assert len(same) > 3 * IMAGES
    for name in same:
        np.testing.assert_equal(found[name], known[name])


@pytest.mark.slow
def test_a_finished_block_keeps_its_matches(done_site: Site) -> None:
    """Only what the changed setting makes stale is left to do, however short the time."""
    outcome = done_site("run", "--set", "refine.max_shift_px=2.5", "--within", "1s")
    assert outcome.code == 0
    assert outcome.facts["left_out"] == ["without the least-squares measuring of tie points (refine)"]
    assert outcome.done().keys().isdisjoint({"orient", "extract", "match", "filter"})
    assert "keypoints: 400" in (done_site.work / "config.yaml").read_text(encoding="utf-8")


SHORT = ("--set", "cascade=guided", "--set", "extract.keypoints=4000")


@pytest.mark.slow
def test_a_short_time_leaves_out_and_exports_all_the_same(site: Site) -> None:
    """Nothing fits into a second: sizes and keypoints are halved three times, and the rest is named."""
    outcome = site("run", "--within", "1s", *PAGE, *SHORT)
    left_out = " ".join(outcome.facts["left_out"])
    assert outcome.code == 0
    assert "500 keypoints per image instead of 4000" in left_out
    assert "without the step guided, which " in left_out
    assert outcome.facts["stages"]["orient"]["done"] == 5  # this run made it, before it was reduced
    assert "refine" in left_out
    assert "the report page" in left_out
    assert not (site.work / "report" / "index.html").exists()
    assert (site.work / "export" / "colmap" / "database.db").is_file()
    assert outcome.facts["stages"]["filter"]["result"]["verified_matches"] > 0
    assert invoke("show", site.work, "--json").facts["left_out"] == outcome.facts["left_out"][:-1]  # all but the page
    shown = invoke("show", site.work).stdout
    assert "left out    to end in time (run --within): 500 keypoints per image instead of 4000; without" in shown
    # The same again loses nothing, and says the same without --json.
    again = invoke("run", "baseline", *site.options("--within", "1s", *PAGE, *SHORT, "--quiet"))
    (line,) = [line for line in again.stderr.splitlines() if line.startswith("within")]
    assert "; for that: 500 keypoints per image instead of 4000" in line
    assert again.stdout == ""
    assert invoke("report", "--workspace", site.work).code == 0
    page = (site.work / "report" / "index.html").read_text(encoding="utf-8")
    assert "Reduced to end in time" in page
    # Without a limit the workspace alone, or its config.yaml, says what was asked for, and gets the rest.
    again = invoke("run", site.work / "config.yaml", "--json")
    assert again.code == 0
    assert f"{site.work / 'asked.yaml'}: as they were asked for" in again.stdout
    assert "left_out" not in again.facts
    assert again.facts["stages"]["extract"]["done"] > 0
    assert "keypoints: 4000" in (site.work / "config.yaml").read_text(encoding="utf-8")
    assert not (site.work / "asked.yaml").exists()
    assert "Reduced to end in time" not in (site.work / "report" / "index.html").read_text(encoding="utf-8")
    assert "left out" not in invoke("show", site.work).stdout


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["extract", "match"])
def test_what_was_asked_for_outlasts_an_interruption(site: Site, monkeypatch: pytest.MonkeyPatch, stage: str) -> None:
    real = {"extract": extract.run_own_first, "match": match.run}[stage]

    def stopped(*arguments: object) -> object:
        if "orientation" in str(arguments[0].workspace.root):  # type: ignore[attr-defined]
            return real(*arguments)  # type: ignore[operator]
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr({"extract": extract, "match": match}[stage], real.__name__, stopped)
        assert site("run", "--within", "1s", "--set", "extract.keypoints=4000").code == 130
    work = site.work
    assert [load(str(work / name)).extract.keypoints for name in ("config.yaml", "asked.yaml")] == [500, 4000]  # type: ignore[attr-defined]
    assert invoke("run", work).code == 0
    assert "keypoints: 4000" in (work / "config.yaml").read_text(encoding="utf-8")
    assert not (work / "asked.yaml").exists()


def _slow_step(monkeypatch: pytest.MonkeyPatch, steps: Sequence[float], name: str = "guided") -> list[Context]:
    """Trials of a step that say so many seconds for every pair, one after the other."""
    real, tried, seconds = timing.tried_pair, list[Context](), iter(steps)

    def slow(context: Context, pair: object, *, keep: bool) -> TriedPair | None:
        found = real(context, pair, keep=keep)  # type: ignore[arg-type]
        if name not in context.scope.part or found is None:
            return found
        tried.append(context)
        return TriedPair(found.image_s, next(seconds), found.keypoints, found.verified)

    monkeypatch.setattr(within, "tried_pair", slow)
    return tried


STEP = ("--set", "cascade=guided", "--set", "cascade.guided.below_matches=100000")


@pytest.mark.slow
def test_a_step_that_does_not_fit_is_left_out_alone(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """A trial that says an hour for every pair of the step: the first step and the measuring stay."""
    tried = _slow_step(monkeypatch, [3600.0])
    outcome = site("run", "--within", "1h", *STEP)
    (left_out,) = outcome.facts["left_out"]
    assert left_out == "without the step guided, which 10 pairs would have taken by its limit (below_matches 100000)"
    assert outcome.facts["stages"]["match"]["result"]["settled_by"].keys() == {"first"}
    assert outcome.facts["stages"]["refine"]["done"] > 0
    assert len(tried) == 1
    # It is no longer left out where it is on file, or where there is time.
    assert site("run", *STEP).facts["stages"]["match"]["result"]["settled_by"].keys() == {"first", "guided"}
    outcome = site("run", "--within", "1h", "--set", "refine.max_shift_px=2.5", *STEP)
    assert (outcome.facts["left_out"], len(tried)) == ([], 1)


@pytest.mark.slow
def test_steps_that_match_makes_are_no_longer_left_out(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    _slow_step(monkeypatch, [3600.0])
    assert len(site("run", "--within", "1h", *STEP).facts["left_out"]) == 1
    assert "without the step guided" in invoke("show", site.work).stdout
    made = invoke("match", "--workspace", site.work, "--json")
    assert made.facts["stages"]["match"]["result"]["settled_by"].keys() == {"first", "guided"}
    assert "left_out" not in invoke("show", site.work, "--json").facts
    assert "next      10 pairs are not verified with these matches: `aeromatch filter` does that" in made.stdout
    assert invoke("filter", "--workspace", site.work).code == 0
    assert "not verified with" not in invoke("match", "--workspace", site.work).stdout


@pytest.mark.slow
def test_what_a_trial_of_a_step_has_found_is_no_part_of_the_block(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """The features of the pair that was tried stay on file; later commands find the block as it was left."""
    tried = _slow_step(monkeypatch, [3600.0], "learned")
    step = ("--set", "cascade=learned", "--set", "cascade.learned.below_matches=100000")
    outcome = site("run", "--within", "1h", *step)
    assert [words.split(",")[0] for words in outcome.facts["left_out"]] == ["without the step learned"]
    assert len(tried) == 1
    assert len(list((site.work / "features" / "learned").glob("*.npz"))) == 2
    for command in ("filter", "adjust", "export"):
        again = invoke(command, "--workspace", site.work, "--json")
        assert (again.code, again.done()) == (0, {}), command


@pytest.mark.slow
def test_a_step_without_time_is_not_tried(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor is one left out that its trial has all but made."""
    tried = _slow_step(monkeypatch, [0.01])
    monkeypatch.setattr(Deadline, "holds", lambda self, more_s: more_s < 3000.0)
    monkeypatch.setattr(within, "_later_s", lambda *_: 3000.0)
    outcome = site("run", "--within", "1h", *STEP)
    assert (
        outcome.facts["left_out"][0]
        == "without the step guided, which 10 pairs would have taken by its limit (below_matches 100000)"
    )
    assert tried == []
    once = iter([True])
    monkeypatch.setattr(Deadline, "holds", lambda self, more_s: next(once, False))
    outcome = site("run", "--within", "1h", *STEP)
    assert (outcome.facts["left_out"], len(tried)) == ([], 1)


@pytest.mark.slow
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


@pytest.mark.slow
def test_of_a_reduced_run_no_pair_of_which_is_verified_the_settings_stay(site: Site) -> None:
    never = ("--set", "filter.poselib.min_inliers=5000", "--set", "extract.keypoints=4000")
    outcome = site("run", "--within", "1s", *never)
    assert outcome.code == 3
    assert outcome.facts["error"].endswith("; this run was reduced: 500 keypoints per image instead of 4000")
    assert "keypoints: 4000" in (site.work / "asked.yaml").read_text(encoding="utf-8")
    assert json.loads((site.work / "reports" / "filter.json").read_text(encoding="utf-8"))["items"] == 10
