"""What an image file says of itself in its header: EXIF, GPS, maker notes and XMP. Pixels are never decoded.

What XMP says is read by `xmp` and `calibration`.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from aeromatch_cli.blocks.accuracies import Sigmas, completed_sigmas_m
from aeromatch_cli.blocks.calibration import angle_sigma_deg, calibrated_camera, position_sigmas_m
from aeromatch_cli.blocks.packets import Packets, jp2_packets, jpeg_packets, png_packets
from aeromatch_cli.blocks.xmp import (
    CameraAngles,
    has_signs,
    tag_number,
    unread_numbers,
    xmp_angles,
    xmp_band,
    xmp_metres,
    xmp_panel,
    xmp_position,
    xmp_properties,
    xmp_serial,
    xmp_speed_m_s,
)
from aeromatch_cli.data import Camera
from aeromatch_cli.errors import ItemError
from aeromatch_cli.images import gdal, heif
from aeromatch_cli.images.gdal import check_pixels

_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_WIDTH, _HEIGHT, _MAKE, _MODEL, _ORIENTATION, _DATE_TIME, _XMP_PACKET = 256, 257, 271, 272, 274, 306, 700
_DATE_TIME_ORIGINAL, _SUBSEC, _SUBSEC_ORIGINAL, _OFFSET_ORIGINAL = 36867, 37520, 37521, 36881
_BODY_SERIAL, _CAMERA_SERIAL, _LENS_MODEL, _LENS_SERIAL = 42033, 50735, 42036, 42037
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM, _DIGITAL_ZOOM = 37386, 41989, 41988
_MAKER_NOTE = 37500
_EXIF_WIDTH, _EXIF_HEIGHT = 40962, 40963
_FOCAL_PLANE_X, _FOCAL_PLANE_UNIT = 41486, 41488
_MAP_DATUM, _POSITIONING_ERROR = 18, 31  # GPSHPositioningError, metres
# Datums that agree with WGS84 to a metre or two, as cameras name them.
_LIKE_WGS84 = re.compile(
    r"WGS[ _-]?(19)?84.*|World Geodetic System 1984|(ITRF|ETRF|ETRS|CGCS|JGD|GDA|NAD[ _-]?83|SIRGAS|PZ|GRS).*|[\W\d_]*",
    re.IGNORECASE,
)
_XMP_CAMERA_SERIAL = "drone-dji:CameraSerialNumber"
_GEOTIFF = frozenset({33550, 34264})  # ModelPixelScale, ModelTransformation: where pixels lie on the map
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_TIME = re.compile(r"(\d{4})[:/.-](\d\d)[:/.-](\d\d)[ T](\d\d):(\d\d):(\d\d)(?:\.(\d+))?", re.ASCII)
# What files with the name of an image hold besides.
_HEAD_BYTES = 512
_DAMAGED = "damaged header or another format"
_OTHERS = {
    re.compile(rb"version https://git-lfs"): "a pointer of Git LFS: fetch the file itself with git lfs pull",
    re.compile(rb"\s*<(!doctype|html|\?xml)", re.IGNORECASE): "a web page or XML: download the file again",
    re.compile(rb"\0{64}"): "zeros: copy the file again",
}
_HEIC_CONTENT = {
    re.compile(rb"....ftyp(heic|heix|hevc|mif1|msf1)", re.DOTALL): "HEIC by its content: rename it to .heic"
}
# Positions nearer to (0, 0) stand for none; altitudes that are higher are overflown numbers.
_NO_FIX_DEG, _HIGHEST_M, _ALTITUDE_ROUNDING_M = 1e-7, 30_000.0, 2.0
# Of one place stated twice, and of two on either side of the equator or of Greenwich.
_SAME_PLACE_DEG, _MIRRORED_DEG = 1e-4, 0.01
# 35-mm equivalents are so many times the focal length, from medium format to the smallest sensors of telephones; two
# statements of one length differ by less than this factor.
_CROP_FACTORS, _SAME_LENGTH = (0.4, 15.0), 1.25
_TAKEN_NORTH_EAST = ": it counts as north and east; where that is wrong, write the letters (exiftool) or give --poses"
# What Pillow raises on headers that are cut or scrambled.
_BROKEN = (OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, EOFError, OverflowError, struct.error)
# CameraPitch, CameraYaw and CameraRoll in DJI's maker notes, an IFD without a head. Source: ExifTool, DJI tags.
_DJI_ANGLES = {"Yaw": 10, "Pitch": 9, "Roll": 11}
_FLOAT, _ENTRY_BYTES = 11, 12


@dataclass(frozen=True)
class ExifFacts:
    """The header of one image; None or "" where a fact is absent or unusable.

    width_px, height_px: the stored raster, whatever `orientation` (1-8) says. focal_35mm_mm: 35-mm equivalent.
    focal_doubt: what XMP states otherwise of these two, in words, the one that counts last. digital_zoom: how many
    times a part of the sensor was enlarged. focal_plane_px_per_mm: horizontal, for the stored
    raster; focal_plane_confirmed: EXIF names the raster that the tag speaks of, so that resizing is allowed for. time:
    ISO text with fraction of a second. latitude_deg, longitude_deg: WGS84, both or neither. altitude_m: as the file
    states it, whatever its datum. xmp_position: the same three as XMP states them. relative_altitude_m: above the
    take-off point. calibrated: the camera by XMP. sigmas_m: standard deviations of the position to the east, to the
    north and of the height, by an RTK receiver or as GPS tags state them; sigma_angle_deg: of the angles. serial:
    number of the aircraft, else that of the camera. camera_serial: of the camera's body, else that of the aircraft.
    lens: model and serial number. band: of a multispectral camera. panel: shows a panel of known reflectance. panorama:
    its projection, "" for other pictures. utc_offset: of `time`, such as "+02:00". speed_m_s: of the aircraft, to true
    north, to the east and down. georeferenced: the file says where its pixels lie on the map, as orthophotos do. notes:
    what was found and could not be used.
    """

    width_px: int
    height_px: int
    orientation: int = 1
    make: str = ""
    model: str = ""
    focal_mm: float | None = None
    focal_35mm_mm: float | None = None
    focal_doubt: str = ""
    digital_zoom: float = 1.0
    focal_plane_px_per_mm: float | None = None
    focal_plane_confirmed: bool = False
    time: str = ""
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    xmp_position: tuple[float | None, float | None, float | None] = (None, None, None)
    relative_altitude_m: float | None = None
    angles: CameraAngles | None = None
    calibrated: Camera | None = None
    sigmas_m: Sigmas | None = None
    sigma_angle_deg: float | None = None
    georeferenced: bool = False
    serial: str = ""
    camera_serial: str = ""
    lens: str = ""
    band: str = ""
    panel: bool = False
    panorama: str = ""
    utc_offset: str = ""
    speed_m_s: tuple[float, float, float] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Header:
    """size_px: width and height of the stored raster. main, exif, gps: tags by number. xmp: packets beside them."""

    size_px: tuple[int, int]
    main: Mapping[int, Any]
    exif: Mapping[int, Any]
    gps: Mapping[int, Any]
    xmp: tuple[Any, ...]


def read_exif(path: Path) -> ExifFacts:
    """Header facts of a JPEG, PNG or TIFF (any depth). Raises ItemError where the file is no readable image."""
    notes: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's remarks on odd tags, one per image, are of no use to anybody
        header = _header(path, notes)
    width_px, height_px = header.size_px
    if width_px < 1 or height_px < 1:
        raise ItemError(f"{path.name}: the header states a size of {width_px} x {height_px} px")
    check_pixels(path, width_px, height_px)
    tags, exif = header.main, header.exif
    # Some aircraft put the packet among the tags of a JPEG, too.
    packets = (*header.xmp, tags.get(_XMP_PACKET), exif.get(_XMP_PACKET))
    xmp = xmp_properties(dict.fromkeys(packet for packet in packets if packet), notes)
    angles = _angles(tags, exif, xmp, notes)
    in_xmp = xmp_position(xmp)
    notes += unread_numbers(xmp)
    latitude_deg, longitude_deg, altitude_m = _position(header.gps, in_xmp, has_signs(xmp), notes)
    focal_mm, focal_35mm_mm, doubt = _focal_lengths(exif, xmp)
    focal_plane, confirmed = _focal_plane(exif, width_px, height_px)
    # 0 says that there is none; pictures are enlarged by it and not reduced.
    zoom = max(_positive(exif.get(_DIGITAL_ZOOM)) or _positive(xmp.get("exif:DigitalZoomRatio")) or 1.0, 1.0)
    orientation = tag_number(tags.get(_ORIENTATION)) or tag_number(xmp.get("tiff:Orientation")) or 1.0
    body = _serial(exif.get(_BODY_SERIAL)) or _serial(tags.get(_CAMERA_SERIAL)) or xmp.get(_XMP_CAMERA_SERIAL, "")
    return ExifFacts(
        width_px=width_px,
        height_px=height_px,
        orientation=int(orientation) if 1 <= orientation <= 8 else 1,
        make=_text(tags.get(_MAKE)) or xmp.get("tiff:Make", ""),
        model=_text(tags.get(_MODEL)) or xmp.get("tiff:Model", ""),
        focal_mm=focal_mm,
        focal_35mm_mm=focal_35mm_mm,
        focal_doubt=doubt,
        digital_zoom=zoom,
        focal_plane_px_per_mm=focal_plane,
        focal_plane_confirmed=confirmed,
        time=_time(tags, exif, xmp),
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        altitude_m=altitude_m,
        xmp_position=in_xmp,
        relative_altitude_m=xmp_metres(xmp, "drone-dji:RelativeAltitude"),
        angles=angles,
        calibrated=calibrated_camera(xmp, width_px, height_px) if zoom == 1.0 else None,
        sigmas_m=_sigmas_m(header.gps, xmp, notes),
        sigma_angle_deg=angle_sigma_deg(xmp),
        georeferenced=bool(_GEOTIFF & tags.keys()),
        serial=xmp_serial(xmp) or body,
        camera_serial=body or xmp_serial(xmp),
        lens=" ".join(part for part in (_text(exif.get(_LENS_MODEL)), _serial(exif.get(_LENS_SERIAL))) if part),
        band=xmp_band(xmp),
        panel=xmp_panel(xmp),
        panorama=xmp.get("GPano:ProjectionType", ""),
        utc_offset=_utc_offset(exif),
        speed_m_s=xmp_speed_m_s(xmp),
        notes=tuple(notes),
    )


def _angles(
    tags: Mapping[int, Any], exif: Mapping[int, Any], xmp: Mapping[str, str], notes: list[str]
) -> CameraAngles | None:
    """Return the angles that XMP states, else those of DJI's maker notes, which is noted."""
    angles = xmp_angles(xmp)
    if angles is not None or _text(tags.get(_MAKE)) != "DJI":
        return angles
    angles = xmp_angles(dji_camera_angles(exif.get(_MAKER_NOTE)))
    if angles is not None:
        notes.append("no angles in XMP: those of DJI's maker notes are used")
    return angles


