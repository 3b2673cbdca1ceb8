"""Matches of real blocks judged by reference poses, and which truth a folder holds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from aeromatch_cli.data import Camera
from aeromatch_cli.errors import ConfigError, InputError
from aeromatch_cli.evaluate import ReferenceTruth
from aeromatch_cli.lab.opening import open_truth
from aeromatch_cli.lab.synthetic.stations import Exterior

CAMERA = Camera("SIMPLE_PINHOLE", 201, 201, (100.0, 100.0, 100.0))
EXTERIORS = {"a.jpg": (0.0, 0.0, 110.0, 0.0, 0.0, 0.0), "b.jpg": (60.0, 0.0, 110.0, 0.0, 0.0, 0.0)}


def make_reference() -> ReferenceTruth:
    """Two images side by side, 100 m above ground at z = 10: epipolar lines are rows."""
    poses = {name: Exterior(*numbers).pose() for name, numbers in EXTERIORS.items()}
    return ReferenceTruth(dict.fromkeys(poses, CAMERA), poses, 10.0)


def write_reference(folder: Path, **changes: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    lines = [",".join([name, *map(str, numbers)]) for name, numbers in EXTERIORS.items()]
    header = "image,x,y,z,omega_deg,phi_deg,kappa_deg"
    (folder / "poses.csv").write_text("\n".join([header, *lines]) + "\n")
    lens = {"model": "SIMPLE_PINHOLE", "width": 201, "height": 201, "params": [100.0, 100.5, 100.5]}
    facts = {"crs": "local", "cameras": {"1": lens}, "ground_z": {"p50": 10.0}} | changes
    (folder / "block.json").write_text(json.dumps({k: v for k, v in facts.items() if v is not None}))
    return folder


def test_shares_within_3_and_5_px_of_epipolar_lines() -> None:
    by = make_reference()
    points0 = np.column_stack([np.arange(70.0, 190.0, 10.0), np.full(12, 100.0)])
    points1 = points0 + np.column_stack([np.full(12, -60.0), [0, 0, 1, -2, 3, 3.1, 4, -5, 5.1, 6, 20, 0]])
    points1[-1, 0] += 15.0  # along the line: nobody sees it
    score = by.judge("a.jpg", "b.jpg", points0, points1, points0, points1, np.ones(12))
    assert (score.kept, score.correct, score.within_5px, score.unseen, score.hidden) == (12, 6, 9, 0, 0)
    np.testing.assert_allclose(sorted(score.errors_px), [0, 0, 0, 1, 2, 3, 3.1, 4, 5, 5.1, 6, 20], atol=1e-9)
    assert score.correctness == 0.5
    assert np.isnan(score.recall)
    assert np.isnan(score.possible)
    assert score.median_error_px == pytest.approx(3.05)
    assert score.coverage == 6 / 256
    assert score.rotation_error_deg < 10.0


def test_overlap_and_view_angle_come_from_the_ground_plane() -> None:
    found = make_reference().conditions("a.jpg", "b.jpg")
    assert found.overlap == 0.70
    assert found.view_angle_deg == pytest.approx(28.0, abs=3.0)
    assert found.shadow_class == found.texture_class == "unknown"


def test_rays_that_miss_the_ground_belong_to_no_overlap() -> None:
    level = Exterior(0.0, 0.0, 110.0, 90.0, 0.0, 0.0).pose()
    by = ReferenceTruth({"a": CAMERA, "b": CAMERA}, {"a": level, "b": level}, 10.0)
    # Every second pixel from 1; a ray (u, v, 1) of this level view meets the ground 1 / v heights away, seen up to 5.
    u, v = np.meshgrid(np.arange(-99, 100, 2) / 100.0, np.arange(-99, 100, 2) / 100.0)
    assert by.conditions("a", "b").overlap == (np.hypot(u, 1.0) <= 5.0 * v).mean()


def test_a_folder_with_reference_poses_or_its_parent_is_opened(tmp_path: Path) -> None:
    write_reference(tmp_path / "block" / "reference")
    (tmp_path / "block" / "images").mkdir()
    for folder in (tmp_path / "block", tmp_path / "block" / "reference"):
        truth = open_truth(folder)
        assert truth.kind == "reference"
        assert truth.cameras["b.jpg"] == CAMERA
        assert truth.images_folder == tmp_path / "block" / "images"
        assert truth.overlap_at_most("a.jpg", "b.jpg") == pytest.approx(0.7, abs=0.05)
    np.testing.assert_allclose(truth.errors("a.jpg", "b.jpg", np.array([[90.0, 50.0]]), np.array([[30.0, 52.0]])), 2.0)


def test_what_is_no_truth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds no truth"):
        open_truth(tmp_path)
    with pytest.raises(InputError, match="ground_z"):
        open_truth(write_reference(tmp_path / "flat", ground_z=None))
    lens = json.loads((write_reference(tmp_path / "ok") / "block.json").read_text())["cameras"]["1"]
    with pytest.raises(ConfigError, match="several cameras"):
        open_truth(write_reference(tmp_path / "two", cameras={"1": lens, "2": lens}))
    write_reference(tmp_path / "bare")
    (tmp_path / "bare" / "poses.csv").write_text("image,x,y,z\na.jpg,0,0,1\nb.jpg,0,0,2\n")
    with pytest.raises(InputError, match="0 images position and attitude"):
        open_truth(tmp_path / "bare")
