"""Preset oblique on a small rendered block seen from five directions, from the shell's point of view."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from conftest import Outcome, invoke

from aeromatch_cli.evaluate import evaluate_workspace
from aeromatch_cli.evaluate.totals import total
from aeromatch_cli.lab.opening import open_truth
from aeromatch_cli.lab.synthetic import render_block

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def suburb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("suburb")
    render_block(folder, "suburb", seed=12, width_px=400, height_px=300, images=6, flight="oblique")
    return folder


def arguments(suburb: Path, work: Path, *recipe: str) -> tuple[str | Path | int, ...]:
    block = ("--images", suburb / "images", "--poses", suburb / "poses_noisy.csv", "--cameras", suburb / "block.json")
    budget = ("--set", "extract.keypoints=1000", "--set", "run.report=false")
    return ("run", *recipe, *budget, *block, "--workspace", work, "--jobs", 1, "--json")


def assert_not_oriented(outcome: Outcome) -> None:
    """Six small pictures that look in five directions are not oriented, and the command says so; matches are exported
    all the same."""
    assert outcome.code == 1, outcome.stderr
    assert outcome.facts["quality"]["verdict"] == "bad"
    assert outcome.facts["quality"]["findings"][0]["what"] in {"oriented images", "connection"}
    assert not outcome.facts["failures"]


@pytest.fixture(scope="module")
def matched(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Workspace of preset oblique."""
    work = tmp_path_factory.mktemp("oblique")
    assert_not_oriented(invoke(*arguments(suburb, work, "oblique")))
    return work


def judged(suburb: Path, work: Path) -> dict[str, float]:
    return total(evaluate_workspace(work, suburb, open_truth, mapping=False).pairs)


def test_oblique_finds_more_than_baseline(suburb: Path, matched: Path, tmp_path: Path) -> None:
    # In a copy: the orientation is the same, and is not made again.
    plainly = tmp_path / "plainly"
    shutil.copytree(matched, plainly)
    outcome = invoke(*arguments(suburb, plainly, "baseline", "--set", "pairs.max_view_angle_deg=90"))
    assert_not_oriented(outcome)
    assert {"extract", "match", "filter"} <= outcome.done().keys()
    plain, learned = (judged(suburb, work) for work in (plainly, matched))
    assert learned["correct"] > 1.2 * plain["correct"] > 0
    assert learned["correctness"] > 0.9


def test_a_second_run_makes_nothing(suburb: Path, matched: Path) -> None:
    again = invoke(*arguments(suburb, matched, "oblique"))
    assert_not_oriented(again)
    assert not {"extract", "match", "filter"} & again.done().keys()
