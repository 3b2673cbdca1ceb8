from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from make_images import write_image
from read_inputs import read_inputs

from aeromatch_cli.blocks.camera_files import read_camera_file
from aeromatch_cli.blocks.cameras import cameras_from_exif, cameras_from_file, fitted, focal_from_exif_px
from aeromatch_cli.blocks.exif import ExifFacts
from aeromatch_cli.data import Camera
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.cameras import colmap_camera

BIG = Camera("SIMPLE_RADIAL", 4000, 3000, (3000.0, 1999.5, 1499.5, 0.01))


def test_focal_length_by_source() -> None:
    size = {"width_px": 4000, "height_px": 3000}
    # 8.8 mm on a 13.2 mm wide sensor; the 3:2 sensor is cropped to 4:3 at full height: 3000 px on 8.8 mm.
    known = ExifFacts(**size, make="DJI", model="FC6310", focal_mm=8.8, focal_35mm_mm=99.0)
    assert focal_from_exif_px(known) == (pytest.approx(3000.0), "sensor size")
    portrait = ExifFacts(width_px=3000, height_px=4000, make="DJI", model="FC6310", focal_mm=8.8)
    assert focal_from_exif_px(portrait)[0] == pytest.approx(3000.0)
    equivalent = ExifFacts(**size, focal_mm=4.0, focal_35mm_mm=24.0, focal_plane_px_per_mm=600.0)
    assert focal_from_exif_px(equivalent) == (
        pytest.approx(24.0 / math.hypot(36, 24) * 5000, rel=1e-4),
        "35-mm equivalent",
    )
    confirmed = ExifFacts(
        **size, focal_mm=4.0, focal_35mm_mm=24.0, focal_plane_px_per_mm=600.0, focal_plane_confirmed=True
    )
    assert focal_from_exif_px(confirmed) == (2400.0, "focal-plane resolution")
    assert focal_from_exif_px(ExifFacts(**size, focal_mm=4.0, focal_plane_px_per_mm=600.0))[0] == 2400.0
    assert focal_from_exif_px(ExifFacts(**size, focal_mm=4.0, focal_plane_px_per_mm=1.0)) == (4800.0, "guess")


def test_digital_zoom_makes_the_focal_length_longer() -> None:
    size = {"width_px": 4000, "height_px": 3000, "digital_zoom": 2.0}
    known = ExifFacts(**size, make="DJI", model="FC6310", focal_mm=8.8, focal_35mm_mm=24.0)
    assert focal_from_exif_px(known) == (pytest.approx(6000.0), "sensor size")
    plane = {"focal_mm": 4.0, "focal_plane_px_per_mm": 600.0, "focal_plane_confirmed": True}
    assert focal_from_exif_px(ExifFacts(**size, **plane)) == (4800.0, "focal-plane resolution")
    px, source = focal_from_exif_px(ExifFacts(**size, focal_35mm_mm=48.0))
    assert (px, source) == (
        pytest.approx(48.0 / math.hypot(36, 24) * 5000, rel=1e-4),
        "35-mm equivalent of a zoomed picture",
    )
    found = cameras_from_exif({"a.jpg": known}, {})
    assert [words for words in found.warnings if "(a.jpg: 2 x) was taken with digital zoom" in words] == list(
        found.warnings
    )


def test_two_focal_lengths_of_which_one_must_be_wrong_are_named() -> None:
    size = {"width_px": 4000, "height_px": 3000}
    known = ExifFacts(**size, make="DJI", model="FC6310", focal_mm=8.8, focal_35mm_mm=99.0)
    (warning,) = cameras_from_exif({"a.jpg": known}, {}).warnings
    assert "a.jpg: 11441 px by 35-mm equivalent, 3000 px by sensor size): the latter is used" in warning
    absurd = ExifFacts(**size, focal_mm=4.0, focal_35mm_mm=65535.0, focal_plane_px_per_mm=600.0)
    assert focal_from_exif_px(absurd) == (2400.0, "focal-plane resolution")


def test_exif_groups() -> None:
    wide = ExifFacts(40, 30, make="Canon", model="Canon S100", focal_mm=5.2, focal_35mm_mm=24.0)
    tele = ExifFacts(40, 30, make="Canon", model="Canon S100", focal_mm=26.0, focal_35mm_mm=120.0)
    bare = ExifFacts(40, 30)
    facts = {"a/1.jpg": wide, "b/2.jpg": wide, "b/3.jpg": tele, "b/4.jpg": bare}
    found = cameras_from_exif(facts, {})
    assert found.camera_ids["a/1.jpg"] == found.camera_ids["b/2.jpg"] == "canon-s100_5.2mm_f27.73_40x30"
    assert len(found.cameras) == 3
    camera = found.cameras[found.camera_ids["b/4.jpg"]]
    assert camera == Camera("SIMPLE_RADIAL", 40, 30, (48.0, 19.5, 14.5, 0.0))
    assert len(found.warnings) == 1
    assert "1 of 4 images (b/4.jpg) is a guess" in found.warnings[0]
    grouped = cameras_from_exif(facts, {"a/1.jpg": "left", "b/2.jpg": "right"})
    assert grouped.camera_ids["a/1.jpg"] != grouped.camera_ids["b/2.jpg"]