def exif_or_reason(path: Path) -> ExifFacts | str:
    """`read_exif`, or the reason why the file is unusable: what a pool of workers maps over many files."""
    try:
        return read_exif(path)
    except ItemError as error:
        return str(error).removeprefix(f"{path.name}: ")  # recorded beside the name


def _header(path: Path, notes: list[str]) -> _Header:
    """Size and tags; a broken table of tags is empty and noted, since the picture itself may be sound."""
    from PIL import Image, UnidentifiedImageError

    # A mapping camera's frame is larger than Pillow's guard against hostile files; nothing is decoded here.
    Image.MAX_IMAGE_PIXELS = None
    if path.suffix.lower() in heif.SUFFIXES:
        heif.readable()
    try:
        with Image.open(path) as image:
            if image.format == "PNG":
                packets = png_packets(path)
            elif image.format == "JPEG2000":
                packets = jp2_packets(path)
            elif image.format in ("JPEG", "MPO"):
                packets = jpeg_packets(getattr(image, "applist", ()))
            else:
                main, exif, gps = _tables(_readers(image.getexif), notes)
                # Pillow turns the size of a TIFF by its Orientation: here the stored raster counts.
                size_px = (int(main[_WIDTH]), int(main[_HEIGHT])) if image.format == "TIFF" else image.size
                return _Header(size_px, main, exif, gps, (image.info.get("xmp"),))
            main, exif, gps = _tables_of(packets, notes)
            return _Header(image.size, main, exif, gps, tuple(packets.xmp))
    except UnidentifiedImageError as error:
        if path.suffix.lower() not in gdal.SUFFIXES:
            raise _unreadable(path) from error
        return _header_of_other(path, notes)
    except _BROKEN as error:
        raise ItemError(f"{path.name}: header cannot be read ({error}): copy the file again") from error


