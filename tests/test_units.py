"""Units and conventions that files state: applied, or refused by name."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from make_pose_files import written
from pyproj import CRS

from aeromatch_cli.blocks.control import read_control
from aeromatch_cli.blocks.control_files import read_survey
from aeromatch_cli.blocks.crs import checked_crs, geographic_from_grid
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.blocks.units import degrees_of, metres_of
from aeromatch_cli.data import Image
from aeromatch_cli.errors import ConfigError

FT, US_FT = 0.3048, 1200.0 / 3937.0
# One image, in metres and degrees.
X, Y, Z = 390949.297, 5818924.122, 142.597
LATITUDE, LONGITUDE = 52.50951757, 13.39314938
OMEGA, PHI, KAPPA = 1.25, -2.5, 91.5


@pytest.mark.parametrize(
    ("header", "cells", "expected"),
    [
        ("x,y,alt_ft", (X, Y, Z / FT), (X, Y, Z)),
        ("x,y,height [ft]", (X, Y, Z / FT), (X, Y, Z)),
        ("x,y,altitude(feet)", (X, Y, Z / FT), (X, Y, Z)),
        ("x [us-ft],y [us-ft],z [ft]", (X / US_FT, Y / US_FT, Z / FT), (X, Y, Z)),
        ("easting_km,northing_km,z_mm", (X / 1e3, Y / 1e3, Z * 1e3), (X, Y, Z)),
        ("x,y,z_us_ft", (X, Y, Z / US_FT), (X, Y, Z)),
        ("x,y,z", (X, Y, f"{Z / FT:.9f} ft"), (X, Y, Z)),
        ("x,y,z", (X, Y, f"{Z} m"), (X, Y, Z)),
        ("x,y,altitude [m, ellipsoidal]", (X, Y, Z), (X, Y, Z)),
        ("lat (deg),lon (deg),alt (feet)", (LATITUDE, LONGITUDE, Z / FT), (LATITUDE, LONGITUDE, Z)),
        ("lat_rad,lon_rad,alt", (math.radians(LATITUDE), math.radians(LONGITUDE), Z), (LATITUDE, LONGITUDE, Z)),
        ("lat,lon,alt", (f"{LATITUDE} N", f"{LONGITUDE} E", Z), (LATITUDE, LONGITUDE, Z)),
        ("lat,lon,alt", (f"{LATITUDE} S", f"W {LONGITUDE}", Z), (-LATITUDE, -LONGITUDE, Z)),
        ("lat,lon,alt", ("52°30'34.263252\"", "13 23 35.337768 E", Z), (LATITUDE, LONGITUDE, Z)),
    ],
)
def test_positions_in_other_units(tmp_path: Path, header: str, cells: tuple, expected: tuple) -> None:
    row = read_pose_file(written(tmp_path, f"image;{header.replace(',', ';')}\na.jpg;{';'.join(map(str, cells))}\n"
                                 if "m, ell" not in header else
                                 f"image;x;y;altitude [m, ellipsoidal]\na.jpg;{X};{Y};{Z}\n")).rows[0]  # fmt: skip
    np.testing.assert_allclose(row.position or (), expected, rtol=0, atol=1e-6 if row.position_kind == "grid" else 1e-9)


@pytest.mark.parametrize(
    ("header", "factor"),
    [
        ("omega_gon,phi_gon,kappa_gon", 1 / 0.9),
        ("omega (rad),phi (rad),kappa (rad)", math.radians(1.0)),
        ("omega [grad],phi [grad],kappa [grad]", 1 / 0.9),
        ("omega [deg],phi [°],kappa (degrees)", 1.0),
    ],
)
def test_angles_and_accuracies_in_other_units(tmp_path: Path, header: str, factor: float) -> None:
    angles = [angle * factor for angle in (OMEGA, PHI, KAPPA)]
    text = (
        f"image,x,y,z,{header},accuracy_mm,sigma_z_cm,sigma_angle_rad\na.jpg,1,2,3,{angles[0]},{angles[1]},{angles[2]}"
    )
    row = read_pose_file(written(tmp_path, f"{text},25,4,0.01\n")).rows[0]
    np.testing.assert_allclose(row.attitude or (), (OMEGA, PHI, KAPPA), atol=1e-9)
    assert row.sigmas_m == pytest.approx((0.025, 0.025, 0.04))
    assert row.sigma_angle_deg == pytest.approx(math.degrees(0.01))


@pytest.mark.parametrize(
    ("comments", "position", "attitude"),
    [
        ("# angles in gon", (100.0, 200.0, 300.0), (0.9, 1.8, 2.7)),
        ("# angles: radians", (100.0, 200.0, 300.0), tuple(map(math.degrees, (1.0, 2.0, 3.0)))),
        ("# heights: ellipsoidal, feet", (100.0, 200.0, 300.0 * FT), (1.0, 2.0, 3.0)),
        ("# units: us survey feet", (100.0 * US_FT, 200.0 * US_FT, 300.0 * US_FT), (1.0, 2.0, 3.0)),
        ("# coordinates in feet\n# heights in metres", (100.0 * FT, 200.0 * FT, 300.0), (1.0, 2.0, 3.0)),
        ("# flying height 300 ft, angles from the IMU in gon", (100.0, 200.0, 300.0), (1.0, 2.0, 3.0)),
    ],
)
@pytest.mark.parametrize("header", ["image x y z omega phi kappa\n", ""])
def test_units_of_comments(tmp_path: Path, header: str, comments: str, position: tuple, attitude: tuple) -> None:
    text = f"{comments}\n{header}a.jpg 100 200 300 1 2 3\n"
    row = read_pose_file(written(tmp_path, text, "list.txt")).rows[0]
    np.testing.assert_allclose(row.position or (), position, atol=1e-9)
    np.testing.assert_allclose(row.attitude or (), attitude, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("image,x,y,z [fathom]\na,1,2,3\n", "line 1: column 'z' counts in 'fathom', which is no length that is known"),
        ("image,x [deg],y [deg],z\na,1,2,3\n", "column 'x' counts in 'deg', which is no length"),
        ("image,lat,lon [m],alt\na,1,2,3\n", "column 'lon' counts in 'm', which is no angle"),
        ("image,lat,lon,alt\na,52.5 E,13,3\n", "line 2, column lat: '52.5 E' is not a number"),
        ("image,lat,lon,alt\na,52 61 10,13,3\n", "column lat: '52 61 10' is not a number"),
        ("image,x,y,altitude (agl)\na,1,2,3\n", "'relative_altitude' counts from the ground"),
        ("# heights above ground\nimage,x,y,z\na,1,2,3\n", "heights do not count from a datum"),
    ],
)
def test_units_that_cannot_be_meant_are_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_pose_file(written(tmp_path, text))
    assert said in str(caught.value)
    assert str(tmp_path / "list.csv") in str(caught.value)


@pytest.mark.parametrize(
    ("header", "cells", "expected"),
    [
        ("label,x_ft,y_ft,z_ft", (X / FT, Y / FT, Z / FT), (X, Y, Z)),
        ("Name,Easting [us-ft],Northing [us-ft],Elevation [us-ft]", (X / US_FT, Y / US_FT, Z / US_FT), (X, Y, Z)),
        ("label,lat,lon,z [ft]", ("52°30'34.263252\" N", "13 23 35.337768", Z / FT), (LONGITUDE, LATITUDE, Z)),
    ],
)
def test_control_points_in_other_units(tmp_path: Path, header: str, cells: tuple, expected: tuple) -> None:
    text = f"{header.replace(',', ';')};accuracy_xy_mm;accuracy_z [cm]\np;{';'.join(map(str, cells))};20;3\n"
    path = written(tmp_path, text, "gcp.csv")
    marks = written(tmp_path, "a.jpg,p,1,2\n", "marks.csv")
    point = read_survey(path, marks).points[0]
    np.testing.assert_allclose(point.position, expected, rtol=0, atol=1e-6 if "lat" not in header else 1e-9)
    assert point.sigmas_m == pytest.approx((0.02, 0.02, 0.03))


def test_units_of_control_points_that_cannot_be_meant_are_refused(tmp_path: Path) -> None:
    marks = written(tmp_path, "image,label,x [mm],y [mm]\na.jpg,p,1,2\n", "marks.csv")
    path = written(tmp_path, "label,x,y,z\np,1,2,3\n", "gcp.csv")
    with pytest.raises(ConfigError, match="image measurements in 'mm': pixels are needed"):
        read_survey(path, marks)
    path.write_text("label,x,y,z [agl]\np,1,2,3\n")
    with pytest.raises(ConfigError):
        read_survey(path, written(tmp_path, "a.jpg,p,1,2\n", "marks.csv"))


@pytest.mark.parametrize(
    "form", ["{d:.8f} {s}", '"{i}°{m}\'{sec:.6f}"" {s}"', "{i} {m} {sec:.6f} {s}", '"{i},{f:.7f}{s}"']
)
@pytest.mark.parametrize("separator", [",", ";"])
def test_exiftools_coordinates_in_every_form(tmp_path: Path, form: str, separator: str) -> None:
    def cell(degrees: float, side: str) -> str:
        minutes = degrees % 1 * 60
        return form.format(d=degrees, s=side, i=int(degrees), m=int(minutes), sec=minutes % 1 * 60, f=minutes)

    cells = ["a.jpg", cell(LATITUDE, "S"), cell(LONGITUDE, "W"), "142.6 m Above Sea Level"]
    text = separator.join(["SourceFile", "GPSLatitude", "GPSLongitude", "GPSAltitude"]) + "\n" + separator.join(cells)
    row = read_pose_file(written(tmp_path, text + "\n", "exif.csv")).rows[0]
    np.testing.assert_allclose(row.position or (), (-LATITUDE, -LONGITUDE, 142.6), atol=1e-8)


def test_numbers_in_degrees_and_metres() -> None:
    assert degrees_of("0°30'S", "NS") == -0.5
    assert degrees_of("-0 30 0", "NS") == -0.5
    assert degrees_of("52,5", "NS") == 52.5
    assert degrees_of("-52.5 S", "NS") is None
    assert degrees_of("1.234,5") is None
    assert metres_of("467,84 ft") == pytest.approx(467.84 * FT)
    assert metres_of("12 parsec") is None


# The same place in California's zone 3: metres, and US survey feet of EPSG:2227.
CALIFORNIA = "EPSG:26943"
CX, CY, CZ = 1_850_123.456, 650_234.567, 45.678


def geo_txt(crs: str, across_m: float, up_m: float, more: str = "") -> str:
    return f"{crs}\na.jpg {CX / across_m:.6f} {CY / across_m:.6f} {CZ / up_m:.6f}{more}\n"


@pytest.mark.parametrize(
    ("crs", "across_m", "up_m"),
    [
        ("EPSG:26943", 1.0, 1.0),
        ("EPSG:2227", US_FT, US_FT),
        ("EPSG:2227+6360", US_FT, US_FT),
        ("EPSG:2227+5703", US_FT, 1.0),
        ("EPSG:26943+6360", 1.0, US_FT),
        ("EPSG:26943+8228", 1.0, FT),
    ],
)
def test_a_crs_in_feet_is_brought_to_metres(tmp_path: Path, crs: str, across_m: float, up_m: float) -> None:
    """The same grid, so that the places are those of the CRS in metres."""
    found = read_pose_file(written(tmp_path, geo_txt(crs, across_m, up_m), "geo.txt"))
    np.testing.assert_allclose(found.rows[0].position or (), (CX, CY, CZ), rtol=0, atol=1e-5)
    assert checked_crs(found.crs or "") == found.crs
    place = geographic_from_grid(found.crs or "", np.array([[CX, CY]]))
    np.testing.assert_allclose(place, geographic_from_grid(CALIFORNIA, np.array([[CX, CY]])), rtol=0, atol=1e-9)
    assert any("heights are read in US survey foot" in text for text in found.warnings) == (crs == "EPSG:2227")


@pytest.mark.parametrize(
    ("crs", "cells", "expected"),
    [
        ("EPSG:32633+5773", (X, Y, Z), (X, Y, Z)),
        ("EPSG: 32633", (X, Y, Z), (X, Y, Z)),
        ("WGS 84 / UTM zone 33N", (X, Y, Z), (X, Y, Z)),
        ("WGS84 UTM 33N", (X, Y, Z), (X, Y, Z)),
        ("WGS84", (LONGITUDE, LATITUDE, Z), (LATITUDE, LONGITUDE, Z)),
        ("EPSG:4326+6360", (LONGITUDE, LATITUDE, Z / US_FT), (LATITUDE, LONGITUDE, Z)),
        ("EPSG:4979", (LONGITUDE, LATITUDE, Z), (LATITUDE, LONGITUDE, Z)),
        # Gon from Paris, and metres that grow towards the poles.
        ("EPSG:4901", ((LONGITUDE - 2.337229166667) / 0.9, LATITUDE / 0.9, Z), (LATITUDE, LONGITUDE, Z)),
        ("ESRI:102100", (1490918.5690998, 6892782.3166716, Z), (LATITUDE, LONGITUDE, Z)),
    ],
)
def test_first_lines_of_geo_txt(tmp_path: Path, crs: str, cells: tuple, expected: tuple) -> None:
    found = read_pose_file(written(tmp_path, f"{crs}\na.jpg {cells[0]:.9f} {cells[1]:.9f} {cells[2]:.9f}\n", "geo.txt"))
    atol = 1e-6 if found.position_kind == "grid" else 2e-3 if crs == "EPSG:4901" else 1e-7
    np.testing.assert_allclose(found.rows[0].position or (), expected, rtol=0, atol=atol)
    assert "ODM geo.txt" in found.format


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"EPSG:4326\na.jpg {X} {Y} 3\n", "line 2: (390949, 5.81892e+06) are no longitude and latitude"),
        ("EPSG:99999\na.jpg 1 2 3\n", "the CRS 'EPSG:99999' is unknown"),
        ("EPSG:5773\na.jpg 1 2 3\n", "EGM96 height has no easting and northing"),
        ("EPSG:32633+5706\na.jpg 1 2 3\n", "counts depths downwards: give heights"),
    ],
)
def test_first_lines_that_cannot_be_meant(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_pose_file(written(tmp_path, text, "geo.txt"))
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("EPSG:3857", "has no true lengths"),
        ("EPSG:26943+6360", "counts heights in another unit"),
        ("EPSG:2227", "foot"),
    ],
)
def test_a_world_has_metres(code: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        checked_crs(code)


@pytest.mark.parametrize(
    ("crs", "across_m", "up_m"),
    [("EPSG:2227", US_FT, US_FT), ("EPSG:2227+5703", US_FT, 1.0), ("EPSG:26943+6360", 1.0, US_FT)],
)
@pytest.mark.parametrize("block", [CALIFORNIA, "local"])
def test_control_points_of_a_crs_in_feet(tmp_path: Path, crs: str, across_m: float, up_m: float, block: str) -> None:
    line = f"{CX / across_m:.6f} {CY / across_m:.6f} {CZ / up_m:.6f} 10 20 a.jpg p\n"
    image = Image(image_id="a", name="a.jpg", width_px=100, height_px=100, camera_id="1", exif_orientation=1)
    points, remarks = read_control(
        str(written(tmp_path, f"{crs}\n{line}", "gcp.txt")), (image,), block, (0.0, 0.0, 0.0)
    )
    np.testing.assert_allclose(points[0].position_m, (CX, CY, CZ), rtol=0, atol=1e-3)
    assert any("heights are read in US survey foot" in text for text in remarks) == (crs == "EPSG:2227")


def test_columns_in_feet_below_a_crs_in_feet_are_converted_once(tmp_path: Path) -> None:
    wkt = CRS("EPSG:2227").to_wkt()
    cells = f"{CX / US_FT},{CY / US_FT},{CZ / FT}"
    marks = written(tmp_path, "a.jpg,p,10,20\n", "marks.csv")
    written(tmp_path, wkt, "gcp.prj")
    image = Image(image_id="a", name="a.jpg", width_px=100, height_px=100, camera_id="1", exif_orientation=1)
    path = written(tmp_path, f"label,x [us-ft],y [us-ft],z [ft]\np,{cells}\n", "gcp.csv")
    points, _ = read_control(str(path), (image,), CALIFORNIA, (0.0, 0.0, 0.0), marks=str(marks))
    np.testing.assert_allclose(points[0].position_m, (CX, CY, CZ), rtol=0, atol=1e-3)
    head = "#Label,X/Easting (us-ft),Y/Northing (us-ft),Z/Altitude (ft),Yaw_(rad),Pitch_(rad),Roll_(rad)"
    row = read_pose_file(
        written(tmp_path, f"# CoordinateSystem: {wkt}\n{head}\na,{cells},1,0,0\n", "reference.csv")
    ).rows[0]
    np.testing.assert_allclose(row.position or (), (CX, CY, CZ), rtol=0, atol=1e-4)
    assert row.attitude == pytest.approx((math.degrees(1.0), 0.0, 0.0))


@pytest.mark.parametrize("words", ["heights: ellipsoidal", "altitudes above mean sea level", "heights in m, EGM96"])
def test_the_zero_of_heights_is_repeated(tmp_path: Path, words: str) -> None:
    found = read_pose_file(written(tmp_path, f"# {words}\nimage,x,y,z\na.jpg,1,2,3\n"))
    assert found.rows[0].position == (1.0, 2.0, 3.0)
    assert f"'# {words}': ground and control points must count" in found.warnings[0]
