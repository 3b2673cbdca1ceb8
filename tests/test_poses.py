from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeromatch_cli.blocks.poses import read_poses
from aeromatch_cli.errors import ConfigError


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "poses.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize(
    "text",
    [
        "image,x,y,z,omega_deg,phi_deg,kappa_deg\na/1.jpg,1.5,2,3,4,5,6\n",
        "\ufeffimage,x,y,z,omega_deg,phi_deg,kappa_deg\r\na/1.jpg,1.5,2,3,4,5,6\r\n",
        "# made by hand\n\nKappa;Phi;Omega;Z;Y;X;FileName\n6;5;4;3;2;1,5;a/1.jpg\n",
        "name\teasting\tnorthing\tz\tomega\tphi\tkappa\n# first strip\na\\1.jpg\t1.5\t2\t3\t4\t5\t6\t\n",
        "image   x  y  z  omega_deg phi_deg  kappa_deg\n  ./a/1.jpg  1.5  2 3   4 5 6\n",
        "# Cameras (1)\n#Label,X/Easting,Y/Northing,Z/Altitude,Omega,Phi,Kappa\na/1.jpg,1.5,2,3,4,5,6\n",
        'image,"x [m]",y (m),Z [m],Omega [deg],phi,kappa\n"a/1.jpg", 1.5, 2, 3, 4, 5, 6\n',
        "image,x,y,z,omega_deg,phi_deg,kappa_deg\na/1.jpg,1.5,2,3,4,5,6\n".encode("utf-16"),
    ],
)
def test_separators_cases_comments_and_encodings(tmp_path: Path, text: str | bytes) -> None:
    poses = read_poses(write(tmp_path, text))
    (row,) = poses.rows
    assert (row.image, row.position, row.attitude) == ("a/1.jpg", (1.5, 2.0, 3.0), (4.0, 5.0, 6.0))
    assert (row.position_kind, row.attitude_kind) == ("grid", "omega_phi_kappa")
    assert poses.warnings == ()


def test_every_form_of_position_and_attitude(tmp_path: Path) -> None:
    header = "image,latitude,lng,altitude,yaw,pitch,roll,camera,sigma_position_m,sigma_angle_deg"
    row = read_poses(write(tmp_path, f"{header}\n1.jpg,46,-92,198,45,-90,0,A,2,\n")).rows[0]
    assert (row.position, row.position_kind) == ((46.0, -92.0, 198.0), "geographic")
    assert (row.attitude, row.attitude_kind) == ((45.0, -90.0, 0.0), "yaw_pitch_roll")
    assert (row.camera, row.sigma_position_m, row.sigma_angle_deg, row.line) == ("A", 2.0, None, 2)
    row = read_poses(write(tmp_path, "image,qw,qx,qy,qz,x,y,z\n1.jpg,0,1,0,0,1,2,3\n")).rows[0]
    assert (row.attitude, row.attitude_kind) == ((0.0, 1.0, 0.0, 0.0), "quaternion")
    row = read_poses(write(tmp_path, "image,x,y,z\n1.jpg,1,2,3\n")).rows[0]
    assert (row.attitude, row.attitude_kind) == (None, "none")


def test_heights_may_be_missing(tmp_path: Path) -> None:
    for text in ("image,x,y\n1.jpg,1,2\n", "image,x,y,z\n1.jpg,1,2,\n"):
        found = read_poses(write(tmp_path, text)).rows[0].position
        assert found is not None
        assert found[:2] == (1.0, 2.0)
        assert math.isnan(found[2])


def test_rows_without_coordinates_are_unposed_and_the_rest_is_kept(tmp_path: Path) -> None:
    lines = ["a,NaN,1,2,0,0,0", "b,,,,,,", "c,0,0,5,0,0,0", "d,1,2,3,,,", "e,1,2,3,4,nan,6", "f,1,2,3,4,5,6"]
    poses = read_poses(write(tmp_path, "\n".join(["image,lat,lon,alt,yaw,pitch,roll", *lines])))
    assert [row.position is not None for row in poses.rows] == [False, False, False, True, True, True]
    assert [row.attitude is not None for row in poses.rows] == [True, False, True, False, False, True]
    assert poses.warnings == (
        "poses.csv, lines 2, 3: no number in column lat, treated as unposed: a, b",
        "poses.csv, line 4: position (0, 0), treated as unposed: c",
        "poses.csv, line 5: no attitude, position only: d",
        "poses.csv, line 6: attitude is incomplete, position only: e",
    )