def _header_of_other(path: Path, notes: list[str]) -> _Header:
    """The same of a file that Pillow does not know (16 bit or float with several bands): by the reader of its pixels.

    Pillow can read the tags of a TIFF all the same.
    """
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    try:
        size_px = gdal.stored_size(path)
    except ItemError as error:
        raise _unreadable(path) from error
    if path.suffix.lower() not in gdal.TIFF:
        packets = jp2_packets(path)
        main, exif, gps = _tables_of(packets, notes)
        return _Header(size_px, main, exif, gps, tuple(packets.xmp))
    with path.open("rb") as stream:
        magic = stream.read(16)
        magic = magic if magic[2:3] == b"+" else magic[:8]  # BigTIFF is version 43, and its offsets have 8 bytes

        def table(pointer: int | None) -> Mapping[int, Any]:
            directory = ImageFileDirectory_v2(magic)
            start = directory.next if pointer is None else table(None).get(pointer)
            if start is not None:
                stream.seek(int(start))
                directory.load(stream)
            return dict(directory)

        main, exif, gps = _tables([partial(table, pointer) for pointer in (None, _EXIF_IFD, _GPS_IFD)], notes)
    return _Header(size_px, main, exif, gps, ())


def _unreadable(path: Path) -> ItemError:
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    others = {} if path.suffix.lower() in heif.SUFFIXES else _HEIC_CONTENT
    kind = next((words for begins, words in (_OTHERS | others).items() if begins.match(head)), _DAMAGED)
    return ItemError(f"{path.name}: not a readable image ({kind})")


