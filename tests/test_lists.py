"""Lists of other programs, as people write and edit them: names, separators, numbers of exposures."""

from __future__ import annotations

import json
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from make_pose_files import written

from aeromatch_cli.blocks.agreement import refuse_degrees
from aeromatch_cli.blocks.camera_files import read_camera_file
from aeromatch_cli.blocks.control import read_control
from aeromatch_cli.blocks.image_names import matched_rows
from aeromatch_cli.blocks.observations import observation_of_row
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.data import Image
from aeromatch_cli.errors import ConfigError

NAMES = ["2022-09-26 15-24-40 DJI_0290.JPG", "2022-09-26 15-24-41 DJI_0291.JPG"]


def images(*names: str, size: tuple[int, int] = (500, 330)) -> tuple[Image, ...]:
    return tuple(Image(name, name, size[0], size[1], "1", 1) for name in names)


@pytest.mark.parametrize("separator", ["\t", " ", ";", ",", ", "])
@pytest.mark.parametrize("quote", ["", '"'])
@pytest.mark.parametrize("end", ["\n", "  \r\n"])
def test_names_with_blanks_in_geo_txt(tmp_path: Path, separator: str, quote: str, end: str) -> None:
    lines = [separator.join([f"{quote}{name}{quote}", f"{390950 + k}.5", "5818924.25", "142.5"])
             for k, name in enumerate(NAMES)]  # fmt: skip
    found = read_pose_file(
        written(tmp_path, b"\xef\xbb\xbf" + end.join(["EPSG:32633", *lines, ""]).encode(), "geo.txt")
    )
    assert [row.image for row in found.rows] == NAMES
    assert [row.position for row in found.rows] == [(390950.5, 5818924.25, 142.5), (390951.5, 5818924.25, 142.5)]


def test_decimal_commas_between_blanks(tmp_path: Path) -> None:
    found = read_pose_file(written(tmp_path, "EPSG:32633\na.jpg 390950,5 5818924,25 142,5\n", "geo.txt"))
    assert found.rows[0].position == (390950.5, 5818924.25, 142.5)
    found = read_pose_file(written(tmp_path, "image x y z\nmy a.jpg 390950,5 5818924,25 142,5\n", "list.txt"))
    assert (found.rows[0].image, found.rows[0].position) == ("my a.jpg", (390950.5, 5818924.25, 142.5))


@pytest.mark.parametrize("separator", ["\t", " ", ",", ";"])
def test_names_with_blanks_in_gcp_list(tmp_path: Path, separator: str) -> None:
    lines = [separator.join(["390940.5", "5818925.25", "34", f"{100 + k}", "200", name, "P0"])
             for k, name in enumerate(NAMES)]  # fmt: skip
    path = written(tmp_path, "\n".join(["EPSG:32633", *lines, ""]), "gcp_list.txt")
    points, remarks = read_control(str(path), images(*NAMES), "EPSG:32633", (0.0, 0.0, 0.0))
    assert remarks == []
    assert [point.name for point in points] == ["P0"]
    np.testing.assert_allclose(points[0].position_m, (390940.5, 5818925.25, 34.0), atol=1e-6)
    np.testing.assert_allclose(points[0].pixels[NAMES[1]], (100.5, 199.5))


@pytest.mark.parametrize(
    ("pixels", "said"),
    [
        ([(441, 375), (437, 608), (970, 417), (700, 49)], "measured in pictures of 2 times the size"),
        ([(900, 1200), (1700, 608), (970, 417), (700, 49)], "measured in pictures of 4 times the size"),
        ([(100, 400), (90, 450), (20, 499), (300, 350)], "exchange pixel x and y"),
        ([(-5, 40), (-7, 40), (-8, 40), (10, 10)], "from the upper left corner"),
    ],
)
def test_pixels_of_other_pictures_are_named(tmp_path: Path, pixels: list, said: str) -> None:
    lines = [f"390940 {5818925 + k} 34 {x} {y} a.jpg P{k}" for k, (x, y) in enumerate(pixels)]
    path = written(tmp_path, "\n".join(["EPSG:32633", *lines, ""]), "gcp_list.txt")
    with pytest.raises(ConfigError, match=said):
        read_control(str(path), images("a.jpg"), "EPSG:32633", (0.0, 0.0, 0.0))


