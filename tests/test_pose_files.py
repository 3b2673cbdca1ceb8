"""Pose files of other programs: one camera in every format is one pose; what is wrong is said with its place."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Site, invoke
from make_pose_files import LOCAL, WORLD, A, B, E, H, N, patb, write, write_micmac

from aeromatch_cli.blocks.image_names import matched_rows
from aeromatch_cli.blocks.observations import observation_of_row, oriented
from aeromatch_cli.blocks.pose_files import POSE_FORMATS, read_pose_file
from aeromatch_cli.blocks.poses import PoseList
from aeromatch_cli.data import Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.tables import read_poses
from aeromatch_cli.geometry.cameras import parameters
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, from_quaternion, to_quaternion

NAMES = ["A.jpg", "B.jpg"]
# Of formats that nothing in the file tells from their neighbours.
NAMED = ("pix4d-opk", "pix4d-ypr", "opk", "opk-gon", "pok", "pok-gon")


def poses_of(found: PoseList) -> tuple[dict[str, Pose], tuple[float, float, float]]:
    """Poses by image name in EPSG:32633 or a local frame, and the origin."""
    rows, remarks = matched_rows(found, NAMES, "list")
    assert not remarks
    observations = {name: o for name in NAMES if (o := observation_of_row(rows[name], "auto")) is not None}
    located = oriented(observations, "auto", found.crs, None, 1.0, 1.0)
    return located.poses, located.frame.origin_m


def check(found: PoseList, center_m: tuple[float, float, float]) -> None:
    poses, origin = poses_of(found)
    for camera in (A, B):
        pose = poses[camera.name]
        np.testing.assert_allclose(pose.center_m + origin, center_m, rtol=0, atol=1e-5)
        assert pose.world_rotation is not None
        np.testing.assert_allclose(pose.world_rotation, camera.world_from_cam.T, rtol=0, atol=1e-8)


def read(tmp_path: Path, name: str, content: str | bytes) -> PoseList:
    folder = name.split("/")[0]
    return read_pose_file(write(tmp_path, name, content), folder if folder in NAMED else "auto")


@pytest.mark.parametrize("name", WORLD)
def test_one_camera_in_every_format_is_one_pose(tmp_path: Path, name: str) -> None:
    check(read(tmp_path, name, WORLD[name]), (E, N, H))


@pytest.mark.parametrize("name", LOCAL)
def test_one_camera_in_every_local_format_is_one_pose(tmp_path: Path, name: str) -> None:
    found = read(tmp_path, name, LOCAL[name])
    assert found.crs is None
    check(found, (0.0, 0.0, H))


def test_a_folder_of_orientations_is_micmacs(tmp_path: Path) -> None:
    found = read_pose_file(write_micmac(tmp_path))
    assert found.format == "MicMac orientation, 2 files"
    check(found, (E, N, H))


@pytest.mark.parametrize("transposed", [False, True])
def test_patb_is_read_in_the_direction_in_which_the_flight_goes_along_the_images(tmp_path: Path, transposed) -> None:
    found = read_pose_file(write(tmp_path, "block.ori", patb(transposed=transposed)))
    assert found.format.startswith("PATB")
    rows, remarks = matched_rows(found, ["DJI_0001.JPG", "DJI_0002.JPG", "DJI_0003.JPG"], "list")
    assert not remarks
    observation = observation_of_row(rows["DJI_0001.JPG"], "auto")
    assert observation is not None
    located = oriented({"a": observation}, "EPSG:32633", None, None, 1.0, 1.0)
    np.testing.assert_allclose(located.poses["a"].world_rotation, A.world_from_cam.T, rtol=0, atol=1e-8)


def test_yaw_counts_from_true_north_in_grid_coordinates_too(tmp_path: Path) -> None:
    """One degree east of the central meridian at 42 N grid north lies sin(42) = 0.669 degrees east of true north."""
    from pyproj import Transformer

    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True).transform(16.0, 42.0)
    text = f"EPSG:32633\nA.jpg {x} {y} 400 0 0 0\nB.jpg {x} {y} 400 90 0 0\n"
    poses, _ = poses_of(read_pose_file(write(tmp_path, "geo.txt", text)))
    rotation = poses["A.jpg"].world_rotation
    assert rotation is not None
    up = -rotation[1]  # the image's top in the world
    np.testing.assert_allclose(np.rad2deg(np.arctan2(up[0], up[1])), -0.6693, atol=2e-3)


def test_accuracies_become_standard_deviations(tmp_path: Path) -> None:
    by_axis, overall = (0.03, 0.03, 0.05), (0.05, 0.05, 0.05)
    for name, sigmas_m in {
        "odm/geo.txt": by_axis, "metashape/ypr.txt": by_axis, "pix4d-ypr/geolocation.csv": by_axis,
        "opensfm-exif/exif_overrides.json": overall,
    }.items():  # fmt: skip
        assert read(tmp_path, name, WORLD[name]).rows[0].sigmas_m == sigmas_m


@pytest.mark.parametrize(
    "name", ["metashape-xml/cameras.xml", "opensfm/reconstruction.json", "transforms/transforms.json"]
)
def test_cameras_come_along(tmp_path: Path, name: str) -> None:
    found = read(tmp_path, name, {**WORLD, **LOCAL}[name])
    camera = found.cameras[found.rows[0].camera]
    values = parameters(camera)
    assert (camera.width_px, camera.height_px) == (4000, 3000)
    # The first pixel's centre is (0, 0) here, and half a pixel less than by its corner.
    np.testing.assert_allclose([values[k] for k in ("fx", "cx", "cy", "k1")], [3000.0, 2009.5, 1494.5, -0.01])


def test_metashapes_given_poses_are_asked_for_by_name(tmp_path: Path) -> None:
    path = write(tmp_path, "est.csv", WORLD["metashape-estimated/est.csv"])
    estimated, given = (read_pose_file(path, name) for name in ("metashape", "metashape-given"))
    assert estimated.rows[0].position == (42.0, 15.0, 400.0)
    assert given.rows[0].position == (41.9, 14.9, 380.0)
    assert given.rows[0].attitude == (1.0, 2.0, 3.0)


def test_an_mrk_names_exposures_by_number(tmp_path: Path) -> None:
    line = (
        "{n}\t1000.5\t[2200]\t -0.359,N\t -0.395,E\t 0.261,V\t{lat},Lat\t-115.38282037,Lon\t1368.367,Ellh\t0.012445, "
    )
    rest = "0.010182, 0.020323\t{q},Q\n"
    text = "".join((line + rest).format(n=n, lat=51.1 + n / 1000, q=q) for n, q in ((1, 50), (2, 34), (3, 0)))
    found = read_pose_file(write(tmp_path, "DJI_Timestamp.MRK", text))
    names = ["DJI_20230101_0001_D.JPG", "DJI_20230101_0001_MS_G.TIF", "DJI_20230101_0002_D.JPG"]
    rows, remarks = matched_rows(found, names, "list")
    assert [rows[name].line for name in names] == [1, 1, 2]
    assert rows[names[0]].position == (51.101, -115.38282037, 1368.367)
    assert rows[names[0]].sigmas_m == (0.010182, 0.012445, 0.020323)  # north stands before east
    assert rows[names[2]].sigmas_m == (0.5, 0.5, 0.5)  # a floating solution
    assert found.rows[2].position is None
    assert len(remarks) == 1
    assert [word in " ".join(found.warnings) for word in ("1 exposures had no fix", "1 of 3 exposures had no fixed")]
    with pytest.raises(ConfigError, match=r"'1' may be a/DJI_0001\.JPG or b/DJI_0001\.JPG"):
        matched_rows(found, ["a/DJI_0001.JPG", "b/DJI_0001.JPG", "DJI_0002.JPG"], "list")


@pytest.mark.parametrize(("encoding", "separator"), [("utf-8-sig", ","), ("utf-16", ";"), ("latin-1", "\t")])
def test_encodings_and_separators(tmp_path: Path, encoding: str, separator: str) -> None:
    text = "".join(separator.join([c.name, "42.5", "15.25", "400", *map(str, c.nadir)]) + "\n" for c in (A, B))
    if separator != ",":
        text = text.replace(".", ",").replace(",jpg", ".jpg")
    path = tmp_path / "geo.csv"
    path.write_bytes(text.encode(encoding))
    found = read_pose_file(path, "pix4d-ypr")
    assert found.rows[0].position == (42.5, 15.25, 400.0)
    assert found.rows[0].attitude == A.nadir


def test_gon_beyond_a_full_turn_are_known(tmp_path: Path) -> None:
    text = f"A.jpg {E} {N} {H} 11.1111111111 -5.5555555556 433.3333333333\nB.jpg {E} {N} {H} 0 0 0\n"
    found = read_pose_file(write(tmp_path, "bingo.txt", text))
    assert found.rows[0].attitude == pytest.approx((10.0, -5.0, 390.0))
    assert "gon" in found.format
    assert "--pose-format" in found.warnings[0]


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("geo.txt", "EPSG:32633\nA.jpg 1 x 3\n", "line 2, column 3: 'x' is not a number"),
        ("geo.txt", "EPSG:99999\nA.jpg 1 2 3\n", "the CRS 'EPSG:99999' is unknown"),
        ("geo.txt", "EPSG:32633\nA.jpg 1 2 3\nA.jpg 1 2 3\n", "line 3, column image: 'A.jpg' stands in line 2 already"),
        ("geo.txt", "EPSG:32633\n", "no image in this ODM geo.txt"),
        ("images.txt", "1 0 0 0 0 1 2 3 1 A.jpg\n\n", "line 1, column QW: a quaternion of length zero"),
        ("images.bin", b"\x01\0\0\0\0\0\0\0\x01", "not COLMAP's images.bin"),
        ("bundle.out", "# Bundle file v0.3\n1 0\n", "put its list.txt beside it"),
        ("reconstruction.json", '[{"cameras": {}, "shots": {"A.jpg": {}}}]', "shot 'A.jpg': rotation or translation"),
        ("x.xml", "<BlocksExchange><Block/></BlocksExchange>", "no photo of this BlocksExchange file has a pose"),
        (
            "block.psx",
            "<document version='1.2.0' path='{projectname}.files/project.zip'/>",
            "looks like a Metashape project",
        ),
        ("x_pmatrix.txt", "A.jpg 1 2 3 4 5 6 7 8 9 10 11 12\n", "looks like Pix4D's projection matrices"),
        ("poses.xlsx", b"PK\x03\x04\0\0", "looks like an Excel workbook: save the sheet as CSV"),
        ("flight.pos", "% program : RTKLIB\n2200 1000.0 42 15 400 1 12\n", "looks like an RTKLIB solution"),
        (
            "geo.txt",
            "A.jpg 1 2 3\nB.jpg 1 2 3\n",
            "looks like ODM's geo.txt without its first line, which names the CRS",
        ),
        ("sfm_data.json", '{"sfm_data_version": "0.3", "views": []}', "looks like openMVG's sfm_data"),
        ("cameras.sfm", '{"version": ["1"], "views": [], "intrinsics": []}', "looks like AliceVision's"),
        ("a.geojson", '{"type": "FeatureCollection", "features": []}', "looks like GeoJSON"),
        ("tracks.csv", "track,image,keypoint,x_px\n1,A.jpg,2,3.0\n", "looks like a list of tracks"),
        ("reference_lla.json", '{"latitude": 1, "longitude": 2, "altitude": 3}', "reconstruction.json has the poses"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(tmp_path: Path, name: str, content: str | bytes, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_pose_file(write(tmp_path, name, content))
    assert expected in str(caught.value)
    assert str(tmp_path / name) in str(caught.value)


def test_a_format_that_does_not_exist_is_named_with_those_that_do(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="use one of auto, colmap"):
        read_pose_file(tmp_path / "x.txt", "colmapp")


def test_a_folder_without_poses_is_none(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is a folder: give a file, a COLMAP model or MicMac's"):
        read_pose_file(tmp_path)


def test_input_page_has_every_format() -> None:
    page = (Path(__file__).parent.parent / "docs" / "input.md").read_text()
    missing = [name for name in POSE_FORMATS if f"`{name}`" not in page]
    assert not missing


@pytest.mark.slow
def test_a_command_says_what_it_recognised_and_reads_the_same_block(site: Site) -> None:
    with site.poses.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    angles = [[float(row[f"{key}_deg"]) for key in ("omega", "phi", "kappa")] for row in rows]
    quaternions = [to_quaternion(from_omega_phi_kappa(*three)) for three in angles]
    site("pairs")
    expected = read_poses(site.work / "poses.csv")
    lines = []
    for row, quaternion in zip(rows, quaternions, strict=True):
        center = np.array([float(row[key]) for key in "xyz"])
        shift = -from_quaternion(*quaternion) @ center
        lines.append(f"1 {' '.join(map(str, [*quaternion, *shift]))} 1 {row['image']}\n")
    path = site.root / "images.txt"
    path.write_text("\n".join(lines) + "\n")
    outcome = invoke("pairs", "baseline", *site.options("--poses", path, "--workspace", site.root / "other"))
    assert outcome.code == 0, outcome.stderr
    assert "poses            COLMAP images.txt: 5 of 5 images" in outcome.stdout
    found = read_poses(site.root / "other" / "poses.csv")
    assert found.keys() == expected.keys()
    for image_id, pose in expected.items():
        np.testing.assert_allclose(found[image_id].center_m, pose.center_m, rtol=0, atol=1e-6)
        np.testing.assert_allclose(found[image_id].world_rotation, pose.world_rotation, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_another_crs_than_the_files_is_refused(site: Site) -> None:
    path = site.root / "geo.txt"
    path.write_text("EPSG:32633\n" + "".join(f"{name} 500000 4600000 400\n" for name in site.names()))
    outcome = invoke("pairs", "baseline", *site.options("--poses", path, "--crs", "EPSG:32632"))
    assert outcome.code == 2
    assert "says that its coordinates are EPSG:32633, --crs says EPSG:32632: leave out --crs" in outcome.stderr


def test_every_format_that_content_tells_is_tried_in_the_tests() -> None:
    """Formats above by folder name, and those of tests of their own."""
    tried = {name.split("/")[0] for name in (*WORLD, *LOCAL)} | {"micmac", "patb", "dji-mrk", "exiftool", "report"}
    assert set(POSE_FORMATS) - tried <= {"columns", "pix4d", "table", "metashape-given"}


def test_metashape_accuracies_of_position_and_angles_are_used(tmp_path: Path) -> None:
    path = tmp_path / "reference.csv"
    path.write_text(
        '# CoordinateSystem: GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257]],'
        'PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328],AUTHORITY["EPSG","4326"]]\n'
        "#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll,Accuracy_X_(m),Accuracy_Y_(m),Accuracy_Z_(m),"
        "Accuracy_Yaw_(deg),Accuracy_Pitch_(deg),Accuracy_Roll_(deg)\n"
        "a,13.39384028,52.50098746,140.6,-4.3,0.9,0.2,0.02,0.03,0.04,2,1,0.5\n"
    )
    row = read_pose_file(path).rows[0]
    assert (row.sigmas_m, row.sigma_angle_deg) == ((0.02, 0.03, 0.04), 2.0)


@pytest.mark.parametrize("form", ["csv", "csv -n", "json"])
def test_exiftools_tables(tmp_path: Path, form: str) -> None:
    """Degrees, minutes and seconds, or numbers with a reference tag; angles by their maker's convention."""
    if form == "csv":
        text = (
            "SourceFile,FileName,GPSLatitude,GPSLongitude,GPSAltitude,GimbalYawDegree,GimbalPitchDegree,GimbalRollDegree\n"
            'imgs/a.jpg,a.jpg,"33 deg 30\' 36.00"" S","70 deg 15\' 0.00"" W",12.5 m Above Sea Level,+10.0,-90.0,0\n'
        )
    elif form == "csv -n":
        text = (
            "SourceFile,GPSLatitude,GPSLatitudeRef,GPSLongitude,GPSLongitudeRef,GPSAltitude,Yaw,Pitch,Roll,GPSXYAccuracy,"
            "GPSZAccuracy\nimgs/a.jpg,33.51,S,70.25,W,12.5,10,0,0,0.04,0.05\n"
        )
    else:
        tags = {
            "SourceFile": "imgs/a.jpg", "EXIF:GPSLatitude": 33.51, "Composite:GPSLatitude": -33.51,
            "EXIF:GPSLongitude": 70.25, "EXIF:GPSLongitudeRef": "W", "XMP:AbsoluteAltitude": "+12.5",
            "EXIF:GPSAltitude": 99.0, "XMP:Yaw": 10, "XMP:Pitch": 0, "XMP:Roll": 0,
        }  # fmt: skip
        text = json.dumps([tags])
    found = read_pose_file(write(tmp_path, "exif.json" if form == "json" else "exif.csv", text))
    row = found.rows[0]
    assert found.format == "ExifTool table"
    assert row.image == "imgs/a.jpg"
    np.testing.assert_allclose(row.position or (), (-33.51, -70.25, 12.5), atol=1e-9)
    assert (row.attitude, row.forward) == (((10.0, -90.0, 0.0), True) if form == "csv" else ((10.0, 0.0, 0.0), False))
    assert row.sigmas_m == ((0.04, 0.04, 0.05) if form == "csv -n" else None)


