"""scripts/bench same: two workspaces are compared by the arrays of their verified matches, and by nothing else."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import __main__ as launcher
from benchmarks import same


def write(workspace: Path, **changes: Any) -> Path:
    """Two pairs of image a: with b three matches of keypoints, with c one measured point."""
    arrays = {
        "image_id1": np.array(["b", "c"]), "fingerprint": np.array(["0", "1"]), "offsets": np.array([0, 3, 4]),
        "indices": np.array([[0, 1], [1, 0], [2, 2], [-1, -1]], np.int32), "scores": np.ones(4, np.float32),
        "points0_px": np.full((4, 2), 7.0), "points1_px": np.full((4, 2), 8.0), "errors_px": np.zeros(4, np.float32),
        "state": np.array(["verified", "rejected"]), "reason": np.array(["", "few"]),
        "model_kind": np.array(["E", ""]), "models": np.zeros((2, 3, 3)), "rotations": np.full((2, 3, 3), np.nan),
        "matches_in": np.array([5, 6]), "rejected": np.array(["{}", "{}"]),
    } | changes  # fmt: skip
    (workspace / "verified").mkdir(parents=True)
    np.savez(workspace / "verified" / "a.npz", **arrays)
    (workspace / "features").mkdir()
    for number, image_id in enumerate("abc"):
        np.savez(workspace / "features" / f"{image_id}.npz", keypoints_px=np.arange(6.0).reshape(3, 2) + number)
    return workspace


def compared(first: Path, second: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, list[str]]:
    code = launcher.main(["same", str(first), str(second)])
    return code, capsys.readouterr().out.splitlines()


def test_equal_arrays_are_the_same_whatever_fingerprints_and_reasons_say(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = write(tmp_path / "one")
    second = write(
        tmp_path / "two", fingerprint=np.array(["x", "y"]), reason=np.array(["", "too few"]),
        rejected=np.array(['{"colour": 1}', "{}"]), state=np.array(["verified", "rejected"], "U20"),
    )  # fmt: skip
    code, lines = compared(first, second, capsys)
    assert (code, lines[-1]) == (0, "the same")
    heads = [line.partition(": ")[2] for line in lines[:2]]
    assert heads[0] == heads[1]
    assert heads[0].startswith("2 pairs, 4 matches, SHA-256 ")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"scores": np.array([1, 1, 0.5, 1], np.float32)}, "a b: scores"),
        ({"indices": np.array([[0, 1], [1, 0], [2, 1], [-1, -1]], np.int32)}, "a b: indices, points1_px"),
        ({"points0_px": np.full((4, 2), 7.5)}, "a c: points0_px"),
        ({"state": np.array(["verified", "verified"])}, "a c: state"),
        ({"image_id1": np.array(["b", "d"])}, "a c: only in the first"),
    ],
)
def test_what_differs_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, Any], said: str
) -> None:
    code, lines = compared(write(tmp_path / "one"), write(tmp_path / "two", **changes), capsys)
    assert code == 1
    assert f"  {said}" in lines
    hashes = [line.rpartition(" ")[2] for line in lines[:2]]
    assert hashes[0] != hashes[1]


def test_keypoints_count_by_where_they_lie(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = write(tmp_path / "one"), write(tmp_path / "two")
    np.savez(second / "features" / "b.npz", keypoints_px=np.zeros((3, 2)))
    code, lines = compared(first, second, capsys)
    assert code == 1
    assert lines[-1] == "  a b: points1_px"


def test_measured_points_are_taken_where_there_is_no_keypoint(tmp_path: Path) -> None:
    pairs = dict(same.read_pairs(write(tmp_path / "one")))
    assert pairs["a", "c"]["points0_px"].tolist() == [[7.0, 7.0]]
    assert pairs["a", "b"]["points1_px"].tolist() == [[3.0, 4.0], [1.0, 2.0], [5.0, 6.0]]


def test_a_folder_without_verified_matches_and_an_unknown_name_are_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = write(tmp_path / "one")
    shutil.rmtree(first / "verified")
    assert launcher.main(["same", str(first), str(first)]) == 2
    assert "has no verified matches" in capsys.readouterr().err
    assert launcher.main(["sane"]) == 2
    assert "knows no 'sane'" in capsys.readouterr().err
    for arguments in ([], ["--help"]):
        assert launcher.main(arguments) == 0
        assert "  same " in capsys.readouterr().out
