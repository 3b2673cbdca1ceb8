"""Spoilt and good blocks of the benchmark `robustness`: against known truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.calibration.simulate import mapped
from benchmarks.robustness.blocks import FAULTS, GOOD, Plan, Task
from benchmarks.robustness.command import evidence_of, main, summary_of

from aeromatch_cli.files import read_json
from aeromatch_cli.geometry.cameras import focal_px
from aeromatch_cli.sfm.quality.judgement import judged


@pytest.fixture(scope="module")
def task() -> Task:
    return Plan("grass", "nadir", 12, "rtk2cm", 4, control=6).task(1000)


def spoilt(task: Task, name: str) -> Task:
    return FAULTS[name][1](task)


def test_there_are_as_many_of_each_as_the_table_needs() -> None:
    assert (len(FAULTS), len(GOOD)) == (34, 23)


def test_positions_are_spoilt_as_the_names_say(task: Task) -> None:
    given = np.array([pose.center_m for pose in task.observed.poses.values()])

    def moved_m(name: str) -> np.ndarray:
        return np.array([pose.center_m for pose in spoilt(task, name).observed.poses.values()]) - given

    shift = moved_m("RTK 1 m off in one of two flights")
    assert np.linalg.norm(shift, axis=1) == pytest.approx([0.0] * 6 + [1.0] * 6)
    assert moved_m("heights 15 m up in one of two flights")[:, 2] == pytest.approx([0.0] * 6 + [15.0] * 6)
    assert (np.linalg.norm(moved_m("positions of four images exchanged"), axis=1) > 0.0).sum() == 4
    sigmas = [pose.sigma_position_m for pose in spoilt(task, "RTK stated ten times too exact").observed.poses.values()]
    assert sigmas == pytest.approx([0.1 * pose.sigma_position_m for pose in task.observed.poses.values()])


def test_cameras_and_matches_are_spoilt_as_the_names_say(task: Task) -> None:
    (true,) = task.block.cameras.values()
    (stated,) = spoilt(task, "focal length stated 26 % too long, to 1 %").observed.cameras.values()
    assert focal_px(stated) / focal_px(true) == pytest.approx(1.26, rel=1e-4)  # of fx and fy, which affinity parts
    pairs = tuple(spoilt(task, "tracks of two images only").contents.pairs)
    used = [(p.pair.image_id0, int(a)) for p in pairs for a in p.matches[:, 0]]
    used += [(p.pair.image_id1, int(b)) for p in pairs for b in p.matches[:, 1]]
    assert len(used) == len(set(used))


@pytest.mark.slow
def test_a_good_block_is_not_bad_and_a_spoilt_one_is_not_good() -> None:
    task = Plan("grass", "cross", 12, "rtk2cm", 4, control=6).task(300)
    contents, groups = mapped(task.block)
    task = replace(task, contents=contents, groups=groups)
    evidence, errors = evidence_of(task)
    assert judged(evidence).verdict != "bad"
    assert errors["focal_percent"] < 1.0
    for name, what in (
        ("focal length stated 26 % too long, to 1 %", "calibration"),
        ("RTK rounded to metres", "positions horizontally"),
    ):
        quality = judged(evidence_of(spoilt(task, name))[0])
        assert quality.verdict == "bad", name
        assert what in {one.what for one in quality.faults}


def test_the_summary_counts_verdicts() -> None:
    rows = [{"expected": kind, "verdict": verdict} for kind, verdict in (("spoilt", "bad"), ("good", "good"))]
    assert summary_of(rows) == (
        "1 spoilt blocks: 0 good, 0 doubtful, 1 bad; 0 of 1 called good (0 % to 95 %). "
        "1 good blocks: 1 good, 0 doubtful, 0 bad; 0 of 1 called bad (0 % to 95 %)."
    )
    many = [{"expected": "spoilt", "verdict": "good" if k < 5 else "bad"} for k in range(20)]
    assert "5 of 20 called good (10 % to 40 %)" in summary_of(many)


@pytest.mark.slow
def test_rows_on_file_are_judged_anew(tmp_path: Path) -> None:
    arguments = ["--only", "strip", "--points", "300", "--jobs", "1", "--out", str(tmp_path)]
    main(arguments)
    (row,) = list((tmp_path / "rows").glob("*.json"))
    made_ns = row.stat().st_mtime_ns
    assert read_json(row)["evidence"]["images"] == 6
    main(arguments)
    assert row.stat().st_mtime_ns == made_ns
    assert "single strip" in (tmp_path / "robustness.md").read_text(encoding="utf-8")