def test_a_crs_with_its_shift_to_wgs84_is_the_crs_itself(tmp_path: Path) -> None:
    """Metashape writes TOWGS84 into its WKT, which makes a bound CRS of it."""
    wkt = (
        'PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,'
        '298.257223563,AUTHORITY["EPSG","7030"]],TOWGS84[0,0,0,0,0,0,0],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0],'
        'UNIT["degree",0.01745329251994328]],PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],'
        'PARAMETER["central_meridian",15],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
        'PARAMETER["false_northing",0],UNIT["metre",1],AUTHORITY["EPSG","32633"]]'
    )
    head = "#Label,X/Easting,Y/Northing,Z/Altitude,Accuracy_X/Y/Z_(m),X_est,Y_est,Z_est"
    rows = "A.jpg,1,2,3,0.07,1.5,2.5,3.5\nB.jpg,1,2,3,0.07,,,\n"
    found = read_pose_file(write(tmp_path, "ref.csv", f"# CoordinateSystem: {wkt}\n{head}\n{rows}"))
    assert found.crs == "EPSG:32633"
    assert [row.position for row in found.rows] == [(1.5, 2.5, 3.5), (1.0, 2.0, 3.0)]
    assert found.rows[1].sigma_position_m == 0.07
    assert "1 of 2 images has no estimated position there" in found.warnings[0]


