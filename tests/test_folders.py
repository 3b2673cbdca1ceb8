"""Folders as they are: doubled pictures, and pictures that were taken on the ground."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from make_images import PARROT_XMP, write_dji, write_image
from read_inputs import read_inputs

from aeromatch_cli.blocks.doubles import doubles, remarks_on
from aeromatch_cli.blocks.exif import ExifFacts, read_exif
from aeromatch_cli.blocks.left_out import ground_shots

COUNT = 20


def test_files_that_are_there_twice_are_found_by_their_contents(tmp_path: Path) -> None:
    contents = {"a.jpg": b"x" * 200_000, "b.jpg": b"x" * 100_000 + b"y" + b"x" * 99_999, "c.jpg": b"z"}
    for name, data in contents.items():
        (tmp_path / name).write_bytes(data)
    shutil.copy(tmp_path / "a.jpg", tmp_path / "d.jpg")
    (tmp_path / "sub").mkdir()
    shutil.copy(tmp_path / "b.jpg", tmp_path / "sub" / "b (1).jpg")
    names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg", "sub/b (1).jpg", "absent.jpg"]
    found = doubles({name: tmp_path / name for name in names})
    assert found == {"d.jpg": "a.jpg", "sub/b (1).jpg": "b.jpg"}
    assert remarks_on(found, range(5)) == [
        "2 of 5 images have the same contents as others (d.jpg is a copy of a.jpg, sub/b (1).jpg is a copy of b.jpg): "
        "the copies are left out and can be deleted"
    ]
    assert remarks_on({}, range(5)) == []


def flight(takeoff_m: float = 400.0, relative: bool = True) -> dict[str, ExifFacts]:
    """A level flight, 100 m above where it took off."""
    return {
        f"{row:02}.jpg": ExifFacts(
            40,
            30,
            latitude_deg=52.5 + 1e-4 * row,
            longitude_deg=13.4,
            altitude_m=takeoff_m + 100.0 + row % 3,
            relative_altitude_m=100.0 + row % 3 if relative else None,
        )
        for row in range(COUNT)
    }


def lowered(fact: ExifFacts, by_m: float, row: int = 0) -> ExifFacts:
    assert fact.altitude_m is not None
    relative = None if fact.relative_altitude_m is None else fact.relative_altitude_m - by_m
    place = 52.5 + 1e-4 * row
    return replace(fact, altitude_m=fact.altitude_m - by_m, relative_altitude_m=relative, latitude_deg=place)


@pytest.mark.parametrize("relative", [True, False])
def test_pictures_before_take_off_are_known_by_their_heights(relative: bool) -> None:
    facts = flight(relative=relative)
    assert ground_shots(facts) == {}
    facts |= {name: lowered(facts[name], 100.0) for name in ("00.jpg", "03.jpg")}
    assert ground_shots(facts) == dict.fromkeys(
        ("00.jpg", "03.jpg"), ("was taken on the ground by its height", "were taken on the ground by their heights")
    )


def test_a_descending_terrain_or_a_second_level_is_not_on_the_ground() -> None:
    slope = {name: lowered(fact, 6.0 * row, row) for row, (name, fact) in enumerate(flight(relative=False).items())}
    assert ground_shots(slope) == {}
    over_a_valley = {name: lowered(fact, 7.0 * row, row) for row, (name, fact) in enumerate(flight().items())}
    assert ground_shots(over_a_valley) == {}
    facts = flight(relative=False)
    low = {name: lowered(fact, 60.0, row) for row, (name, fact) in enumerate(facts.items()) if row < 4}
    assert ground_shots(facts | low) == {}  # over 33 m
    assert ground_shots(dict(list(facts.items())[:5])) == {}


def test_the_lowest_of_images_at_many_heights_is_not_on_the_ground() -> None:
    """An oblique flight (lewis, every 4th image): 16.8 m below the next one, which are 30.5 m apart themselves."""
    heights_m = (283.9, 300.7, 301.9, 308.9, 310.9, 320.2, 322.1, 331.2)
    facts = dict(zip((f"{row}.jpg" for row in range(8)), flight(relative=False).values(), strict=False))
    at = {name: replace(fact, altitude_m=z_m) for (name, fact), z_m in zip(facts.items(), heights_m, strict=True)}
    assert ground_shots(at) == {}
    low = {name: replace(fact, altitude_m=283.9 if row else 150.0) for row, (name, fact) in enumerate(facts.items())}
    assert list(ground_shots(low)) == ["0.jpg"]


@pytest.mark.parametrize(
    ("tag", "panel"),
    [
        ("<Camera:CalibrationPicture>2</Camera:CalibrationPicture>", True),
        ("<Camera:CalibrationPicture>0</Camera:CalibrationPicture>", False),
        ("<Camera:PanelSerial>RP04-1</Camera:PanelSerial>", True),
        ('<m:Albedo xmlns:m="http://micasense.com/MicaSense/1.0/">0.49</m:Albedo>', True),
        ("", False),
    ],
)
def test_pictures_of_reflectance_panels_are_known_by_xmp(tmp_path: Path, tag: str, panel: bool) -> None:
    xmp = PARROT_XMP.format(yaw=1, pitch=2, roll=3).replace("<Camera:Yaw>", f"{tag}<Camera:Yaw>")
    facts = read_exif(write_image(tmp_path / "a.tif", xmp=xmp))
    assert facts.panel == panel
    assert bool(ground_shots({"a.tif": facts})) == panel


def test_pictures_on_the_ground_are_named_and_left_out_where_that_is_asked_for(tmp_path: Path) -> None:
    for row in range(8):
        height = 0.0 if row == 0 else 100.0 + row
        write_dji(tmp_path / f"{row}.jpg", 52.5 + 1e-4 * row, 13.4, 400.0 + height, relative=height)
    words = "1 of 8 images (0.jpg) was taken on the ground by its height: "
    kept = read_inputs(tmp_path, "exif")
    assert len(kept.images) == 8
    assert f"{words}leave them out with --set block.ground_shots=drop" in kept.warnings
    dropped = read_inputs(tmp_path, "exif", drop_ground_shots=True)
    assert [image.name for image in dropped.images] == [f"{row}.jpg" for row in range(1, 8)]
    assert f"{words}left out" in dropped.warnings
