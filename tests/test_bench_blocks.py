"""scripts/bench blocks: pairs across series, matches counted by hand, a small run of its sections."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import __main__
from benchmarks.blocks import cases, tables
from benchmarks.peers.table import check_method

from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.data import Block, Camera, Image, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa

pytestmark = pytest.mark.slow

# 100 m above ground this camera sees 100 m x 80 m.
CAMERA = Camera("PINHOLE", 1000, 800, (1000.0, 1000.0, 499.5, 399.5))
NADIR = from_omega_phi_kappa(0.0, 0.0, 0.0)


def test_series_are_cut_at_the_largest_factor() -> None:
    levels = {"a": 110.0, "b": 60.0, "c": 150.0, "d": 52.0, "e": 0.0}
    assert cases.two_series({k: v for k, v in levels.items() if k != "e"}) == ({"b", "d"}, {"a", "c"})
    assert cases.two_series(levels)[0] == {"e"}  # a black frame is a series of its own


def test_pairs_across_share_a_fifth_of_the_smaller_footprint() -> None:
    places = {"dark0": 0.0, "dark1": 10.0, "lit0": 79.0, "lit1": 81.0, "lit2": 95.0}
    images = tuple(Image(name, f"{name}.jpg", 1000, 800, "cam") for name in sorted(places))
    poses = {name: Pose(np.array([x, 0.0, 100.0]), NADIR, 1.0, 1.0) for name, x in places.items()}
    block = Block(images, {"cam": CAMERA}, poses, "local", (0.0, 0.0, 0.0), ConstantGround(0.0), "given", 0.1)
    two = ({"dark0.jpg", "dark1.jpg"}, {"lit0.jpg", "lit1.jpg", "lit2.jpg"})
    # 79 m apart share 21 m of 100 m, 81 m only 19 m; dark1 is 10 m farther, so 71 m and 85 m; pairs within a series go.
    assert cases.pairs_across(block, two) == [
        ("dark0.jpg", "lit0.jpg"), ("dark1.jpg", "lit0.jpg"), ("dark1.jpg", "lit1.jpg"),
    ]  # fmt: skip


def write_reference(folder: Path) -> None:
    """Two images 40 m apart, looking straight down from 100 m: epipolar lines are rows."""
    folder.mkdir()
    (folder / "poses.csv").write_text(
        "image,x,y,z,omega_deg,phi_deg,kappa_deg\na.jpg,0,0,100,0,0,0\nb.jpg,40,0,100,0,0,0\n", encoding="utf-8"
    )
    lens = {"model": "PINHOLE", "width": 1000, "height": 800, "params": [1000, 1000, 500, 400]}
    facts = {"crs": "local", "cameras": {"1": lens}, "ground_z": {"p50": 0.0}}
    (folder / "block.json").write_text(json.dumps(facts), encoding="utf-8")


def write_database(path: Path, keypoints0: Any, keypoints1: Any, matches: Any) -> None:
    """The tables of a COLMAP database that counting reads; its keypoints have the corner origin."""
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE images (image_id, name)")
        connection.execute("CREATE TABLE keypoints (image_id, rows, cols, data)")
        connection.execute("CREATE TABLE two_view_geometries (pair_id, rows, data)")
        for image_id, (name, places) in enumerate((("a.jpg", keypoints0), ("b.jpg", keypoints1)), 1):
            data = np.asarray(places, np.float32) + 0.5
            connection.execute("INSERT INTO images VALUES (?, ?)", (image_id, name))
            connection.execute("INSERT INTO keypoints VALUES (?, ?, 2, ?)", (image_id, len(data), data.tobytes()))
        rows = np.asarray(matches, np.uint32)
        connection.execute(
            "INSERT INTO two_view_geometries VALUES (?, ?, ?)", (2147483647 + 2, len(rows), rows.tobytes())
        )


def test_matches_are_counted_within_3_and_5_px_once_a_place_and_thinned(tmp_path: Path) -> None:
    write_reference(tmp_path / "reference")
    x = 500.0 + 20.0 * np.arange(20)
    places0 = np.column_stack([x, np.full(20, 300.0)])
    places1 = places0 - (400.0, 0.0)
    places1[:5, 1] += 4.0  # 4 px off their rows
    places1[5:7, 1] += 20.0
    places0, places1 = np.vstack([places0, places0[19:] + 1.0]), np.vstack([places1, places1[19:] + 1.0])
    matches = [(i, i) for i in range(21)] + [(0, 0)]  # the last place is 1.4 px from another, the first comes twice
    write_database(tmp_path / "database.db", places0, places1, matches)
    found = cases.count_matches(tmp_path / "database.db", tmp_path / "reference")
    assert (found["pairs"], found["matches"], found["unique_matches"]) == (1, 22, 21)
    assert (found["within_3px"], found["within_5px"]) == (14, 19)
    assert (found["thinned"], found["thinned_3px"], found["thinned_5px"]) == (20, 13, 18)
    assert (found["keypoints_mean"], found["keypoints_max"]) == (21.0, 21)
    none = cases.count_matches(tmp_path / "database.db", tmp_path / "reference", {("a.jpg", "c.jpg")})
    assert none["pairs"] == none["matches"] == 0


def test_factors_are_against_the_first_method_of_a_block() -> None:
    counted = {"pairs": 3, "matches": 500, "within_3px": 300, "within_5px": 400, "thinned": 200, "thinned_3px": 100}
    first = counted | {"block": "x", "method": "pycolmap", "asked_pairs": 4, "unique_matches": 400, "seconds": None}
    first |= {"thinned_5px": 150}
    second = first | {"method": "baseline", "pairs": 4, "unique_matches": 900, "thinned": 500, "seconds": 8.0}
    lines = tables.cross_table([first, second]).splitlines()
    assert lines[2].startswith(
        "| x | `pycolmap` | 4 | 3 | 75 % | 100 | 1.00 x | 75.0 % | 100.0 % | 50 | 1.00 x | 50.0 %"
    )
    assert lines[3].startswith("| x | `baseline` | 4 | 4 | 100 % | 225 | 2.25 x | 33.3 % | 44.4 % | 125 | 2.50 x |")
    assert lines[3].endswith("| 8.0 |")


def test_speed_is_a_rate_with_the_share_of_every_stage() -> None:
    head = {"block": "x", "images": 5, "pairs": 6, "thinned_3px": 900}
    peer = head | {"method": "pycolmap", "seconds": 30.0, "tried_pairs": 10}
    peer |= {"stages": {"extract": 24.0, "match+verify": 6.0}}
    mine = head | {"method": "baseline", "seconds": 20.0, "tried_pairs": 8}
    mine |= {"stages": {"orient": 1.0, "pairs": 1.0, "extract": 4.0, "match": 6.0, "filter": 5.0, "export": 3.0}}
    first, second = tables.speed_table([peer, mine]).splitlines()[2:]
    figures = "| 5 | 30.0 | 1.00 x | 10 | 20 | 6 | 12 | 900 | 1800 |"
    assert first == f"| x | `pycolmap` {figures} 0 % | 0 % | 80 % | 20 % | 0 % | 0 % | 0 % |"
    figures = "| 5 | 20.0 | 0.67 x | 8 | 24 | 6 | 18 | 900 | 2700 |"
    assert second == f"| x | `baseline` {figures} 5 % | 5 % | 20 % | 30 % | 25 % | 0 % | 15 % |"


def test_methods_are_checked_before_anything_runs(tmp_path: Path) -> None:
    for spec in ("pycolmap-uncut-guided", "baseline[match.ratio=0.7]"):
        check_method(spec, cases.COLMAP)
    for wrong in ("colmap", "pycolmap-twice", "baseline[match.ratoi=0.7]"):
        with pytest.raises(ConfigError):
            check_method(wrong, cases.COLMAP)
    assert bench(tmp_path, "easy", "opencv-surf") == 2


def bench(data: Path, section: str, methods: str) -> int:
    """In this process; the steps have their own."""
    asked = ["blocks", section, "--data", str(data), "--blocks", "small", "--thin", "1", "--quick"]
    asked += ["--keypoints", "300", "--jobs", "1", "--no-mapping", "--methods", methods, "--out", str(data / "out")]
    return __main__.main(asked)


def test_a_small_block_runs_and_is_not_run_again(
    rendered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "small" / "reference").mkdir(parents=True)
    (tmp_path / "small" / "images").symlink_to(rendered / "images")
    for name in ("poses.csv", "block.json"):
        (tmp_path / "small" / "reference" / name).symlink_to(rendered / name)
    methods = "all=baseline[pairs=exhaustive],pycolmap-guided"
    assert bench(tmp_path, "blocks", methods) == 0
    rows = json.loads((tmp_path / "out" / "blocks.json").read_text(encoding="utf-8"))
    assert [row["method"] for row in rows] == ["all", "pycolmap-guided"]
    for row in rows:
        assert row["images"] == 5
        assert row["pairs"] >= 5
        assert row["within_3px"] > 0.8 * row["unique_matches"] > 30
        assert row["seconds"] > 0
        assert row["keypoints_max"] <= 300
    first = capsys.readouterr().out
    assert f"| small | 1 | `all` | reference | {rows[0]['keypoints_mean']:.0f} |" in first
    monkeypatch.setattr("benchmarks.blocks.cases.run_step", None)  # nothing is left to run
    assert bench(tmp_path, "blocks", methods) == 0
    assert capsys.readouterr().out == first
