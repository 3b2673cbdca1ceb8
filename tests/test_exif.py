from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from make_images import DJI_XMP, PARROT_XMP, gps_tags, write_bands, write_image, write_jpeg_2000
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from PIL.TiffImagePlugin import IFDRational

from aeromatch_cli.blocks.exif import exif_or_reason, read_exif
from aeromatch_cli.blocks.xmp import CameraAngles
from aeromatch_cli.errors import ItemError


def test_facts_of_a_jpeg(tmp_path: Path) -> None:
    path = write_image(
        tmp_path / "a.JPG",
        (80, 60),
        main={271: "Canon\0", 272: "Canon S100", 274: 6, 306: "2011:01:01 00:00:00"},
        exif={36867: "2016:11:22 16:32:34", 37521: "498", 37386: 5.2, 41989: 24, 41486: 100.0, 41488: 3, 40962: 160}
        | {40963: 120},
        gps=gps_tags(-41.5, -81.25, -12.5),
    )
    facts = read_exif(path)
    assert (facts.width_px, facts.height_px, facts.orientation) == (80, 60, 6)  # stored size, whatever Orientation says
    assert (facts.make, facts.model, facts.focal_mm, facts.focal_35mm_mm) == ("Canon", "Canon S100", 5.2, 24.0)
    # 100 px/cm = 10 px/mm on the 160 px wide original: 5 px/mm on this half-size picture.
    assert facts.focal_plane_px_per_mm == pytest.approx(5.0)
    assert facts.focal_plane_confirmed
    assert facts.time == "2016-11-22T16:32:34.498000"
    assert (facts.latitude_deg, facts.longitude_deg) == pytest.approx((-41.5, -81.25), abs=1e-7)
    assert facts.altitude_m == pytest.approx(-12.5)
    assert facts.notes == ()


def test_gimbal_angles_are_read_and_not_the_aircraft_s(tmp_path: Path) -> None:
    xmp = DJI_XMP.format(yaw="+45.00", pitch="-89.90", roll="+0.10", relative="+39.80")
    facts = read_exif(write_image(tmp_path / "a.jpg", xmp=xmp))
    assert facts.angles is not None
    assert (facts.angles.yaw_deg, facts.angles.pitch_deg, facts.angles.roll_deg) == (45.0, -89.9, 0.1)
    assert facts.angles.convention == "gimbal"
    assert facts.relative_altitude_m == 39.8


@pytest.mark.parametrize("name", ["a.jpg", "a.tif"])
def test_camera_namespace_is_nadir_also_in_16_bit_tiff(tmp_path: Path, name: str) -> None:
    xmp = PARROT_XMP.format(yaw="-13.305", pitch="5.18259", roll="2.73152") + "\n \0\0"
    facts = read_exif(
        write_image(
            tmp_path / name, main={271: "Parrot"}, exif={37386: 3.98}, gps=gps_tags(41.4, -81.6, 349.0), xmp=xmp
        )
    )
    assert facts.angles is not None
    assert (facts.angles.yaw_deg, facts.angles.pitch_deg, facts.angles.roll_deg) == (-13.305, 5.18259, 2.73152)
    assert facts.angles.convention == "nadir"
    assert facts.focal_mm == pytest.approx(3.98)
    assert facts.longitude_deg == pytest.approx(-81.6)


@pytest.mark.parametrize("name", ["a.jpg", "a.tif", "a.png"])
def test_orientation_never_turns_the_stored_size(tmp_path: Path, name: str) -> None:
    facts = read_exif(write_image(tmp_path / name, (40, 30), main={274: 6}))
    assert (facts.width_px, facts.height_px, facts.orientation) == (40, 30, 6)


@pytest.mark.parametrize(
    ("dtype", "count"), [("uint16", 3), ("uint16", 4), ("uint16", 5), ("uint8", 5), ("float32", 3), ("int16", 3)]
)
def test_tiffs_of_several_bands_that_only_rasterio_knows(tmp_path: Path, dtype: str, count: int) -> None:
    facts = read_exif(write_bands(tmp_path / "a.tif", np.ones((count, 6, 7), dtype)))
    assert (facts.width_px, facts.height_px, facts.orientation, facts.notes) == (7, 6, 1, ())


