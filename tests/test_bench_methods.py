"""scripts/bench methods: --quick runs, its rows agree with one another, resume and repeat; pairs and tables by hand."""

from __future__ import annotations

import json
import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import __main__, scenes
from benchmarks.methods import results
from benchmarks.peers import matching, table
from benchmarks.peers.base import Options, Scene

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.evaluate import Conditions
from aeromatch_cli.lab.opening import open_truth

pytestmark = pytest.mark.slow

METHODS = ("opencv-sift", "pycolmap", "baseline")
FIELDS = [
    "method", "scene", "condition", "pair", "view_angle_deg", "shadow_share", "overlap", "keypoints", "possible",
    "kept", "correct", "correctness", "recall", "mean_error_px", "median_error_px", "coverage", "rotation_error_deg",
    "translation_error_deg", "seconds", "peak_mb",
]  # fmt: skip
KEYPOINTS, PAIRS = 512, 4
Row = dict[str, Any]


def bench(out: Path, methods: tuple[str, ...], *more: str) -> int:
    """Exit code, in this process; every method has its own."""
    quick = ["--quick", "--scenes", "grass", "--images", "8", "--seed", "1", "--out", str(out)]
    with pytest.MonkeyPatch.context() as patched:
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_LOG_LEVEL"):
            patched.setenv(name, os.environ.get(name, ""))  # as they were, afterwards
        patched.setattr(scenes, "render_once", partial(scenes.render_once, jobs=1))
        return __main__.main(["methods", *quick, "--methods", ",".join(methods), *more])


def rows_of(out: Path) -> list[Row]:
    rows: list[Row] = json.loads((out / "results.json").read_text(encoding="utf-8"))
    return rows


def figures(rows: list[Row]) -> list[Row]:
    """Rows without what no seed fixes."""
    return [{key: value for key, value in row.items() if key not in ("seconds", "peak_mb")} for row in rows]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bench")
    assert bench(out, METHODS) == 0
    return out


def test_every_method_is_judged_on_the_same_pairs(done: Path) -> None:
    rows = rows_of(done)
    assert len(rows) == PAIRS * len(METHODS)
    conditions = ("scene", "condition", "pair", "view_angle_deg", "shadow_share", "overlap")
    by_method = {name: [[r[key] for key in conditions] for r in rows if r["method"] == name] for name in METHODS}
    assert all(by_method[name] == by_method["opencv-sift"] for name in METHODS)
    for row in rows:
        hard = row["view_angle_deg"] >= 30 or row["shadow_share"] >= 0.2
        assert row["condition"] == ("hard" if hard else "easy")
        assert row["overlap"] >= 0.2
    assert {row["condition"] for row in rows} == {"hard", "easy"}


def test_rows_hold_the_fields_of_the_table_and_agree_with_themselves(done: Path) -> None:
    for row in rows_of(done):
        assert list(row)[: len(FIELDS)] == FIELDS
        # Exactly the budget; fewer only where no more are found: the baseline's views of far ground are small.
        assert row["keypoints"] == KEYPOINTS or (row["method"] == "baseline" and row["keypoints"] < KEYPOINTS)
        assert 0 <= row["correct"] <= row["kept"] <= KEYPOINTS
        assert row["correct"] <= row["possible"] <= KEYPOINTS
        assert row["correctness"] == (pytest.approx(row["correct"] / row["kept"], abs=1e-6) if row["kept"] else None)
        assert row["seconds"] > 0.01
        assert 50 < row["peak_mb"] < 4000


def test_good_methods_do_well_on_easy_pairs(done: Path) -> None:
    easy = [row for row in rows_of(done) if row["condition"] == "easy"]
    correct = {name: sum(row["correct"] for row in easy if row["method"] == name) for name in METHODS}
    assert min(correct["opencv-sift"], correct["pycolmap"], correct["baseline"]) >= 15
    kept = {name: sum(row["kept"] for row in easy if row["method"] == name) for name in METHODS}
    assert all(correct[name] >= 0.7 * kept[name] for name in METHODS)
    best = min(row["median_error_px"] for row in easy if row["median_error_px"] is not None)
    assert best < 1.0


def test_the_table_sums_the_rows(done: Path) -> None:
    text = (done / "table.md").read_text(encoding="utf-8")
    for name in METHODS:
        mine = [row for row in rows_of(done) if row["method"] == name]
        line = next(line for line in text.splitlines() if line.startswith(f"| grass | `{name}` |"))
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert cells[2:5] == [str(PAIRS), str(sum(r["correct"] for r in mine)), str(sum(r["kept"] for r in mine))]


