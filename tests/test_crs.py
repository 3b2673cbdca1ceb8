from __future__ import annotations

import math

import numpy as np
import pytest
from pyproj import Transformer

from aeromatch_cli.blocks.crs import (
    checked_crs,
    choose_crs,
    convergence_deg,
    grid_from_geographic,
    outside_area,
    rounded_origin_m,
    utm_crs,
)
from aeromatch_cli.errors import ConfigError


def test_utm_zone_of_the_median_position() -> None:
    assert utm_crs(np.array([46.8, 46.9, 0.0]), np.array([-91.99, -91.98, -91.97])) == "EPSG:32615"
    assert utm_crs(np.array([-33.0]), np.array([151.0])) == "EPSG:32756"
    assert utm_crs(np.array([5.0, 5.0, 5.0]), np.array([179.99, -179.99, 179.98])) == "EPSG:32660"
    assert utm_crs(np.array([5.0]), np.array([180.0])) == "EPSG:32601"
    with pytest.raises(ConfigError, match="UTM"):
        utm_crs(np.array([86.0]), np.array([10.0]))


def test_grid_coordinates_of_the_central_meridian() -> None:
    xy_m = grid_from_geographic("EPSG:32617", np.array([0.0, 45.0]), np.array([-81.0, -81.0]))
    assert xy_m[:, 0] == pytest.approx([500000.0, 500000.0], abs=1e-6)
    # Meridian arc from the equator to 45 degrees on WGS84, times the scale 0.9996.
    assert xy_m[:, 1] == pytest.approx([0.0, 4984944.378 * 0.9996], abs=0.01)


def test_convergence_is_positive_in_the_north_east_and_corrects_azimuths() -> None:
    """One degree east of the meridian: about sin(latitude); a step to true north goes to the left of grid north."""
    latitudes, longitudes = np.array([28.0, 28.0, -28.0]), np.array([-80.0, -82.0, -80.0])
    found = convergence_deg("EPSG:32617", latitudes, longitudes)
    assert found == pytest.approx([math.sin(math.radians(28.0)), -0.4695, -0.4695], abs=1e-3)
    transformer = Transformer.from_crs("EPSG:4326", "EPSG:32617", always_xy=True)
    x0, y0 = transformer.transform(-80.0, 28.0)
    x1, y1 = transformer.transform(-80.0, 28.0001)
    grid_azimuth_of_true_north = math.degrees(math.atan2(x1 - x0, y1 - y0))
    assert grid_azimuth_of_true_north == pytest.approx(0.0 - found[0], abs=1e-3)
    assert convergence_deg("local", latitudes, longitudes).tolist() == [0.0, 0.0, 0.0]


def test_choice_of_the_crs() -> None:
    assert choose_crs("epsg:25833", "EPSG:32615", [1.0], [1.0]) == "EPSG:25833"
    assert choose_crs("auto", "EPSG:32615", [], []) == "EPSG:32615"
    assert choose_crs("", None, [28.0], [-82.0]) == "EPSG:32617"
    assert choose_crs("auto", "local", [28.0], [-82.0]) == "EPSG:32617"
    assert choose_crs("auto", None, [], []) == "local"
    assert choose_crs("Local", None, [], []) == "local"


@pytest.mark.parametrize(
    ("code", "words"),
    [("EPSG:999999", "unknown"), ("nonsense", "unknown"), ("EPSG:4326", "not projected"), ("EPSG:2263", "foot")],
)
def test_unfit_crs(code: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        checked_crs(code)


def test_south_oriented_axes_are_refused_and_compound_heights_dropped() -> None:
    with pytest.raises(ConfigError, match="axes point east and north"):
        checked_crs("EPSG:2053")
    assert checked_crs("EPSG:32633+5773") == "EPSG:32633"


def test_geographic_positions_need_a_crs() -> None:
    with pytest.raises(ConfigError, match="local frame"):
        grid_from_geographic("local", np.array([1.0]), np.array([1.0]))


def test_origin_is_rounded_down_to_kilometres() -> None:
    centers_m = np.array([[576663.2, 5188164.9, 197.0], [576673.1, 5188174.2, 198.0], [0.0, 0.0, 0.0]])
    assert rounded_origin_m(centers_m) == (576000.0, 5188000.0, 0.0)
    assert rounded_origin_m(np.array([[-137.0, 7.0, 59.0]])) == (-1000.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("crs", "latitude", "longitude", "said"),
    [
        ("EPSG:32633", 52.5, 13.4, ""),
        ("EPSG:32633", 52.5, 10.0, ""),  # the zone beside
        ("EPSG:32610", 52.5, 13.4, "far outside EPSG:32610"),
        ("EPSG:2154", 52.5, 13.4, "far outside EPSG:2154"),
        ("EPSG:2193", -41.0, 175.0, ""),  # across the antimeridian
        ("local", 52.5, 13.4, ""),
    ],
)
def test_a_crs_of_another_place_is_named(crs: str, latitude: float, longitude: float, said: str) -> None:
    geographic = np.array([latitude, latitude]), np.array([longitude, longitude])
    remark = outside_area(crs, np.zeros((2, 2)) if crs == "local" else grid_from_geographic(crs, *geographic))
    assert (said in remark) if said else not remark
    # What PROJ says of the area is told in whole words.
    assert "onshore and)" not in remark


def test_eastings_with_the_zones_number_are_named() -> None:
    assert "take 33,000,000 off" in outside_area("EPSG:32633", np.array([[33_391_000.0, 5_818_000.0]]))
    assert not outside_area("EPSG:4647", np.array([[32_391_000.0, 5_818_000.0]]))