def _readers(table: Callable[[], Any]) -> tuple[Callable[[], Mapping[int, Any]], ...]:
    """Of main, EXIF and GPS tags. table: makes Pillow's, which reads what it is asked for."""
    return lambda: dict(table()), lambda: dict(table().get_ifd(_EXIF_IFD)), lambda: dict(table().get_ifd(_GPS_IFD))


def _tables(readers: Iterable[Callable[[], Mapping[int, Any]]], notes: list[str]) -> list[Mapping[int, Any]]:
    """Main, EXIF and GPS tags, each by its reader."""
    tables: list[Mapping[int, Any]] = []
    for label, read in zip(("EXIF", "EXIF", "GPS"), readers, strict=True):
        try:
            tables.append(read())
        except _BROKEN:
            tables.append({})
            notes.append(f"{label} tags are damaged")
    return tables


def _tables_of(packets: Packets, notes: list[str]) -> list[Mapping[int, Any]]:
    """The same of blocks of Exif: of a tag that several state the first block counts."""
    from PIL import Image

    tables: list[Mapping[int, Any]] = [{}, {}, {}]
    for block in packets.exif:
        exif = Image.Exif()

        def table(exif: Image.Exif = exif, block: bytes = block) -> Image.Exif:
            exif.load(block)  # once: what it has loaded it knows
            return exif

        tables = [{**later, **first} for first, later in zip(tables, _tables(_readers(table), notes), strict=True)]
    return tables


def _position(
    gps: Mapping[int, Any], in_xmp: tuple[float | None, float | None, float | None], signed: bool, notes: list[str]
) -> tuple[float | None, float | None, float | None]:
    """Latitude, longitude and altitude: of EXIF, else of XMP, or where these differ by the hemisphere alone and XMP
    states it. signed: whether it does."""
    latitude, longitude = _exif_position(gps, in_xmp, notes)
    if signed and latitude is not None and longitude is not None and _mirrored((latitude, longitude), in_xmp[:2]):
        notes.append(
            "the hemisphere of the GPS position (GPSLatitudeRef, GPSLongitudeRef) is not that of XMP: that of XMP is "
            "used"
        )
        latitude = longitude = None
    if latitude is None or longitude is None:
        latitude, longitude = in_xmp[:2]
    if latitude is None or longitude is None:
        return None, None, None
    return latitude, longitude, _altitude(gps, in_xmp[2], notes)


def _mirrored(own: tuple[float, float], others: tuple[float | None, float | None]) -> bool:
    """Whether two positions are the same but for signs."""
    latitude, longitude = others
    if latitude is None or longitude is None:
        return False
    pairs = (own[0], latitude), (own[1], longitude)
    if not all(abs(abs(one) - abs(other)) < _SAME_PLACE_DEG for one, other in pairs):
        return False
    return any(abs(one - other) > _MIRRORED_DEG for one, other in pairs)