def test_folders_tell_images_of_one_name_apart(tmp_path: Path) -> None:
    """Absolute paths of another machine, as ContextCapture writes them."""
    photo = "<Photo><ImagePath>D:\\flight\\{}\\1.JPG</ImagePath>"
    photo += "<Pose><Center><x>{}</x><y>2</y><z>3</z></Center></Pose></Photo>"
    photos = photo.format("100MEDIA", 1) + photo.format("101MEDIA", 2)
    text = (
        f"<BlocksExchange><Block><Photogroups><Photogroup>{photos}</Photogroup></Photogroups></Block></BlocksExchange>"
    )
    found = read_pose_file(write(tmp_path, "blocks.xml", text))
    rows, _ = matched_rows(found, ["100MEDIA/1.JPG", "101MEDIA/1.JPG"], "list")
    assert {name: row.position[0] for name, row in rows.items() if row.position} == {
        "100MEDIA/1.JPG": 1.0, "101MEDIA/1.JPG": 2.0
    }  # fmt: skip


def test_a_line_of_points_is_no_image(tmp_path: Path) -> None:
    points = "512 300.5 -1 700 200 17 900 100 5 40.5 41.5 -1"  # ten columns, the last with a point: as an image's line
    model = write(tmp_path, "sparse/images.txt", f"1 1 0 0 0 0 0 0 1 A.jpg\n{points}\n2 1 0 0 0 5 0 0 1 B.jpg\n\n")
    assert [row.image for row in read_pose_file(model.parent).rows] == ["A.jpg", "B.jpg"]


