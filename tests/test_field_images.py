"""Pictures and folders as people have them, rebuilt after public reports: docs/field_cases.md names the source
of each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import invoke
from make_images import DJI_XMP, PARROT_XMP, gps_tags, write_dji, write_image
from PIL import Image
from read_inputs import read_inputs

from aeromatch_cli.blocks.camera_files import read_camera_file
from aeromatch_cli.blocks.cameras import fitted
from aeromatch_cli.blocks.exif import exif_or_reason, read_exif
from aeromatch_cli.blocks.other_files import masks_by_content
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.cameras import MODELS, corner_params
from aeromatch_cli.images.masks import mask_path

COUNT = 4
GPANO = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
    'GPano:ProjectionType="equirectangular"/></rdf:RDF></x:xmpmeta>'
)
DOWN = (0.0, 0.0, -1.0)


def flight(folder: Path) -> list[str]:
    names = [f"a{row}.jpg" for row in range(COUNT)]
    for row, name in enumerate(names):
        write_dji(folder / name, 52.5 + 2e-4 * row, 13.4, 140.0)
    return names


@pytest.mark.parametrize(
    ("gps", "latitude"),
    [
        ({2: (52.0, 30.59328, 0.0)}, -52.509888),  # decimal minutes
        ({1: "South"}, -52.509888),
        ({1: "s"}, -52.509888),
        ({2: (52.0, 29.0, 60.0)}, -52.5),  # seconds that were rounded up
    ],
)
def test_latitudes_as_programs_write_them(tmp_path: Path, gps: dict, latitude: float) -> None:
    path = write_image(tmp_path / "a.jpg", gps=gps_tags(-52.509888, 13.4, 140.0) | gps)
    assert read_exif(path).latitude_deg == pytest.approx(latitude, abs=1e-9)


@pytest.mark.parametrize(("datum", "said"), [("TOKYO", True), ("WGS-84", False), ("WGS84", False), ("", False)])
def test_positions_in_another_datum_are_named(tmp_path: Path, datum: str, said: bool) -> None:
    facts = read_exif(write_image(tmp_path / "a.jpg", gps=gps_tags(35.0, 139.0, 40.0) | {18: datum}))
    assert facts.latitude_deg == pytest.approx(35.0)
    assert any("GPSMapDatum is TOKYO, and positions count as WGS84" in note for note in facts.notes) == said


@pytest.mark.parametrize(("pitch", "looks", "said"), [(-90, DOWN, True), (0, DOWN, False), (-60, None, True)])
def test_pitches_that_count_from_level_against_their_tag(
    tmp_path: Path, pitch: float, looks: tuple | None, said: bool
) -> None:
    """Autel's XL715 writes DJI's pitch under Pix4D's name, by which the camera would look backwards."""
    for row in range(COUNT):
        write_image(
            tmp_path / f"a{row}.jpg", main={271: "Camera", 272: "XL715"}, gps=gps_tags(52.5 + 2e-4 * row, 13.4, 140.0),
            xmp=PARROT_XMP.format(yaw=10, pitch=pitch, roll=0),
        )  # fmt: skip
    found = read_inputs(tmp_path, "exif")
    axis = found.poses["a0_jpg"].world_rotation[2]  # type: ignore[index]
    if looks is not None:
        np.testing.assert_allclose(axis, looks, atol=1e-9)
    else:
        assert axis[2] == pytest.approx(-np.sin(np.deg2rad(60.0)))
    assert any("4 of 4 images" in line and "looks backwards" in line for line in found.warnings) == said
    by_tag = read_inputs(tmp_path, "exif", angles="nadir")
    assert by_tag.poses["a0_jpg"].world_rotation[2][2] == pytest.approx(-np.cos(np.deg2rad(pitch)))  # type: ignore[index]


def test_the_same_in_a_table_of_exiftool(tmp_path: Path) -> None:
    head = "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude,Yaw,Pitch,Roll"
    path = tmp_path / "tags.csv"
    for pitch, forward in ((-90, True), (2, False)):
        path.write_text(f"{head}\na.jpg,52.5,13.4,140,10,{pitch},0\n")
        assert read_pose_file(path).rows[0].forward is forward


