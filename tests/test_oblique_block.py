"""Preset oblique on a small rendered block seen from five directions, from the shell's point of view."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import invoke

from aeromatch_cli.synthetic import render_block


@pytest.fixture(scope="module")
def suburb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("suburb")
    render_block(folder, "suburb", seed=12, width_px=480, height_px=360, images=6, flight="oblique")
    return folder


def run(suburb: Path, work: Path, *more: str) -> dict[str, float]:
    """The figures of `evaluate`."""
    block = ["--images", suburb / "images", "--poses", suburb / "poses_noisy.csv", "--cameras", suburb / "block.json"]
    outcome = invoke("run", *more, *block, "--workspace", work, "--jobs", 1, "--json")
    assert outcome.code == 0, outcome.stderr
    judged = invoke("evaluate", work, "--truth", suburb, "--no-mapping", "--json")
    assert judged.code == 0, judged.stderr
    totals: dict[str, float] = json.loads(judged.stdout.strip().splitlines()[-1])["totals"]
    return totals


def test_oblique_finds_more_than_baseline(suburb: Path, tmp_path: Path) -> None:
    budget = ("--set", "extract.keypoints=1000")
    plain = run(suburb, tmp_path / "baseline", "baseline", *budget, "--set", "pairs.max_view_angle_deg=90")
    learned = run(suburb, tmp_path / "oblique", "oblique", *budget)
    assert learned["correct"] > 1.2 * plain["correct"]
    assert learned["correctness"] > 0.9


def test_a_second_run_makes_nothing(suburb: Path, tmp_path: Path) -> None:
    block = ["--images", suburb / "images", "--poses", suburb / "poses_noisy.csv", "--cameras", suburb / "block.json"]
    arguments = (
        "run",
        "oblique",
        *block,
        "--workspace",
        tmp_path,
        "--jobs",
        1,
        "--set",
        "extract.keypoints=300",
        "--json",
    )
    assert invoke(*arguments).code == 0
    again = invoke(*arguments)
    assert again.code == 0
    assert not {"extract", "match", "filter"} & again.done().keys()
