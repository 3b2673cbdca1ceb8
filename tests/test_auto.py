"""Preset auto: what runs where none is named, and what an easy block is spared."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections import Counter

import pytest
from conftest import PAGE, Site, invoke

from aeromatch_cli.config import load

# Small pictures have few matches: with so many a pair is an easy one.
EASY = tuple(
    word
    for step in ("guided", "learned")
    for word in ("--set", f"cascade.{step}.below_matches=60", "--set", f"cascade.{step}.below_coverage=0")
)


def test_commands_take_auto_where_no_preset_is_named(tmp_path) -> None:
    outcome = invoke("check", "--images", tmp_path, "--workspace", tmp_path / "work")
    assert outcome.code == 3
    assert "no image" in outcome.stderr
    settings = load("auto")
    assert [step.name for step in settings.cascade] == ["guided", "learned"]


@pytest.mark.slow
def test_a_single_stage_follows_the_workspace_where_no_preset_is_named(done_site: Site) -> None:
    """The site's own settings, baseline with few keypoints: nothing is made again by another recipe."""
    outcome = invoke("extract", "--workspace", done_site.work, "--json")
    assert outcome.code == 0
    assert outcome.facts["stages"]["extract"]["done"] == 0


def test_a_folder_in_the_place_of_a_preset_is_pointed_out(tmp_path) -> None:
    outcome = invoke("run", tmp_path)
    assert outcome.code == 2
    assert f"--images {tmp_path}" in outcome.stderr


_RUN = """
import sys
from aeromatch_cli.cli import main
try:
    main()
finally:
    print("torch" in sys.modules)
"""


@pytest.mark.slow
def test_an_easy_block_never_loads_torch(site: Site) -> None:
    arguments = [str(argument) for argument in ("run", *site.options("--executor", "serial", *EASY))]
    done = subprocess.run([sys.executable, "-c", _RUN, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (
        "10 of 10 pairs have enough matches after step first, 0 more after guided, 0 more after learned\n"
        in done.stdout
    )
    assert done.stdout.splitlines()[-1] == "False"


@pytest.mark.slow
def test_check_says_what_further_steps_may_take(site: Site) -> None:
    outcome = invoke("check", *site.options("--json"))
    assert outcome.facts["estimate"]["seconds_of_further_steps"] > 0.0
    assert "further   guided and learned: up to" in outcome.stdout


@pytest.mark.slow
def test_a_hard_pair_takes_the_learned_step_and_says_why(site: Site) -> None:
    # The pictures have 400 keypoints at most: as many matches as of 2000.
    more = [word for step in ("guided", "learned") for word in ("--set", f"cascade.{step}.below_matches=3000")]
    outcome = invoke("run", *site.options("--json", *more, *PAGE))
    assert outcome.code == 0
    with (site.work / "steps.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    taken = [row for row in rows if row["steps"] == "first+guided+learned"]
    assert taken
    assert all(row["reasons"].startswith("guided: ") and "; learned: " in row["reasons"] for row in taken)
    page = (site.work / "report" / "index.html").read_text()
    assert page.count(">first+guided+learned<br>") == len(taken)
    facts = outcome.facts["stages"]["match"]["result"]
    settled = Counter(row["settled_by"] for row in rows)
    assert facts["settled_by"] == {name: settled[name] for name in ("first", "guided", "learned")}
    assert facts["not_settled"] == sum(row["settled_by"] == "" for row in rows)
    assert all(bool(row["lacks"]) == (row["settled_by"] == "") for row in rows)