@pytest.mark.parametrize(("side", "longitude"), [("W", -14.1606695), ("E", 14.1606695), ("", 14.1606695)])
def test_the_hemisphere_of_xmp_in_a_tag_of_its_own(tmp_path: Path, side: str, longitude: float) -> None:
    tags = f"<exif:GPSLongitude>14.1606695</exif:GPSLongitude><exif:GPSLongitudeRef>{side}</exif:GPSLongitudeRef>"
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:exif="http://ns.adobe.com/exif/1.0/"><exif:GPSLatitude>28.1844783'
        f"</exif:GPSLatitude>{tags}</rdf:Description></rdf:RDF></x:xmpmeta>"
    )
    facts = read_exif(write_image(tmp_path / "a.jpg", xmp=xmp))
    assert (facts.latitude_deg, facts.longitude_deg) == pytest.approx((28.1844783, longitude))


def test_gimbal_angles_in_elements_and_not_those_of_the_aircraft(tmp_path: Path) -> None:
    attributes = DJI_XMP.format(yaw="+84.20", pitch="-44.50", roll="+0.00", relative="46").split("drone-dji:")
    pairs = [part.split('"') for part in attributes if "=" in part and "Degree" in part]
    elements = "".join(f"<drone-dji:{name[:-1]}>{value}</drone-dji:{name[:-1]}>" for name, value, *_ in pairs)
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/">'
        f"{elements}</rdf:Description></rdf:RDF></x:xmpmeta>"
    )
    angles = read_exif(write_image(tmp_path / "a.jpg", xmp=xmp)).angles
    assert angles is not None
    assert (angles.yaw_deg, angles.pitch_deg, angles.roll_deg) == (84.2, -44.5, 0.0)


def test_pictures_of_the_way_to_the_first_line_are_named(tmp_path: Path) -> None:
    """Before and behind the mission the gimbal looks to the horizon."""
    for row in range(8):
        pitch = 0.0 if row in (0, 7) else -90.0
        write_dji(tmp_path / f"a{row}.jpg", 52.5 + 2e-4 * row, 13.4, 140.0, pitch=pitch)
    said = invoke("check", "baseline", "--images", tmp_path, "--poses", "exif", "--jobs", "1").stderr
    assert "2 images (a0.jpg, a7.jpg) with the horizon in view" in said


def test_gimbal_angles_that_were_never_measured_are_named(tmp_path: Path) -> None:
    for row in range(COUNT):
        write_dji(tmp_path / f"a{row}.jpg", 52.5 + 2e-4 * row, 13.4, 140.0, yaw=0, pitch=0, roll=0)
    said = invoke("check", "baseline", "--images", tmp_path, "--poses", "exif", "--jobs", "1").stderr
    assert "all angles of 4 images" in said
    assert "are zero: most likely they were never measured" in said


def test_panoramas_among_the_pictures_are_left_out_and_named(tmp_path: Path) -> None:
    names = flight(tmp_path)
    write_image(tmp_path / "pano.jpg", (80, 40), gps=gps_tags(52.5, 13.4, 140.0), xmp=GPANO)
    found = read_inputs(tmp_path, "exif")
    assert [image.name for image in found.images] == names
    assert any("passed over 1: pano.jpg: panoramas by their XMP (equirectangular)" in line for line in found.warnings)


def two_values(path: Path, size_px: tuple[int, int] = (40, 30)) -> None:
    values = np.zeros(size_px[::-1], dtype=np.uint8)
    values[10:] = 255
    Image.fromarray(values).save(path)


def test_masks_that_have_the_name_of_their_image(tmp_path: Path) -> None:
    names = flight(tmp_path)
    for name in names:
        two_values(tmp_path / name.replace("jpg", "png"))
    found = read_inputs(tmp_path, "exif")
    assert [image.name for image in found.images] == names
    assert any("passed over 4: a0.png" in line and "masks of images" in line for line in found.warnings)
    assert mask_path(str(tmp_path), "a0.jpg") == tmp_path / "a0.png"


