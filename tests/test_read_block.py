from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from make_images import DJI_XMP, PARROT_XMP, gps_tags, write_dji, write_image
from read_inputs import read_inputs

from aeromatch_cli.blocks.crs import WorldFrame
from aeromatch_cli.blocks.exif import exif_or_reason
from aeromatch_cli.blocks.image_names import matched_rows
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.blocks.read import BlockInputs
from aeromatch_cli.blocks.scan import image_id, image_ids, scan_files, scan_images
from aeromatch_cli.config.overview import first_settings
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError, InputError

EAST, NORTH, UP = np.eye(3)


def axes(inputs: BlockInputs, image: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """World directions of image right, image top and the line of sight."""
    rotation = inputs.poses[image].world_rotation
    assert rotation is not None
    return rotation[0], -rotation[1], rotation[2]


def write_poses(folder: Path, text: str) -> Path:
    path = folder / "poses.csv"
    path.write_text(text)
    return path


# Scan


def test_scan_finds_images_at_any_depth_and_says_what_it_passed_over(tmp_path: Path) -> None:
    for name in ("b.JPG", "a/b.jpg", "a/c.TIFF", "d.png", "x.jpg/inside.jpeg"):
        write_image(tmp_path / name)
    for name in (".hidden/e.jpg", ".f.jpg", "notes.txt", "._b.JPG"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "broken.jpg").symlink_to(tmp_path / "nowhere.jpg")
    (tmp_path / "a" / "loop").symlink_to(tmp_path)
    names, failures = scan_images(tmp_path)
    assert names == ["a/b.jpg", "a/c.TIFF", "b.JPG", "d.png", "x.jpg/inside.jpeg"]
    lost = {failure.name: failure.image_lost for failure in failures}
    assert lost == {"._b.JPG": False, "broken.jpg": True, "empty.jpg": True, "x.jpg": False}


def test_results_of_an_earlier_project_among_the_images_are_named(tmp_path: Path) -> None:
    import rasterio

    write_image(tmp_path / "images" / "a.jpg")
    profile = {"driver": "GTiff", "width": 64, "height": 48, "count": 1, "dtype": "float32"}
    with rasterio.open(tmp_path / "dem.tif", "w", transform=rasterio.Affine(0.5, 0, 9, 0, -0.5, 8), **profile) as out:
        out.write(np.ones((48, 64), np.float32), 1)
    said = "1 of 2 images (dem.tif) is georeferenced (GeoTIFF)"
    assert any(warning.startswith(said) for warning in read_inputs(tmp_path).warnings)
    assert not any("georeferenced" in warning for warning in read_inputs(tmp_path / "images").warnings)


def test_scan_of_no_folder_or_an_unreadable_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="does not exist"):
        scan_images(tmp_path / "none")
    with pytest.raises(ConfigError, match="is not a folder"):
        scan_images(write_image(tmp_path / "a.jpg"))

    def denied(self: Path) -> object:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", denied)
    with pytest.raises(ConfigError, match=r"cannot be read \(Permission denied\)"):
        scan_images(tmp_path)


def test_an_unreadable_subfolder_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_image(tmp_path / "a.jpg")
    write_image(tmp_path / "sub" / "b.jpg")
    scandir = os.scandir

    def denied_below(path: str) -> object:
        if Path(path).name == "sub":
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", denied_below)
    names, failures = scan_images(tmp_path)
    assert names == ["a.jpg"]
    assert [(failure.name, failure.image_lost) for failure in failures] == [("sub", True)]


def test_image_ids() -> None:
    assert image_id("a/1.jpg") == "a--1_jpg"
    assert image_id("DJI_0001.JPG") == "DJI_0001_JPG"
    assert image_id("2023-05-01 x.jpg").startswith("2023-05-01_x_jpg-")
    assert len(image_id("x" * 400 + ".jpg")) < 200


@given(st.lists(st.text("aA-_./ ü", min_size=1, max_size=8).map(lambda stem: stem + ".jpg"), unique=True))
def test_image_ids_are_unique_plain_and_independent_of_each_other(names: list[str]) -> None:
    ids = image_ids(names)
    assert len(set(ids.values())) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+", value) for value in ids.values())
    assert all(ids[name] == image_ids([name])[name] for name in names)