def test_a_second_run_keeps_what_is_there_and_makes_the_rest(done: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = rows_of(done)
    kept = [row for i, row in enumerate(before) if i != 1]
    (done / "scenes" / "found" / f"{before[1]['key']}.npz").unlink()
    assert bench(done, METHODS) == 0
    assert "1 of 3" in capsys.readouterr().err
    after = rows_of(done)
    assert [row["seconds"] for i, row in enumerate(after) if i != 1] == [row["seconds"] for row in kept]
    assert figures(after) == figures(before)  # the missing row was made again, the same


def test_unknown_names_are_refused_with_the_choices(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench(tmp_path, ("opencv-surf",)) == 2
    said = capsys.readouterr().err
    assert "opencv-asift" in said
    assert "baseline" in said
    assert bench(tmp_path, ("aliked",)) == 2
    assert "--reference-weights" in capsys.readouterr().err


def test_asift_of_opencv_does_well_on_an_easy_pair(done: Path) -> None:
    """Alone: its 43 views of an image take seconds."""
    block = next((done / "scenes").glob("grass-*"))
    easy = [row for row in rows_of(done) if row["condition"] == "easy"]
    pair = tuple(max(easy, key=lambda row: row["possible"])["pair"].split(" "))
    truth = open_truth(block)
    scene = Scene("grass", block / "images", block / "poses.csv", block / "block.json", truth.cameras, (pair,))
    method = table.method("opencv-asift")(scene, Options(KEYPOINTS, "image", 1, 1, None))
    features = [method.features(image) for image in pair]
    assert [len(side.descriptors) for side in features] == [KEYPOINTS, KEYPOINTS]
    found = method.match(*pair, *features)
    answer = found.keypoints0_px, found.keypoints1_px, found.points0_px, found.points1_px, found.scores
    score = truth.judge(*pair, *answer)
    assert score.kept >= 15
    assert score.correct >= 0.7 * score.kept


def test_methods_are_split_outside_brackets_and_checked() -> None:
    text = "opencv-sift, baseline[match.ratio=0.7,extract.edge_threshold=8],pycolmap"
    names = table.split_methods(text)
    assert names == ["opencv-sift", "baseline[match.ratio=0.7,extract.edge_threshold=8]", "pycolmap"]
    for name in names:
        table.method(name)
    with pytest.raises(ConfigError, match="ratio"):
        table.method("baseline[match.ratoi=0.7]")
    with pytest.raises(ConfigError, match="no settings"):
        table.method("pycolmap[x=1]")


def candidates(hard: int, easy: int) -> list[Any]:
    """Pairs whose angles run through all classes: hard ones from 30 degrees on, easy ones below."""
    angles = [("hard", 30.0 + 50.0 * i / hard) for i in range(hard)] + [("easy", 29.0 * i / easy) for i in range(easy)]
    return [
        scenes.JudgedPair((f"{i:03}", "x"), kind, Conditions(angle, 0.5, 0.0, 0.1))
        for i, (kind, angle) in enumerate(angles)
    ]


@pytest.mark.parametrize(
    ("hard", "easy", "expected"), [(60, 60, (6, 6)), (60, 2, (10, 2)), (3, 60, (3, 9)), (2, 2, (2, 2))]
)
def test_pairs_are_spread_and_filled_up(hard: int, easy: int, expected: tuple[int, int]) -> None:
    selection = scenes.Selection("all", 12, 0)
    pool = candidates(hard, easy)
    pairs = scenes.chosen(pool, selection, np.random.default_rng(0))
    kinds = [pair.condition for pair in pairs]
    assert (kinds.count("hard"), kinds.count("easy")) == expected
    assert len({pair.images for pair in pairs}) == len(pairs)
    if (hard, easy) == (60, 60):
        classes = [pair.conditions.view_angle_class for pair in pairs]
        assert set(classes) == {"0-20", "20-40", "40-60", ">60"}
    assert pairs == scenes.chosen(pool, selection, np.random.default_rng(0))
    if len(pool) > 12:
        assert pairs != scenes.chosen(pool, selection, np.random.default_rng(1))


def test_a_summary_worked_by_hand() -> None:
    common = {"possible": 100, "coverage": 0.5, "peak_mb": 100.0}
    good = {**common, "correct": 40, "kept": 50, "median_error_px": 0.5, "seconds": 1.0}
    none = {**common, "correct": 0, "kept": 0, "median_error_px": None, "seconds": 3.0}
    good |= {"rotation_error_deg": 1.0, "translation_error_deg": 2.5}
    none |= {"rotation_error_deg": None, "translation_error_deg": None}
    # One of two pairs with an error of 2.5 degrees: a triangle up to 2.5, then half; the other never.
    auc5, auc10 = (2.5 * 0.5 / 2 + 2.5 * 0.5) / 5, (2.5 * 0.5 / 2 + 7.5 * 0.5) / 10
    expected = ["2", "40", "50", "80.0 %", "20.0 %", "50 %", "0.50", "0.500"]
    expected += [f"{auc5:.2f}", f"{auc10:.2f}", "2.00", "100"]
    assert [str(cell([good, none])) for _, cell in results.COLUMNS] == expected


def test_nearest_neighbours_of_the_peers_are_exact() -> None:
    rng = np.random.default_rng(0)
    first = rng.integers(0, 40, (600, 8)).astype(np.float32)
    second = (first[rng.permutation(600)[:500]] + rng.integers(-4, 5, (500, 8))).astype(np.float32)
    distances = np.linalg.norm(first[:, None] - second[None], axis=2)
    ordered = np.sort(distances, axis=1)
    for ratio in (None, 0.8):
        wanted = set()
        for row, column in enumerate(distances.argmin(axis=1)):
            passes = ratio is None or ordered[row, 0] < ratio * ordered[row, 1]
            if passes and distances[:, column].argmin() == row:
                wanted.add((row, int(column)))
        rows, columns, scores = matching.mutual_nearest(first, second, ratio)
        assert set(zip(rows.tolist(), columns.tolist(), strict=True)) == wanted
        np.testing.assert_allclose(1 - scores, ordered[rows, 0] / ordered[rows, 1], atol=1e-5)