def test_a_fault_of_every_line_is_one_warning(tmp_path: Path) -> None:
    lines = [f"{number}.jpg,1,2,3,,,0" for number in range(2000)]
    poses = read_poses(write(tmp_path, "\n".join(["image,lat,lon,alt,yaw,pitch,roll", *lines])))
    assert poses.warnings == (
        "poses.csv, lines 2, 3, 4, 5, 6 and 1,995 more: attitude is incomplete, position only: "
        "0.jpg, 1.jpg, 2.jpg, 3.jpg, 4.jpg and 1,995 more",
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("a.jpg,1,2,3\nb.jpg,1,2,3\n", "line 1: no header"),
        ("# only a remark\n", "no header"),
        ("image,x,y,z\n", "no line follows"),
        ("image,omega_deg,phi_deg,kappa_deg\na,1,2,3\n", "no position"),
        ("image,x\na,1\n", "'y' is missing"),
        ("image,lat,lon,agl\na,1,2,3\n", "'alt' is missing.*'agl' counts from the ground"),
        ("image,x,y,z,omega_deg,phi_deg\na,1,2,3,4,5\n", "'kappa_deg' is missing"),
        ("image,x,y,z,omega_deg,phi_deg,kapa_deg\na,1,2,3,4,5,6\n", "did you mean 'kappa_deg'"),
        ("image,x,y,z,qw,qx,qy,qz,yaw,pitch,roll\na,1,2,3,1,0,0,0,4,5,6\n", "two forms of attitude"),
        ("image,x,y,z,x\na,1,2,3,4\n", "'x' is named twice"),
        ("image,x,y,z\na,1,2,3\na,1,2,3\n", "line 3, column image: 'a' stands in line 2 already"),
        ("image,x,y,z\na,1,2\n", "line 2: 3 values, but the header names 4"),
        ("image,x,y,z\na,1,2,3,4\n", "line 2: 5 values"),
        ("image,x,y,z\n,1,2,3\n", "column image: empty"),
        ("image,x,y,z\na,1,inf,3\n", "line 2, column y: inf is out of range"),
        ("image,x,y,z\na,1,two,3\n", "line 2, column y: 'two' is not a number"),
        ("image,lat,lon,alt\na,-92,46,3\n", "column lat: -92 is out of range"),
        ("image,x,y,z,yaw,pitch,roll\na,1,2,3,400,0,0\n", "column yaw_deg: 400 is out of range"),
        ("image,x,y,z,qw,qx,qy,qz\na,1,2,3,0,0,0,0\n", "has length 0"),
        ("image,x,y,z,sigma_position_m\na,1,2,3,-1\n", "standard deviation"),
        (b"image,x,y,z\n\xff\xfa,1,2,3\n", "save it as UTF-8"),
        (b"image,x\0,y,z\n", "binary"),
    ],
)
def test_malformed_lists_name_the_place(tmp_path: Path, text: str | bytes, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        read_poses(write(tmp_path, text))


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(ConfigError, match="cannot be read"):
            read_poses(path)


def test_unknown_columns_are_ignored_with_a_warning(tmp_path: Path) -> None:
    poses = read_poses(write(tmp_path, "image,x,y,z,hdop,note\na,1,2,3,0.5,hello\n"))
    assert poses.rows[0].position == (1.0, 2.0, 3.0)
    assert poses.warnings == ("poses.csv: unknown columns ignored: hdop, note",)


@settings(max_examples=40, deadline=None)
@given(
    values=st.lists(st.tuples(*[st.floats(-1e7, 1e7)] * 3, *[st.floats(-360, 360)] * 3), min_size=1, max_size=5),
    separator=st.sampled_from([",", ";", "\t", " "]),
)
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, values: list[tuple[float, ...]], separator: str) -> None:
    header = separator.join(["image", "x", "y", "z", "yaw_deg", "pitch_deg", "roll_deg"])
    lines = [separator.join([f"{row}.jpg", *map(repr, numbers)]) for row, numbers in enumerate(values)]
    poses = read_poses(write(tmp_path_factory.mktemp("poses"), "\n".join([header, *lines])))
    assert [(*row.position, *row.attitude) for row in poses.rows if row.position and row.attitude] == values