# Conventions, by hand


def test_dji_gimbal_at_yaw_90_pitch_minus_90_has_its_top_to_the_east(tmp_path: Path) -> None:
    write_dji(tmp_path / "e.jpg", 28.0, -81.0, 150.0, yaw=90.0)  # on UTM 17's central meridian: no convergence
    write_dji(tmp_path / "n.jpg", 28.0, -81.0, 150.0, yaw=0.0, pitch=-45.0)
    inputs = read_inputs(tmp_path, "exif")
    right, top, sight = axes(inputs, "e_jpg")
    assert [*right, *top, *sight] == pytest.approx([*-NORTH, *EAST, *-UP], abs=1e-9)
    right, top, sight = axes(inputs, "n_jpg")
    assert [*right, *sight] == pytest.approx([*EAST, *((NORTH - UP) / np.sqrt(2))], abs=1e-9)


def test_parrot_zero_angles_have_their_top_to_the_north_and_positive_pitch_looks_ahead(tmp_path: Path) -> None:
    gps = gps_tags(28.0, -81.0, 150.0)
    for name, pitch in (("0.jpg", 0), ("10.jpg", 10)):
        write_image(tmp_path / name, gps=gps, xmp=PARROT_XMP.format(yaw=0, pitch=pitch, roll=0))
    inputs = read_inputs(tmp_path, "exif")
    right, top, sight = axes(inputs, "0_jpg")
    assert [*right, *top, *sight] == pytest.approx([*EAST, *NORTH, *-UP], abs=1e-9)
    assert axes(inputs, "10_jpg")[2] @ NORTH == pytest.approx(np.sin(np.deg2rad(10)))


def test_zero_omega_phi_kappa_and_the_matching_quaternion(tmp_path: Path) -> None:
    write_image(tmp_path / "a.jpg")
    for columns in ("omega_deg,phi_deg,kappa_deg\na.jpg,1,2,3,0,0,0", "qw,qx,qy,qz\na.jpg,1,2,3,0,1,0,0"):
        inputs = read_inputs(tmp_path, write_poses(tmp_path, f"image,x,y,z,{columns}\n"))
        right, top, sight = axes(inputs, "a_jpg")
        assert [*right, *top, *sight] == pytest.approx([*EAST, *NORTH, *-UP], abs=1e-9)
        assert (inputs.crs, inputs.origin_m) == ("local", (0.0, 0.0, 0.0))
        assert inputs.poses["a_jpg"].center_m.tolist() == [1.0, 2.0, 3.0]


def test_true_yaw_is_turned_to_the_grid_and_grid_yaw_is_not(tmp_path: Path) -> None:
    """One degree east of the meridian at 28 N, true north lies 0.4695 degrees left of grid north."""
    write_image(tmp_path / "a.jpg")
    angles = "yaw_deg,pitch_deg,roll_deg"
    geographic = read_inputs(tmp_path, write_poses(tmp_path, f"image,lat,lon,alt,{angles}\na.jpg,28,-80,150,0,-90,0\n"))
    top = axes(geographic, "a_jpg")[1]
    assert np.rad2deg(np.arctan2(top[0], top[1])) == pytest.approx(-0.4695, abs=1e-3)
    grid = read_inputs(
        tmp_path, write_poses(tmp_path, f"image,x,y,z,{angles}\na.jpg,598300,3097600,150,0,-90,0\n"), crs="EPSG:32617"
    )
    assert axes(grid, "a_jpg")[1] == pytest.approx(NORTH, abs=1e-9)
    assert geographic.poses["a_jpg"].center_m == pytest.approx([308.9, 584.1, 150.0], abs=400)
    nadir = read_inputs(tmp_path, write_poses(tmp_path, f"image,x,y,z,{angles}\na.jpg,1,2,3,0,0,0\n"), angles="nadir")
    assert axes(nadir, "a_jpg")[2] == pytest.approx(-UP, abs=1e-9)
    gimbal = read_inputs(tmp_path, write_poses(tmp_path, f"image,x,y,z,{angles}\na.jpg,1,2,3,0,0,0\n"))
    assert axes(gimbal, "a_jpg")[2] == pytest.approx(NORTH, abs=1e-9)


