"""A pose list against the GPS of the images: exchanged columns, zones, lines of other images, other flights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from make_images import write_dji
from read_inputs import read_inputs

from aeromatch_cli.blocks.crs import grid_from_geographic
from aeromatch_cli.blocks.read import BlockInputs

IMAGES = 6
# Two strips of three images, some 50 m apart, in UTM zone 33 near its western border.
LATITUDES = 48.0 + np.array([0.0, 0.0005, 0.0010, 0.0010, 0.0005, 0.0])
LONGITUDES = 12.2 + np.array([0.0, 0.0, 0.0, 0.0008, 0.0008, 0.0008])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number in range(IMAGES):
        write_dji(tmp_path / "images" / f"{number}.jpg", LATITUDES[number], LONGITUDES[number], 300.0)
    return tmp_path


def read(folder: Path, columns: str, first: np.ndarray, second: np.ndarray, crs: str = "auto") -> BlockInputs:
    lines = [f"image,{columns}", *(f"{n}.jpg,{first[n]!r},{second[n]!r},300" for n in range(IMAGES))]
    path = folder / "list.csv"
    path.write_text("\n".join(lines).replace("np.float64(", "").replace(")", "") + "\n")
    return read_inputs(folder / "images", poses=str(path), crs=crs)


def grid(code: str) -> np.ndarray:
    return grid_from_geographic(code, LATITUDES, LONGITUDES)


def remarks(inputs: BlockInputs) -> list[str]:
    return [warning for warning in inputs.warnings if warning.startswith("pose list")]


def test_a_list_that_agrees_is_not_questioned(folder: Path) -> None:
    noise = np.random.default_rng(0).normal(0.0, 5e-5, IMAGES)
    assert remarks(read(folder, "lat,lon,alt", LATITUDES + noise, LONGITUDES)) == []
    xy = grid("EPSG:32633")
    assert remarks(read(folder, "x,y,z", *xy.T, crs="EPSG:32633")) == []


def test_heights_of_another_zero_are_said(folder: Path) -> None:
    """The pictures say 300 m; as above the ground the list says 60, as above sea level 255."""
    lines = "\n".join(f"{n}.jpg,{LATITUDES[n]:.7f},{LONGITUDES[n]:.7f},HEIGHT" for n in range(IMAGES))
    said = {}
    for height_m in ("60", "255", "700"):
        (folder / "list.csv").write_text("image,lat,lon,alt\n" + lines.replace("HEIGHT", height_m))
        said[height_m] = remarks(read_inputs(folder / "images", poses=str(folder / "list.csv")))
    assert said["255"] == []
    assert "heights are 240 m below those of the GPS" in said["60"][0]
    assert "heights are 400 m above those of the GPS" in said["700"][0]


def test_exchanged_latitudes_and_longitudes_are_put_right(folder: Path) -> None:
    right = read(folder, "lat,lon,alt", LATITUDES, LONGITUDES)
    swapped = read(folder, "lat,lon,alt", LONGITUDES, LATITUDES)
    assert "lat and lon are exchanged" in remarks(swapped)[0]
    assert swapped.crs == right.crs == "EPSG:32633"
    for image_id, pose in right.poses.items():
        np.testing.assert_allclose(swapped.poses[image_id].center_m, pose.center_m, atol=1e-6)


def test_exchanged_x_and_y_are_put_right(folder: Path) -> None:
    xy = grid("EPSG:32633")
    right = read(folder, "x,y,z", *xy.T, crs="EPSG:32633")
    swapped = read(folder, "x,y,z", *xy.T[::-1], crs="EPSG:32633")
    assert "x and y are exchanged" in remarks(swapped)[0]
    for image_id, pose in right.poses.items():
        np.testing.assert_allclose(swapped.poses[image_id].center_m, pose.center_m, atol=1e-6)


def test_a_wrong_zone_is_named_with_the_right_one(folder: Path) -> None:
    found = remarks(read(folder, "x,y,z", *grid("EPSG:32632").T, crs="EPSG:32633"))
    assert len(found) == 1
    assert "x and y fit EPSG:32632; give --crs EPSG:32632" in found[0]


def test_the_zone_of_a_list_without_crs_is_named(folder: Path) -> None:
    found = remarks(read(folder, "x,y,z", *grid("EPSG:32633").T))
    assert len(found) == 1
    assert found[0].endswith("by the GPS of the images, x and y are EPSG:32633: give --crs EPSG:32633")
    assert remarks(read(folder, "x,y,z", *(grid("EPSG:32633") - grid("EPSG:32633")[0]).T)) == []


def test_lines_of_other_images_are_named(folder: Path) -> None:
    order = [3, 4, 5, 0, 1, 2]
    found = remarks(read(folder, "lat,lon,alt", LATITUDES[order], LONGITUDES[order]))
    assert len(found) == 1
    assert "lines look like those of other images" in found[0]


def test_another_flight_is_named(folder: Path) -> None:
    found = remarks(read(folder, "lat,lon,alt", LATITUDES + 0.1, LONGITUDES))
    assert "11.1 km apart: is it the list of another flight" in found[0]