def test_degrees_below_a_projected_crs_are_named(tmp_path: Path) -> None:
    found = read_pose_file(written(tmp_path, "EPSG:32633\na.jpg 52.5 13.4 142\nb.jpg 0 0 0\n", "geo.txt"))
    rows = {row.image: observation_of_row(row, "auto") for row in found.rows}
    observations = {name: one for name, one in rows.items() if one is not None}
    with pytest.raises(
        ConfigError, match=r"x and y \(52\.500000, 13\.400000\) are degrees by their size, and EPSG:32633"
    ):
        refuse_degrees(observations, found.crs or "", "geo.txt")
    refuse_degrees(observations, "local", "geo.txt")


def mrk(folder: Path, seconds: list[float]) -> Path:
    """Exposures from 1 on; latitudes tell their numbers."""
    line = "{n}\t{s:.6f}\t[2200]\t1,N\t2,E\t3,V\t{lat:.8f},Lat\t13.0,Lon\t100.0,Ellh\t0.01, 0.01, 0.02\t50,Q\n"
    text = "".join(line.format(n=n, s=s, lat=52 + n / 1000) for n, s in enumerate(seconds, start=1))
    return written(folder, text, "DJI_Timestamp.MRK")


def clock(gps_s: float, zone_h: float, off_s: float = 0.0) -> str:
    """What a camera writes: local time in whole seconds."""
    stamp = datetime(1980, 1, 6) + timedelta(weeks=2200, seconds=gps_s - 18.0 + off_s, hours=zone_h)
    return stamp.replace(microsecond=0).isoformat()


SECONDS = [1000.2, 1002.3, 1005.9, 1007.8, 1010.1, 1013.4]


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("count", [2, 6])
def test_captures_that_count_in_tens(tmp_path: Path, timed: bool, count: int) -> None:
    """P4 Multispectral: DJI_0010 to DJI_0015 are the bands of the first exposure."""
    truth = {f"DJI_{10 * n + band:04d}.{'JPG' if band == 0 else 'TIF'}": n
             for n in range(1, count + 1) for band in range(6)}  # fmt: skip
    times = {name: clock(SECONDS[n - 1], 2.0) for name, n in truth.items()} if timed else {}
    rows, remarks = matched_rows(read_pose_file(mrk(tmp_path, SECONDS[:count])), sorted(truth), "list", times)
    assert {name: int(row.image) for name, row in rows.items()} == truth
    assert remarks == []


@pytest.mark.parametrize("shift", [0, 340, 3])
@pytest.mark.parametrize("zone_h", [0.0, 5.75, -3.0])
def test_counters_that_go_on_and_images_that_are_missing(tmp_path: Path, shift: int, zone_h: float) -> None:
    """With another number than that of the list, time tells."""
    truth = {f"DJI_{n + shift:04d}.JPG": n for n in (2, 3, 5, 6)}
    times = {name: clock(SECONDS[n - 1], zone_h, 0.4) for name, n in truth.items()}
    rows, _ = matched_rows(read_pose_file(mrk(tmp_path, SECONDS)), sorted(truth), "list", times)
    assert {name: int(row.image) for name, row in rows.items()} == truth


def test_an_mrk_belongs_to_the_folder_of_its_time(tmp_path: Path) -> None:
    truth = {f"b/DJI_000{n}.JPG": n for n in (1, 2, 3)}
    times = {name: clock(SECONDS[n - 1], 1.0) for name, n in truth.items()}
    others = {f"a/DJI_000{n}.JPG": clock(SECONDS[n - 1] + 4321.0, 1.0) for n in (1, 2, 3)}
    found = read_pose_file(mrk(tmp_path, SECONDS[:3]))
    rows, _ = matched_rows(found, sorted([*truth, *others]), "list", times | others)
    assert {name: int(row.image) for name, row in rows.items()} == truth