@pytest.mark.parametrize("big", [False, True])
def test_their_tags_are_read(tmp_path: Path, big: bool) -> None:
    xmp = PARROT_XMP.format(yaw="-13.305", pitch="5.18259", roll="2.73152")
    path = write_bands(
        tmp_path / "a.TIF",
        np.ones((5, 6, 7), np.uint16),
        main={271: "MicaSense", 272: "RedEdge", 274: 6, 306: "2016:11:22 16:32:34"},
        exif={37386: 5.5},
        gps=gps_tags(41.5, -81.25, 349.0),
        xmp=xmp,
        big=big,
    )
    facts = read_exif(path)
    assert (facts.width_px, facts.height_px, facts.orientation) == (7, 6, 6)
    assert (facts.make, facts.model, facts.focal_mm, facts.time) == ("MicaSense", "RedEdge", 5.5, "2016-11-22T16:32:34")
    assert (facts.latitude_deg, facts.longitude_deg, facts.altitude_m) == (41.5, -81.25, 349.0)
    assert facts.angles is not None
    assert (facts.angles.yaw_deg, facts.angles.convention) == (-13.305, "nadir")
    assert facts.notes == ()


def test_lost_tables_of_such_a_tiff_cost_no_more_than_their_tags(tmp_path: Path) -> None:
    path = write_bands(tmp_path / "a.tif", np.ones((5, 6, 7), np.uint16), main={271: "Make", 0x8825: 10**9})
    facts = read_exif(path)
    assert (facts.width_px, facts.make, facts.latitude_deg) == (7, "Make", None)


@pytest.mark.parametrize("kept", [0, 8, 60])
def test_damaged_tiffs_are_refused_as_ever(tmp_path: Path, kept: int) -> None:
    path = write_bands(tmp_path / "a.tif", np.ones((5, 6, 7), np.uint16))
    path.write_bytes(path.read_bytes()[:kept] + b"?" * 40)
    with pytest.raises(ItemError, match=r"a\.tif: not a readable image \(damaged header or another format\)"):
        read_exif(path)


def test_png_without_tags(tmp_path: Path) -> None:
    facts = read_exif(write_image(tmp_path / "a.png"))
    assert (facts.width_px, facts.height_px, facts.time, facts.angles, facts.altitude_m) == (40, 30, "", None, None)


@pytest.mark.parametrize(
    ("change", "note"),
    [
        ({2: (IFDRational(46, 0), IFDRational(0, 0), IFDRational(0, 0))}, "incomplete"),
        ({1: "X"}, "incomplete"),
        ({2: (95.0, 0.0, 0.0)}, "incomplete"),
        ({2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)}, "(0, 0)"),
    ],
)
def test_garbage_positions_are_dropped_and_noted(tmp_path: Path, change: dict[int, object], note: str) -> None:
    facts = read_exif(write_image(tmp_path / "a.jpg", gps=gps_tags(46.0, 7.0, 500.0) | change))
    assert facts.latitude_deg is None
    assert facts.altitude_m is None
    assert note in facts.notes[0]


@pytest.mark.parametrize(
    ("letter", "degrees", "latitude", "note"),
    [
        ("", 46, 46.5, "without hemisphere (GPSLatitudeRef, GPSLongitudeRef): it counts as north and east"),
        ("", -46, -46.5, "without hemisphere"),
        ("S", -46, -46.5, ""),
        ("South", 46, -46.5, ""),
        ("N", -46, None, "incomplete or out of range"),
    ],
)
def test_hemispheres(tmp_path: Path, letter: str, degrees: int, latitude: float | None, note: str) -> None:
    path = write_image(tmp_path / "a.jpg", gps=gps_tags(46.5, 7.0, 500.0) | {1: letter})
    data = path.read_bytes()
    if degrees < 0:  # signed rationals, which Pillow does not write
        data = data.replace(struct.pack(">HHI", 2, 5, 3), struct.pack(">HHI", 2, 10, 3))
        assert data.count(struct.pack(">2I", 46, 1)) == 1
        data = data.replace(struct.pack(">2I", 46, 1), struct.pack(">2i", -46, 1))
    path.write_bytes(data)
    facts = read_exif(path)
    assert facts.latitude_deg == latitude
    assert (note in facts.notes[0]) if note else not facts.notes


def test_absent_seconds_and_zero_denominators_elsewhere(tmp_path: Path) -> None:
    gps = gps_tags(46.0, 7.0, None) | {2: (46.0, 30.0, IFDRational(0, 0)), 6: IFDRational(5, 0)}
    facts = read_exif(write_image(tmp_path / "a.jpg", gps=gps, exif={37386: IFDRational(0, 0)}))
    assert facts.latitude_deg == pytest.approx(46.5)
    assert facts.altitude_m is None
    assert facts.focal_mm is None