def test_pictures_in_two_formats_are_no_masks_and_are_named(tmp_path: Path) -> None:
    names = flight(tmp_path)
    noise = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    for name in names:
        Image.fromarray(noise).save(tmp_path / name.replace("jpg", "png"))
    both = sorted([*names, *(name.replace("jpg", "png") for name in names)])
    assert masks_by_content(tmp_path, both) == set()
    found = read_inputs(tmp_path, "exif")
    assert len(found.images) == 2 * COUNT
    assert mask_path(str(tmp_path), "a0.jpg") is None
    assert any("4 pictures are there in two formats (a0.jpg and a0.png" in line for line in found.warnings)
    two_values(tmp_path / "alone.png")  # beside no picture of its name
    assert masks_by_content(tmp_path, [*both, "alone.png"]) == set()


@pytest.mark.parametrize(
    ("head", "said"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n", "git lfs pull"),
        (b"<!DOCTYPE html><html><title>404</title></html>", "a web page or XML: download the file again"),
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(50), "HEIC by its content: rename it to .heic"),
        (bytes(5000), "zeros: copy the file again"),
        (b"garbage", "damaged header or another format"),
    ],
)
def test_files_that_are_no_pictures_say_what_they_are(tmp_path: Path, head: bytes, said: str) -> None:
    (tmp_path / "a.jpg").write_bytes(head)
    reason = exif_or_reason(tmp_path / "a.jpg")
    assert isinstance(reason, str)
    assert said in reason


@pytest.mark.parametrize(
    ("sensor", "size_px"),
    [("17.49998592000000030566x13.12498944000000200560", (4608, 3456)), ("12.82x8.55", (5472, 3648)),
     ("35.0x23.328125", (8192, 5460))],
)  # fmt: skip
def test_a_camera_of_pix4d(tmp_path: Path, sensor: str, size_px: tuple[int, int]) -> None:
    """Millimetres of its sensor become pixels of the pictures, from the upper left corner, and the lens of the
    calibrated camera parameters beside it."""
    width, height = size_px
    pixel_mm = float(sensor.split("x")[0]) / width
    px = {"F": 0.85 * width, "Px": 0.49 * width, "Py": 0.48 * height}
    lens = {"K1": 0.038334, "K2": -0.017509, "K3": 0.020498, "T1": 0.0024, "T2": 0.0029}
    values = {name: value * pixel_mm for name, value in px.items()} | lens
    path = tmp_path / "x_pix4d_calibrated_internal_camera_parameters.cam"
    path.write_text(
        "Pix4D camera calibration file 0\n"
        f"#Focal Length mm assuming a sensor width of {sensor}mm\nF {values['F']:.20f}\n#Principal Point mm\n"
        + "".join(f"{name} {values[name]:.20f}\n" for name in ("Px", "Py"))
        + "#Symmetrical Lens Distortion Coeffs\n" + "".join(f"{name} {value}\n" for name, value in lens.items())
    )  # fmt: skip
    (stated,) = read_camera_file(path).cameras.values()
    camera = fitted(stated, width, height)
    assert camera is not None
    assert (camera.model, camera.width_px, camera.height_px) == ("BROWN", width, height)
    named = dict(zip(MODELS["BROWN"], corner_params(camera), strict=True))
    expected = {"f": px["F"], "cx": px["Px"], "cy": px["Py"], "k1": lens["K1"], "p1": lens["T1"], "p2": lens["T2"]}
    # Rows and columns of the last sensor have no common scale within a thousandth of a pixel each.
    assert {name: named[name] for name in expected} == pytest.approx(expected, rel=2e-4)


def test_what_a_camera_of_pix4d_lacks_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.cam"
    for text, said in (
        ("Pix4D camera calibration file 0\n#Focal Length mm assuming a sensor width of 6.2x4.6mm\nF 4\nPx 3\n", "Py"),
        ("Pix4D camera calibration file 0\nF 4\nPx 3\nPy 2\n", "width and height of the sensor"),
        ("FOCAL 4.3\n", "is no calibration of Pix4D that is read"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=said):
            read_camera_file(path)


def test_bytes_behind_the_end_of_a_picture_cost_nothing(tmp_path: Path) -> None:
    """DJI's pictures have them; other readers refuse them."""
    path = write_dji(tmp_path / "a.jpg", 52.5, 13.4, 140.0)
    path.write_bytes(path.read_bytes() + bytes(500) + b"\xff\xd9")
    assert read_exif(path).latitude_deg == pytest.approx(52.5)
