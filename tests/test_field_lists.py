"""Lists as people have them, rebuilt after public reports: docs/field_cases.md names the source of each."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from make_images import gps_tags, write_image
from make_pose_files import written
from read_inputs import read_inputs

from aeromatch_cli.blocks.control import read_control
from aeromatch_cli.blocks.control_files import read_survey
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.data import Image
from aeromatch_cli.errors import ConfigError

US_FT = 1200.0 / 3937.0
X, Y, Z = 390950.0, 5818970.0, 142.6
LATITUDE, LONGITUDE = 52.50993, 13.39315
CALIFORNIA, CX, CY, CZ = "EPSG:26943", 1850000.0, 650000.0, 90.0
IMAGE = Image(image_id="a", name="a.jpg", width_px=100, height_px=100, camera_id="1", exif_orientation=1)
MARK = "a.jpg,P1,10,20\n"


# --- poses --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "position", "crs"),
    [
        (f"wkt_geom\tfilename\nPointZ ({X} {Y} {Z})\ta.jpg\n", (X, Y, Z), None),
        (f'WKT,filename,lat,lon\n"POINT Z ({LONGITUDE} {LATITUDE} {Z})",a.jpg,1,2\n', (LATITUDE, LONGITUDE, Z), None),
        (f"filename,geometry,altitude\na.jpg,POINT ({LONGITUDE} {LATITUDE}),{Z}\n", (LATITUDE, LONGITUDE, Z), None),
        (f"filename,geom\na.jpg,SRID=32633;POINT Z ({X} {Y} {Z})\n", (X, Y, Z), "EPSG:32633"),
        (f",filename,geometry\n0,a.jpg,POINT Z ({LONGITUDE} {LATITUDE} {Z})\n", (LATITUDE, LONGITUDE, Z), None),
        # Emlid Studio, with two forms of coordinates.
        (
            f"Photo,Latitude,Longitude,Ellipsoidal height,Easting,Northing\na.jpg,{LATITUDE},{LONGITUDE},{Z},{X},{Y}\n",
            (LATITUDE, LONGITUDE, Z),
            None,
        ),
        (f"image,x,y,z,lat,lon,alt,crs\na.jpg,{X},{Y},{Z},1,2,3,32633\n", (X, Y, Z), "EPSG:32633"),
        # ExifTool's words behind heights, and its one tag for both coordinates.
        (f"FileName,GPSLatitude,GPSLongitude,GPSAltitude\na.jpg,{LATITUDE} N,{LONGITUDE} E,{Z} m Above Sea Level\n",
         (LATITUDE, LONGITUDE, Z), None),
        (f"image,lat,lon,alt\na.jpg,{LATITUDE},{LONGITUDE},{Z} m Below Sea Level\n", (LATITUDE, LONGITUDE, -Z), None),
        (f'SourceFile,GPSPosition,GPSAltitude\na.jpg,"{LATITUDE} S, {LONGITUDE} W",{Z} m\n', (-LATITUDE, -LONGITUDE, Z),
         None),
        # A letter of the band of latitude in the name of the zone.
        (f"WGS84 UTM 33U\na.jpg {X} {Y} {Z}\n", (X, Y, Z), "EPSG:32633"),
        (f"WGS84 UTM 33H\na.jpg {X} {Y} {Z}\n", (X, Y, Z), "EPSG:32733"),
    ],
)  # fmt: skip
def test_positions_of_gis_and_of_geotagging_tools(tmp_path: Path, text: str, position: tuple, crs: str | None) -> None:
    found = read_pose_file(written(tmp_path, text))
    assert (found.rows[0].image, found.crs) == ("a.jpg", crs)
    assert found.rows[0].position == pytest.approx(position, abs=1e-9)


def test_of_two_forms_of_position_the_one_that_counts_is_said(tmp_path: Path) -> None:
    found = read_pose_file(written(tmp_path, "image,x,y,z,lat,lon,alt\na.jpg,1,2,3,52,13,100\n"))
    assert found.rows[0].position == (52.0, 13.0, 100.0)
    assert "of two forms of position lat, lon count, since no CRS of the others is named; x, y, z" in found.warnings[0]


@pytest.mark.parametrize(
    ("head", "cells", "attitude", "sigmas_m"),
    [
        ("Name,Latitude,Longitude,AbsAlt,RltAlt,Pitch,Roll,Yaw,StdHorizon,StdHeight",
         "52,13,142,100,-90,0,10,0.02,0.05", (10.0, -90.0, 0.0), (0.02, 0.02, 0.05)),
        ("Filename,Latitude,Longitude,Height,Horizontal StdDev,Vertical StdDev", "52,13,142,0.02,0.03",
         None, (0.02, 0.02, 0.03)),
        ("Label,Latitude,Longitude,Altitude,AccuracyX,AccuracyY,AccuracyZ", "52,13,142,0.02,0.03,0.05",
         None, (0.02, 0.03, 0.05)),
        ("#name,lat,lon,alt,heading,pitch,roll,f", "52,13,142,10,1,2,35", (10.0, 1.0, 2.0), None),
        ("PhotoName,lat,lon,alt,accuracy horizontal [meter],accuracy vertical [meter]", "52,13,142,0.02,0.04",
         None, (0.02, 0.02, 0.04)),
    ],
)  # fmt: skip
def test_columns_of_other_programs(
    tmp_path: Path, head: str, cells: str, attitude: tuple | None, sigmas_m: tuple | None
) -> None:
    row = read_pose_file(written(tmp_path, f"{head}\na.jpg,{cells}\n")).rows[0]
    assert row.position == (52.0, 13.0, 142.0)
    assert (row.attitude, row.sigmas_m) == (attitude, sigmas_m and pytest.approx(sigmas_m))


@pytest.mark.parametrize("cell", ["3,91E+05", "3.9095e+05", "5.81897E+06", "4E+05"])
def test_coordinates_that_a_spreadsheet_has_rounded_are_refused(tmp_path: Path, cell: str) -> None:
    with pytest.raises(ConfigError, match=r"line 2, column x: .* has lost its last digits"):
        read_pose_file(written(tmp_path, f"image;x;y;z\na.jpg;{cell};5818970,0;142,4\n"))
    with pytest.raises(ConfigError, match="has lost its last digits"):
        read_pose_file(written(tmp_path, f"EPSG:32633\na.jpg\t{cell}\t5818970\t142\n", "geo.txt"))
    with pytest.raises(ConfigError, match="has lost its last digits"):
        read_survey(written(tmp_path, f"label;x;y;z\nP1;{cell};5818970;34\n", "gcp.csv"), None)
    with pytest.raises(ConfigError, match="has lost its last digits"):
        read_survey(written(tmp_path, f"EPSG:32633\n{cell}\t5818970\t34\t1\t2\ta.jpg\n", "gcp_list.txt"), None)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.csv", "image;x;y;z\na.jpg;390.945,174;5.818.965,434;142,4\n", "column x: '390.945,174' is not a number"),
        ("a.csv", "image,lat,lon,alt,yaw\na.jpg,52.5,13.4,142,10\n", "column 'pitch_deg' is missing"),
        ("a.csv", "image,lat,lon,alt\na.jpg,-31077865,322473932,1401\n", "column lat: -31077865 is out of range"),
        ("geo.txt", "EPSG:4326\na.jpg -31077865 322473932 1401\n", "are no longitude and latitude"),
        ("x_events.pos", "% program : RTKLIB\n2020/01/01 10:00:00.000 52.5 13.4 142 1 9\n", "an RTKLIB solution"),
    ],
)  # fmt: skip
def test_lists_that_are_refused_with_their_place(tmp_path: Path, name: str, text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        read_pose_file(written(tmp_path, text, name))


def test_a_zone_without_its_datum_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="line 1: the CRS 'UTM 33N' is unknown: give the list with a code"):
        read_pose_file(written(tmp_path, f"UTM 33N\na.jpg {X} {Y} {Z}\n", "geo.txt"))


def test_numbers_with_all_their_digits_may_have_an_exponent(tmp_path: Path) -> None:
    found = read_pose_file(written(tmp_path, "image,x,y,z\na.jpg,3.909501740000e+05,5.8189700e6,1.426e2\n"))
    assert found.rows[0].position == pytest.approx((390950.174, 5818970.0, 142.6))


@pytest.mark.parametrize(
    "head",
    [
        "time(millisecond),latitude,longitude,height_above_takeoff(feet)",
        "timestamp,timestamp_utc,seq,lat,lon,alt,ground_distance",
    ],
)
def test_flight_logs_are_named(tmp_path: Path, head: str) -> None:
    with pytest.raises(ConfigError, match="looks like a flight log or a track, positions by time without image names"):
        read_pose_file(written(tmp_path, f"{head}\n{','.join('1' for _ in head.split(','))}\n"))


@pytest.mark.parametrize("code", ["ESRI:102100", "EPSG:3857"])
def test_numbers_of_utm_under_the_crs_of_web_maps_are_named(tmp_path: Path, code: str) -> None:
    for text, name in (
        (f"{code}\na.jpg {X} {Y} {Z}\n", "geo.txt"),
        (f"# CRS: {code}\nimage,x,y,z\na.jpg,{X},{Y},{Z}\n", "a.csv"),
    ):
        found = read_pose_file(written(tmp_path, text, name))
        assert found.position_kind == "geographic"
        assert any("lie at latitude 46.24, longitude 3.51 in" in said for said in found.warnings)
    berlin = read_pose_file(written(tmp_path, f"{code}\na.jpg 1490918.57 6892782.32 {Z}\n", "geo.txt"))
    assert berlin.warnings == ()


def test_lists_of_the_raw_pictures_are_those_of_the_developed_ones(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_image(tmp_path / "images" / f"{name}.jpg")
    found = read_inputs(tmp_path / "images", written(tmp_path, "image,x,y,z\na.ARW,1,2,3\nb.ARW,4,5,6\n"))
    assert [pose.center_m.tolist() for pose in found.poses.values()] == [[1, 2, 3], [4, 5, 6]]
    found = read_inputs(tmp_path / "images", written(tmp_path, "image,x,y,z\na.ARW,1,2,3\na.jpg,4,5,6\n"))
    assert [pose.center_m.tolist() for pose in found.poses.values()] == [[4, 5, 6]]


@pytest.mark.parametrize(
    ("latitude", "longitude", "sides", "expected"),
    [
        ("38.025312", "145.28905", ("S", "E"), (-38.025312, 145.28905)),
        ("-38.025312", "145.28905", ("N", "E"), (-38.025312, 145.28905)),
        ("-38.025312", "145.28905", ("S", "E"), (-38.025312, 145.28905)),
        ("38.025312", "122.5", ("North", "West"), (38.025312, -122.5)),
    ],
)
def test_signs_and_letters_of_exiftool(
    tmp_path: Path, latitude: str, longitude: str, sides: tuple, expected: tuple
) -> None:
    head = "SourceFile,GPSLatitude,GPSLongitude,GPSLatitudeRef,GPSLongitudeRef,GPSAltitude"
    text = f"{head}\n./a.jpg,{latitude},{longitude},{sides[0]},{sides[1]},100\n"
    assert read_pose_file(written(tmp_path, text)).rows[0].position == (*expected, 100.0)


@pytest.mark.parametrize(
    ("text", "attitude", "sigmas_m"),
    [
        ("#imagename,coordinate1,coordinate2,z,yaw,pitch,roll\na.jpg,52.5,13.4,142,38.6,3.5,8.3\n",
         (38.6, 3.5, 8.3), None),
        ("a.jpg,52.5,13.4,142,0.02,0.04\n", None, (0.02, 0.02, 0.04)),
        ("EPSG:4326\n\na.jpg 13.4 52.5 142 nan nan nan 0.02 0.04\n", None, (0.02, 0.02, 0.04)),
        ("EPSG:4326\na.jpg 13.4 52.5 142 38.6 3.5 8.3\n", (38.6, 3.5, 8.3), None),
    ],
)  # fmt: skip
def test_lists_without_header(tmp_path: Path, text: str, attitude: tuple | None, sigmas_m: tuple | None) -> None:
    row = read_pose_file(written(tmp_path, text)).rows[0]
    assert (row.position, row.attitude, row.sigmas_m) == ((52.5, 13.4, 142.0), attitude, sigmas_m)


# --- a CRS in feet with --crs -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("crs", "head", "values"),
    [
        ("EPSG:2227", "x,y,z", (CX / US_FT, CY / US_FT, CZ / US_FT)),
        ("EPSG:2227+5703", "x,y,z", (CX / US_FT, CY / US_FT, CZ)),
        ("EPSG:2227", "x,y,alt_ft", (CX / US_FT, CY / US_FT, CZ / 0.3048)),
        ("EPSG:2227", "x [m],y [m],z [m]", (CX, CY, CZ)),
        ("EPSG:26943+6360", "x,y,z", (CX, CY, CZ / US_FT)),
    ],
)
def test_a_crs_in_feet_that_the_user_names(tmp_path: Path, crs: str, head: str, values: tuple) -> None:
    write_image(tmp_path / "images" / "a.jpg")
    cells = ",".join(f"{value:.6f}" for value in values)
    found = read_inputs(tmp_path / "images", written(tmp_path, f"image,{head}\na.jpg,{cells}\n"), crs=crs)
    assert found.crs == CALIFORNIA
    np.testing.assert_allclose(found.poses["a_jpg"].center_m + found.origin_m, (CX, CY, CZ), rtol=0, atol=1e-5)


def test_a_list_without_header_and_positions_of_exif_under_a_crs_in_feet(tmp_path: Path) -> None:
    write_image(tmp_path / "images" / "a.jpg", gps=gps_tags(37.8, -122.3, 90.0))
    found = read_inputs(tmp_path / "images", "exif", crs="EPSG:2227")
    assert found.crs == CALIFORNIA
    x, y, z = found.poses["a_jpg"].center_m + found.origin_m
    assert 1_800_000 < x < 1_900_000
    assert 600_000 < y < 700_000
    assert z == pytest.approx(90.0)
    plain = written(tmp_path, f"a.jpg {CX / US_FT:.6f} {CY / US_FT:.6f} {CZ / US_FT:.6f} 0 0 0\n", "plain.txt")
    places = read_pose_file(plain, crs="EPSG:2227").rows[0].position
    np.testing.assert_allclose(places or (), (CX, CY, CZ), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        (f"P1,{CX / US_FT:.6f},{CY / US_FT:.6f},{CZ / US_FT:.6f}\n", (CX, CY, CZ)),
        (f"label,x,y,z [m]\nP1,{CX / US_FT:.6f},{CY / US_FT:.6f},{CZ}\n", (CX, CY, CZ)),
        (f"label,x [m],y [m],z [m]\nP1,{CX},{CY},{CZ}\n", (CX, CY, CZ)),
        ("label,lat,lon,z\nP1,37.5,-122,90\n", (1867375.640, 612043.529, 90.0)),
        (f"EPSG:26943\n{CX} {CY} {CZ} 10 20 a.jpg P1\n", (CX, CY, CZ)),
    ],
)
def test_control_points_without_crs_count_in_the_crs_that_the_user_names(
    tmp_path: Path, text: str, place: tuple
) -> None:
    path, marks = written(tmp_path, text, "gcp.csv"), written(tmp_path, MARK, "marks.csv")
    more = {"marks": str(marks)} if "EPSG" not in text else {}
    points, _ = read_control(str(path), (IMAGE,), CALIFORNIA, (0.0, 0.0, 0.0), usual_crs="EPSG:2227", **more)
    np.testing.assert_allclose(points[0].position_m, place, rtol=0, atol=2e-3)


# --- control points -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "position", "crs"),
    [
        (f"EPSG:32633\t\t\t\nP1\t{X}\t{Y}\t34\n", (X, Y, 34.0), "EPSG:32633"),
        (f"WGS84 UTM33N\nP1 {X} {Y} 34\n", (X, Y, 34.0), "WGS84 UTM33N"),
        (f"#, CRS, EPSG:32633,\nid, x, y, z\nP1, {X}, {Y}, 34\n", (X, Y, 34.0), "EPSG:32633"),
        (f"# CRS: EPSG:32633\nP1,{X},{Y},34\n", (X, Y, 34.0), "EPSG:32633"),
        ("GCP Label,Northing/Latitude,Easting/Longitude,Elevation (ft)\nP1,52.5,13.4,100\n", (13.4, 52.5, 30.48), None),
        (f"Point,Northing (ft),Easting (ft),Elev (ft)\nP1,{Y / 0.3048},{X / 0.3048},100\n", (X, Y, 30.48), None),
        (f'WKT,name\n"POINT Z ({X} {Y} 34)",P1\n', (X, Y, 34.0), None),
        (f"fid;name;geom\n1;P1;SRID=32633;POINT Z ({X} {Y} 34)\n".replace("SRID=32633;", ""), (X, Y, 34.0), None),
    ],
)
def test_tables_of_control_points(tmp_path: Path, text: str, position: tuple, crs: str | None) -> None:
    written(tmp_path, MARK, "marks.csv")
    found = read_survey(written(tmp_path, text, "gcp.csv"), None)
    assert (found.points[0].name, found.crs) == ("P1", crs)
    assert found.points[0].position == pytest.approx(position)


@pytest.mark.parametrize(
    "head",
    ["WGS84\t", "EPSG:4326", "EPSG:4979", "+proj=longlat +datum=WGS84 +no_defs +type=crs", "# remark\nEPSG:4326"],
)
def test_gcp_list_in_degrees(tmp_path: Path, head: str) -> None:
    """The longitude stands first, as in ODM; a line behind # is no measurement."""
    lines = f"{LONGITUDE}\t{LATITUDE}\t34\t10.5\t20\ta.jpg\tP1\n#{LONGITUDE}\t{LATITUDE}\t34\t1\t2\tb.jpg\tP1\n"
    path = written(tmp_path, f"{head}\n{lines}", "gcp_list.txt")
    points, remarks = read_control(str(path), (IMAGE,), "EPSG:32633", (0.0, 0.0, 0.0))
    np.testing.assert_allclose(points[0].position_m, (390950.4, 5818970.3, 34.0), rtol=0, atol=0.5)
    np.testing.assert_allclose(points[0].pixels["a"], (10.0, 19.5))
    assert remarks == []