def test_position_in_xmp_alone_with_dji_s_misspelt_tag(tmp_path: Path) -> None:
    xmp = DJI_XMP.format(yaw=0, pitch=-90, roll=0, relative=1).replace(
        "drone-dji:Rel", 'drone-dji:GpsLatitude="46.5" drone-dji:GpsLongtitude="-7.25" drone-dji:Rel'
    )
    facts = read_exif(write_image(tmp_path / "a.jpg", xmp=xmp))
    assert (facts.latitude_deg, facts.longitude_deg, facts.altitude_m) == (46.5, -7.25, 198.31)


def test_malformed_xmp_is_noted_and_the_rest_kept(tmp_path: Path) -> None:
    facts = read_exif(write_image(tmp_path / "a.jpg", gps=gps_tags(46.0, 7.0, 500.0), xmp="<x:xmpmeta"))
    assert facts.notes == ("XMP block is malformed",)
    assert facts.altitude_m == 500.0


def test_entities_in_xmp_are_refused(tmp_path: Path) -> None:
    bomb = '<!DOCTYPE x [<!ENTITY a "aaaa">]>' + DJI_XMP.format(yaw="&a;", pitch="1", roll="1", relative="1")
    facts = read_exif(write_image(tmp_path / "a.jpg", xmp=bomb))
    assert facts.angles is None
    assert facts.notes == ("XMP block is malformed",)


@pytest.mark.parametrize(
    "content", [b"not an image at all", b"\xff\xd8\xff\xe0\x00\x10JFIF", b"II*\x00\x08\x00\x00\x00"]
)
def test_corrupt_files_are_item_errors(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.jpg"
    path.write_bytes(content)
    with pytest.raises(ItemError, match=r"bad\.jpg"):
        read_exif(path)
    reason = exif_or_reason(path)
    assert isinstance(reason, str)
    assert "bad.jpg" not in reason  # it is recorded beside the name


_RDF = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    "<rdf:Description {spaces}>{body}</rdf:Description></rdf:RDF></x:xmpmeta>"
)
_SKYDIO = 'xmlns:drone-skydio="https://www.skydio.com/drone-skydio/1.0/"'
_SKYDIO_BODY = (
    '<drone-skydio:CameraOrientationFLU rdf:parseType="Resource"><drone-skydio:Yaw>1</drone-skydio:Yaw>'
    "<drone-skydio:Pitch>2</drone-skydio:Pitch><drone-skydio:Roll>3</drone-skydio:Roll>"
    "</drone-skydio:CameraOrientationFLU>"
    "<drone-skydio:CameraOrientationNED {ned}"
    "<drone-skydio:Latitude>47.5</drone-skydio:Latitude><drone-skydio:Longitude>8.5</drone-skydio:Longitude>"
    "<drone-skydio:AbsoluteAltitude>480.5</drone-skydio:AbsoluteAltitude>"
)
_AS_ELEMENTS = (
    'rdf:parseType="Resource"><drone-skydio:Yaw>30.5</drone-skydio:Yaw><drone-skydio:Pitch>-88</drone-skydio:Pitch>'
    "<drone-skydio:Roll>0.5</drone-skydio:Roll></drone-skydio:CameraOrientationNED>"
)
_AS_ATTRIBUTES = 'drone-skydio:Yaw="30.5" drone-skydio:Pitch="-88" drone-skydio:Roll="0.5"/>'


@pytest.mark.parametrize("ned", [_AS_ELEMENTS, _AS_ATTRIBUTES])
def test_skydios_orientation_is_the_one_against_north_east_down(tmp_path: Path, ned: str) -> None:
    xmp = _RDF.format(spaces=_SKYDIO, body=_SKYDIO_BODY.replace("{ned}", ned))
    facts = read_exif(write_image(tmp_path / "a.jpg", xmp=xmp))
    assert facts.angles == CameraAngles(30.5, -88.0, 0.5, "gimbal")
    assert (facts.latitude_deg, facts.longitude_deg, facts.altitude_m) == (47.5, 8.5, 480.5)


def test_parrots_camera_angles_count_from_level(tmp_path: Path) -> None:
    space = 'xmlns:drone-parrot="http://www.parrot.com/drone-parrot/1.0/"'
    body = "".join(
        f"<drone-parrot:Camera{name}Degree>{value}</drone-parrot:Camera{name}Degree>"
        for name, value in (("Yaw", "-12.5"), ("Pitch", "-90.0"), ("Roll", "0.0"))
    )
    facts = read_exif(write_image(tmp_path / "a.jpg", xmp=_RDF.format(spaces=space, body=body)))
    assert facts.angles == CameraAngles(-12.5, -90.0, 0.0, "gimbal")