def test_mission_planners_angles_are_the_aircrafts(tmp_path: Path) -> None:
    text = "#name latitude/Y longitude/X height/Z yaw pitch roll SAlt\na.jpg 52.5 13.4 142.6 358.69 1.2 -0.8 108.6\n"
    found = read_pose_file(written(tmp_path, text, "location.txt"))
    row = found.rows[0]
    assert (row.position, row.attitude, row.forward) == ((52.5, 13.4, 142.6), (358.69, 1.2, -0.8), False)
    assert found.format == "Mission Planner location.txt"


def test_records_oria(tmp_path: Path) -> None:
    text = (
        "C a comment\nORIA 101 1000.0 2000.0 500.0 10.0 -20.0 100.0\nPHOT 101 7\nORIA 102 1100 2000 500 0 0 399.9 0.1\n"
    )
    found = read_pose_file(written(tmp_path, text, "itera.dat"))
    assert [row.attitude for row in found.rows] == [
        pytest.approx((9.0, -18.0, 90.0)), pytest.approx((0.0, 0.0, 359.91))
    ]  # fmt: skip
    assert found.rows[0].position == (1000.0, 2000.0, 500.0)
    assert "behind kappa" in found.warnings[0]


@pytest.mark.parametrize(
    ("text", "position", "attitude"),
    [
        ("# name,lon,lat,alt\na.jpg,13.4,52.5,140\n", (52.5, 13.4, 140.0), None),
        ("#image x y z yaw pitch roll\na.jpg 1 2 3 10 -90 0\n", (1.0, 2.0, 3.0), (10.0, -90.0, 0.0)),
        ("# name X[m] Y[m] Z[m] Omega[gon] Phi[gon] Kappa[gon]\na.jpg 1 2 3 10 20 100\n", (1, 2, 3), (9.0, 18.0, 90.0)),
        ("sep=;\nimage;lat;lon;alt\na.jpg;52,5;13,4;140,0\n", (52.5, 13.4, 140.0), None),
        ("FileName,GPSLatitude,GPSLongitude,GPSAltitude\na.jpg,52.5 N,13.4 W,140\n", (52.5, -13.4, 140.0), None),
        (
            "image,latitude,longitude,height_above_takeoff(feet),altitude_above_seaLevel(feet)\na.jpg,52.5,13.4,1,100\n",
            (52.5, 13.4, 30.48),
            None,
        ),
        (
            "photo,filename,directory,altitude,direction,longitude,latitude\na.jpg,a,C:/f,140,,13.4,52.5\n",
            (52.5, 13.4, 140.0),
            None,
        ),
    ],
)  # fmt: skip
def test_tables_of_other_programs(tmp_path: Path, text: str, position: tuple, attitude: tuple | None) -> None:
    row = read_pose_file(written(tmp_path, text, "list.csv")).rows[0]
    assert row.image == "a.jpg"
    assert row.position == pytest.approx(position)
    assert row.attitude == (attitude and pytest.approx(attitude))


@pytest.mark.parametrize(
    ("text", "position", "crs"),
    [
        ("# CRS: EPSG:2227\nimage,x,y,z\na.jpg,{fx},{fy},{fz}\n", (1850000.0, 650000.0, 90.0), "EPSG:26943"),
        ("# EPSG:2227+5703\nimage,x,y,z\na.jpg,{fx},{fy},90\n", (1850000.0, 650000.0, 90.0), "EPSG:26943"),
        ("image,x [m],y [m],z,crs\na.jpg,1850000,650000,{fz},2227\n", (1850000.0, 650000.0, 90.0), "EPSG:26943"),
        ("image,x,y,z,crs\na.jpg,390950,5818970,90,EPSG:32633\n", (390950.0, 5818970.0, 90.0), "EPSG:32633"),
        ("# coordinate system: WGS84\nimage,x,y,z\na.jpg,13.4,52.5,90\n", (52.5, 13.4, 90.0), None),
        ("# crs: EPSG:32633\nimage,lat,lon,alt\na.jpg,52.5,13.4,90\n", (52.5, 13.4, 90.0), "EPSG:32633"),
    ],
)
def test_a_list_names_its_crs(tmp_path: Path, text: str, position: tuple, crs: str | None) -> None:
    foot = 1200.0 / 3937.0
    text = text.format(fx=1850000.0 / foot, fy=650000.0 / foot, fz=90.0 / foot)
    found = read_pose_file(written(tmp_path, text, "list.csv"))
    np.testing.assert_allclose(found.rows[0].position or (), position, rtol=0, atol=1e-6)
    assert found.crs == crs
    assert {row.position_kind for row in found.rows} == {found.position_kind}