def test_our_own_exports_are_read_with_their_crs(tmp_path: Path) -> None:
    """orientation.csv counts in the CRS, the COLMAP model from the origin that world.json names."""
    write(tmp_path, "world.json", '{"crs": "EPSG:32633", "origin_m": [391000.0, 5818000.0, 0.0]}')
    text = "image,x,y,z,omega_deg,phi_deg,kappa_deg,frame\nA.jpg,391010,5818020,100,0,0,0,world\n"
    found = read_pose_file(write(tmp_path, "orientation.csv", text))
    assert (found.crs, found.rows[0].position) == ("EPSG:32633", (391010.0, 5818020.0, 100.0))
    model = write(tmp_path, "sparse/images.txt", "1 0 1 0 0 -10 20 100 1 A.jpg\n\n")
    found = read_pose_file(model.parent)
    assert found.crs == "EPSG:32633"
    np.testing.assert_allclose(found.rows[0].position or (), (391010.0, 5818020.0, 100.0))


def test_names_that_are_numbers_and_decimal_commas_in_quotes(tmp_path: Path) -> None:
    text = 'image,x,y,z\n0001,"1,5",2,3\n'
    found = read_pose_file(write(tmp_path, "list.csv", text))
    assert found.rows[0].position == (1.5, 2.0, 3.0)
    rows, _ = matched_rows(found, ["DJI_0001.JPG", "DJI_0002.JPG"], "list")
    assert list(rows) == ["DJI_0001.JPG"]


@pytest.mark.parametrize("pose_format", ["metashape-xml", "blocks-exchange", "auto"])
@pytest.mark.parametrize("damage", ["cut", "entities"])
def test_xml_that_cannot_be_read_is_refused_in_words(tmp_path: Path, pose_format: str, damage: str) -> None:
    sound = WORLD["metashape-xml/cameras.xml"]
    bomb = '<?xml version="1.0"?><!DOCTYPE document [<!ENTITY a "aaaa">]><document>&a;</document>'
    path = tmp_path / "cameras.xml"
    path.write_text(sound[: len(sound) // 2] if damage == "cut" else bomb)
    with pytest.raises(ConfigError, match=r"cameras\.xml is no XML that can be read: it is cut off, or declares"):
        read_pose_file(path, pose_format)


def test_a_list_of_a_hundred_thousand_brackets_is_refused_at_once(tmp_path: Path) -> None:
    path = write(tmp_path, "deep.json", '{"type":"FeatureCollection","features":' + "[" * 100_000)
    with pytest.raises(ConfigError, match="no header with a column 'image'"):
        read_pose_file(path, "auto")