def test_sensefly_states_accuracies(tmp_path: Path) -> None:
    body = "".join(
        f"<Camera:{name}>{value}</Camera:{name}>"
        for name, value in {
            "Yaw": 10, "Pitch": 2, "Roll": -1, "GPSXYAccuracy": 0.03, "GPSZAccuracy": 0.05, "IMUYawAccuracy": 5,
            "IMUPitchAccuracy": 1, "IMURollAccuracy": 1,
        }.items()
    )  # fmt: skip
    space = 'xmlns:Camera="http://ns.sensefly.com/Camera/1.0/"'
    facts = read_exif(write_image(tmp_path / "a.jpg", xmp=_RDF.format(spaces=space, body=body)))
    assert facts.angles == CameraAngles(10.0, 2.0, -1.0, "nadir")
    assert (facts.sigmas_m, facts.sigma_angle_deg) == ((0.03, 0.03, 0.05), 5.0)


def test_bands_of_a_multispectral_camera(tmp_path: Path) -> None:
    space = 'xmlns:Camera="http://pix4d.com/camera/1.0/"'
    for inner, band in (
        ("<rdf:Seq><rdf:li>Green</rdf:li></rdf:Seq>", "Green"),
        ("<rdf:Seq><rdf:li>Red</rdf:li><rdf:li>Green</rdf:li></rdf:Seq>", ""),
        ("NIR", "NIR"),
    ):
        body = f"<Camera:BandName>{inner}</Camera:BandName>"
        facts = read_exif(write_image(tmp_path / "a.jpg", xmp=_RDF.format(spaces=space, body=body)))
        assert facts.band == band


def test_a_positioning_error_in_the_gps_tags_is_a_standard_deviation(tmp_path: Path) -> None:
    facts = read_exif(write_image(tmp_path / "a.jpg", gps=gps_tags(46.0, 7.0, 500.0) | {31: 2.5}))
    assert facts.sigmas_m == (2.5, 2.5, 5.0)  # it is the horizontal one


def test_serial_number_offset_of_the_clock_and_speed(tmp_path: Path) -> None:
    exif = {36867: "2016:11:22 16:32:34", 36881: "+02:00", 42033: "3Q4\0"}
    more = 'drone-dji:FlightXSpeed="+1.50" drone-dji:FlightYSpeed="-4.0" drone-dji:FlightZSpeed="0.1" drone-dji:GimbalY'
    xmp = DJI_XMP.format(yaw="1", pitch="-90", roll="0", relative="40").replace("drone-dji:GimbalY", more)
    facts = read_exif(write_image(tmp_path / "a.jpg", exif=exif, xmp=xmp))
    assert (facts.serial, facts.utc_offset, facts.speed_m_s) == ("3Q4", "+02:00", (1.5, -4.0, 0.1))
    xmp = xmp.replace("drone-dji:FlightXS", 'drone-dji:DroneSerialNumber="1581F" drone-dji:FlightXS')
    facts = read_exif(write_image(tmp_path / "a.jpg", exif=exif | {36881: "   :  "}, xmp=xmp))
    assert (facts.serial, facts.camera_serial, facts.utc_offset) == ("1581F", "3Q4", "")
    facts = read_exif(write_image(tmp_path / "a.jpg", exif={42033: "0000000000", 42036: "24 mm f/2.8", 42037: "77"}))
    assert (facts.serial, facts.camera_serial, facts.lens) == ("", "", "24 mm f/2.8 77")
    facts = read_exif(write_image(tmp_path / "a.jpg"))
    assert (facts.serial, facts.utc_offset, facts.speed_m_s) == ("", "", None)


_GIMBAL = DJI_XMP.format(yaw="10", pitch="-89", roll="1", relative="40")
_GIMBAL_ANGLES = CameraAngles(10.0, -89.0, 1.0, "gimbal")
_USED = "XMP block is malformed: what can be read of it is used"


def write_segments(path: Path, *segments: bytes) -> Path:
    """A JPEG with these APP1 segments, in this order."""
    data = write_image(path).read_bytes()
    parts = b"".join(b"\xff\xe1" + struct.pack(">H", len(one) + 2) + one for one in segments)
    path.write_bytes(data[:2] + parts + data[2:])
    return path