def test_deviations_by_axis(tmp_path: Path) -> None:
    rows = read_poses(
        write(tmp_path, "image,lat,lon,alt,sdn(m),sde(m),sdu(m)\na.jpg,48,12,300,0.011,0.012,0.03\n")
    ).rows
    assert rows[0].sigmas_m == (0.012, 0.011, 0.03)
    assert rows[0].sigma_position_m == pytest.approx(0.019706, abs=1e-6)
    rows = read_poses(write(tmp_path, "image,x,y,z,accuracy,sigma_z_m\na.jpg,1,2,3,0.5,0.03\n")).rows
    assert rows[0].sigmas_m == (0.5, 0.5, 0.03)
    with pytest.raises(ConfigError, match="a standard deviation is positive"):
        read_poses(write(tmp_path, "image,x,y,z,sigma_z_m\na.jpg,1,2,3,-1\n"))


@pytest.mark.parametrize(
    ("columns", "cells", "sigmas_m"),
    [
        ("sigma_xy_m,sigma_z_m", "0.02,0.05", (0.02, 0.02, 0.05)),
        ("Horizontal accuracy (m),Vertical accuracy (m)", "0.02,0.05", (0.02, 0.02, 0.05)),
        ("accuracy_xy,accuracy_z", "0.02,0.05", (0.02, 0.02, 0.05)),
        ("std_x,std_y,std_z", "0.02,0.03,0.05", (0.02, 0.03, 0.05)),
        ("Easting RMS,Northing RMS,Elevation RMS", "0.02,0.03,0.05", (0.02, 0.03, 0.05)),
        ("sigma_xy_m", "0.02", (0.02, 0.02, 0.04)),  # heights are about twice as inexact
        ("sigma_z_m", "0.05", (0.05, 0.05, 0.05)),
        ("sigma_position_m", "0.05", (0.05, 0.05, 0.05)),
        ("sigma_x_m,sigma_y_m,sigma_z_m", ",,", None),
    ],
)
def test_names_of_deviations(tmp_path: Path, columns: str, cells: str, sigmas_m: tuple | None) -> None:
    (row,) = read_poses(write(tmp_path, f"image,x,y,z,{columns}\na.jpg,1,2,3,{cells}\n")).rows
    assert row.sigmas_m == sigmas_m


def test_latitudes_beyond_90_degrees_are_longitudes(tmp_path: Path) -> None:
    path = tmp_path / "list.csv"
    path.write_text("image,lat,lon,alt\n" + "".join(f"{n},{116.0 + n},40.{n},{n}\n" for n in range(3)))
    found = read_poses(path)
    assert [row.position for row in found.rows] == [(40.0, 116.0, 0.0), (40.1, 117.0, 1.0), (40.2, 118.0, 2.0)]
    assert "lat and lon are exchanged" in found.warnings[0]
    path.write_text("image,lat,lon,alt\na,116,40,1\nb,40,116,1\nc,116,40,1\n")
    with pytest.raises(ConfigError, match="line 2, column lat: 116 is out of range"):
        read_poses(path)


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("Filename,Easting,Northing,Height", "height is taken for the height z"),
        ("Filename,Easting,Northing,Altitude", "alt is taken for the height z"),
        ("Filename,Easting,Northing,Ellipsoidal height (m)", "ellipsoidal_height is taken for the height z"),
        ("Filename,Lat,Lon,Elevation", "elevation is taken for the height alt"),
        ("Filename,Easting,Northing,Z", ""),
    ],
)
def test_heights_under_other_names(tmp_path: Path, header: str, said: str) -> None:
    path = tmp_path / "p.csv"
    path.write_text(f"{header}\na.jpg,10,20,30\n")
    found = read_poses(path)
    assert found.rows[0].position == (10.0, 20.0, 30.0)
    assert said in " ".join(found.warnings)
    assert bool(found.warnings) == bool(said)


def test_our_own_orientation_is_read_again(tmp_path: Path) -> None:
    head = "image,x,y,z,omega_deg,phi_deg,kappa_deg,sigma_x_m,sigma_y_m,sigma_z_m,sigma_omega_deg,sigma_phi_deg,"
    path = tmp_path / "orientation.csv"
    path.write_text(
        f"{head}sigma_kappa_deg,camera,frame\na.jpg,1,2,3,0,0,9,0.1,0.2,0.3,0.01,0.02,0.03,1,world\n"
        "b.jpg,1,2,3,0,0,9,0.1,0.2,0.3,0.01,0.02,0.03,1,own 1\n"
    )
    found = read_poses(path)
    assert (found.rows[0].sigmas_m, found.rows[0].sigma_angle_deg) == ((0.1, 0.2, 0.3), 0.03)
    assert (found.rows[1].position, found.rows[1].attitude) == (None, None)
    assert found.warnings == ("orientation.csv, line 3: in a frame of its own, treated as unposed: b.jpg",)
