"""scripts/bench anchors: data sets as they are handed out, errors by hand, and a small run."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from benchmarks import __main__
from benchmarks.anchors.judge import error_px
from benchmarks.anchors.layouts import anchors_in

from aeromatch_cli.errors import InputError
from aeromatch_cli.files import read_json
from aeromatch_cli.geometry.frames import apply_homography

HOMOGRAPHY = np.array([[0.9, 0.1, 12.0], [-0.08, 0.95, 20.0], [1e-4, -5e-5, 1.0]])


def texture(side: int = 320) -> np.ndarray:
    """Smooth random blobs, (S, S, 3) uint8."""
    rng = np.random.default_rng(4)
    found = sum(
        cv2.resize(rng.uniform(-1.0, 1.0, (side // cell, side // cell)), (side, side), interpolation=cv2.INTER_CUBIC)
        for cell in (4, 8, 16, 32)
    )
    gray = np.clip(128.0 + 45.0 * np.asarray(found), 0, 255).astype(np.uint8)
    return np.dstack([gray] * 3)


def write_pair(first: Path, second: Path) -> None:
    for path in (first, second):
        path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(first), texture())
    cv2.imwrite(str(second), cv2.warpPerspective(texture(), HOMOGRAPHY, (320, 320), borderMode=cv2.BORDER_REFLECT))


def write_homogr(folder: Path) -> np.ndarray:
    """Nine points of the plane, the centre of the first pixel at (1, 1)."""
    write_pair(folder / "oneA.jpg", folder / "oneB.jpg")
    grid = np.stack(np.meshgrid([60.0, 160.0, 250.0], [60.0, 160.0, 250.0]), axis=-1).reshape(-1, 2)
    table = np.column_stack([grid, apply_homography(HOMOGRAPHY, grid)]) + 1.0
    lines = "\n".join(",".join(f"{value:.4f}" for value in row) for row in table)
    (folder / "one.csv").write_text(f"x0,y0,x1,y1\n{lines}\n", encoding="utf-8")
    return grid


def test_each_layout_is_read(tmp_path: Path) -> None:
    grid = write_homogr(tmp_path / "homogr")
    (one,) = anchors_in("homogr", tmp_path / "homogr")
    assert one.name == "one"
    np.testing.assert_allclose(one.truth((320, 320), (320, 320))[0], grid, atol=1e-3)
    np.testing.assert_allclose(one.truth((320, 320), (320, 320))[1], apply_homography(HOMOGRAPHY, grid), atol=1e-3)
    for n in (2, 4):
        write_pair(tmp_path / "hpatches" / "v_x" / "1.ppm", tmp_path / "hpatches" / "v_x" / f"{n}.ppm")
        np.savetxt(tmp_path / "hpatches" / "v_x" / f"H_1_{n}", HOMOGRAPHY)
    two, four = anchors_in("hpatches", tmp_path / "hpatches")
    assert (two.name, four.image1.name, four.image0.name) == ("v_x-2", "4.ppm", "1.ppm")
    places0, places1 = two.truth((320, 320), (320, 320))
    np.testing.assert_allclose(places1, apply_homography(HOMOGRAPHY, places0))
    assert 0 < len(places0) < 25  # some corners leave the picture
    write_pair(tmp_path / "evd" / "1" / "cafe.png", tmp_path / "evd" / "2" / "cafe.png")
    (tmp_path / "evd" / "h").mkdir()
    np.savetxt(tmp_path / "evd" / "h" / "cafe.txt", HOMOGRAPHY)
    (cafe,) = anchors_in("evd", tmp_path / "evd")
    np.testing.assert_allclose(cafe.homography, HOMOGRAPHY)
    write_pair(tmp_path / "wxbs" / "WGBS" / "kn" / "01.jpg", tmp_path / "wxbs" / "WGBS" / "kn" / "02.jpg")
    np.savetxt(tmp_path / "wxbs" / "WGBS" / "kn" / "corrs.txt", [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])
    (kn,) = anchors_in("wxbs", tmp_path / "wxbs")
    assert (kn.name, kn.planar) == ("WGBS-kn", False)
    assert kn.points1_px is not None
    assert kn.points1_px.tolist() == [[3.0, 4.0], [7.0, 8.0]]


def test_what_is_no_data_set_says_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no pair in the layout evd"):
        anchors_in("evd", tmp_path)
    write_homogr(tmp_path)
    (tmp_path / "oneB.jpg").unlink()
    with pytest.raises(InputError, match=r"oneB\.jpg is missing"):
        anchors_in("homogr", tmp_path)
    (tmp_path / "one.csv").write_text("x0,y0,x1,y1\n1,2,three,4\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"one\.csv is no table of numbers"):
        anchors_in("homogr", tmp_path)


def test_errors_are_distances_from_the_truth() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 800.0, (200, 2))
    there = apply_homography(HOMOGRAPHY, points)
    there[150:] = rng.uniform(0.0, 800.0, (50, 2))  # a quarter is wrong
    places = rng.uniform(0.0, 800.0, (10, 2))
    exact, explained = error_px(points, there, places, apply_homography(HOMOGRAPHY, places), planar=True)
    assert exact < 1e-3
    assert 150 <= explained < 160
    off, _ = error_px(points, there, places, apply_homography(HOMOGRAPHY, places) + np.array([3.0, 4.0]), planar=True)
    assert off == pytest.approx(5.0, abs=0.01)
    assert error_px(points[:7], there[:7], places, places, planar=True) == (float("inf"), 0)


def test_errors_of_scenes_in_depth_are_distances_from_epipolar_lines() -> None:
    """The second camera stands beside the first: epipolar lines are rows."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 800.0, (200, 2))
    there = points + np.column_stack([rng.uniform(5.0, 60.0, 200), np.zeros(200)])
    error, explained = error_px(points, there, points[:20], there[:20] + np.array([7.0, 2.0]), planar=False)
    assert explained == 200
    assert error == pytest.approx(2.0, abs=0.05)


@pytest.mark.slow
def test_a_run_solves_an_easy_pair_and_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_LOG_LEVEL"):
        monkeypatch.setenv(name, os.environ.get(name, ""))
    write_homogr(tmp_path / "data")
    asked = ["anchors", "--data", str(tmp_path / "data"), "--methods", "opencv-sift,baseline", "--keypoints", "500"]
    asked += ["--size", "240", "--out", str(tmp_path / "out")]
    assert __main__.main(asked) == 0
    rows = read_json(tmp_path / "out" / "rows.json")["rows"]
    assert [(row["method"], row["pair"]) for row in rows] == [("opencv-sift", "one"), ("baseline", "one")]
    for row in rows:
        assert row["error_px"] < 1.0
        assert row["explained"] > 50
    made = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("*.json") if len(path.stem) == 16}
    assert len(made) == 2
    assert __main__.main(asked) == 0
    assert {name: (tmp_path / "out" / name).stat().st_mtime_ns for name in made} == made
    assert "| `opencv-sift` | 1 | 1 | 1 |" in capsys.readouterr().out