@pytest.mark.parametrize("named", [True, False])
def test_two_forms_of_coordinates(tmp_path: Path, named: bool) -> None:
    """Emlid Flow: the elevation goes with easting and northing, the ellipsoidal height with the degrees."""
    head = "Name,Easting,Northing,Elevation,Longitude,Latitude,Ellipsoidal height,Lateral RMS,Elevation RMS"
    line = "P1,390950,5818970,34,13.39315,52.50993,74.5,0.01,0.02"
    if named:
        head, line = f"{head},CS name", f"{line},WGS 84 / UTM zone 33N + EGM96 height"
    path = written(tmp_path, f"{head}\n{line}\n", "gcp.csv")
    marks = written(tmp_path, "a.jpg,P1,100,200\n", "marks.csv")
    points, remarks = read_control(str(path), images("a.jpg"), "EPSG:32633", (0.0, 0.0, 0.0), marks=str(marks))
    expected = (390950.0, 5818970.0, 34.0) if named else (390950.4, 5818970.3, 74.5)
    np.testing.assert_allclose(points[0].position_m, expected, rtol=0, atol=1e-6 if named else 1.0)
    assert points[0].sigmas_m == (0.01, 0.01, 0.02)
    assert "of two forms of coordinates" in remarks[0]


def test_units_of_comments_in_gcp_list_and_inpho(tmp_path: Path) -> None:
    text = "EPSG:32633\n# heights in feet\n390950 5818970 100 10 20 a.jpg P1\n"
    points, _ = read_control(str(written(tmp_path, text, "gcp.txt")), images("a.jpg"), "EPSG:32633", (0.0, 0.0, 0.0))
    np.testing.assert_allclose(points[0].position_m, (390950.0, 5818970.0, 30.48), atol=1e-6)
    prj = (
        "$PROJECT\n$LINEAR_UNITS_OBJECT : ft\n$PHOTO\n $PHOTO_FILE : a.tif\n $EXT_ORI : \n 100 1000 2000 500\n"
        " 1 0 0\n 0 1 0\n 0 0 1\n$END\n"
    )
    found = read_pose_file(written(tmp_path, prj, "block.prj"))
    assert found.rows[0].position == pytest.approx((304.8, 609.6, 152.4))


@pytest.mark.parametrize("focal", [8.8, 0.85])
def test_a_focal_length_that_is_no_pixels_is_refused(tmp_path: Path, focal: float) -> None:
    path = written(tmp_path, f"1 SIMPLE_PINHOLE 5472 3648 {focal} 6.6 4.4\n", "cameras.txt")
    with pytest.raises(ConfigError, match=r"line 1: a focal length of .* is it in millimetres"):
        read_camera_file(path)


@pytest.mark.parametrize(("coordinates", "height"), [([13.4, 52.5, 140.5], 140.5), ([13.4, 52.5], 30.48)])
def test_a_layer_of_points(tmp_path: Path, coordinates: list[float], height: float) -> None:
    point = {"type": "Feature", "geometry": {"type": "Point", "coordinates": coordinates}}
    layer = {
        "type": "FeatureCollection",
        "features": [point | {"properties": {"Name": "my, a.jpg", "altitude_ft": 100, "lat": 1}}],
    }
    row = read_pose_file(written(tmp_path, json.dumps(layer), "layer.geojson")).rows[0]
    assert (row.image, row.position, row.line) == ("my, a.jpg", (52.5, 13.4, height), 1)
    layer["features"][0]["geometry"]["coordinates"] = [390950.0, 5818970.0]
    with pytest.raises(ConfigError, match=r"feature 1: .* are no longitude and latitude"):
        read_pose_file(written(tmp_path, json.dumps(layer), "layer.geojson"))