# Whole blocks


def test_exif_block(tmp_path: Path) -> None:
    for row in range(3):
        write_dji(tmp_path / f"{row}.jpg", 46.84, -91.99 + row * 1e-4, 200.0 + row, relative=41.0 + row)
    inputs = read_inputs(tmp_path, "exif")
    assert (inputs.crs, inputs.origin_m) == ("EPSG:32615", (577000.0, 5187000.0, 0.0))
    assert [image.image_id for image in inputs.images] == ["0_jpg", "1_jpg", "2_jpg"]
    assert set(inputs.cameras) == {"dji-fc6310_8.8mm_f30_40x30"}
    step_m = inputs.poses["1_jpg"].center_m - inputs.poses["0_jpg"].center_m
    assert np.linalg.norm(step_m[:2]) == pytest.approx(1e-4 * 111320 * np.cos(np.deg2rad(46.84)), rel=5e-3)
    assert step_m[2] == pytest.approx(1.0)
    assert inputs.ground_hint_z_m == pytest.approx(159.0)
    assert inputs.ground_hint_source == "XMP relative altitude of 3 images"
    assert (inputs.warnings, inputs.failures) == ((), ())
    assert (inputs.poses["0_jpg"].sigma_position_m, inputs.poses["0_jpg"].sigma_angle_deg) == (2.0, 3.0)


def test_one_bad_image_never_stops_the_rest(tmp_path: Path) -> None:
    write_dji(tmp_path / "good.jpg", 46.84, -91.99, 200.0)
    write_image(tmp_path / "noposition.jpg")
    write_image(tmp_path / "noangles.jpg", gps=gps_tags(46.84, -91.99, 200.0))
    write_image(tmp_path / "zero.jpg", gps=gps_tags(0.0, 0.0, 200.0))
    write_image(tmp_path / "noaltitude.jpg", gps=gps_tags(46.84, -91.99, None))
    (tmp_path / "corrupt.jpg").write_bytes(b"\xff\xd8\xff\xe1 no picture")
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "._good.jpg").write_bytes(b"x")
    inputs = read_inputs(tmp_path, "exif")
    assert {image.image_id for image in inputs.images} == {
        *("good_jpg", "noposition_jpg", "noangles_jpg", "zero_jpg", "noaltitude_jpg")
    }
    assert set(inputs.poses) == {"good_jpg", "noangles_jpg", "noaltitude_jpg"}
    heights_m = {image_id: pose.center_m[2] for image_id, pose in inputs.poses.items()}
    assert heights_m["noaltitude_jpg"] == np.median([heights_m["good_jpg"], heights_m["noangles_jpg"]])
    assert inputs.poses["noangles_jpg"].world_rotation is None
    assert [failure.name for failure in inputs.failures] == ["corrupt.jpg", "empty.jpg"]
    text = "\n".join(inputs.warnings)
    for words in (
        "._good.jpg",
        "2 of 5 images (noposition.jpg, zero.jpg) have no GPS",
        "no angles",
        "1 of 5 images (noaltitude.jpg) has a position without height: a level flight at ",
    ):
        assert words in text
    assert "(0, 0): no fix" in text