def exif_segment(main: dict[int, object], gps: dict[int, object] | None = None) -> bytes:
    tags = Image.Exif()
    tags.update(main)
    tags.get_ifd(0x8825).update(gps or {})
    return tags.tobytes()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("drone-dji:Rel", 'drone-dji:SelfData="A&B" drone-dji:Rel'),
        ("drone-dji:Rel", 'drone-dji:CameraSerialNumber="1ZN\1" drone-dji:Rel'),
        ("drone-dji:Rel", 'crs:Version="7.0" drone-dji:Rel'),
        ("</rdf:RDF>", "<broken></rdf:RDF>"),
        ("</rdf:RDF></x:xmpmeta>", ""),
        (' xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"', ""),
        ("<x:xmpmeta", '<?xml version="1.0" encoding="UTF-8"?><x:xmpmeta crs:a="b&c"'),
    ],
)
def test_what_can_be_read_of_malformed_xmp_counts(tmp_path: Path, old: str, new: str) -> None:
    facts = read_exif(write_image(tmp_path / "a.jpg", xmp=_GIMBAL.replace(old, new)))
    assert facts.angles == _GIMBAL_ANGLES
    assert facts.relative_altitude_m == 40.0
    assert facts.notes == (_USED,)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("drone-dji:", "dji:"),
        ("http://www.dji.com/drone-dji/1.0/", "http://ns.dji.com/drone-dji/2.0"),
        ("http://www.dji.com/drone-dji/1.0/", "http://www.autelrobotics.com/flight/1.0/"),
        ('drone-dji:GimbalYawDegree="10"', "drone-dji:GimbalYawDegree='10'"),
    ],
)
def test_other_prefixes_and_namespaces(tmp_path: Path, old: str, new: str) -> None:
    xmp = _GIMBAL.replace("xmlns:drone-dji", "xmlns:dji") if old == "drone-dji:" else _GIMBAL
    facts = read_exif(write_image(tmp_path / "a.jpg", xmp=xmp.replace(old, new)))
    assert (facts.angles, facts.relative_altitude_m, facts.notes) == (_GIMBAL_ANGLES, 40.0, ())


@pytest.mark.parametrize("code", ["utf-16", "utf-16-le", "utf-16-be", "utf-8-sig", "latin-1"])
def test_encodings_of_packets(tmp_path: Path, code: str) -> None:
    packet = _GIMBAL.replace("drone-dji:Rel", 'drone-dji:Place="M\u00fcnchen" drone-dji:Rel').encode(code)
    facts = read_exif(write_segments(tmp_path / "a.jpg", b"http://ns.adobe.com/xap/1.0/\0" + packet))
    assert facts.angles == _GIMBAL_ANGLES
    text = PngInfo()
    text.add(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + packet)
    Image.new("L", (40, 30)).save(tmp_path / "a.png", pnginfo=text)
    assert read_exif(tmp_path / "a.png").angles == _GIMBAL_ANGLES


def test_properties_of_all_packets_count(tmp_path: Path) -> None:
    head = b"http://ns.adobe.com/xap/1.0/\0"
    other = _RDF.format(spaces='xmlns:xmp="http://ns.adobe.com/xap/1.0/"', body="<xmp:Rating>3</xmp:Rating>").encode()
    for packets in ((_GIMBAL.encode(), other), (other, _GIMBAL.encode())):
        facts = read_exif(write_segments(tmp_path / "a.jpg", *(head + packet for packet in packets)))
        assert (facts.angles, facts.notes) == (_GIMBAL_ANGLES, ())


def test_extended_xmp_is_put_together(tmp_path: Path) -> None:
    packet, guid = _GIMBAL.encode(), b"A" * 32
    head = b"http://ns.adobe.com/xmp/extension/\0" + guid + struct.pack(">I", len(packet))
    cut = len(packet) // 2
    parts = [head + struct.pack(">I", start) + packet[start:end] for start, end in ((cut, None), (0, cut))]
    facts = read_exif(write_segments(tmp_path / "a.jpg", *parts))
    assert (facts.angles, facts.notes) == (_GIMBAL_ANGLES, ())


def test_several_segments_of_exif(tmp_path: Path) -> None:
    first, second = (
        exif_segment({272: "First"}),
        exif_segment({272: "Second", 271: "Maker"}, gps_tags(46.0, 7.0, 500.0)),
    )
    facts = read_exif(write_segments(tmp_path / "a.jpg", first, second))
    assert (facts.model, facts.make, facts.latitude_deg, facts.altitude_m) == ("First", "Maker", 46.0, 500.0)
    cut = len(second) // 2
    facts = read_exif(write_segments(tmp_path / "b.jpg", second[:cut], b"Exif\0\0" + second[cut:]))
    assert (facts.model, facts.latitude_deg, facts.notes) == ("Second", 46.0, ())
    facts = read_exif(write_segments(tmp_path / "c.jpg", b"exif\0\0" + second[6:]))
    assert (facts.model, facts.latitude_deg) == ("Second", 46.0)


