"""Preset oblique on a small rendered block seen from five directions, from the shell's point of view."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from conftest import invoke

from aeromatch_cli.evaluate import evaluate_workspace
from aeromatch_cli.evaluate.totals import total
from aeromatch_cli.synthetic import render_block

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def suburb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("suburb")
    render_block(folder, "suburb", seed=12, width_px=480, height_px=360, images=6, flight="oblique")
    return folder


def arguments(suburb: Path, work: Path, *recipe: str) -> tuple[str | Path | int, ...]:
    block = ("--images", suburb / "images", "--poses", suburb / "poses_noisy.csv", "--cameras", suburb / "block.json")
    budget = ("--set", "extract.keypoints=1000", "--set", "run.report=false")
    return ("run", *recipe, *budget, *block, "--workspace", work, "--jobs", 1, "--json")


@pytest.fixture(scope="module")
def matched(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Workspace of preset oblique."""
    work = tmp_path_factory.mktemp("oblique")
    outcome = invoke(*arguments(suburb, work, "oblique"))
    assert outcome.code == 0, outcome.stderr
    return work


def judged(suburb: Path, work: Path) -> dict[str, float]:
    return total(evaluate_workspace(work, suburb, mapping=False).pairs)


def test_oblique_finds_more_than_baseline(suburb: Path, matched: Path, tmp_path: Path) -> None:
    # In a copy: the orientation is the same, and is not made again.
    plainly = tmp_path / "plainly"
    shutil.copytree(matched, plainly)
    outcome = invoke(*arguments(suburb, plainly, "baseline", "--set", "pairs.max_view_angle_deg=90"))
    assert outcome.code == 0, outcome.stderr
    assert {"extract", "match", "filter"} <= outcome.done().keys()
    plain, learned = (judged(suburb, work) for work in (plainly, matched))
    assert learned["correct"] > 1.2 * plain["correct"] > 0
    assert learned["correctness"] > 0.9


def test_a_second_run_makes_nothing(suburb: Path, matched: Path) -> None:
    again = invoke(*arguments(suburb, matched, "oblique"))
    assert again.code == 0
    assert not {"extract", "match", "filter"} & again.done().keys()