def test_nothing_usable(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no image"):
        read_inputs(tmp_path)
    (tmp_path / "a.jpg").touch()
    with pytest.raises(InputError, match=r"^the only image in .* cannot be used; a\.jpg: file is empty"):
        read_inputs(tmp_path)


def test_without_poses_every_image_is_unposed(tmp_path: Path) -> None:
    write_dji(tmp_path / "a.jpg", 46.84, -91.99, 200.0)
    for poses in (None, ""):
        inputs = read_inputs(tmp_path, poses)
        assert (len(inputs.images), dict(inputs.poses), inputs.crs) == (1, {}, "local")


def test_a_list_without_heights(tmp_path: Path) -> None:
    """Heights of EXIF where it has some, else a level flight; the accuracy of a position says so."""
    write_dji(tmp_path / "a.jpg", 46.84, -91.99, 200.0)
    write_dji(tmp_path / "b.jpg", 46.841, -91.99, 210.0)
    table = write_poses(tmp_path, "image,x,y,sigma_position_m\na.jpg,1,2,0.5\nb.jpg,3,4,0.5\n")
    inputs = read_inputs(tmp_path, table)
    assert [pose.center_m.tolist() for pose in inputs.poses.values()] == [[1.0, 2.0, 200.0], [3.0, 4.0, 210.0]]
    assert "2 of 2 images (a.jpg, b.jpg) have no height in the list: that of EXIF is used" in inputs.warnings
    for name in ("a.jpg", "b.jpg"):
        write_image(tmp_path / name)
    inputs = read_inputs(tmp_path, table)
    assert [pose.center_m.tolist() for pose in inputs.poses.values()] == [[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]]
    assert [pose.axis_sigmas_m.tolist() for pose in inputs.poses.values()] == [[0.5, 0.5, 10.0]] * 2
    assert any("a level flight at 0 m, so that heights count from the flight, is assumed" in w for w in inputs.warnings)


def test_equal_names_in_two_folders_and_missing_images(tmp_path: Path) -> None:
    for name in ("a/1.jpg", "b/1.jpg", "b/2.JPG", "c/3.jpg"):
        write_image(tmp_path / name)
    table = "image,x,y,z\na/1.jpg,1,0,9\nb/1.jpg,2,0,9\n2.jpg,3,0,9\nlost.jpg,5,0,9\n3,6,0,9\n"
    inputs = read_inputs(tmp_path, write_poses(tmp_path, table))
    found = {image.name: inputs.poses[image.image_id].center_m[0] for image in inputs.images}
    assert found == {"a/1.jpg": 1.0, "b/1.jpg": 2.0, "b/2.JPG": 3.0, "c/3.jpg": 6.0}
    text = "\n".join(inputs.warnings)
    assert "names 1 image that is not in the folder: lost.jpg" in text
    for name, place in (("1.jpg", 1.0), (r"D:\flight\b\1.jpg", 2.0)):
        table = f"image,x,y,z\n{name},{place},0,9\n"
        if name == "1.jpg":
            with pytest.raises(ConfigError, match=r"line 2, column image: '1\.jpg' may be a/1\.jpg or b/1\.jpg"):
                read_inputs(tmp_path, write_poses(tmp_path, table))
        else:
            assert set(read_inputs(tmp_path, write_poses(tmp_path, table)).poses) == {"b--1_jpg"}

    partial = read_inputs(tmp_path, write_poses(tmp_path, "image,x,y,z\na/1.jpg,1,0,9\nb/1.jpg,,,\n"))
    assert set(partial.poses) == {"a--1_jpg"}
    assert any("2 of 4 images (b/2.JPG, c/3.jpg) are not in" in warning for warning in partial.warnings)
    assert "poses.csv, line 3: no number in column x, treated as unposed: b/1.jpg" in partial.warnings
    with pytest.raises(
        ConfigError, match=r"names none of the 4 images .* it says lost\.jpg, the folder holds a/1\.jpg"
    ):
        read_inputs(tmp_path, write_poses(tmp_path, "image,x,y,z\nlost.jpg,1,0,9\n"))
    with pytest.raises(ConfigError, match=r"both mean the image b/2\.JPG"):
        read_inputs(tmp_path, write_poses(tmp_path, "image,x,y,z\nb/2.JPG,1,0,9\n2.jpg,1,0,9\n"))


def test_a_line_of_a_folder_that_is_not_there_belongs_to_no_image(tmp_path: Path) -> None:
    write_image(tmp_path / "a" / "5.jpg")
    write_image(tmp_path / "a" / "6.jpg")
    both = "image,x,y,z\na/5.jpg,1,0,9\nb/5.jpg,2,0,9\nb/6.jpg,3,0,9\na/7.jpg,4,0,9\nb/7.jpg,4,0,9\n"
    inputs = read_inputs(tmp_path, write_poses(tmp_path, both))
    found = {image.name: inputs.poses[image.image_id].center_m[0] for image in inputs.images}
    # Of 6.jpg there is one line, of a folder that may have another name here.
    assert found == {"a/5.jpg": 1.0, "a/6.jpg": 3.0}
    assert any("names 3 images that are not in the folder: b/5.jpg, a/7.jpg, b/7.jpg" in w for w in inputs.warnings)


@pytest.mark.parametrize("form", ["DJI_20260101_{:04d}_V-site2.jpg", "DJI_{}_0001_{:04d}.jpg", "IMG_{:04d}.jpg"])
def test_running_numbers_are_the_digits_that_the_list_speaks_of(form: str) -> None:
    names = [form.format(*([20260101120000 + k, k] if form.count("{") > 1 else [k])) for k in range(1, 6)]
    rows = tuple(PoseRow(str(k), k, (float(k), 0.0, 0.0), "grid", None, "none", numbered=True) for k in range(1, 6))
    found, remarks = matched_rows(PoseList(rows, "grid"), names, "list")
    assert {name: int(row.image) for name, row in found.items()} == {name: k for k, name in enumerate(names, start=1)}
    assert remarks == []


def test_a_mask_among_the_images_is_no_image(tmp_path: Path) -> None:
    for name in ("a.jpg", "mask.png"):
        write_image(tmp_path / name)
    assert scan_images(tmp_path, [tmp_path / "mask.png"]) == (["a.jpg"], [])


def test_block_json_gives_camera_crs_and_ground(tmp_path: Path) -> None:
    images = tmp_path / "images"
    write_image(images / "a.jpg", main={274: 6})
    write_image(images / "cropped.jpg", (40, 20))
    camera = {"model": "SIMPLE_RADIAL", "width": 80, "height": 60, "params": [100, 40, 30, 0.01]}
    block = tmp_path / "block.json"
    block.write_text(json.dumps({"crs": "EPSG:32615", "cameras": {"1": camera}, "ground_z": {"p50": 161.6}}))
    poses = write_poses(tmp_path, "image,x,y,z,sigma_position_m\na.jpg,576663.2,5188164.9,197.4,0.5\n")
    inputs = read_inputs(images, poses, cameras=str(block))
    assert (inputs.crs, inputs.origin_m) == ("EPSG:32615", (576000.0, 5188000.0, 0.0))
    assert (inputs.ground_hint_z_m, inputs.ground_hint_source) == (161.6, "ground height of block.json")
    (image,) = inputs.images
    assert (image.exif_orientation, image.width_px, image.height_px) == (6, 40, 30)
    assert inputs.cameras[image.camera_id].params == pytest.approx((50.0, 19.5, 14.5, 0.01))
    assert inputs.poses["a_jpg"].center_m == pytest.approx([663.2, 164.9, 197.4])
    assert inputs.poses["a_jpg"].sigma_position_m == 0.5
    assert inputs.failures[0].name == "cropped.jpg"
    other = read_inputs(images, poses, cameras=str(block), crs="EPSG:32616")
    assert (other.crs, other.ground_hint_z_m, other.ground_hint_source) == ("EPSG:32616", None, "")


def test_cameras_by_folder_and_by_column(tmp_path: Path) -> None:
    for name in ("l/1.jpg", "r/1.jpg", "top.jpg"):
        write_dji(tmp_path / name, 46.84, -91.99, 200.0)
    assert len(read_inputs(tmp_path).cameras) == 1
    assert len(read_inputs(tmp_path, cameras="folder").cameras) == 3
    table = "image,x,y,z,camera\nl/1.jpg,1,0,9,A\nr/1.jpg,2,0,9,A\ntop.jpg,3,0,9,B\n"
    by_column = read_inputs(tmp_path, write_poses(tmp_path, table))
    ids = {image.name: image.camera_id for image in by_column.images}
    assert ids["l/1.jpg"] == ids["r/1.jpg"] != ids["top.jpg"]


def test_a_growing_block_keeps_its_frame(tmp_path: Path) -> None:
    write_dji(tmp_path / "a.jpg", 46.84, -91.99, 200.0)
    first = read_inputs(tmp_path, "exif")
    for row in range(3):
        write_dji(tmp_path / f"b{row}.jpg", 46.9, -89.99, 200.0)  # moves the median two kilometres and one zone on
    grown = read_inputs(tmp_path, "exif", known_frame=WorldFrame(first.crs, first.origin_m))
    assert (grown.crs, grown.origin_m) == (first.crs, first.origin_m)
    assert grown.poses["a_jpg"].center_m.tolist() == first.poses["a_jpg"].center_m.tolist()
    assert read_inputs(tmp_path, "exif").crs == "EPSG:32616"


def test_positions_outside_the_crs_and_bad_arguments(tmp_path: Path) -> None:
    write_dji(tmp_path / "a.jpg", 46.84, -91.99, 200.0)
    with pytest.raises(ConfigError, match="unknown"):
        read_inputs(tmp_path, "exif", crs="EPSG:nothing")
    with pytest.raises(ConfigError, match="local frame"):
        read_inputs(tmp_path, "exif", crs="local")
    with pytest.raises(ConfigError, match="angles 'down' is unknown"):
        read_inputs(tmp_path, "exif", angles="down")
    with pytest.raises(ConfigError, match="camera file"):
        read_inputs(tmp_path, "exif", cameras=str(tmp_path / "none.yaml"))


def test_facts_may_be_read_elsewhere(tmp_path: Path) -> None:
    write_dji(tmp_path / "a.jpg", 46.84, -91.99, 200.0)
    write_image(tmp_path / "b.jpg")
    inputs = read_inputs(tmp_path, read_header=lambda path: "refused" if path.name == "a.jpg" else exif_or_reason(path))
    assert inputs.failures[0].reason == "refused"
    assert [image.name for image in inputs.images] == ["b.jpg"]


def test_a_camera_file_goes_before_the_cameras_of_a_pose_file(tmp_path: Path) -> None:
    write_image(tmp_path / "images" / "a.jpg", (40, 30))
    shot = {"rotation": [3.14159, 0.0, 0.0], "translation": [0.0, 0.0, 100.0], "camera": "theirs"}
    theirs = {"projection_type": "perspective", "width": 40, "height": 30, "focal": 0.9, "k1": 0.0, "k2": 0.0}
    poses = tmp_path / "reconstruction.json"
    poses.write_text(json.dumps([{"cameras": {"theirs": theirs}, "shots": {"a.jpg": shot}}]))
    assert [camera.params[0] for camera in read_inputs(tmp_path / "images", poses).cameras.values()] == [36.0]
    own = tmp_path / "own.json"
    own.write_text('{"own": {"model": "SIMPLE_PINHOLE", "width": 40, "height": 30, "params": [77, 20, 15]}}')
    found = read_inputs(tmp_path / "images", poses, str(own))
    assert [camera.params[0] for camera in found.cameras.values()] == [77.0]
    assert not found.failures


def test_names_with_control_characters_are_passed_over(tmp_path: Path) -> None:
    for name in ("a\nb.jpg", "c\x1b[31m.jpg", "plain.jpg"):
        write_image(tmp_path / name)
    names, failures = scan_images(tmp_path)
    assert names == ["plain.jpg"]
    assert [(failure.name, failure.image_lost) for failure in failures] == [("a?b.jpg", True), ("c?[31m.jpg", True)]
    assert all("control characters" in failure.reason for failure in failures)
    listed, passed_over = scan_files({"a\nb.jpg": 5, "plain.jpg": 5})
    assert (listed, [failure.name for failure in passed_over]) == (["plain.jpg"], ["a?b.jpg"])


def test_positions_have_the_deviations_of_their_axes(tmp_path: Path) -> None:
    """Fixed, floating and single RTK solutions; and a horizontal positioning error."""
    for n, flag in enumerate((50, 34, 16)):
        rtk = f'drone-dji:RtkFlag="{flag}" drone-dji:RtkStdLon="0.03" drone-dji:RtkStdLat="0.04" '
        xmp = DJI_XMP.format(yaw=0, pitch=-90, roll=0, relative=50).replace(
            "drone-dji:GimbalYaw", f'{rtk}drone-dji:RtkStdHgt="0.6" drone-dji:GimbalYaw'
        )
        write_image(tmp_path / f"{n}.jpg", gps=gps_tags(46.8 + 1e-4 * n, 12.0, 300.0), xmp=xmp)
    write_image(tmp_path / "3.jpg", gps=gps_tags(46.81, 12.0, 300.0) | {31: 1.5})
    inputs = read_inputs(tmp_path, "exif")
    assert [inputs.poses[f"{n}_jpg"].axis_sigmas_m.tolist() for n in range(4)] == [
        [0.03, 0.04, 0.6], [0.5, 0.5, 0.6], [2.0, 2.0, 2.0], [1.5, 1.5, 3.0],
    ]  # fmt: skip
    assert inputs.poses["0_jpg"].sigma_position_m == pytest.approx(np.sqrt((0.03**2 + 0.04**2 + 0.6**2) / 3.0))
    assert inputs.poses["2_jpg"].sigmas_m is None
    said = " ".join(inputs.warnings)
    assert "1 of 4 images: no fixed RTK solution, so that the position counts with 0.5 m at least" in said
    assert "1 of 4 images: no RTK solution, so that the stated accuracy of the position does not count" in said


@pytest.mark.parametrize(
    ("names", "masks"),
    [
        (("a.JPG", "b.JPG", "a_mask.JPG", "b_mask.JPG"), ["a_mask.JPG", "b_mask.JPG"]),  # ODM
        (("1/a.JPG", "1/a_mask.png", "2/a_mask.png"), ["1/a_mask.png"]),  # Metashape; the last one masks nothing
        (("a.jpg", "masks/a.png", "masks/b.png"), ["masks/a.png"]),
        (("in/a.jpg", "Masks/a_mask.png", "in/masks/a.jpg.png"), ["Masks/a_mask.png", "in/masks/a.jpg.png"]),
        (("a.jpg", "a.jpg.png", "b.jpg", "b.jpg.mask.png"), ["a.jpg.png", "b.jpg.mask.png"]),
        (("a.jpg", "a.png", "unmask.jpg", "white_mask.jpg"), []),
        (("masks/a.jpg", "masks/b.jpg"), []),  # nothing but a name for the folder
    ],
)
def test_masks_beside_the_images_are_no_images(tmp_path: Path, names: tuple[str, ...], masks: list[str]) -> None:
    for name in names:
        write_image(tmp_path / name)
    for found, passed_over in (scan_images(tmp_path), scan_files(dict.fromkeys(names, 9))):
        assert found == sorted(set(names) - set(masks))
        assert [one.name for one in passed_over] == masks
        assert not any(one.image_lost for one in passed_over)
    said = read_inputs(tmp_path).warnings
    assert any("masks of images, not images: give the folder" in line for line in said) == bool(masks)


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("DJI_0001.DNG", "raw pictures are not read: develop them to JPEG or TIFF"),
        ("IMG_1.HEIC", "HEIC is read where pillow-heif is installed"),
        ("IMG_1.webp", "WEBP is not read: convert to JPEG or TIFF"),
        ("DJI_0001.MP4", "videos are not read: `aeromatch frames VIDEO --out DIR`"),
    ],
)
def test_pictures_that_are_not_read_are_named(
    tmp_path: Path, file: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("aeromatch_cli.images.heif.readable", lambda: False)
    (tmp_path / file).write_bytes(b"x")
    with pytest.raises(
        InputError, match=rf"^no image \(jpg, .*\) in .*: check --images; passed over 1: {file}: {words}"
    ):
        read_inputs(tmp_path)
    with pytest.raises(InputError, match=f"{file}: {words}"):
        first_settings(tmp_path, tmp_path)
    write_image(tmp_path / "a.jpg")
    assert [line for line in read_inputs(tmp_path).warnings if words in line]
    write_image(tmp_path / Path(file).with_suffix(".JPG").name)  # of the same name: nothing is missing
    assert not [line for line in read_inputs(tmp_path).warnings if words in line]
