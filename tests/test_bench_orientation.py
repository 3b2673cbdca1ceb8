"""bench orientation: what each case makes worse, and how attitudes are compared."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks.orientation.cases import ANGLES, NOISE_DEG, NOISE_SHARE, worsened
from benchmarks.orientation.figures import most_alike, turned_errors
from scipy.spatial.transform import Rotation

NAMES = [f"i{n:02d}.jpg" for n in range(40)]
HEIGHT_M = 100.0


@pytest.fixture
def reference(tmp_path: Path) -> Path:
    """Forty images in a row, 100 m above the ground at 20 m."""
    with (tmp_path / "poses.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["image", "x", "y", "z", *ANGLES])
        writer.writerows([name, 10.0 * n, 5.0, 20.0 + HEIGHT_M, 1.0, 2.0, 30.0] for n, name in enumerate(NAMES))
    lens = {"model": "SIMPLE_RADIAL", "width": 800, "height": 600, "params": [700.0, 400.0, 300.0, 0.0]}
    block = {"crs": "EPSG:32633", "ground_z": {"p50": 20.0}, "cameras": {"1": lens}}
    (tmp_path / "block.json").write_text(json.dumps(block))
    return tmp_path


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "poses.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_noisy_poses_have_the_noise_that_is_said(reference: Path, tmp_path: Path) -> None:
    extra, wrong = worsened("noisy", reference, NAMES, tmp_path / "noisy")
    assert (wrong, extra[-2:]) == (set(), ["--crs", "EPSG:32633"])
    rows = rows_of(tmp_path / "noisy")
    off_m = np.array(
        [[float(r["x"]) - 10.0 * n, float(r["y"]) - 5.0, float(r["z"]) - 120.0] for n, r in enumerate(rows)]
    )
    assert off_m.std() == pytest.approx(NOISE_SHARE * HEIGHT_M, rel=0.15)
    off_deg = np.array([[float(r[key]) for key in ANGLES] for r in rows]) - [1.0, 2.0, 30.0]
    assert off_deg.std() == pytest.approx(NOISE_DEG, rel=0.15)
    extra, _ = worsened("unoriented", reference, NAMES, tmp_path / "unoriented")
    assert rows_of(tmp_path / "unoriented") == rows
    assert extra[-3:] == ["--set=orient=none", "--ground", "20.0"]


@pytest.mark.parametrize(("case", "count"), [("third", 14), ("yaw", 40), ("columns", 40), ("noise", 0), ("longer", 0)])
def test_a_case_names_whose_attitude_it_makes_wrong(reference: Path, tmp_path: Path, case: str, count: int) -> None:
    _, wrong = worsened(case, reference, NAMES, tmp_path / case)
    assert len(wrong) == count


def test_attitudes_are_compared_after_a_common_turn() -> None:
    rng = np.random.default_rng(1)
    truth = {name: Rotation.random(random_state=n).as_matrix() for n, name in enumerate(NAMES)}
    turn = Rotation.from_euler("y", 12.0, degrees=True).as_matrix()
    found = {name: rotation @ turn for name, rotation in truth.items()}
    errors, whole_deg = turned_errors(found, truth)
    np.testing.assert_allclose(errors, 0.0, atol=1e-5)
    assert whole_deg == pytest.approx(12.0)
    off = NAMES[3]
    found[off] = Rotation.from_rotvec(np.deg2rad(5.0) * np.eye(3)[rng.integers(3)]).as_matrix() @ found[off]
    errors, _ = turned_errors(found, truth)
    assert errors.max() == pytest.approx(5.0, abs=0.2)
    assert np.median(errors) < 0.2
    assert len(turned_errors({}, truth)[0]) == 0


def test_images_in_the_wrong_place_are_not_right() -> None:
    truth = {name: Rotation.random(random_state=n).as_matrix() for n, name in enumerate(NAMES)}
    turn = Rotation.from_euler("y", 40.0, degrees=True).as_matrix()
    away = Rotation.from_euler("x", 30.0, degrees=True).as_matrix()
    found = {name: rotation @ (away if n >= 30 else turn) for n, (name, rotation) in enumerate(truth.items())}
    assert most_alike(found, truth, 3.0) == 30
    assert most_alike({}, truth, 3.0) == 0