@pytest.mark.parametrize("head", ["PUWG1992", "WGS84 longlat"])
def test_words_that_are_no_crs(tmp_path: Path, head: str) -> None:
    path = written(tmp_path, f"{head}\n{X} {Y} 34 10 20 a.jpg P1\n", "gcp_list.txt")
    with pytest.raises(ConfigError, match=f"line 1: '{head}' is no CRS: write a code"):
        read_control(str(path), (IMAGE,), "EPSG:32633", (0.0, 0.0, 0.0))


def test_names_of_columns_below_the_crs_of_gcp_list(tmp_path: Path) -> None:
    text = f"EPSG:32633\ngeo_x,geo_y,geo_z,im_x,im_y,image_name,gcp_name\n{X},{Y},34,10,20,a.jpg,P1\n"
    found = read_survey(written(tmp_path, text, "gcp_list.txt"), None)
    assert (found.crs, found.points[0].position, found.marks[0].pixel) == ("EPSG:32633", (X, Y, 34.0), (10.0, 20.0))


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("gcp_list.txt", f"{X} {Y} 34 1 2 a.jpg P1\n{X} {Y} 34 1 2 b.jpg P1\n", "the first line names the CRS"),
        ("gcp.csv", "label,lat,lon,Height AGL\nP1,52,13,34\n", "is no file of control points that is known"),
        ("gcp.xlsx", "PK", "are a workbook: save the sheet as CSV"),
        ("gcp.kml", "<kml/>", "are a layer of GIS: export it as CSV"),
    ],
)
def test_what_holds_no_control_points_is_named(tmp_path: Path, name: str, text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        read_survey(written(tmp_path, text, name), None)


def test_names_of_images_in_another_case(tmp_path: Path) -> None:
    path = written(tmp_path, f"EPSG:32633\n{X} {Y} 34 10 20 A.JPG P1\n", "gcp_list.txt")
    points, _ = read_control(str(path), (IMAGE,), "EPSG:32633", (0.0, 0.0, 0.0))
    np.testing.assert_allclose(points[0].pixels["a"], (9.5, 19.5))


def test_the_page_of_the_cases_names_tests_that_exist() -> None:
    folder = Path(__file__).parent
    page = (folder.parent / "docs" / "field_cases.md").read_text(encoding="utf-8")
    own = "".join((folder / f"test_field_{kind}.py").read_text(encoding="utf-8") for kind in ("lists", "images"))
    named = re.findall(r"(?:`(test_\w+\.py)`: )?\b(test_\w+)\b(?!\.py)", page)
    assert len(named) > 60
    texts = {file: (folder / file).read_text(encoding="utf-8") if file else own for file, _ in named}
    assert [name for file, name in named if f"def {name}(" not in texts[file]] == []


def test_points_whose_name_says_that_they_are_check_points(tmp_path: Path) -> None:
    text = f"EPSG:32633\n{X} {Y} 34 10 20 a.jpg p1\n{X} {Y} 35 30 20 a.jpg CHK-p2\n"
    found = read_survey(written(tmp_path, text, "gcp_list.txt"), None)
    assert [(point.name, point.check) for point in found.points] == [("p1", False), ("CHK-p2", True)]
    assert found.remarks == ("gcp_list.txt: 1 point is a check point by name (CHK-...)",)


def test_heights_that_are_all_zero_are_named(tmp_path: Path) -> None:
    lines = "".join(f"{X + k} {Y} 0 10 20 a.jpg P{k}\n" for k in range(3))
    path = written(tmp_path, f"EPSG:32633\n{lines}", "gcp_list.txt")
    _, remarks = read_control(str(path), (IMAGE,), "EPSG:32633", (0.0, 0.0, 0.0))
    assert "gcp_list.txt: all 3 control points have the height 0: were heights surveyed?" in remarks