def test_tags_of_a_png_in_every_form(tmp_path: Path) -> None:
    exif = exif_segment({272: "Model"}, gps_tags(46.0, 7.0, 500.0))
    path = tmp_path / "a.png"

    def profile(name: str, data: bytes) -> bytes:
        digits = data.hex().encode()
        lines = b"\n".join(digits[start : start + 72] for start in range(0, len(digits), 72))
        return (
            f"Raw profile type {name}".encode()
            + b"\0\0"
            + zlib.compress(b"\n%s\n%8d\n" % (name.encode(), len(data)) + lines)
        )

    packed = b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(_GIMBAL.encode())
    in_app1 = b"http://ns.adobe.com/xap/1.0/\0" + _GIMBAL.encode()
    for own, chunks in (
        (exif, ((b"iTXt", packed),)),
        (None, ((b"zTXt", profile("exif", exif)), (b"zTXt", profile("xmp", _GIMBAL.encode())))),
        (None, ((b"zTXt", profile("APP1", exif)), (b"zTXt", profile("APP1", in_app1)))),
    ):
        text = PngInfo()
        for kind, data in chunks:
            text.add(kind, data)
        Image.new("L", (40, 30)).save(path, pnginfo=text, exif=own)
        facts = read_exif(path)
        assert (facts.model, facts.latitude_deg, facts.angles, facts.notes) == ("Model", 46.0, _GIMBAL_ANGLES, ())


_PLACED = _GIMBAL.replace("drone-dji:Rel", 'drone-dji:GpsLatitude="-46.5" drone-dji:GpsLongitude="7.25" drone-dji:Rel')


@pytest.mark.parametrize(
    ("change", "place", "note"),
    [
        ({1: "", 3: ""}, (-46.5, 7.25, 500.0), "GPS position without hemisphere (GPSLatitudeRef, GPSLongitudeRef)"),
        ({2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)}, (-46.5, 7.25, 500.0), "GPS position is (0, 0): no fix"),
        ({2: (IFDRational(46, 0),) * 3}, (-46.5, 7.25, 500.0), "GPS position is incomplete or out of range"),
        ({6: 0.0}, (46.0, 7.0, 198.31), "GPSAltitude is 0"),
        ({6: 4294967.0}, (46.0, 7.0, 198.31), "GPSAltitude is out of range"),
        (
            {5: b"\1", 6: 198.3},
            (46.0, 7.0, 198.31),
            "GPSAltitude and the altitude of XMP have opposite signs (GPSAltitudeRef)",
        ),
        ({6: IFDRational(5, 0)}, (46.0, 7.0, 198.31), ""),
        ({}, (46.0, 7.0, 500.0), ""),
    ],
)
def test_a_sound_position_of_xmp_counts_where_that_of_exif_is_broken(
    tmp_path: Path, change: dict[int, object], place: tuple[float, float, float], note: str
) -> None:
    facts = read_exif(write_image(tmp_path / "a.jpg", gps=gps_tags(46.0, 7.0, 500.0) | change, xmp=_PLACED))
    assert (facts.latitude_deg, facts.longitude_deg, facts.altitude_m) == pytest.approx(place)
    assert facts.notes == ((f"{note}: that of XMP is used",) if note else ())


def test_adobes_positions_in_xmp(tmp_path: Path) -> None:
    space = 'xmlns:exif="http://ns.adobe.com/exif/1.0/"'
    for latitude, longitude in (("46,30.0S", "7,15.0E"), ("46,30,0S", "7,15,0E")):
        body = (
            f"<exif:GPSLatitude>{latitude}</exif:GPSLatitude><exif:GPSLongitude>{longitude}</exif:GPSLongitude>"
            "<exif:GPSAltitude>1205/10</exif:GPSAltitude><exif:GPSAltitudeRef>1</exif:GPSAltitudeRef>"
        )
        facts = read_exif(write_image(tmp_path / "a.tif", xmp=_RDF.format(spaces=space, body=body)))
        assert (facts.latitude_deg, facts.longitude_deg, facts.altitude_m) == (-46.5, 7.25, -120.5)


def test_angles_that_are_none_give_way_to_those_of_another_maker(tmp_path: Path) -> None:
    spaces = 'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" xmlns:Camera="http://pix4d.com/camera/1.0/"'
    camera = "<Camera:Yaw>10</Camera:Yaw><Camera:Pitch>2</Camera:Pitch><Camera:Roll>-1</Camera:Roll>"

    def angles(*gimbal: str) -> CameraAngles | None:
        tags = "".join(
            f"<drone-dji:Gimbal{name}Degree>{value}</drone-dji:Gimbal{name}Degree>"
            for name, value in zip(("Yaw", "Pitch", "Roll"), gimbal, strict=True)
        )
        return read_exif(write_image(tmp_path / "a.jpg", xmp=_RDF.format(spaces=spaces, body=tags + camera))).angles

    assert angles("5", "-90", "0") == CameraAngles(5.0, -90.0, 0.0, "gimbal")
    for broken in (("0", "0", "0"), ("nan", "-90", "0"), ("5", "", "0"), ("5", "-1e30", "0")):
        assert angles(*broken) == CameraAngles(10.0, 2.0, -1.0, "nadir")


