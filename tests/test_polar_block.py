"""Preset polar on a small rendered block of grass, from the shell's point of view, with poses as they are in flight."""

from __future__ import annotations

import re
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from conftest import invoke

from aeromatch_cli.evaluate import evaluate_workspace
from aeromatch_cli.evaluate.totals import total
from aeromatch_cli.formats.rows import read_verified_row
from aeromatch_cli.formats.tables import read_pairs
from aeromatch_cli.lab.opening import open_truth
from aeromatch_cli.lab.synthetic import render_block

pytestmark = pytest.mark.slow

MAX_IMAGE_ID = 2147483647
PLAIN = ("--set", "run.report=false")


@pytest.fixture(scope="module")
def grass(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("grass")
    render_block(folder, "grass", seed=11, width_px=480, height_px=360, images=4)
    return folder


@pytest.fixture(scope="module")
def work(grass: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("run")
    block = ["--images", grass / "images", "--poses", grass / "poses_noisy.csv", "--cameras", grass / "block.json"]
    outcome = invoke("run", "polar", *block, "--workspace", root / "work", "--jobs", 1, "--json", *PLAIN)
    assert outcome.code == 0, outcome.stderr
    return root / "work"


def test_every_pair_that_shares_enough_is_verified(work: Path, grass: Path) -> None:
    figures = total(evaluate_workspace(work, grass, open_truth, mapping=False).pairs)
    assert figures["correctness"] > 0.995
    assert figures["median_error_px"] < 0.15
    assert figures["coverage"] > 0.8
    pairs = {(pair.image_id0, pair.image_id1): pair.overlap for pair in read_pairs(work / "pairs.csv")}
    states = {}
    for path in (work / "verified").iterdir():
        for image_id1, entry in read_verified_row(path).items():
            states[path.stem, image_id1] = entry.verdict
            assert entry.matches.sigmas_px is not None
            assert ((entry.matches.sigmas_px > 0.0) & (entry.matches.sigmas_px <= 0.5)).all()
    assert len(states) == len(pairs) >= 4
    assert all(states[pair].state == "verified" for pair, overlap in pairs.items() if overlap >= 0.3)
    assert all(verdict.reason for verdict in states.values() if verdict.state != "verified")


def test_the_export_joins_what_several_images_see(work: Path) -> None:
    """A keypoint of one image stands in the pairs with two others: points of three views and more."""
    with sqlite3.connect(work / "export" / "colmap" / "database.db") as connection:
        rows = connection.execute("SELECT pair_id, rows, data FROM two_view_geometries WHERE rows > 0").fetchall()
    seen: dict[tuple[int, int], set[int]] = {}
    for pair_id, count, data in rows:
        ids = divmod(pair_id, MAX_IMAGE_ID)
        for match in np.frombuffer(data, np.uint32).reshape(count, 2).tolist():
            for side in (0, 1):
                seen.setdefault((ids[side], match[side]), set()).add(ids[1 - side])
    shares = np.array([len(others) for others in seen.values()])
    assert len(rows) >= 4
    assert (shares >= 2).mean() > 0.3


def test_a_second_run_makes_nothing(work: Path, grass: Path) -> None:
    block = ["--images", grass / "images", "--poses", grass / "poses_noisy.csv", "--cameras", grass / "block.json"]
    outcome = invoke("run", "polar", *block, "--workspace", work, "--jobs", 1, "--json", *PLAIN)
    assert outcome.code == 0
    assert not {"extract", "match", "filter"} & outcome.done().keys()


def test_the_page_shows_residuals_at_the_measured_places(work: Path, grass: Path) -> None:
    """Points of polar registration are no keypoints: those of the features would be hundreds of pixels off."""
    block = ["--images", grass / "images", "--poses", grass / "poses_noisy.csv", "--cameras", grass / "block.json"]
    assert invoke("report", "polar", *block, "--workspace", work, "--jobs", 1, *PLAIN).code == 0
    page = (work / "report" / "index.html").read_text(encoding="utf-8")
    remaining = re.search(r"What remains: .*? up to ([\d.]+) px", page)
    assert remaining is not None
    assert float(remaining[1]) < 1.0
