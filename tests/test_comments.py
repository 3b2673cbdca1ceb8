"""What comments, columns and files beside a list state of its numbers: applied, refused by name, or named."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from make_pose_files import written
from pyproj import CRS, Transformer

from aeromatch_cli.blocks.control_files import Survey, read_survey
from aeromatch_cli.blocks.crs_comments import crs_comment
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.blocks.statements import statements_of
from aeromatch_cli.errors import ConfigError

FT, US_FT = 0.3048, 1200.0 / 3937.0
UTM = "EPSG:32633"
POSES = "image,x,y,z,omega,phi,kappa,accuracy_xy,accuracy_z\na.jpg,100,200,300,1,2,3,20,30\n"
POINTS = "label,x,y,z,accuracy_xy,accuracy_z\nP,1000,2000,300,20,30\n"


def survey_of(folder: Path, text: str, name: str = "points.csv") -> Survey:
    written(folder, "image,label,x,y\na.jpg,P,1,2\n", "marks.csv")
    return read_survey(written(folder, text, name), folder / "marks.csv")


# comment -> metres of one unit across, of heights, of accuracies, degrees of one of angles
UNITS = [
    ("vertical units: ft", (1, FT, 1, 1)),
    ("Vertical unit: foot_us", (1, US_FT, 1, 1)),
    ("vertical datum NAVD88 (ft)", (1, FT, 1, 1)),
    ("NAVD88 (ft)", (1, FT, 1, 1)),
    ("NAVD88 heights in feet", (1, FT, 1, 1)),
    ("Höhe in Fuß (NAVD88)", (1, FT, 1, 1)),
    ("Elevation data are US survey feet above NAVD88", (1, US_FT, 1, 1)),
    ("heights: NAVD88, US Survey Feet", (1, US_FT, 1, 1)),
    ("Z in feet above sea level", (1, FT, 1, 1)),
    ("Units: feet (US survey)", (US_FT, US_FT, 1, 1)),
    ("units: survey feet", (US_FT, US_FT, 1, 1)),
    ("units: Foot_US", (US_FT, US_FT, 1, 1)),
    ("units: U.S. Survey Feet", (US_FT, US_FT, 1, 1)),
    ("coordinates in feet, US survey", (US_FT, US_FT, 1, 1)),
    ("vertical units: feet (intl)", (1, FT, 1, 1)),
    ("All values in feet", (FT, FT, 1, 1)),
    ("Linear unit: US survey foot", (US_FT, US_FT, 1, 1)),
    ("Horizontal units: US Survey Feet", (US_FT, 1, 1, 1)),
    ("x_unit=ft, z_unit=m", (FT, 1, 1, 1)),
    ("coordinates in m, sigma in mm", (1, 1, 1e-3, 1)),
    ("std dev in mm, coordinates in m", (1, 1, 1e-3, 1)),
    ("accuracies of x, y, z in cm", (1, 1, 1e-2, 1)),
    ("coordinates and accuracies in feet", (FT, FT, FT, 1)),
    ("angular units = gon", (1, 1, 1, 0.9)),
    ("Rotation angles [gon]", (1, 1, 1, 0.9)),
    ("Winkel in gon", (1, 1, 1, 0.9)),
    ("all angles given in centesimal degrees", (1, 1, 1, 0.9)),
    ("EOF units gon", (1, 1, 1, 0.9)),
    ("Angles are in radians (rad)", (1, 1, 1, math.degrees(1))),
    ("Units: international feet; angles: grads (400)", (FT, FT, 1, 0.9)),
    ("Units: m, gon", (1, 1, 1, 0.9)),
    ("feet: x y z", (FT, FT, 1, 1)),
    ("US feet heights, mm accuracies", (1, US_FT, 1e-3, 1)),
    ("focal length in mm, heights in feet", (1, FT, 1, 1)),
    ("heights in ft (1 ft = 0.3048 m)", (1, FT, 1, 1)),
]


@pytest.mark.parametrize(("comment", "units"), UNITS)
def test_units_of_comments_in_any_words(tmp_path: Path, comment: str, units: tuple) -> None:
    across, up, sigma, angle = units
    row = read_pose_file(written(tmp_path, f"# {comment}\n{POSES}")).rows[0]
    np.testing.assert_allclose(row.position or (), (100 * across, 200 * across, 300 * up), rtol=1e-12)
    np.testing.assert_allclose(row.attitude or (), (angle, 2 * angle, 3 * angle), rtol=1e-12)
    np.testing.assert_allclose(row.sigmas_m or (), (20 * sigma, 20 * sigma, 30 * sigma), rtol=1e-12)
    for text in (POINTS, POINTS.partition("\n")[2]):  # with and without a header
        point = survey_of(tmp_path, f"# {comment}\n{text}").points[0]
        np.testing.assert_allclose(point.position, (1000 * across, 2000 * across, 300 * up), rtol=1e-12)
        np.testing.assert_allclose(point.sigmas_m or (), (20 * sigma, 20 * sigma, 30 * sigma), rtol=1e-12)


@pytest.mark.parametrize(
    ("comment", "words"),
    [
        ("flying height 300 ft, angles from the IMU in gon", "not clearly of what"),
        ("survey feet", "not clearly of what"),
        ("flight altitudes in feet", "not clearly of what"),
        ("heights converted from feet to m", "not clearly of what"),
        ("Coordinates: US State Plane, feet", "not clearly of what"),
        ("heights in m or ft", "names m and ft for one thing"),
        ("Reference: takeoff", "may say what heights count from"),
        ("flight heights above ground", "speaks of heights above ground"),
        ("UTM33", "names no whole CRS"),
        ("zone: 33N", "names no whole CRS"),
        ("Datum: NAD27", "names no whole CRS"),
        ("hemisphere: S", "names no whole CRS"),
        ("converted from EPSG:4326", "does not say which CRS"),
    ],
)
def test_what_cannot_be_placed_is_named_and_changes_nothing(tmp_path: Path, comment: str, words: str) -> None:
    found = read_pose_file(written(tmp_path, f"# {comment}\n{POSES}"))
    assert found.rows[0].position == (100.0, 200.0, 300.0)
    assert found.crs is None
    assert any(words in one and comment in one for one in found.warnings)
    survey = survey_of(tmp_path, f"# {comment}\n{POINTS}")
    assert survey.points[0].position == (1000.0, 2000.0, 300.0)
    assert any(words in one and comment in one for one in survey.remarks)


@pytest.mark.parametrize(
    "comment",
    [
        "exported by X on 2024-05-03", "flight height 100 m", "flight height above ground: 100 m",
        "images taken in 5 m steps", "flown at 400 ft AGL", "AGL: 80 m", "mission altitude 120 m above ground level",
        "ground control points of the city, 12 pieces", "pixel size 2.4 um, focal length in mm: 8.8", "GSD 2.5cm",
        "take-off at 10:32, landing 10:58", "antenna height 1.8 ft", "35 mm lens", "relative accuracy of heights 0.1",
        "home point elevation: 34.2 m", "Datum: 03.05.2024", "scale 1:500", "Metashape 2.1, 1 ft = 0.3048 m",
        "coordinates of the projection centres", "projection centres in m", "magnetic declination: 3.5 (applied)",
        "image,x,y,z [ft]", "1,200 pictures of 80 MB each", "Camera: 24 mm, f/5.6, 1/1000 s", "strip 3, line 12",
        "time zone: local", "GPS week 2210, leap seconds 18", "processed with RTK base 12 km away",
    ],
)  # fmt: skip
def test_ordinary_comments_state_nothing(tmp_path: Path, comment: str) -> None:
    plain = read_pose_file(written(tmp_path, f"#\n{POSES}"))
    found = read_pose_file(written(tmp_path, f"# {comment}\n{POSES}"))
    assert (found.rows, found.warnings, found.crs) == (plain.rows, plain.warnings, None)


@pytest.mark.parametrize(
    "comment",
    [
        "AGL heights", "AGL", "z = height above takeoff", "Altitude reference: takeoff", "heights are AGL",
        "Altitude mode: relativeToGround", "altitudes relative to the home point", "vertical reference: ground level",
        "heights: barometric (relative to take-off)", "Höhen über Grund", "height above ground: 100 m",
    ],
)  # fmt: skip
def test_heights_above_the_ground_are_refused_in_any_words(tmp_path: Path, comment: str) -> None:
    for read, text in (
        (lambda t: read_pose_file(written(tmp_path, t)), POSES),
        (lambda t: survey_of(tmp_path, t), POINTS),
    ):
        with pytest.raises(ConfigError, match="heights do not count from a datum") as caught:
            read(f"# {comment}\n{text}")
        assert comment in str(caught.value)


@pytest.mark.parametrize(
    ("comment", "zero"),
    [
        ("heights relative to the ellipsoid", "ellipsoid"), ("vertical datum: NAVD88", "EPSG:5703"),
        ("heights above mean sea level", ""), ("Datum: NAVD 88", "EPSG:5703"),
    ],
)  # fmt: skip
def test_zeros_of_comments(tmp_path: Path, comment: str, zero: str) -> None:
    found = read_pose_file(written(tmp_path, f"# {comment}\n{POSES}"))
    assert found.heights == zero
    assert any("the same zero" in words for words in found.warnings)
    assert survey_of(tmp_path, f"# {comment}\n{POINTS}").heights == zero


SYSTEMS = [
    "Coordinate system: WGS 84 / UTM zone 33N (EPSG::32633)", "EPSG=32633", "EPSG code: 32633", "srid 32633",
    "SRID=32633",
    "crs: urn:ogc:def:crs:EPSG::32633", "Projection: UTM 33N WGS84", 'PROJCS: "WGS 84 / UTM zone 33N"', "WGS84 UTM33N",
    "+proj=utm +zone=33 +datum=WGS84", "proj: +proj=utm +zone=33 +datum=WGS84", "crs 32633", "WGS 84 / UTM zone 33N",
    "UTM zone 33, northern hemisphere, WGS84", "coordinates are in EPSG:32633", "CRS: EPSG:32633, angles in degrees",
    f"CRS: {CRS(UTM).to_wkt('WKT1_GDAL')}",
]  # fmt: skip


@pytest.mark.parametrize("comment", SYSTEMS)
def test_crs_of_comments_in_any_words(tmp_path: Path, comment: str) -> None:
    for text in (POSES, "a.jpg,100,200,300\n", "a.jpg 100 200 300 1 2 3\n"):
        found = read_pose_file(written(tmp_path, f"# {comment}\n{text}"))
        assert found.rows[0].position == (100.0, 200.0, 300.0)
        assert found.crs == UTM
    survey = survey_of(tmp_path, f"# {comment}\n{POINTS}")
    assert CRS(survey.crs).equals(CRS(UTM), ignore_axis_order=True) or "UTM zone 33N" in CRS(survey.crs).name
    marks = "".join(f"{x} 200 300 {x} 20 a.jpg P{x}\n" for x in (100, 110))
    listed = read_survey(written(tmp_path, f"# {comment}\n# x y z px py image name\n{marks}", "gcp_list.txt"), None)
    assert [point.position[0] for point in listed.points] == [100.0, 110.0]
    assert listed.crs == survey.crs


def test_the_unit_of_a_crs_with_its_code_in_brackets_counts(tmp_path: Path) -> None:
    comment = "# Coordinate system: NAD83(2011) / California zone 3 (ftUS) EPSG:6420\n"
    found = read_pose_file(written(tmp_path, f"{comment}{POSES}"))
    np.testing.assert_allclose(found.rows[0].position or (), np.array([100, 200, 300]) * US_FT, rtol=1e-9)
    assert found.crs == "EPSG:6419"


@pytest.mark.parametrize("text", [POSES, "a.jpg,100,200,300\n"])
@pytest.mark.parametrize("end", ["prj", "qpj"])
def test_a_prj_beside_a_list_counts(tmp_path: Path, text: str, end: str) -> None:
    wkt = CRS.from_proj4("+proj=utm +zone=33 +datum=WGS84 +units=us-ft").to_wkt("WKT1_ESRI")
    written(tmp_path, wkt, f"list.{end}")
    found = read_pose_file(written(tmp_path, text))
    np.testing.assert_allclose(found.rows[0].position or (), np.array([100, 200, 300]) * US_FT, rtol=1e-9)
    assert CRS(found.crs).utm_zone == "33N"
    written(tmp_path, "$PROJECT 6.0\n", f"list.{end}")  # of Inpho
    assert read_pose_file(written(tmp_path, text)).rows[0].position == (100.0, 200.0, 300.0)


@pytest.mark.parametrize("named", ["# Datum: NAD27\nimage,lat,lon,alt\n", "image,lat,lon,alt,datum\n"])
def test_a_datum_of_degrees_is_applied(tmp_path: Path, named: str) -> None:
    cell = ",NAD27" if "datum\n" in named else ""
    row = read_pose_file(written(tmp_path, f"{named}a.jpg,40,-100,300{cell}\n")).rows[0]
    longitude, latitude = Transformer.from_crs("EPSG:4267", "EPSG:4326", always_xy=True).transform(-100, 40)
    np.testing.assert_allclose(row.position or (), (latitude, longitude, 300), atol=1e-9)
    assert abs(longitude + 100.0) > 1e-4  # some 30 m


@pytest.mark.parametrize(
    ("header", "cells", "position"),
    [
        ("lat,latref,lon,lonref,alt", "52,S,13,W,300", (-52, -13, 300)),
        ("lat,N/S,lon,E/W,alt", "52,south,13,East,300", (-52, 13, 300)),
        ("latitude,longitude,altitude,latitude_ref,longitude_ref", "-52,13,300,S,W", (-52, -13, 300)),
        ("latitude (S),longitude (W),alt", "52,13,300", (-52, -13, 300)),
        ("lat,lon,alt,altitude_unit", "52,13,300,ft", (52, 13, 300 * FT)),
        ("lat,lon,alt,units", "52,13,300,feet", (52, 13, 300 * FT)),
        ("x,y,z,unit", "100,200,300,US survey feet", (100 * US_FT, 200 * US_FT, 300 * US_FT)),
        ("x,y,z,z_unit", "100,200,300,ft", (100, 200, 300 * FT)),
        ("lat,lon,Elev (ft)", "52,13,300", (52, 13, 300 * FT)),
        ("lat,lon,MSL_ft", "52,13,300", (52, 13, 300 * FT)),
        ("lat,lon,alt(m) MSL", "52,13,300", (52, 13, 300)),
        ("lat,lon,alt_msl_ft", "52,13,300", (52, 13, 300 * FT)),
        ("E[m],N[m],H[m]", "100,200,300", (100, 200, 300)),
        ("East,North,Height", "100,200,300", (100, 200, 300)),
        ("x,y,z (NAVD88 ft)", "100,200,300", (100, 200, 300 * FT)),
        ("x (feet US),y (survey ft),z", "100,200,300", (100 * US_FT, 200 * US_FT, 300)),
    ],
)
@pytest.mark.parametrize("image", ["image", "PhotoID", "Nom de l'image"])
def test_units_sides_and_heights_in_columns(
    tmp_path: Path, header: str, cells: str, position: tuple, image: str
) -> None:
    found = read_pose_file(written(tmp_path, f"{image},{header}\na.jpg,{cells}\n"))
    np.testing.assert_allclose(found.rows[0].position or (), position, rtol=1e-12)
    assert found.rows[0].image == "a.jpg"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("image,lat,lon,alt,lat_ref\na.jpg,-52,13,3,N\n", "-52 and the side N contradict each other"),
        ("image,lat,lon,alt,lat_ref\na.jpg,52,13,3,x\n", "'x' is no side of the globe"),
        ("image,x,y,z,z_unit\na.jpg,1,2,3,ft\nb.jpg,1,2,3,m\n", "column z_unit: ft and m: only one can be applied"),
        ("image,lat,lon,alt,altitude_ref\na.jpg,52,13,3,takeoff\n", "heights do not count from a datum"),
        ("image,lat,lon,alt [m ATO]\na.jpg,52,13,3\n", "counts from the ground"),
        ("# z in Indian feet\nimage,x,y,z\na.jpg,1,2,3\n", "'indian feet', which is no length that is known"),
        ("# yaw: magnetic north\nimage,lat,lon,alt,yaw,pitch,roll\na.jpg,52,13,3,1,2,3\n", "lack the declination"),
        ("image,lat,lon,alt,yaw (magnetic),pitch,roll\na.jpg,52,13,3,1,2,3\n", "lack the declination"),
        (
            "# headings from grid north\nimage,lat,lon,alt,yaw,pitch,roll\na.jpg,52,13,3,1,2,3\n",
            "count from true north",
        ),
    ],
)
def test_statements_that_cannot_be_applied_are_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_pose_file(written(tmp_path, text))
    assert said in str(caught.value)


def test_columns_that_may_be_heights_are_named(tmp_path: Path) -> None:
    found = read_pose_file(written(tmp_path, "image,x,y,baro_alt\na.jpg,1,2,3\n"))
    assert math.isnan((found.rows[0].position or ())[2])
    assert any("baro_alt may be heights and are not read" in words for words in found.warnings)


@pytest.mark.parametrize("head", ["# yaw from true north\nimage,x,y,z,yaw", "image,x,y,z,yaw (true north)"])
def test_headings_of_grid_positions_may_count_from_true_north(tmp_path: Path, head: str) -> None:
    assert read_pose_file(written(tmp_path, f"{head},pitch,roll\na.jpg,391000,5819000,300,1,2,3\n")).rows[0].true_north


@pytest.mark.parametrize(
    ("header", "cells", "position"),
    [
        ("label,lat,latref,lon,lonref,z,z_unit", "52,S,13,W,300,ft", (-13, -52, 300 * FT)),
        ("label,x,y,z,units", "100,200,300,feet", (100 * FT, 200 * FT, 300 * FT)),
        ("label,x,y,Elev (US ft)", "100,200,300", (100, 200, 300 * US_FT)),
        ("label,x,y,MSL_ft", "100,200,300", (100, 200, 300 * FT)),
    ],
)
def test_columns_of_control_points(tmp_path: Path, header: str, cells: str, position: tuple) -> None:
    point = survey_of(tmp_path, f"{header}\nP,{cells}\n").points[0]
    np.testing.assert_allclose(point.position, position, rtol=1e-12)


@pytest.mark.slow
def test_a_comment_is_read_in_one_pass_whatever_its_length() -> None:
    long = "# " + "heights above the " * 20_000 + "z ( " * 20_000
    assert not statements_of([long]).units
    assert crs_comment(long) is None
    rows = [f"# flight 7/b/IMG_{n:04}.jpg,52.{n},13.{n},100 # off" for n in range(3000)]  # lines switched off
    assert statements_of(rows).crs is None