def test_focal_lengths_and_digital_zoom(tmp_path: Path) -> None:
    facts = read_exif(write_image(tmp_path / "a.jpg", exif={37386: 0.0, 41989: 0, 41988: 0.0}))
    assert (facts.focal_mm, facts.focal_35mm_mm, facts.digital_zoom) == (None, None, 1.0)
    facts = read_exif(write_image(tmp_path / "a.jpg", exif={37386: 4.3, 41989: 24, 41988: IFDRational(2, 0)}))
    assert (facts.focal_mm, facts.focal_35mm_mm, facts.digital_zoom) == (pytest.approx(4.3), 24.0, 1.0)
    more = 'drone-dji:CalibratedFocalLength="30" drone-dji:Rel'
    xmp = _GIMBAL.replace("drone-dji:Rel", more)
    assert read_exif(write_image(tmp_path / "a.jpg", xmp=xmp)).calibrated is not None
    facts = read_exif(write_image(tmp_path / "a.jpg", exif={41988: 2.5}, xmp=xmp))
    assert (facts.digital_zoom, facts.calibrated) == (2.5, None)
    body = "<exif:FocalLength>88/10</exif:FocalLength><exif:FocalLengthIn35mmFilm>24</exif:FocalLengthIn35mmFilm>"
    space = 'xmlns:exif="http://ns.adobe.com/exif/1.0/"'
    facts = read_exif(write_image(tmp_path / "a.jpg", xmp=_RDF.format(spaces=space, body=body)))
    assert (facts.focal_mm, facts.focal_35mm_mm) == (8.8, 24.0)


@pytest.mark.parametrize("order", ["<", ">"])
def test_angles_of_djis_maker_notes_where_xmp_is_lost(tmp_path: Path, order: str) -> None:
    values = {6: 1.0, 7: 2.0, 8: 3.0, 9: -89.9, 10: 45.5, 11: 0.25}  # of the aircraft, then of the camera
    entries = [struct.pack(f"{order}HHI4s", 1, 2, 4, b"DJI\0")]
    entries += [struct.pack(f"{order}HHIf", tag, 11, 1, value) for tag, value in values.items()]
    note = struct.pack(f"{order}H", len(entries)) + b"".join(entries) + b"\0\0\0\0"
    path = write_image(tmp_path / "a.jpg", main={271: "DJI"}, exif={37500: note})
    facts = read_exif(path)
    assert facts.angles == CameraAngles(45.5, -89.9, 0.25, "gimbal")
    assert facts.notes == ("no angles in XMP: those of DJI's maker notes are used",)
    facts = read_exif(write_image(path, main={271: "DJI"}, exif={37500: note[:40]}))
    assert (facts.angles, facts.notes) == (None, ())
    facts = read_exif(write_image(path, main={271: "DJI"}, exif={37500: note}, xmp=_GIMBAL))
    assert (facts.angles, facts.notes) == (_GIMBAL_ANGLES, ())


@pytest.mark.parametrize("bands", [1, 3, 5])
def test_boxes_of_jpeg_2000(tmp_path: Path, bands: int) -> None:
    path = write_jpeg_2000(tmp_path / "a.jp2", np.ones((bands, 30, 40), np.uint8))
    plain = path.read_bytes()
    assert read_exif(path).angles is None
    exif = exif_segment({272: "Model"}, gps_tags(46.0, 7.0, 500.0))
    xmp = bytes.fromhex("be7acfcb97a942e89c71999491e3afac") + _GIMBAL.encode()
    for name, data in (
        (b"JpgTiffExif->JP2", exif[6:]),
        (b"JpgTiffExif->JP2", exif),
        (bytes.fromhex("0537cdab9d0c4431a72afa561f2a113e"), exif[6:]),
    ):
        boxes = b"".join(struct.pack(">I", len(one) + 8) + b"uuid" + one for one in (name + data, xmp))
        # Behind the signature and the type of the file, before the code stream.
        end = 12 + int.from_bytes(plain[12:16], "big")
        path.write_bytes(plain[:end] + boxes + plain[end:])
        facts = read_exif(path)
        assert (facts.width_px, facts.height_px, facts.model, facts.latitude_deg) == (40, 30, "Model", 46.0)
        assert (facts.angles, facts.notes) == (_GIMBAL_ANGLES, ())


