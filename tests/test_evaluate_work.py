"""evaluate on whole workspaces: figures, files, and what is refused."""

from __future__ import annotations

import csv
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import HEIGHT, IMAGES, WIDTH

from aeromatch_cli.errors import ConfigError, InputError
from aeromatch_cli.evaluate import evaluate_workspace
from aeromatch_cli.evaluate.mapping import map_database
from aeromatch_cli.evaluate.output import condition_rows, facts, lines, summary_rows, write_evaluation
from aeromatch_cli.evaluate.totals import total
from aeromatch_cli.evaluate.work import Evaluation
from aeromatch_cli.files import digests, read_json, write_json
from aeromatch_cli.formats.features import features_fingerprint, read_features, write_features
from aeromatch_cli.formats.rows import read_verified_row, write_verified_row
from aeromatch_cli.lab.opening import open_truth

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def work(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace of its own, which evaluations may write into."""
    copy = tmp_path_factory.mktemp("evaluated") / "work"
    shutil.copytree(finished / "work", copy)
    return copy


def judged(work: Path, truth: Path, *, mapping: bool = True) -> Evaluation:
    return evaluate_workspace(work, truth, open_truth, mapping=mapping)


@pytest.fixture(scope="module")
def evaluation(work: Path, rendered: Path) -> Evaluation:
    return judged(work, rendered)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_finished_run_is_nearly_all_correct(evaluation: Evaluation) -> None:
    figures = total(evaluation.pairs)
    assert figures["pairs_verified"] >= 4
    assert figures["kept"] > 100
    assert figures["correctness"] > 0.9
    assert 0.0 < figures["recall"] <= 1.0
    assert figures["median_error_px"] < 1.0
    assert figures["rotation_error_deg"] < 2.0
    for row in evaluation.pairs:
        assert row.state == "verified" or (row.score.kept == 0 and row.conditions.overlap >= 0.2)
        assert row.score.possible > 0
    assert 2 <= evaluation.consumer["registered"] <= IMAGES
    assert evaluation.consumer["reprojection_error_px"] < 1.0


def test_shifted_keypoints_are_nearly_all_wrong(work: Path, rendered: Path, tmp_path: Path) -> None:
    copy = tmp_path / "work"
    shutil.copytree(work, copy)
    shutil.rmtree(copy / "refined")  # where it is, its places count
    path = sorted((copy / "features").iterdir())[0]
    features, same = read_features(path), str(features_fingerprint(path))
    with path.open("wb") as stream:
        write_features(stream, replace(features, keypoints_px=features.keypoints_px + np.float32(12.0)), same)
    found = judged(copy, rendered, mapping=False)
    name = next(row["name"] for row in rows(copy / "images.csv") if row["image_id"] == path.stem)
    moved = [row for row in found.pairs if name in (row.name0, row.name1)]
    assert sum(row.score.kept for row in moved) > 50
    assert total(moved)["correctness"] < 0.05
    assert total(moved)["median_error_px"] > 10
    assert found.consumer == {"skipped": "not asked for"}


def test_pairs_that_were_rejected_or_never_tried_count_as_found_nothing(
    work: Path, rendered: Path, tmp_path: Path, evaluation: Evaluation
) -> None:
    copy = tmp_path / "work"
    shutil.copytree(work, copy)
    path = max((copy / "verified").iterdir(), key=lambda p: len(read_verified_row(p)))
    entries = list(read_verified_row(path).values())
    assert len(entries) >= 2
    entries[0] = replace(entries[0], verdict=replace(entries[0].verdict, state="rejected"))
    with path.open("wb") as stream:
        write_verified_row(stream, entries[:1])
    found = judged(copy, rendered, mapping=False)
    before = {(row.name0, row.name1): row for row in evaluation.pairs}
    after = {(row.name0, row.name1): row for row in found.pairs}
    changed = [key for key in before if key not in after or after[key].state != before[key].state]
    assert len(changed) == len(entries)
    for key in set(changed) & set(after):
        assert after[key].state in ("rejected", "not tried")
        assert after[key].score.kept == 0
        assert after[key].score.possible == before[key].score.possible
    assert total(found.pairs)["recall"] < total(evaluation.pairs)["recall"]


def test_files_hold_what_was_found(work: Path, evaluation: Evaluation) -> None:
    written = write_evaluation(evaluation)
    assert {path.name for path in written} == {
        "evaluation.json", "pairs.csv", "conditions.csv", "errors.png", "view_angles.png", "coverage.png",
    }  # fmt: skip
    folder = work / "evaluation"
    found = read_json(folder / "evaluation.json")
    assert found == json.loads(json.dumps(facts(evaluation)))
    assert found["totals"]["correct"] == sum(row.score.correct for row in evaluation.pairs)
    pairs = rows(folder / "pairs.csv")
    assert len(pairs) == len(evaluation.pairs)
    assert sum(int(row["kept"]) for row in pairs) == found["totals"]["kept"]
    assert {row["texture_class"] for row in pairs} <= {"poor", "medium", "rich"}
    angles = [row for row in rows(folder / "conditions.csv") if row["condition"] == "view angle"]
    assert sum(int(row["pairs"]) for row in angles) == len(pairs)
    for path in written[3:]:
        assert cv2.imread(str(path)).std() > 5
    again = {path: path.read_bytes() for path in written}
    write_evaluation(evaluation)
    assert {path: path.read_bytes() for path in written} == again
    shown = dict(summary_rows(evaluation))
    hidden, unseen = (sum(getattr(row.score, name) for row in evaluation.pairs) for name in ("hidden", "unseen"))
    assert shown["hidden, unseen"].startswith(f"{hidden}, {unseen} (wrong: on a surface that the other image does not")
    assert shown["mapping"] == f"{evaluation.consumer['registered']} of {IMAGES} images in one model"
    assert shown["pairs with 30 correct"] == str(found["totals"]["pairs_with_30_correct"])
    assert len({len(row) for row in condition_rows(evaluation)}) == 1
    table = lines(evaluation)[len(shown) + 1 :]
    assert len({len(line) for line in table}) == 1  # columns stand below each other
    assert table[0].split()[:3] == ["condition", "class", "pairs"]


def test_a_workspace_judged_by_poses_alone(work: Path, rendered: Path, tmp_path: Path, evaluation: Evaluation) -> None:
    """The exact poses of a rendered block, taken as reference poses of a real one."""
    for name in ("poses.csv", "block.json"):
        shutil.copy(rendered / name, tmp_path / name)
    found = judged(work, tmp_path, mapping=False)
    figures = total(found.pairs)
    assert found.truth_kind == "reference"
    assert figures["correctness"] >= total(evaluation.pairs)["correctness"]
    assert np.isnan(figures["recall"])
    assert facts(found)["totals"]["recall"] is None
    assert dict(summary_rows(found))["recall"] == "- of - possible"
    # An image without reference pose is left out, and said so.
    *listed, last = (tmp_path / "poses.csv").read_text().splitlines()
    (tmp_path / "poses.csv").write_text("\n".join(listed) + "\n")
    without = judged(work, tmp_path, mapping=False)
    assert without.left_out == (last.split(",")[0],)
    assert dict(summary_rows(without))["truth"] == f"reference, {IMAGES - 1} images (1 left out: no reference pose)"
    # Mapping takes it all the same.
    mapped = dict(summary_rows(replace(without, consumer=evaluation.consumer)))
    assert mapped["mapping"] == f"{evaluation.consumer['registered']} of {IMAGES} images in one model"


def test_an_export_of_earlier_matches_is_not_mapped(work: Path, rendered: Path, tmp_path: Path) -> None:
    shutil.copytree(work, tmp_path / "later")
    report = tmp_path / "later" / "reports" / "filter.json"
    later_s = report.stat().st_mtime + 3600.0
    os.utime(report, (later_s, later_s))
    consumer = judged(tmp_path / "later", rendered).consumer
    assert consumer == {"skipped": "the export is of earlier matches: run aeromatch export"}


def test_what_does_not_belong_together_is_refused(work: Path, rendered: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no workspace.*images\.csv"):
        judged(tmp_path, rendered)
    with pytest.raises(ConfigError, match="holds no truth"):
        judged(work, tmp_path)
    copy = tmp_path / "work"
    shutil.copytree(work, copy)
    name = rows(copy / "images.csv")[0]["name"]
    with pytest.raises(InputError, match=rf"1 of {IMAGES} images \(holiday\.jpg\) of the workspace is not"):
        judged(_with_images(copy, name, "holiday.jpg"), rendered)
    _with_images(copy, "holiday.jpg", name)
    with pytest.raises(InputError, match=rf"{2 * WIDTH}x{HEIGHT} px in the workspace and {WIDTH}x{HEIGHT} px"):
        judged(_with_images(copy, f",{WIDTH},{HEIGHT},", f",{2 * WIDTH},{HEIGHT},"), rendered)


def _with_images(work: Path, old: str, new: str) -> Path:
    """The workspace as a run over other images would have left it: the report of pairs vouches for its table."""
    table = work / "images.csv"
    table.write_text(table.read_text().replace(old, new))
    report = work / "reports" / "pairs.json"
    record = read_json(report)
    write_json(report, {**record, "files": digests(work, record["files"])})
    return work


def test_the_truth_of_another_block_of_the_same_names_is_refused(work: Path, rendered: Path, tmp_path: Path) -> None:
    shutil.copytree(rendered, tmp_path / "other")
    picture = sorted((tmp_path / "other" / "images").iterdir())[1]
    cv2.imwrite(str(picture), 255 - cv2.imread(str(picture)))
    assert judged(work, rendered, mapping=False).pairs
    with pytest.raises(InputError, match=rf"{picture.name} is not the picture"):
        judged(work, tmp_path / "other", mapping=False)


def test_a_workspace_that_lost_its_files_says_so(work: Path, rendered: Path, tmp_path: Path) -> None:
    shutil.copytree(work, tmp_path / "a", ignore=shutil.ignore_patterns("features"))
    with pytest.raises(InputError, match=r"features of .* are gone"):
        judged(tmp_path / "a", rendered, mapping=False)
    shutil.copytree(work, tmp_path / "b", ignore=shutil.ignore_patterns("verified"))
    with pytest.raises(InputError, match="has a verdict"):
        judged(tmp_path / "b", rendered, mapping=False)


def test_a_mapping_that_fails_says_so(tmp_path: Path) -> None:
    (tmp_path / "database.db").write_bytes(b"no database")
    assert "exit code" in map_database(tmp_path / "database.db", None)["skipped"]


def test_without_export_mapping_is_skipped_with_a_reason(work: Path, rendered: Path, tmp_path: Path) -> None:
    copy = tmp_path / "work"
    shutil.copytree(work, copy, ignore=shutil.ignore_patterns("export"))
    found = judged(copy, rendered)
    assert "aeromatch export" in found.consumer["skipped"]
    assert dict(summary_rows(found))["mapping"].startswith("skipped: ")
