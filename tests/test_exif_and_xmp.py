"""Which of two positions counts where EXIF and XMP state different ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from make_images import DJI_XMP, gps_tags, write_image
from read_inputs import read_inputs

from aeromatch_cli.blocks.cameras import cameras_from_exif
from aeromatch_cli.blocks.exif import ExifFacts, read_exif
from aeromatch_cli.blocks.exif_and_xmp import settled

COUNT = 8


def place(row: int) -> tuple[float, float, float]:
    return 52.5 + 2e-4 * row, 13.4 + 1e-4 * row, 140.0 + 0.3 * row


def facts_of(exif: list[tuple[float, float, float]], xmp: list[tuple[float, float, float]]) -> dict[str, ExifFacts]:
    return {
        f"{row}.jpg": ExifFacts(40, 30, latitude_deg=a[0], longitude_deg=a[1], altitude_m=a[2], xmp_position=b)
        for row, (a, b) in enumerate(zip(exif, xmp, strict=True))
    }


def found(facts: dict[str, ExifFacts]) -> list[tuple[float | None, float | None, float | None]]:
    return [(one.latitude_deg, one.longitude_deg, one.altitude_m) for one in settled(facts)[0].values()]


TRUE = [place(row) for row in range(COUNT)]
SAME = [(52.5, 13.4, 140.0)] * COUNT
TO_MINUTES = [(round(60 * a) / 60, round(60 * b) / 60, z) for a, b, z in TRUE]
HIGHER = [(a, b, z + 40.0) for a, b, z in TRUE]


@pytest.mark.parametrize(
    ("exif", "xmp", "counts", "words"),
    [
        (TRUE, TRUE, TRUE, []),
        (TO_MINUTES, TRUE, TRUE, ["different positions of 7 of 8 images (1.jpg,", "so XMP is used"]),
        ([(a, b, 0.5) for a, b, _ in TRUE], TRUE, TRUE, ["different heights of 8 of 8", "so XMP is used"]),
        (TRUE, SAME, TRUE, ["different positions of 7 of 8", "so EXIF is used"]),
        (TRUE, HIGHER, TRUE, ["different heights of 8 of 8 images", "by 40.0 m: EXIF is used"]),
        (
            [*TRUE[:3], (48.0, 11.0, 140.0), *TRUE[4:]],
            TRUE,
            [*TRUE[:3], (*TRUE[3][:2], 140.0), *TRUE[4:]],
            ["EXIF states positions of 1 of 8 images (3.jpg) far from all others, XMP does not: XMP is used"],
        ),
        (
            TRUE,
            [*TRUE[:3], (48.0, 11.0, 140.0), *TRUE[4:]],
            TRUE,
            ["positions of 1 of 8 images (3.jpg)", "EXIF is used"],
        ),
    ],
    ids=["alike", "minutes", "one height", "take-off point", "another zero", "stray in EXIF", "stray in XMP"],
)
def test_the_sounder_position_counts_and_the_other_is_named(
    exif: list[tuple[float, float, float]],
    xmp: list[tuple[float, float, float]],
    counts: list[tuple[float, float, float]],
    words: list[str],
) -> None:
    facts = facts_of(exif, xmp)
    assert found(facts) == counts
    said = " ".join(settled(facts)[1])
    assert bool(said) == bool(words)
    for word in words:
        assert word in said


@pytest.mark.parametrize("altitude", [None, 0.0])
def test_heights_above_the_take_off_point_count_where_there_are_no_others(altitude: float | None) -> None:
    facts = {
        f"{row}.jpg": ExifFacts(
            40, 30, latitude_deg=a, longitude_deg=b, altitude_m=altitude, relative_altitude_m=80.0 + row
        )
        for row, (a, b, _) in enumerate(TRUE)
    }
    heights, remarks = settled(facts)
    assert [one.altitude_m for one in heights.values()] == [80.0 + row for row in range(COUNT)]
    (remark,) = remarks
    assert remark.endswith(": heights above the take-off point (RelativeAltitude) are used")
    facts["3.jpg"] = replace(facts["3.jpg"], relative_altitude_m=None)
    heights, remarks = settled(facts)
    assert [one.altitude_m for one in heights.values()] == [None] * COUNT
    assert remarks == (["GPSAltitude is 0 in 8 of 8 images: not used"] if altitude == 0.0 else [])
    facts["4.jpg"] = replace(facts["4.jpg"], altitude_m=120.0)  # a flight from the sea
    assert settled(facts) == (facts, [])


def test_positions_that_only_one_of_them_states_are_left_alone() -> None:
    facts = {"a.jpg": ExifFacts(40, 30, latitude_deg=1.0, longitude_deg=2.0), "b.jpg": ExifFacts(40, 30)}
    assert settled(facts) == (facts, [])


def test_a_block_takes_the_positions_of_xmp_where_exif_has_one_for_all(tmp_path: Path) -> None:
    for row, (latitude, longitude, altitude) in enumerate(TRUE):
        tags = f'drone-dji:GpsLatitude="{latitude:.8f}" drone-dji:GpsLongitude="{longitude:.8f}" drone-dji:Gimbal'
        xmp = DJI_XMP.format(yaw=0, pitch=-90, roll=0, relative=100).replace("+198.31", f"{altitude:+.2f}")
        xmp = xmp.replace("drone-dji:Gimbal", tags, 1)
        write_image(tmp_path / f"{row}.jpg", gps=gps_tags(52.5, 13.4, altitude), xmp=xmp)
    inputs = read_inputs(tmp_path, "exif")
    step_m = inputs.poses["7_jpg"].center_m - inputs.poses["0_jpg"].center_m
    assert abs(step_m[1] - 7 * 2e-4 * 111_260.0) < 5.0  # metres to the north; one degree there has 111,260
    assert any("EXIF and XMP state different positions of 7 of 8 images" in line for line in inputs.warnings)


SIGNED = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {}/></rdf:RDF></x:xmpmeta>'
)


@pytest.mark.parametrize(
    ("latitude", "longitude", "counts", "said"),
    [
        ("+52.5", "+13.4", (52.5, 13.4), True),
        ("52.5", "13.4", (-52.5, 13.4), False),  # XMP may have lost the sign
        ("+52.500900", "+13.4", (-52.5, 13.4), False),  # another place
    ],
)
def test_of_two_hemispheres_the_signed_one_counts(
    tmp_path: Path, latitude: str, longitude: str, counts: tuple[float, float], said: bool
) -> None:
    xmp = SIGNED.format(f'drone-dji:GpsLatitude="{latitude}" drone-dji:GpsLongitude="{longitude}"')
    facts = read_exif(write_image(tmp_path / "a.jpg", gps=gps_tags(-52.5, 13.4, 140.0), xmp=xmp))
    assert (facts.latitude_deg, facts.longitude_deg) == pytest.approx(counts, abs=1e-9)
    assert any("that of XMP is used" in note for note in facts.notes) == said


@pytest.mark.parametrize(
    ("latitude", "longitude", "altitude", "counts", "unread"),
    [
        ("N 52.5", "W 13.4", "+142.6 m", (52.5, -13.4, 142.6), ""),
        ("52.5 S", "13.4E", "+142.6", (-52.5, 13.4, 142.6), ""),
        ("+52,5", "+13,4", "+142,6", (None, None, None), "GpsLatitude, GpsLongitude, AbsoluteAltitude"),
    ],
)
def test_numbers_of_xmp_with_letters_units_and_commas(
    tmp_path: Path, latitude: str, longitude: str, altitude: str, counts: tuple, unread: str
) -> None:
    tags = f'drone-dji:GpsLatitude="{latitude}" drone-dji:GpsLongitude="{longitude}"'
    xmp = SIGNED.format(f'{tags} drone-dji:AbsoluteAltitude="{altitude}"')
    facts = read_exif(write_image(tmp_path / "a.jpg", xmp=xmp))
    assert facts.xmp_position == counts
    assert any(f"XMP states {unread} in a form that is not read" in note for note in facts.notes) == bool(unread)


def lens(tmp_path: Path, focal_mm: float, exif_35: int, xmp_35: int) -> ExifFacts:
    xmp = SIGNED.replace("{}", f'xmlns:exif="http://ns.adobe.com/exif/1.0/" exif:FocalLengthIn35mmFilm="{xmp_35}"')
    return read_exif(write_image(tmp_path / "a.jpg", exif={37386: focal_mm, 41989: exif_35}, xmp=xmp))


def test_of_two_focal_lengths_the_one_that_goes_with_the_lens_counts(tmp_path: Path) -> None:
    facts = lens(tmp_path, 9.0, 310, 31)
    assert (facts.focal_35mm_mm, facts.focal_doubt) == (31.0, "35-mm equivalent 310 mm in EXIF, 31 mm in XMP")
    found = cameras_from_exif({"a.jpg": facts}, {})
    (camera,) = found.cameras.values()
    assert camera.params[0] == pytest.approx(31.0 / 43.267 * 50.0, abs=0.01)
    assert "(a.jpg: 35-mm equivalent 310 mm in EXIF, 31 mm in XMP): the latter is used" in found.warnings[0]
    facts = lens(tmp_path, 9.0, 31, 310)
    assert (facts.focal_35mm_mm, facts.focal_doubt) == (31.0, "35-mm equivalent 310 mm in XMP, 31 mm in EXIF")
    assert lens(tmp_path, 9.0, 31, 30).focal_doubt == ""


def test_focal_lengths_that_differ_by_rounding_are_one_camera() -> None:
    facts = {f"{row}.jpg": ExifFacts(40, 30, focal_mm=9.0 + 0.01 * row, focal_35mm_mm=31.0) for row in range(6)}
    found = cameras_from_exif(facts, {})
    assert list(found.cameras) == ["unknown_9mm_f35.82_40x30"]
    (said,) = found.warnings
    assert "6 of 6 images" in said
    assert "(9 to 9.05 mm): they count as one camera with 9 mm" in said
    zoom = {f"{row}.jpg": ExifFacts(40, 30, focal_mm=9.0 + 0.2 * row, focal_35mm_mm=31.0) for row in range(6)}
    assert len(cameras_from_exif(zoom, {}).cameras) == 6
    many = {f"{row}.jpg": ExifFacts(40, 30, focal_mm=9.0 + 0.01 * (row % 2), focal_35mm_mm=31.0) for row in range(6)}
    assert len(cameras_from_exif(many, {}).cameras) == 2
