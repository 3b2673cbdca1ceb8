"""What --quiet never hides: pictures of the folder that the block does not have, and control that is not used."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import invoke
from make_images import write_dji, write_image
from PIL import Image
from read_inputs import read_inputs

from aeromatch_cli.blocks.control_files import read_survey
from aeromatch_cli.blocks.scan import scan_images
from aeromatch_cli.images.files import read_pixels

COUNT = 4


def flight(folder: Path) -> list[str]:
    names = [f"a{row}.jpg" for row in range(COUNT)]
    for row, name in enumerate(names):
        write_dji(folder / name, 52.5 + 2e-4 * row, 13.4, 140.0)
    return names


def quiet(command: str, images: Path, *more: object) -> str:
    outcome = invoke(
        command, "baseline", "--images", images, "--poses", "exif", "--workspace", images.parent / "work", "--quiet",
        "--set", "orient=none", "--jobs", 1, *more,
    )  # fmt: skip
    assert outcome.code == 0
    assert not outcome.stdout
    return outcome.stderr


def test_jpegs_of_all_suffixes_are_read(tmp_path: Path) -> None:
    for name in ("a.jfif", "b.jpe", "c.JPG", "d.JPEG"):
        write_image(tmp_path / name)
    assert scan_images(tmp_path) == (["a.jfif", "b.jpe", "c.JPG", "d.JPEG"], [])
    assert read_pixels(tmp_path / "a.jfif", colour=False).shape == (30, 40)


@pytest.mark.parametrize(
    ("name", "format_", "words"),
    [
        ("b.webp", "WEBP", "WEBP is not read"),
        ("b.mpo", "JPEG", "MPO is not read"),
        ("b", "JPEG", "a JPEG by its content: rename it to .jpg"),
        ("b.jpg_original", "JPEG", "a JPEG by its content"),
        ("b.dat", "PNG", "a PNG by its content"),
        ("b.dat", "TIFF", "TIFF or raw by its content"),
        ("b.thm", "JPEG", ""),
        ("b.dat", "", ""),
        ("a0.jpg_original", "JPEG", ""),  # of a picture that is there
    ],
)
def test_pictures_that_are_passed_over_are_named(tmp_path: Path, name: str, format_: str, words: str) -> None:
    images = tmp_path / "images"
    flight(images)
    if format_:
        Image.new("RGB", (8, 8)).save(images / name, format=format_)
    else:
        (images / name).write_bytes(b"no picture")
    inputs = read_inputs(images, "exif")
    said = "\n".join(inputs.warnings)
    assert (f"passed over 1: {name}: " in said) == bool(words)
    assert words in said
    assert [one.name for one in inputs.unread] == ([name] if words else [])
    assert not inputs.failures


def test_pictures_that_are_passed_over_are_said_in_quiet(tmp_path: Path) -> None:
    images = tmp_path / "images"
    flight(images)
    (images / "b.webp").write_bytes(b"x")
    assert quiet("pairs", images).startswith("warning: passed over 1: b.webp: WEBP is not read")
    assert quiet("pairs", images, "--exclude", "b.webp") == ""


def test_videos_are_no_lost_pictures(tmp_path: Path) -> None:
    flight(tmp_path)
    (tmp_path / "DJI_0001.MP4").write_bytes(b"x")
    assert read_inputs(tmp_path, "exif").unread == ()


def points(folder: Path, rows: list[str]) -> Path:
    path = folder / "gcp_list.txt"
    path.write_text("\n".join(["EPSG:32633", *rows]) + "\n")
    return path


def test_control_of_other_images_is_named_where_quiet_is_asked_for(tmp_path: Path) -> None:
    flight(tmp_path / "images")
    rows = [f"391000 5818{row}00 34 10 1{row} other{row}.jpg P{row}" for row in range(3)]
    said = quiet("pairs", tmp_path / "images", "--gcp", points(tmp_path, rows))
    assert "gcp_list.txt names 3 images that the block does not have" in said
    assert "3 of 3 control points are measured in no image of the block" in said


def test_exchanged_names_of_image_and_point_are_put_right(tmp_path: Path) -> None:
    rows = [f"391000 5818{row}00 34 10 1{row} P{row} a{row}.jpg" for row in range(3)]
    survey = read_survey(points(tmp_path, rows), None)
    assert [point.name for point in survey.points] == ["P0", "P1", "P2"]
    assert [mark.image for mark in survey.marks] == ["a0.jpg", "a1.jpg", "a2.jpg"]
    assert survey.remarks == ("gcp_list.txt: the names of image and point are exchanged: they were put right",)


def test_exchanged_columns_of_measurements_are_named(tmp_path: Path) -> None:
    flight(tmp_path / "images")
    (tmp_path / "points.csv").write_text("label,x,y,z\n" + "".join(f"P{k},39100{k},5818000,34\n" for k in range(3)))
    (tmp_path / "marks.csv").write_text("label,image,x,y\n" + "".join(f"a{k}.jpg,P{k},10,1{k}\n" for k in range(3)))
    outcome = invoke(
        "pairs", "baseline", "--images", tmp_path / "images", "--poses", "exif", "--workspace", tmp_path / "work",
        "--gcp", tmp_path / "points.csv", "--set", f"block.gcp_marks={tmp_path / 'marks.csv'}", "--quiet", "--jobs", 1,
    )  # fmt: skip
    assert outcome.code == 2
    assert "images as points (a0.jpg, a1.jpg, a2.jpg): exchange the columns of image and point" in outcome.stderr
