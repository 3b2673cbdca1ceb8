"""Ground from a constant and a DEM, against planes that are known."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from aeromatch_cli.blocks.ground import ConstantGround, DemGround, SeveralGrounds, open_dem, stated_height_m
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError

ORIGIN = (333000.0, 3100000.0, 0.0)
POSITIONS = np.array([[0.0, 0.0, 220.0], [200.0, 150.0, 222.0]])


def plane_m(x: FloatArray, y: FloatArray) -> FloatArray:
    """Heights of a tilted plane in EPSG:32617."""
    return np.asarray(100.0 + 0.02 * (x - ORIGIN[0]) - 0.03 * (y - ORIGIN[1]))


def write_dem(
    path: Path,
    heights: FloatArray,
    west: float,
    north: float,
    cell_m: float,
    crs: str | None = "EPSG:32617",
    nodata: float | None = None,
) -> Path:
    import rasterio

    profile = {"driver": "GTiff", "height": heights.shape[0], "width": heights.shape[1], "count": 1}
    transform = rasterio.Affine(cell_m, 0.0, west, 0.0, -cell_m, north)
    with rasterio.open(path, "w", **profile, dtype="float32", crs=crs, transform=transform, nodata=nodata) as target:
        target.write(heights.astype(np.float32), 1)
    return path


def plane_dem(path: Path, **options: object) -> Path:
    """2 km x 2 km at 5 m around the origin."""
    west, north, cell = ORIGIN[0] - 1000.0, ORIGIN[1] + 1000.0, 5.0
    x, y = np.meshgrid(west + cell * (np.arange(400) + 0.5), north - cell * (np.arange(400) + 0.5))
    return write_dem(path, plane_m(x, y), west, north, cell, **options)  # type: ignore[arg-type]


def test_constant_ground() -> None:
    np.testing.assert_array_equal(ConstantGround(12.5).height_m(np.zeros((3, 2))), [12.5, 12.5, 12.5])
    assert ConstantGround(1.0).height_m(np.zeros((0, 2))).shape == (0,)


def test_dem_is_bilinear_between_cell_centres() -> None:
    dem = DemGround(np.array([[10.0, 20.0], [30.0, 60.0]]), 0.0, 100.0, (10.0, 10.0), -1.0)
    points = np.array([[0, 100], [10, 100], [5, 100], [5, 95], [-4, 104], [14, 86], [-6, 100], [0, 120]])
    np.testing.assert_allclose(dem.height_m(points), [10.0, 20.0, 15.0, 30.0, 10.0, 60.0, -1.0, -1.0])


def test_dem_of_a_plane_in_the_same_crs(tmp_path: Path) -> None:
    ground, notes = open_dem(plane_dem(tmp_path / "dem.tif"), "EPSG:32617", ORIGIN, POSITIONS)
    assert notes == ()
    xy = np.random.default_rng(0).uniform(-300.0, 400.0, (200, 2))
    np.testing.assert_allclose(ground.height_m(xy), plane_m(xy[:, 0] + ORIGIN[0], xy[:, 1] + ORIGIN[1]), atol=1e-3)
    # Only the block's surroundings: 5 flying heights (about 130 m) on either side, not the 2 km of the file.
    assert ground.heights_m.shape[1] * 5.0 < 1700.0


def test_world_origin_is_subtracted(tmp_path: Path) -> None:
    lifted = (*ORIGIN[:2], 40.0)
    positions = POSITIONS - [0.0, 0.0, 40.0]
    ground, _ = open_dem(plane_dem(tmp_path / "dem.tif"), "EPSG:32617", lifted, positions)
    assert ground.height_m(np.array([[50.0, 10.0]]))[0] == pytest.approx(100.0 + 1.0 - 0.3 - 40.0, abs=1e-3)


def test_dem_in_another_crs_is_transformed(tmp_path: Path) -> None:
    from pyproj import Transformer

    to_geographic = Transformer.from_crs("EPSG:32617", "EPSG:4326", always_xy=True)
    west, north = to_geographic.transform(ORIGIN[0] - 1500.0, ORIGIN[1] + 1500.0)
    cell = 5e-5
    longitude, latitude = np.meshgrid(west + cell * (np.arange(600) + 0.5), north - cell * (np.arange(560) + 0.5))
    x, y = to_geographic.transform(longitude, latitude, direction="INVERSE")
    path = write_dem(tmp_path / "dem.tif", plane_m(x, y), west, north, cell, crs="EPSG:4326")
    ground, notes = open_dem(path, "EPSG:32617", ORIGIN, POSITIONS)
    assert notes == ()
    xy = np.random.default_rng(0).uniform(-200.0, 300.0, (100, 2))
    np.testing.assert_allclose(ground.height_m(xy), plane_m(xy[:, 0] + ORIGIN[0], xy[:, 1] + ORIGIN[1]), atol=0.01)


def test_gaps_get_the_median_and_a_note(tmp_path: Path) -> None:
    heights = np.full((400, 400), 120.0)
    heights[:, :200] = -9999.0
    path = write_dem(tmp_path / "dem.tif", heights, ORIGIN[0] - 1000.0, ORIGIN[1] + 1000.0, 5.0, nodata=-9999.0)
    ground, (note,) = open_dem(path, "EPSG:32617", ORIGIN, POSITIONS)
    np.testing.assert_allclose(ground.height_m(np.array([[-300.0, 0.0], [200.0, 0.0], [-5000.0, 0.0]])), 120.0)
    assert "no data" in note
    assert "120.0 m" in note


@pytest.mark.parametrize("code", [-9999.0, -32768.0, 32767.0, -3.4028235e38, 3.4028235e38, 0.0, -99999.0])
@pytest.mark.parametrize("declared", [None, -9999.0])
@pytest.mark.parametrize("crs", ["EPSG:32617", "EPSG:32618"])
def test_voids_that_are_not_declared_are_none(tmp_path: Path, code: float, declared: float | None, crs: str) -> None:
    lift = 700.0  # a block that lies high
    path = plane_dem(tmp_path / "dem.tif", nodata=declared)
    import rasterio

    with rasterio.open(path, "r+") as dem:
        heights = dem.read(1) + lift
        heights[:, :200] = code  # west of the block's first image
        dem.write(heights, 1)
    positions = POSITIONS + np.array([50.0, 0.0, lift])
    xy, origin = positions[:, :2], ORIGIN
    if crs != "EPSG:32617":
        from pyproj import Transformer

        moved = Transformer.from_crs("EPSG:32617", crs, always_xy=True).transform(*(xy + origin[:2]).T)
        positions = np.column_stack([np.array(moved).T - np.array(moved).T.min(axis=0), positions[:, 2]])
        origin = (*np.array(moved).T.min(axis=0), 0.0)
    ground, notes = open_dem(path, crs, origin, positions)  # type: ignore[arg-type]
    expected = plane_m(*(xy + ORIGIN[:2]).T) + lift
    np.testing.assert_allclose(ground.height_m(positions[:, :2]), expected, atol=0.05)
    assert ground.heights_m.min() > 700.0
    assert ground.heights_m.max() < 1000.0
    named = [note for note in notes if f"has cells of {code:g} that it does not declare as no data" in note]
    assert bool(named) == (code != declared)


def test_a_coast_has_heights_of_zero(tmp_path: Path) -> None:
    import rasterio

    path = plane_dem(tmp_path / "dem.tif")
    with rasterio.open(path, "r+") as dem:
        dem.write(np.maximum(dem.read(1) - 100.0, 0.0), 1)
    ground, notes = open_dem(path, "EPSG:32617", ORIGIN, POSITIONS)
    assert ground.height_m(np.array([[-400.0, 400.0], [400.0, -400.0]])) == pytest.approx([0.0, 20.0], abs=0.01)
    assert not any("declare" in note for note in notes)


def test_scaled_heights_are_metres(tmp_path: Path) -> None:
    import rasterio

    path = plane_dem(tmp_path / "dem.tif")
    with rasterio.open(path, "r+") as dem:
        dem.write(dem.read(1) * 10.0, 1)
        dem.scales = (0.1,)
    ground, _ = open_dem(path, "EPSG:32617", ORIGIN, POSITIONS)
    np.testing.assert_allclose(
        ground.height_m(POSITIONS[:, :2]), plane_m(*(POSITIONS[:, :2] + ORIGIN[:2]).T), atol=0.01
    )


def test_dem_without_crs_is_taken_in_the_blocks(tmp_path: Path) -> None:
    path = plane_dem(tmp_path / "dem.tif", crs=None)
    ground, (note,) = open_dem(path, "EPSG:32617", ORIGIN, POSITIONS)
    assert "names no CRS" in note
    assert ground.height_m(np.zeros((1, 2)))[0] == pytest.approx(100.0, abs=1e-3)
    local, notes = open_dem(path, "local", ORIGIN, POSITIONS)
    assert notes == ()
    assert local.height_m(np.zeros((1, 2)))[0] == pytest.approx(100.0, abs=1e-3)


def test_dem_travels_to_workers(tmp_path: Path) -> None:
    ground, _ = open_dem(plane_dem(tmp_path / "dem.tif"), "EPSG:32617", ORIGIN, POSITIONS)
    xy = np.array([[12.0, 34.0]])
    assert pickle.loads(pickle.dumps(ground)).height_m(xy) == ground.height_m(xy)


def test_unusable_dems_are_refused(tmp_path: Path) -> None:
    path = plane_dem(tmp_path / "dem.tif")
    with pytest.raises(ConfigError, match="does not cover the block"):
        open_dem(path, "EPSG:32617", (433000.0, 3100000.0, 0.0), POSITIONS)
    with pytest.raises(ConfigError, match="local frame"):
        open_dem(path, "local", ORIGIN, POSITIONS)
    with pytest.raises(ConfigError, match="needs image positions"):
        open_dem(path, "EPSG:32617", ORIGIN, np.zeros((0, 3)))
    (tmp_path / "text.tif").write_text("no raster")
    with pytest.raises(ConfigError, match=r"cannot read the DEM .*text\.tif"):
        open_dem(tmp_path / "text.tif", "EPSG:32617", ORIGIN, POSITIONS)
    with pytest.raises(ConfigError, match="cannot read the DEM"):
        open_dem(tmp_path / "absent.tif", "EPSG:32617", ORIGIN, POSITIONS)


def test_of_several_rasters_the_one_that_holds_a_point_counts() -> None:
    near = DemGround(np.full((3, 4), 10.0), 0.0, 20.0, (10.0, 10.0), outside_m=11.0)  # -5 to 35 m, -5 to 25 m
    far = DemGround(np.full((2, 2), 70.0), 1000.0, 0.0, (10.0, 10.0), outside_m=71.0)  # 995 to 1015 m, -15 to 5 m
    ground = SeveralGrounds((near, far))
    places = [[0.0, 0.0], [1010.0, -10.0], [-40.0, 0.0], [900.0, 500.0]]
    np.testing.assert_allclose(ground.height_m(np.array(places)), [10.0, 70.0, 11.0, 71.0])
    np.testing.assert_allclose(near.distance_m(np.array([[35.0, 25.0], [38.0, 29.0], [-15.0, 0.0]])), [0.0, 5.0, 10.0])


US_FOOT_M = 1200.0 / 3937.0


@pytest.mark.parametrize(
    ("crs", "units", "one_m", "said"),
    [
        ("EPSG:32617", "US survey foot", US_FOOT_M, "states heights in US survey foot"),
        ("EPSG:32617", "ft", 0.3048, "states heights in ft"),
        ("EPSG:32617", "cm", 0.01, "states heights in cm"),
        ("EPSG:32617", "m", 1.0, ""),
        ("EPSG:32617", "DN", 1.0, "'DN', which is no unit that is known: metres are assumed"),
        ("EPSG:32617+6360", None, US_FOOT_M, "states heights in US survey foot"),
        ("EPSG:32617+5703", None, 1.0, ""),
    ],
)
def test_heights_of_a_dem_count_in_the_unit_that_it_states(
    tmp_path: Path, crs: str, units: str | None, one_m: float, said: str
) -> None:
    import rasterio

    heights = np.full((400, 400), 30.0 / one_m)
    heights[:20] = -9999.0
    path = write_dem(tmp_path / "dem.tif", heights, ORIGIN[0] - 1000.0, ORIGIN[1] + 1000.0, 5.0, crs)
    if units:
        with rasterio.open(path, "r+") as target:
            target.units = (units,)
    ground, notes = open_dem(path, "EPSG:32617", ORIGIN, POSITIONS)
    np.testing.assert_allclose(ground.height_m(POSITIONS[:, :2]), [30.0, 30.0], atol=1e-4)
    assert any(said in note for note in notes if "heights in" in note) == bool(said)
    assert any("cells of -9999 that it does not declare" in note for note in notes)


def test_a_dem_in_a_crs_in_feet_without_a_unit_of_heights_is_named(tmp_path: Path) -> None:
    heights = np.full((400, 400), 30.0)
    path = write_dem(tmp_path / "dem.tif", heights, 600_000.0, 200_000.0, 15.0, "EPSG:2264")
    from pyproj import Transformer

    x, y = Transformer.from_crs("EPSG:2264", "EPSG:32617", always_xy=True).transform(603_000.0, 197_000.0)
    ground, notes = open_dem(path, "EPSG:32617", (x, y, 0.0), POSITIONS)
    assert ground.height_m(np.zeros((1, 2)))[0] == pytest.approx(30.0)
    assert any("counts in US survey foot, and nothing states the unit of its heights" in note for note in notes)


@pytest.mark.parametrize(("land_m", "said"), [(34.0, True), (3.0, False)])
def test_cells_of_zero_far_below_all_others_are_named(tmp_path: Path, land_m: float, said: bool) -> None:
    heights = np.full((400, 400), land_m)
    heights[:200] = 0.0
    path = write_dem(tmp_path / "dem.tif", heights, ORIGIN[0] - 1000.0, ORIGIN[1] + 1000.0, 5.0)
    _, notes = open_dem(path, "EPSG:32617", ORIGIN, POSITIONS)
    assert any("cells of 0 (" in note and "-a_nodata 0" in note for note in notes) == said


@pytest.mark.parametrize(("text", "z_m"), [("112 ft", 34.1376), ("34m", 34.0), ("34.5 m", 34.5), ("-3", -3.0)])
def test_a_stated_height_may_have_a_unit(text: str, z_m: float) -> None:
    assert stated_height_m(text) == pytest.approx(z_m)


def test_a_stated_height_that_is_none_is_named() -> None:
    for text in ("34,5", "112 xy", "1.2.3"):
        with pytest.raises(ConfigError, match="is no height: give metres with a decimal point"):
            stated_height_m(text)
    for text in ("dem.tif", "auto", "34.tif", "3/dem.tif"):
        assert stated_height_m(text) is None
