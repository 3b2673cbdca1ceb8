"""Heights above the ellipsoid beside heights above the geoid: transformed where both are stated and PROJ has the geoid,
else the constant difference is estimated, named and taken out. Truth: a geoid 45 m above the ellipsoid at Greenwich
that rises by 1 m in 10 degrees to the east."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio
from make_images import write_image
from make_results import filled
from read_inputs import read_inputs

from aeromatch_cli.blocks.control import read_control
from aeromatch_cli.blocks.crs import ELLIPSOID, checked_heights, converted_heights, grid_from_geographic, heights_of
from aeromatch_cli.blocks.ground import ConstantGround, DemGround, open_dem
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.blocks.read import GivenHeights
from aeromatch_cli.data import Image, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.results.adjustment import GroupResult
from aeromatch_cli.results.stages import AdjustResult, OrientResult
from aeromatch_cli.sfm.dem import Terrain
from aeromatch_cli.sfm.heights import shift_of_points_m, shift_to_control_m
from aeromatch_cli.sfm.quality.finding import QualityInput
from aeromatch_cli.sfm.quality.judgement import judged
from aeromatch_cli.stages.ground import judged_ground
from aeromatch_cli.stages.surveyed import height_remarks

LATITUDE, LONGITUDE = 48.0, 15.0
GEOID_M = 45.0 + LONGITUDE / 10.0
EGM96 = "EPSG:5773"


@pytest.fixture
def geoid(tmp_path: Path) -> Iterator[None]:
    """EGM96's grid where PROJ looks for it, with the geoid of the truth."""
    folder, before = tmp_path / "proj", pyproj.datadir.get_data_dir()
    folder.mkdir()
    grid = np.broadcast_to(45.0 + np.linspace(-180.0, 180.0, 361) / 10.0, (181, 361)).astype(np.float32)
    place = rasterio.Affine(1.0, 0.0, -180.5, 0.0, -1.0, 90.5)
    size: dict[str, Any] = {"height": 181, "width": 361, "count": 1, "dtype": "float32"}
    with rasterio.open(
        folder / "us_nga_egm96_15.tif", "w", driver="GTiff", crs="EPSG:4326", transform=place, **size
    ) as f:
        f.write(grid, 1)
        f.update_tags(AREA_OR_POINT="Point", TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL")
    pyproj.datadir.append_data_dir(str(folder))
    yield
    pyproj.datadir.set_data_dir(before)


def poses_file(folder: Path, comment: str = "") -> Path:
    write_image(folder / "images" / "a.jpg")
    path = folder / "poses.csv"
    path.write_text(f"{comment}image,lat,lon,alt\na.jpg,{LATITUDE},{LONGITUDE},346.5\n")
    return path


def height_m(inputs: Any) -> float:
    return float(inputs.poses["a_jpg"].center_m[2])


@pytest.mark.parametrize(
    ("text", "heights"),
    [
        ("EPSG:32633+5773", EGM96), ("EPSG:4979", ELLIPSOID), ("EPSG:4326", ""), ("EPSG:32633", ""),
        ("EPSG:4326+3855", "EPSG:3855"), ("EPSG:5773", EGM96), ("no CRS", ""),
    ],
)  # fmt: skip
def test_what_a_crs_says_of_heights(text: str, heights: str) -> None:
    assert heights_of(text) == heights


def test_unknown_heights_are_refused() -> None:
    assert checked_heights("Ellipsoid") == ELLIPSOID
    with pytest.raises(ConfigError, match="give ellipsoid, or a vertical CRS"):
        checked_heights("EPSG:32633")


def test_heights_are_transformed_both_ways(geoid: None) -> None:
    places_m = np.array([[500_000.0, 5_300_000.0, 346.5], [500_000.0, 5_300_000.0, 0.0]])
    found_m, why_not = converted_heights("EPSG:32633", ELLIPSOID, EGM96, places_m)
    assert why_not == ""
    np.testing.assert_allclose(found_m, [300.0, -GEOID_M], atol=1e-4)
    back_m, _ = converted_heights("EPSG:32633", EGM96, ELLIPSOID, np.column_stack([places_m[:, :2], found_m]))
    np.testing.assert_allclose(back_m, places_m[:, 2], atol=1e-4)


def test_units_of_vertical_systems_count() -> None:
    """NAVD88 in metres and in US survey feet are the same heights."""
    places_m = np.array([[500_000.0, 4_500_000.0, 100.0]])
    found_m, why_not = converted_heights("EPSG:26910", "EPSG:5703", "EPSG:6360", places_m)
    assert (found_m.tolist(), why_not) == ([pytest.approx(100.0, abs=1e-6)], "")


def test_a_missing_grid_is_named_and_heights_stay() -> None:
    found_m, why_not = converted_heights("EPSG:32633", ELLIPSOID, EGM96, np.array([[5e5, 5.3e6, 346.5]]))
    assert found_m.tolist() == [346.5]
    assert "PROJ lacks the grid us_nga_egm96_15.tif: `pyproj sync --file us_nga_egm96_15.tif` fetches it" in why_not


@pytest.mark.parametrize("comment", ["# crs: EPSG:4979\n", "# heights: ellipsoidal\n"])
def test_positions_that_state_the_ellipsoid_get_the_heights_of_the_crs(
    tmp_path: Path, geoid: None, comment: str
) -> None:
    inputs = read_inputs(tmp_path / "images", poses_file(tmp_path, comment), crs="EPSG:32633+5773")
    assert height_m(inputs) == pytest.approx(300.0, abs=1e-3)
    assert (inputs.crs, inputs.heights) == ("EPSG:32633", EGM96)
    assert any("to EGM96 height (EPSG:5773): -46.50 m" in line for line in inputs.warnings)


def test_without_the_grid_positions_stay_and_it_is_said(tmp_path: Path) -> None:
    poses = poses_file(tmp_path, "# crs: EPSG:4979\n")
    inputs = read_inputs(tmp_path / "images", poses, crs="EPSG:32633+5773")
    assert (height_m(inputs), inputs.heights) == (346.5, ELLIPSOID)
    assert any("positions: heights above the ellipsoid cannot be brought to" in line for line in inputs.warnings)


def test_positions_that_state_nothing_stay_unless_the_user_says_what_they_are(tmp_path: Path, geoid: None) -> None:
    poses = poses_file(tmp_path)
    inputs = read_inputs(tmp_path / "images", poses, crs="EPSG:32633+5773")
    assert (height_m(inputs), inputs.heights) == (346.5, "")
    assert any("--set block.heights=ellipsoid has them transformed" in line for line in inputs.warnings)
    told = GivenHeights("ellipsoid")
    inputs = read_inputs(tmp_path / "images", poses, crs="EPSG:32633+5773", given_heights=told)
    assert (height_m(inputs), inputs.heights) == (pytest.approx(300.0, abs=1e-3), EGM96)
    plain = read_inputs(tmp_path / "images", poses, crs="EPSG:32633")
    assert (height_m(plain), plain.heights) == (346.5, "")
    assert not any("height" in line for line in plain.warnings)


def test_a_known_height_shifts_all_positions(tmp_path: Path) -> None:
    shifted = GivenHeights(shift_m=-46.5)
    inputs = read_inputs(tmp_path / "images", poses_file(tmp_path), given_heights=shifted)
    assert height_m(inputs) == pytest.approx(300.0)


def test_dji_mrk_states_the_ellipsoid(tmp_path: Path) -> None:
    path = tmp_path / "DJI_Timestamp.MRK"
    path.write_text("1\t100.5\t[2200]\t1,N\t2,E\t3,V\t48.1,Lat\t15.0,Lon\t346.5,Ellh\t0.01, 0.01, 0.02\t50,Q\n")
    assert read_pose_file(path).heights == ELLIPSOID


def test_control_points_get_the_heights_of_the_world(tmp_path: Path, geoid: None) -> None:
    x, y = grid_from_geographic("EPSG:32633", np.array([LATITUDE]), np.array([LONGITUDE]))[0]
    path = tmp_path / "gcp_list.txt"
    path.write_text(f"EPSG:32633+5773\n{x} {y} 300.0 50 40 a.jpg p\n")
    images = (Image("a_jpg", "a.jpg", 100, 80, "1"),)
    origin_m = (500_000.0, 5_300_000.0, 10.0)
    (point,), remarks = read_control(str(path), images, "EPSG:32633", origin_m, heights=ELLIPSOID)
    assert point.position_m[2] == pytest.approx(346.5 - 10.0, abs=1e-3)
    assert remarks == [
        "gcp_list.txt: heights of control points are transformed from EGM96 height (EPSG:5773) to heights above the "
        "ellipsoid: +46.50 m (median)"
    ]
    for heights in ("", EGM96):  # nothing to transform from, or to
        (point,), remarks = read_control(str(path), images, "EPSG:32633", origin_m, heights=heights)
        assert (point.position_m[2], remarks) == (290.0, [])


def write_dem(path: Path, crs: str, heights: np.ndarray) -> Path:
    rows, columns = heights.shape
    place = rasterio.Affine(100.0, 0.0, 498_000.0, 0.0, -100.0, 5_302_000.0)
    size: dict[str, Any] = {"height": rows, "width": columns, "count": 1, "dtype": "float64"}
    with rasterio.open(path, "w", driver="GTiff", crs=crs, transform=place, **size) as dataset:
        dataset.write(heights, 1)
    return path


def test_a_dem_gets_the_heights_of_the_world(tmp_path: Path, geoid: None) -> None:
    path = write_dem(tmp_path / "dem.tif", "EPSG:32633+5773", np.full((40, 40), 300.0))
    centers_m = np.array([[500_000.0, 5_300_000.0, 450.0]])
    ground, notes = open_dem(path, "EPSG:32633", (0.0, 0.0, 0.0), centers_m, ELLIPSOID)
    # 600 m east are 0.008 degrees, which the geoid rises in by 0.8 mm.
    assert ground.height_m(np.array([[500_000.0, 5_300_000.0], [500_600.0, 5_300_000.0]])) == pytest.approx(
        [346.5, 346.5008], abs=2e-4
    )
    assert any(
        "are transformed from EGM96 height (EPSG:5773) to heights above the ellipsoid: +46.50 m" in n for n in notes
    )
    ground, _ = open_dem(path, "EPSG:32633", (0.0, 0.0, 0.0), centers_m)
    assert ground.height_m(centers_m[:, :2]).tolist() == [300.0]


def dem_context(terrain: Terrain, shape: np.ndarray, sigma_m: float) -> Any:
    """A flight 100 m above a terrain, and a DEM of heights `shape` on the terrain's grid."""
    rows, columns = terrain.heights_m.shape
    dem = DemGround(shape, terrain.west_m, terrain.north_m, (terrain.cell_m, terrain.cell_m), 0.0)
    places = [(x, y) for x in range(20, 10 * columns - 20, 30) for y in range(20, 10 * rows - 20, 30)]
    poses = {
        str(n): Pose(np.array([x, -y, 100.0 + terrain.heights_m[0, 0]]), None, sigma_m, 3.0)
        for n, (x, y) in enumerate(places)
    }
    return SimpleNamespace(
        block=SimpleNamespace(ground=dem, ground_source="DEM dem.tif", poses=poses),
        settings=SimpleNamespace(keeps_poses=False, block=SimpleNamespace(sigma_position_m=5.0)),
    )


TERRAIN = Terrain(300.0 + np.add.outer(np.zeros(20), np.linspace(0.0, 20.0, 20)), 0.0, 0.0, 10.0)
ORIENTED = filled(OrientResult, frame="world", points=1000)


@pytest.mark.parametrize("off_m", [-45.0, 30.0, -8.0])
def test_a_dem_with_another_zero_is_used_shifted_and_the_offset_named(off_m: float) -> None:
    """The smallest is 8 % of the flying height: more than positions of 0.03 m leave open."""
    context = dem_context(TERRAIN, TERRAIN.heights_m + off_m, 0.03)
    ground, source, (remark,) = judged_ground(context, [TERRAIN], ORIENTED, context.block.poses)
    places = np.array([[50.0, -50.0], [120.0, -30.0]])
    np.testing.assert_allclose(ground.height_m(places), context.block.ground.height_m(places) - off_m, atol=1e-9)
    assert source == f"DEM dem.tif, {'raised' if off_m < 0 else 'lowered'} by {abs(off_m):.1f} m"
    assert f"lies {abs(off_m):.1f} m {'below' if off_m < 0 else 'above'} the terrain" in remark
    assert f"--set block.height_shift_m={off_m:.2f}" in remark
    assert "most likely one counts from the ellipsoid (GNSS, RTK), the other from the geoid" in remark
    assert ("unless trees or roofs cover the ground" in remark) == (off_m == -8.0)


@pytest.mark.parametrize(
    ("error_m", "images", "ground_m", "said"),
    [
        (2.0, 1000, 332.0, True),  # three standard deviations of 5 m, as stated, are 15 m
        (9.0, 1000, 332.0, False),  # 15.6 m off in space: 10 m for each coordinate, three times that is 30 m
        (0.0, 2, 324.0, False),  # 30 m apart, 5 m exact: nothing tells the scale to a quarter of the flying height
        (0.0, 2, 342.0, True),  # views of such a ground would miss each other
    ],
)
def test_the_ground_is_doubted_only_as_far_as_positions_tell_it(
    error_m: float, images: int, ground_m: float, said: bool
) -> None:
    """The terrain lies at 310 m in the middle of all images, and at 302 m below the first two; these fly at 400 m."""
    context = dem_context(TERRAIN, TERRAIN.heights_m, 5.0)
    context.block.ground, context.block.ground_source = ConstantGround(ground_m), "given"
    context.block.poses = dict(list(context.block.poses.items())[:images])
    oriented = {
        i: replace(pose, center_m=pose.center_m + error_m * (-1.0) ** int(i)) for i, pose in context.block.poses.items()
    }
    assert bool(judged_ground(context, [TERRAIN], ORIENTED, oriented)[2]) == said


def test_a_dem_that_agrees_or_has_another_shape_is_not_shifted() -> None:
    agreeing = dem_context(TERRAIN, TERRAIN.heights_m + 3.0, 0.03)
    assert judged_ground(agreeing, [TERRAIN], ORIENTED, agreeing.block.poses) == (
        agreeing.block.ground,
        "DEM dem.tif",
        [],
    )
    uncertain = dem_context(TERRAIN, TERRAIN.heights_m + 12.0, 5.0)  # three standard deviations of GPS
    assert judged_ground(uncertain, [TERRAIN], ORIENTED, uncertain.block.poses)[2] == []
    hill = 60.0 * np.sin(np.arange(20) / 3.0)[:, None] + TERRAIN.heights_m - 80.0
    ground, source, (remark,) = judged_ground(dem_context(TERRAIN, hill, 0.03), [TERRAIN], ORIENTED, {})
    assert (source, "The terrain of the pictures is used" in remark) == (
        "terrain from 1000 points of the first pass",
        True,
    )
    assert ground is not None


def group(*shifts_m: tuple[float, float, float], used: bool = True) -> GroupResult:
    flights = [
        {
            "flight": f"{n}",
            "images": 12,
            "step_m": 0.0,
            **{f"shift_{a}": [v, 0.1] for a, v in zip("xyz", one, strict=True)},
        }
        for n, one in enumerate(shifts_m)
    ]
    found = {
        "kind": "positions", "images": 24, "flights": flights, "control": {"used": ["p1"] if used else []},
        "positions": {"stated_m": [0.02, 0.02, 0.03], "images": 24, "used": 24},
    }  # fmt: skip
    return filled(GroupResult, found)


def test_the_offset_of_positions_to_control_is_told() -> None:
    assert shift_to_control_m(group((0.01, -0.03, 45.3), (0.02, 0.01, 45.1))) == pytest.approx(45.2)
    assert shift_to_control_m(group((0.0, 0.0, -33.0))) == -33.0  # as in North America
    for other in (
        group((0.0, 0.0, 45.0), used=False), group((0.0, 0.0, 45.0), (0.0, 0.0, 3.0)), group((9.0, 0.0, 45.0)),
        group((0.0, 0.0, 250.0)), group((0.0, 0.0, 0.4)), group(),
    ):  # fmt: skip
        assert shift_to_control_m(other) is None
    assert height_remarks([group((0.0, 0.0, 45.31))]) == [
        "heights of the given positions lie 45.3 m above those of the control points, everywhere by about as much: "
        "most likely one counts from the ellipsoid (GNSS, RTK), the other from the geoid (sea level); the block has "
        "the heights of the control points"
    ]


def test_an_offset_that_control_points_explain_is_no_doubt() -> None:
    def level(one: dict[str, Any]) -> list[str]:
        found = judged(QualityInput(images=24, adjust=AdjustResult(images=24, positions_given=24, groups=[one])))
        return [finding.level for finding in found.findings if finding.what == "shift of a flight"]

    assert level(group((0.01, -0.03, 45.3))) == ["good"]
    assert level(group((0.01, -0.03, 45.3), used=False)) == ["doubtful"]
    assert level(group((5.0, 0.0, 45.3))) == ["doubtful"]


def test_the_offset_of_check_points_is_told_and_named() -> None:
    errors_m = {"a": [0.01, 0.0, 45.02], "b": [-0.02, 0.03, 45.1], "c": [0.0, -0.01, 44.98]}
    assert shift_of_points_m(list(errors_m.values()), [0.03, 0.03, 0.05]) == 45.02
    assert shift_of_points_m([[0.0, 0.0, 45.0], [0.0, 0.0, 2.0]], [0.03, 0.03, 0.05]) is None
    assert shift_of_points_m([[0.0, 0.0, 45.0]], [0.03, 0.03, 0.05]) is None
    control = {
        "points": 3, "control": 0, "check": 3, "residuals": errors_m, "checks": list(errors_m), "doubtful": [],
        "sigmas_m": [0.03, 0.03, 0.05], "transformation": None, "check_rmse_m": None,
    }  # fmt: skip
    inside = {
        "used": [], "wrong": [], "exchanged": [], "held_out": "check points", "kept": True,
        "held_out_rms_m": [0.02, 0.02, 45.03], "without_rms_m": [0.02, 0.02, 45.03],
    }  # fmt: skip
    groups = [{"kind": "positions", "images": 12, "control": inside}]
    adjusted = {"images": 12, "positions_given": 12, "groups": groups}
    found = judged(filled(QualityInput, images=12, adjust=adjusted | {"control": control}))
    (named,) = [finding for finding in found.findings if finding.what == "heights of surveyed points"]
    assert named.level == "doubtful"
    assert (
        "the block lies 45.02 m above all surveyed points: most likely one counts from the ellipsoid" in named.sentence
    )
    assert "--set block.height_shift_m=-45.02" in named.sentence
    (points,) = [finding for finding in found.findings if finding.what == "check points"]
    assert points.level == "good"  # but for the offset they are met to 0.06 m
    control = {**control, "residuals": {name: [0.0, 0.0, 7.0 * n] for n, name in enumerate(errors_m)}}
    found = judged(filled(QualityInput, images=12, adjust=adjusted | {"control": control}))
    assert next(finding for finding in found.findings if finding.what == "check points").level == "bad"