def test_two_aircraft_of_one_model_are_two_cameras() -> None:
    """And so are two lenses and the bands of a multispectral camera."""
    one = ExifFacts(40, 30, make="DJI", model="FC6310", focal_mm=8.8, camera_serial="0K8A")
    facts = {
        "1": replace(one, lens="50 mm"), "2": replace(one, lens="50 mm"),
        "3": replace(one, lens="50 mm", camera_serial="0K8B"), "4": replace(one, lens="35 mm F2.8"),
        "5": replace(one, lens="24 mm F2.8"), "6": replace(one, band="NIR"), "7": replace(one, band="Green"),
    }  # fmt: skip
    found = cameras_from_exif(facts, {})
    assert found.camera_ids["1"] == found.camera_ids["2"]
    assert len(found.cameras) == 6
    assert found.camera_ids["6"] == "dji-fc6310_0K8A_NIR_8.8mm_f30_40x30"
    assert found.warnings == ()


def test_a_lost_serial_number_splits_no_camera() -> None:
    one = ExifFacts(40, 30, make="DJI", model="FC6310", focal_mm=8.8, camera_serial="0K8A", lens="8.8 mm")
    stripped = replace(one, camera_serial="", lens="")
    found = cameras_from_exif({"1": one, "2": stripped, "3": one}, {})
    assert len(found.cameras) == 1
    assert found.warnings == ()
    other = replace(one, camera_serial="0K8B")
    found = cameras_from_exif({"1": one, "2": stripped, "3": other}, {})
    assert len(found.cameras) == 3
    assert "1 of 3 images (2) has no serial number, and others of the same model have several" in found.warnings[0]
    # Another size, or another folder's camera, tells nothing.
    small = replace(stripped, width_px=20, height_px=15)
    found = cameras_from_exif({"1": one, "2": small}, {})
    assert found.camera_ids["2"] == "dji-fc6310_8.8mm_f15_20x15"


