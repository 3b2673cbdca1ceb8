"""A block of arbitrary scale is not described in metres."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import IMAGES, Site, invoke

from aeromatch_cli.blocks.plausibility import warnings_of
from aeromatch_cli.blocks.summary import summarise
from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Block, Image, Pose
from aeromatch_cli.formats.adjusted import orientation_text
from aeromatch_cli.geometry.cameras import from_colmap
from aeromatch_cli.geometry.frames import length_words
from aeromatch_cli.strategies.exporters.solution import write_world

CAMERA = from_colmap("PINHOLE", 800, 600, (700.0, 700.0, 400.0, 300.0))
STRAIGHT_DOWN = np.diag([1.0, -1.0, -1.0])
# A number with a unit of metres.
METRES = re.compile(r"\d (m|cm|km)\b|metre")


class Level:
    """Ground at height 0."""

    def height_m(self, xy_m: np.ndarray) -> np.ndarray:
        return np.zeros(len(xy_m))


def flown(*, metric: bool, height: float = 100.0) -> Block:
    """Three images; 3 units above ground is an odd height only in metres."""
    poses = {name: Pose(np.array([40.0 * k, 0.0, height]), STRAIGHT_DOWN, 0.5, 0.2) for k, name in enumerate("abc")}
    images = tuple(Image(name, f"{name}.jpg", 800, 600, "c") for name in poses)
    return Block(images, {"c": CAMERA}, poses, "local", (0.0, 0.0, 0.0), Level(), "terrain", 0.14, metric=metric)


def test_lengths_have_the_unit_of_their_frame() -> None:
    assert length_words(1234.56, metric=True) == "1,234.6 m"
    assert length_words(1234.56, metric=False) == "1,234.6 units"
    assert length_words(0.14, 3, metric=False) == "0.140 units"


def test_the_summary_has_metres_only_where_there_are_metres() -> None:
    known, unknown = (summarise(flown(metric=metric)) for metric in (True, False))
    assert "extent           80.0 m east-west, 0.0 m north-south" in known.lines()
    assert "flying height    100.0 m (100.0 to 100.0) above ground" in known.lines()
    assert "extent           80.0 units along x, 0.0 units along y" in unknown.lines()
    assert "flying height    100.0 units (100.0 to 100.0) above ground" in unknown.lines()
    assert "ground sampling  0.1429 units per pixel" in unknown.lines()
    said = [line for line in unknown.lines() if not line.startswith("scale ")]
    assert not [line for line in said if METRES.search(line)]


def test_figures_that_are_no_metres_are_null() -> None:
    figures = summarise(flown(metric=False)).figures()
    assert figures["metric"] is False
    assert [figures[key] for key in ("flying_height_m", "gsd_m", "extent_m")] == [None] * 3
    figures = summarise(flown(metric=True)).figures()
    assert figures["metric"] is True
    assert figures["gsd_m"] == pytest.approx(100.0 / 700.0)
    assert figures["extent_m"] == [80.0, 0.0]


def test_a_height_is_odd_in_metres_alone() -> None:
    assert any("flown 3.0 to 3.0 m above ground" in one for one in warnings_of(flown(metric=True, height=3.0)))
    assert not any("flown" in one for one in warnings_of(flown(metric=False, height=3.0)))


def test_the_table_of_poses_names_the_unit_of_each_line() -> None:
    block = flown(metric=True)
    nothing = np.full(3, 0.1)
    poses = {i: AdjustedPose(block.poses[i].center_m, STRAIGHT_DOWN, nothing, nothing) for i in "ab"}
    adjusted = replace(AdjustedBlock.empty(), cameras=block.cameras, poses=poses, frames={"b": 1})
    for metric, expected in ((True, ["m", "arbitrary", "m"]), (False, ["arbitrary"] * 3)):
        rows = list(csv.DictReader(orientation_text(adjusted, replace(block, metric=metric)).splitlines()))
        assert [row["unit"] for row in rows] == expected
        assert [bool(row["sigma_x_m"]) for row in rows] == [unit == "m" for unit in expected]
        assert all(row["sigma_omega_deg"] for row in rows)
        assert [row["frame"] for row in rows] == ["world", "own 1", "predicted"]
    moved = replace(block, origin_m=(500000.0, 0.0, 0.0))
    rows = list(csv.DictReader(orientation_text(adjusted, moved).splitlines()))
    shifts = [float(row["x"]) - block.poses[i].center_m[0] for i, row in zip("abc", rows, strict=True)]
    assert shifts == [500000.0, 0.0, 500000.0]


@pytest.mark.parametrize(("metric", "unit"), [(True, "m"), (False, "arbitrary")])
def test_the_world_of_an_export_names_its_unit(tmp_path: Path, metric: bool, unit: str) -> None:
    write_world(tmp_path, flown(metric=metric))
    assert json.loads((tmp_path / "world.json").read_text())["unit"] == unit


def lengths(facts: Any) -> set[str]:
    """Names of figures that are metres, wherever they stand."""
    if isinstance(facts, list):
        return set().union(*map(lengths, facts))
    if not isinstance(facts, dict):
        return set()
    own = {name for name, value in facts.items() if name.endswith("_m") and value is not None}
    return own.union(*map(lengths, facts.values()))


@pytest.mark.slow
def test_a_run_without_positions_says_no_metre(site: Site) -> None:
    outcome = site("run", "--poses", "none", "--ground", "auto")
    said = [line for line in outcome.stdout.splitlines() if not line.startswith(("scale ", "{"))]
    assert not [line for line in said if METRES.search(line)]
    stages = outcome.facts["stages"]
    assert stages["pairs"]["result"]["block"]["metric"] is False
    assert stages["pairs"]["result"]["block"]["gsd_m"] is None
    assert stages["adjust"]["result"]["images"] > 0
    assert stages["adjust"]["result"]["sigma_position_m"] is None
    assert lengths(stages) == {"origin_m"}  # of a frame that has none
    (group,) = stages["adjust"]["result"]["groups"]
    assert group["first_image"] == site.names()[0]
    assert 0.0 < group["heights"]["sigma"] / group["heights"]["pixel"] < 10.0
    oriented = stages["adjust"]["result"]["images"]
    assert f"images      {IMAGES}, 0 with position given; {oriented} oriented\n" in invoke("show", site.work).stdout
    shown = invoke("show", site.work, site.names()[0]).stdout
    assert "units of arbitrary length" in shown
    assert not METRES.search(shown)