def _exif_position(
    gps: Mapping[int, Any], in_xmp: tuple[float | None, float | None, float | None], notes: list[str]
) -> tuple[float | None, float | None]:
    """Both, or None and a note where they cannot be used."""
    if gps.get(2) is None and gps.get(4) is None:
        return None, None
    letters = _text(gps.get(1)), _text(gps.get(3))
    bare = not all(letters)
    latitude = _sexagesimal(gps.get(2), letters[0], "NS", 90.0)
    longitude = _sexagesimal(gps.get(4), letters[1], "EW", 180.0)
    instead = ": that of XMP is used" if in_xmp[0] is not None else ""
    if latitude is None or longitude is None:
        notes.append(f"GPS position is incomplete or out of range{instead}")
        return None, None
    if abs(latitude) < _NO_FIX_DEG and abs(longitude) < _NO_FIX_DEG:
        notes.append(f"GPS position is (0, 0): no fix{instead}")
        return None, None
    datum = _text(gps.get(_MAP_DATUM))
    if datum and not _LIKE_WGS84.fullmatch(datum):
        notes.append(f"GPSMapDatum is {datum[:30]}, and positions count as WGS84: give a list in that CRS with --poses")
    if bare:
        notes.append(f"GPS position without hemisphere (GPSLatitudeRef, GPSLongitudeRef){instead or _TAKEN_NORTH_EAST}")
        return (None, None) if instead else (latitude, longitude)
    return latitude, longitude


def _altitude(gps: Mapping[int, Any], in_xmp: float | None, notes: list[str]) -> float | None:
    altitude = tag_number(gps.get(6))
    if altitude is None:
        return in_xmp
    reference = gps.get(5)
    code = reference[0] if isinstance(reference, bytes) and reference else tag_number(reference)
    # 1: below sea level; 3: below the ellipsoid (Exif 3.0). Some writers store the character instead of the number.
    altitude = -abs(altitude) if code in (1, 3, 49, 51) else altitude
    instead = ": that of XMP is used" if in_xmp is not None else ""
    if abs(altitude) > _HIGHEST_M:
        notes.append(f"GPSAltitude is out of range{instead}")
        return in_xmp
    if in_xmp is not None and altitude == 0.0 and abs(in_xmp) > _ALTITUDE_ROUNDING_M:
        notes.append(f"GPSAltitude is 0{instead}")
        return in_xmp
    if in_xmp is not None and altitude * in_xmp < 0.0 and abs(altitude + in_xmp) < _ALTITUDE_ROUNDING_M:
        notes.append(f"GPSAltitude and the altitude of XMP have opposite signs (GPSAltitudeRef){instead}")
        return in_xmp
    return altitude


def _sexagesimal(value: Any, reference: str, letters: str, largest: float) -> float | None:
    """Signed degrees of (degrees, minutes, seconds); None where a part is missing or absurd. Without a hemisphere the
    first letter counts, unless degrees have a sign, which must not contradict it."""
    parts = value if isinstance(value, tuple | list) else (value,)
    letter = reference[:1].upper()
    sign = {"": 1.0, letters[0]: 1.0, letters[1]: -1.0}.get(letter)
    if sign is None or not parts or len(parts) > 3:
        return None
    degrees = tag_number(parts[0])
    if degrees is None or (degrees < 0.0 and letter == letters[0]):
        return None
    sign, total = (-1.0 if degrees < 0.0 else sign), abs(degrees)
    for part, scale in zip(parts[1:], (60.0, 3600.0), strict=False):
        number = tag_number(part)
        if number is None and getattr(part, "numerator", None) == 0:
            number = 0.0  # 0/0 stands for "no seconds given" with several writers
        if number is None or not 0 <= number <= 60:
            return None
        total += number / scale
    return sign * total if total <= largest else None


def _focal_lengths(exif: Mapping[int, Any], xmp: Mapping[str, str]) -> tuple[float | None, float | None, str]:
    """Focal length and its 35-mm equivalent: of EXIF, else of XMP; where these state different ones, that which goes
    with the other of the two. And both in words, where they do."""
    lengths = _positive(exif.get(_FOCAL_LENGTH)), _positive(xmp.get("exif:FocalLength"))
    equivalents = _positive(exif.get(_FOCAL_LENGTH_35MM)), _positive(xmp.get("exif:FocalLengthIn35mmFilm"))
    length, equivalent = _that_go_together(_stated(lengths), _stated(equivalents))
    doubts = [_doubt("focal length", lengths, length), _doubt("35-mm equivalent", equivalents, equivalent)]
    return length, equivalent, "; ".join(doubt for doubt in doubts if doubt)


def _stated(values: Sequence[float | None]) -> list[float | None]:
    """Return the values that are stated, each once; [None] of none."""
    return [value for value in dict.fromkeys(values) if value] or [None]