def test_colmap_text(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text("# Camera list\n1 SIMPLE_RADIAL 4000 3000 3000 2000 1500 0.01\n2 PINHOLE 640 512 900 901 320 256\n")
    cameras = read_camera_file(path).cameras
    assert cameras["1"] == BIG  # COLMAP's corner origin: cx is 0.5 less here
    assert colmap_camera(cameras["2"])[1] == (900.0, 901.0, 320.0, 256.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 FISHEYE 40 30 30 20 15\n", "line 1: camera model 'FISHEYE' is not supported; use one of"),
        ("\n1 PINHOLE 40 30 30 20 15\n", "line 2: camera model PINHOLE has the 4 parameters"),
        ("1 PINHOLE 40\n", "expected CAMERA_ID"),
        ("1 SIMPLE_PINHOLE 40 30 30 20 15\n" * 2, "line 2: camera 1 is defined twice"),
        ("1 SIMPLE_PINHOLE 40 30 20 900 15\n", "check the order of params"),
        ("1 SIMPLE_PINHOLE 40 x 20 20 15\n", "must be numbers"),
        ("1 SIMPLE_PINHOLE 40 30 nan 20 15\n", "finite"),
        ("# none\n", "names no camera"),
    ],
)
def test_malformed_colmap_text(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text(text)
    with pytest.raises(ConfigError, match=words):
        read_camera_file(path)


def test_yaml_and_block_json(tmp_path: Path) -> None:
    yaml = tmp_path / "cams.yaml"
    yaml.write_text("left: {model: SIMPLE_RADIAL, width: 4000, height: 3000, params: [3e3, 2000, 1500, 0.01]}\n")
    plain = read_camera_file(yaml)
    assert (plain.cameras, plain.crs, plain.ground_z_m) == ({"left": BIG}, None, None)
    entry = {"model": "SIMPLE_RADIAL", "width": 4000, "height": 3000, "params": [3000, 2000, 1500, 0.01]}
    block = tmp_path / "block.json"
    tree = {
        "crs": "EPSG:32615",
        "cameras": {"1": entry},
        "ground_z": {"p5": 1.0, "p50": 161.6, "p95": 3.0},
        "points": 7,
    }
    block.write_text(json.dumps(tree, indent="\t"))
    found = read_camera_file(block)
    assert (found.cameras, found.crs, found.ground_z_m) == ({"1": BIG}, "EPSG:32615", 161.6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("left: {model: PINHOLE, width: 40, height: 30}", "camera 'left': key 'params' is missing"),
        ("left: {model: SIMPLE_PINHOLE, width: 40, height: 30, params: [30, 20, 15], k: 1}", "unknown key 'k'"),
        ("left: {model: SIMPLE_PINHOLE, width: 40, height: 30, params: 30}", "params: must be a list"),
        ("left: 7", "must be {model"),
        ("[1, 2]", "must hold NAME"),
        ("left: {", "line 1 is neither YAML nor JSON"),
        (
            "cameras: {1: {model: SIMPLE_PINHOLE, width: 40, height: 30, params: [30, 20, 15]}}\nground_z: high",
            "ground_z",
        ),
    ],
)
def test_malformed_yaml(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "cams.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=words):
        read_camera_file(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_camera_file(tmp_path)


def test_resized_pictures_get_the_resized_camera() -> None:
    half = fitted(BIG, 2000, 1500)
    assert half is not None
    # (cx + 0.5) / 2 - 0.5: the middle stays the middle.
    assert half.params == pytest.approx((1500.0, 999.5, 749.5, 0.01))
    odd = fitted(BIG, 1333, 1000)
    assert odd is not None
    assert odd.params[0] == pytest.approx(3000 * (1333 / 4000 + 1 / 3) / 2)
    assert fitted(BIG, 4000, 2250) is None
    assert fitted(BIG, 3000, 4000) is None
    assert fitted(BIG, 4000, 3000) is BIG


def test_cameras_of_a_file_by_only_one_column_folder_and_size() -> None:
    small = Camera("SIMPLE_PINHOLE", 640, 512, (900.0, 319.5, 255.5))
    sizes = {"a/1.jpg": (4000, 3000), "a/2.jpg": (2000, 1500), "a/3.jpg": (4000, 2250), "a/4.jpg": (3000, 4000)}
    one = cameras_from_file({"1": BIG}, sizes, {})
    assert one.camera_ids == {"a/1.jpg": "1", "a/2.jpg": "1_2000x1500"}
    assert one.cameras["1_2000x1500"].params[0] == 1500.0
    assert "cropped" in one.reasons["a/3.jpg"]
    assert "turned by 90 degrees" in one.reasons["a/4.jpg"]

    by_size = cameras_from_file({"rgb": BIG, "thermal": small}, {"1.jpg": (2000, 1500), "2.jpg": (640, 512)}, {})
    assert by_size.camera_ids == {"1.jpg": "rgb_2000x1500", "2.jpg": "thermal"}
    twins = {"left": BIG, "right": BIG}
    by_folder = cameras_from_file(twins, {"left/1.jpg": (4000, 3000), "x/1.jpg": (4000, 3000)}, {})
    assert by_folder.camera_ids == {"left/1.jpg": "left"}
    assert "all fit 4000 x 3000" in by_folder.reasons["x/1.jpg"]
    by_column = cameras_from_file(twins, {"a": (4000, 3000), "b": (4000, 3000)}, {"a": "right", "b": "middle"})
    assert by_column.camera_ids == {"a": "right"}
    assert "'middle' of the pose list is not in the camera file, which has left, right" in by_column.reasons["b"]


@pytest.mark.parametrize(("focal_35mm", "fisheye"), [(15, True), (20, False), (24, False)])
def test_a_fisheye_lens_is_named(tmp_path: Path, focal_35mm: int, fisheye: bool) -> None:
    for number in range(2):
        write_image(tmp_path / f"{number}.jpg", (400, 300), exif={37386: 2.7, 41989: focal_35mm})
    warnings = read_inputs(tmp_path).warnings
    assert any("probably a fisheye lens" in warning for warning in warnings) == fisheye
    assert any("give its camera as OPENCV_FISHEYE" in warning for warning in warnings) == fisheye


def test_names_of_cameras_that_the_file_has_none_of_are_not_used(tmp_path: Path) -> None:
    """Our own orientation.csv names cameras as the program calls them."""
    write_image(tmp_path / "images" / "a.jpg")
    camera = {"model": "SIMPLE_RADIAL", "width": 40, "height": 30, "params": [50, 20, 15, 0.01]}
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": {"wide": camera}}))
    (tmp_path / "poses.csv").write_text("image,x,y,z,camera\na.jpg,1,2,9,canon_5.2mm_40x30\n")
    inputs = read_inputs(tmp_path / "images", tmp_path / "poses.csv", cameras=str(tmp_path / "cameras.json"))
    assert [image.camera_id for image in inputs.images] == ["wide"]
    assert any("none of the cameras that the pose list names (canon_5.2mm_40x30)" in w for w in inputs.warnings)


@pytest.mark.slow
def test_a_camera_file_of_a_hundred_thousand_brackets_is_refused(tmp_path: Path) -> None:
    (tmp_path / "deep.json").write_text('{"cameras":' + "[" * 100_000)
    with pytest.raises(ConfigError, match="nested too deeply"):
        read_camera_file(tmp_path / "deep.json")