def test_pictures_of_two_cameras_in_one_file(tmp_path: Path) -> None:
    """MPO: of the first picture."""
    tags = Image.Exif()
    tags[272] = "Model"
    path, picture = tmp_path / "a.JPG", Image.new("RGB", (40, 30))
    picture.save(path, format="MPO", exif=tags, xmp=_GIMBAL.encode(), save_all=True, append_images=[picture])
    facts = read_exif(path)
    assert (facts.width_px, facts.model, facts.angles) == (40, "Model", _GIMBAL_ANGLES)


@pytest.mark.parametrize(
    ("stamp", "time"),
    [
        ("2016:11:22 16:32:34", "2016-11-22T16:32:34"),
        ("2016-11-22T16:32:34.25", "2016-11-22T16:32:34.250000"),
        ("2016/11/22 16:32:34", "2016-11-22T16:32:34"),
        ("0000:00:00 00:00:00", "2020-01-02T03:04:05"),
        ("    :  :     :  :  ", "2020-01-02T03:04:05"),
        ("2016:13:22 16:32:34", "2020-01-02T03:04:05"),
    ],
)
def test_capture_times(tmp_path: Path, stamp: str, time: str) -> None:
    space = 'xmlns:exif="http://ns.adobe.com/exif/1.0/"'
    xmp = _RDF.format(spaces=space, body="<exif:DateTimeOriginal>2020-01-02T03:04:05+02:00</exif:DateTimeOriginal>")
    facts = read_exif(write_image(tmp_path / "a.jpg", exif={36867: stamp}, xmp=xmp))
    assert facts.time == time


@pytest.mark.parametrize("table", ["main", "exif"])
def test_a_packet_among_the_tags_of_a_jpeg(tmp_path: Path, table: str) -> None:
    """As some DJI cameras write it: tag 700, bytes."""
    facts = read_exif(write_image(tmp_path / "a.jpg", **{table: {700: _GIMBAL.encode()}}))
    assert (facts.angles, facts.notes) == (_GIMBAL_ANGLES, ())


def test_gps_tags_that_are_there_and_hold_nothing(tmp_path: Path) -> None:
    """As DJI's mobile SDK leaves them at times, while XMP has the position."""
    nothing = (IFDRational(0, 0),) * 3
    for value in (nothing, (0.0, 0.0, 0.0)):
        gps = {0: b"\0\0\0\0", 1: "", 2: value, 3: "", 4: value, 5: b"\0", 6: IFDRational(0, 0)}
        facts = read_exif(write_image(tmp_path / "a.jpg", gps=gps, xmp=_PLACED))
        assert (facts.latitude_deg, facts.longitude_deg, facts.altitude_m) == (-46.5, 7.25, 198.31)
        assert facts.notes[0].endswith(": that of XMP is used")


def test_a_png_of_a_photo_program_has_everything_in_xmp(tmp_path: Path) -> None:
    spaces = 'xmlns:exif="http://ns.adobe.com/exif/1.0/" xmlns:tiff="http://ns.adobe.com/tiff/1.0/"'
    body = (
        "<tiff:Make>DJI</tiff:Make><tiff:Model>FC6310</tiff:Model><tiff:Orientation>6</tiff:Orientation>"
        "<exif:FocalLength>88/10</exif:FocalLength><exif:FocalLengthIn35mmFilm>24</exif:FocalLengthIn35mmFilm>"
        "<exif:DateTimeOriginal>2024-05-01T10:20:30.5</exif:DateTimeOriginal><exif:GPSLatitude>52,30.0N</exif:GPSLatitude>"
        "<exif:GPSLongitude>13,15.0W</exif:GPSLongitude><exif:GPSAltitude>1426/10</exif:GPSAltitude>"
    )
    text = PngInfo()
    text.add_itxt("XML:com.adobe.xmp", _RDF.format(spaces=spaces, body=body))
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png", pnginfo=text)
    facts = read_exif(tmp_path / "a.png")
    assert (facts.make, facts.model, facts.orientation, facts.focal_mm, facts.focal_35mm_mm) == (
        "DJI",
        "FC6310",
        6,
        8.8,
        24,
    )
    assert (facts.time, facts.latitude_deg, facts.longitude_deg) == ("2024-05-01T10:20:30.500000", 52.5, -13.25)
    assert (facts.altitude_m, facts.notes) == (142.6, ())