def _that_go_together(
    lengths: Sequence[float | None], equivalents: Sequence[float | None]
) -> tuple[float | None, float | None]:
    """Return the first focal length and 35-mm equivalent of one camera; the first ones where none go together."""
    for length in lengths:
        for equivalent in equivalents:
            if not length or not equivalent or _CROP_FACTORS[0] < equivalent / length < _CROP_FACTORS[1]:
                return length, equivalent
    return lengths[0], equivalents[0]


def _doubt(what: str, stated: tuple[float | None, float | None], used: float | None) -> str:
    """Return both lengths of EXIF and XMP in words where they differ, that which is used last; else ""."""
    by_exif, by_xmp = stated
    if not by_exif or not by_xmp or 1.0 / _SAME_LENGTH < by_exif / by_xmp < _SAME_LENGTH:
        return ""
    places = {"EXIF": by_exif, "XMP": by_xmp}
    shown = sorted(places.items(), key=lambda place: place[1] == used)
    return f"{what} " + ", ".join(f"{mm:g} mm in {place}" for place, mm in shown)


def _focal_plane(exif: Mapping[int, Any], width_px: int, height_px: int) -> tuple[float | None, bool]:
    """Pixels per millimetre of the stored raster, and whether EXIF names the raster that the tag speaks of."""
    resolution = _positive(exif.get(_FOCAL_PLANE_X))
    unit_mm = _MM_PER_UNIT.get(int(tag_number(exif.get(_FOCAL_PLANE_UNIT)) or 2))
    if resolution is None or unit_mm is None:
        return None, False
    exif_width, exif_height = _positive(exif.get(_EXIF_WIDTH)), _positive(exif.get(_EXIF_HEIGHT))
    if exif_width and exif_height and abs(width_px * exif_height - height_px * exif_width) < 2 * exif_width:
        return resolution / unit_mm * width_px / exif_width, True
    return resolution / unit_mm, False


def _time(tags: Mapping[int, Any], exif: Mapping[int, Any], xmp: Mapping[str, str]) -> str:
    for stamp, subsec in (
        (exif.get(_DATE_TIME_ORIGINAL), exif.get(_SUBSEC_ORIGINAL)),
        (xmp.get("exif:DateTimeOriginal"), None),
        (tags.get(_DATE_TIME), exif.get(_SUBSEC)),
    ):
        # Exif separates dates by colons, XMP and some cameras in other ways.
        parts = _TIME.match(_text(stamp))
        try:
            time = datetime.strptime(" ".join(parts.groups()[:6]), "%Y %m %d %H %M %S") if parts else None
        except ValueError:
            continue
        if time is None or parts is None:
            continue
        digits = _text(subsec) or parts[7] or ""
        fraction = digits[:6].ljust(6, "0") if digits.isascii() and digits.isdigit() else "0"
        return time.replace(microsecond=int(fraction)).isoformat()
    return ""


def _utc_offset(exif: Mapping[int, Any]) -> str:
    offset = _text(exif.get(_OFFSET_ORIGINAL))
    return offset if re.fullmatch(r"[+-](0\d|1[0-4]):[0-5]\d", offset) else ""


def _sigmas_m(gps: Mapping[int, Any], xmp: Mapping[str, str], notes: list[str]) -> Sigmas | None:
    sigmas_m, remark = position_sigmas_m(xmp)
    if remark:
        notes.append(remark)
        return sigmas_m
    return sigmas_m or completed_sigmas_m(across_m=_positive(gps.get(_POSITIONING_ERROR)))


def _text(value: Any) -> str:
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return value.replace("\0", " ").strip() if isinstance(value, str) else ""


def _serial(value: Any) -> str:
    """A serial number; zeros stand for none."""
    text = _text(value)
    return text if text.strip("0 ") else ""


def _positive(value: Any) -> float | None:
    number = tag_number(value)
    return number if number is not None and number > 0 else None


def dji_camera_angles(note: Any) -> dict[str, str]:
    """Return the angles of the camera in DJI's maker notes, which remain where programs have dropped the XMP.

    They stand under the names that XMP has for them, in degrees as there; none where one is missing.
    """
    if not isinstance(note, bytes):
        return {}
    for order in "<>":
        found: dict[int, float] = {}
        for start in range(2, len(note) - _ENTRY_BYTES + 1, _ENTRY_BYTES):
            tag, kind, count, value = struct.unpack_from(f"{order}HHIf", note, start)
            if kind == _FLOAT and count == 1:
                found.setdefault(tag, value)
        if found.keys() >= set(_DJI_ANGLES.values()):
            return {f"drone-dji:Gimbal{name}Degree": f"{found[tag]:.2f}" for name, tag in _DJI_ANGLES.items()}
    return {}
