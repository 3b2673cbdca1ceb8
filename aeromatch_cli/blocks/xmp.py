"""What aircraft write into the XMP of their pictures: angles of the camera, positions, speed, serial number.

Angles come from the camera's tags, never the aircraft's (Flight*Degree): DJI's and newer Autels' Gimbal*Degree,
Skydio's CameraOrientationNED and Parrot's Camera*Degree count from level (`gimbal`: pitch -90 looks down);
Camera:Yaw, Pitch, Roll of the Pix4D namespace (senseFly, MicaSense, Sequoia, older Autels, integrators of Sony
cameras) from straight down with the image's top to the north (`nadir`; but see `from_level`). Yaw is against true
north in all.

DJI's FlightXSpeed, FlightYSpeed and FlightZSpeed are those of the aircraft to true north, to the east and, in the
same axes as its angles (NED), down, in metres per second (Mavic 3E and Zenmuse P1 user manuals, list of XMP fields).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from aeromatch_cli.blocks.units import metres_of

_LATITUDES = ("drone-dji:GpsLatitude", "drone-dji:Latitude", "drone-skydio:Latitude", "exif:GPSLatitude")
# DJI's firmware spelt the tag "GpsLongtitude" for years.
_LONGITUDES = (
    "drone-dji:GpsLongitude", "drone-dji:GpsLongtitude", "drone-dji:Longitude", "drone-skydio:Longitude",
    "exif:GPSLongitude",
)  # fmt: skip
_ALTITUDES = ("drone-dji:AbsoluteAltitude", "drone-skydio:AbsoluteAltitude")
_SERIALS = ("drone-dji:DroneSerialNumber", "drone-parrot:SerialNumber")
_PREFIXES = ("drone-dji", "drone-skydio", "drone-parrot")
# Of the standard, by a part of their namespaces; that of aux holds exif, too.
_STANDARD = ("tiff", "aux", "exif")
# Names that several makers have, under namespaces of their own, and the prefix under which they count.
_COPIED = {
    **dict.fromkeys((
        "GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree", "AbsoluteAltitude", "RelativeAltitude",
        "GpsLatitude", "GpsLongitude",
    ), "drone-dji"),
    "ProjectionType": "GPano",
    **dict.fromkeys(("CalibrationPicture", "Albedo", "ReflectArea", "PanelSerial"), "Camera"),
}  # fmt: skip
_BAND = "BandName"
# Structures whose members carry the names of others.
_LISTS = ("}Seq", "}Bag", "}Alt")
_STRUCTURE = "CameraOrientationNED"
_MEMBERS = ("Yaw", "Pitch", "Roll")
_ANGLES = (
    (tuple(f"drone-dji:Gimbal{name}Degree" for name in _MEMBERS), "gimbal"),
    (tuple(f"drone-skydio:{_STRUCTURE}.{name}" for name in _MEMBERS), "gimbal"),
    (tuple(f"Camera:{name}" for name in _MEMBERS), "nadir"),
    (tuple(f"drone-parrot:Camera{name}Degree" for name in _MEMBERS), "gimbal"),
)
# How text of two bytes a character begins.
_WIDE = {
    b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"<\0": "utf-16-le", b"\0<": "utf-16-be",
}  # fmt: skip
# A letter of the hemisphere before or behind a number of degrees.
_LETTERED = re.compile(r"([NSEW]?)\s*(\d+(?:\.\d+)?)\s*°?\s*([NSEW]?)")
_ADOBE_DEGREES = re.compile(r"(\d+),(\d+(?:\.\d+)?)(?:,(\d+(?:\.\d+)?))?([NSEW])")
_LARGEST_ANGLE_DEG = 360.0
# A camera that looks further back than this from straight down.
_BACKWARDS_DEG = -45.0
_MALFORMED = "XMP block is malformed: what can be read of it is used"
_DECLARATION = re.compile(r"<\?xml\s[^>]*\?>")
_NO_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")
_BARE_AMPERSAND = re.compile(r"&(?!(?:amp|lt|gt|quot|apos|#\d+|#x[0-9a-fA-F]+);)")
_PREFIX_USED = re.compile(r"[<\s/]([A-Za-z_][\w.-]*):[A-Za-z_]")
_PREFIX_DECLARED = re.compile(r"\sxmlns:([A-Za-z_][\w.-]*)\s*=")


@dataclass(frozen=True)
class CameraAngles:
    """Attitude of the camera, degrees; yaw against true north. convention: "gimbal" or "nadir"."""

    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    convention: str


def from_level(pitches_deg: Sequence[float]) -> bool:
    """Whether pitches of one camera under the Pix4D namespace count from level, against its definition, as some Autels
    write them: cameras look down, and hardly ever backwards."""
    return bool(pitches_deg) and median(pitches_deg) < _BACKWARDS_DEG


class _Collector:
    """Target of an XML parser: collects properties as they come, so that those before a damage are there."""

    def __init__(self) -> None:
        self.properties: dict[str, str] = {}
        self._open: list[tuple[str, list[str]]] = []
        self._items: list[str] = []  # of the list that is open

    def start(self, tag: str, attributes: Mapping[str, str]) -> None:
        self._open.append((tag, []))
        for name, value in attributes.items():
            self._add(name, value)

    def data(self, text: str) -> None:
        if self._open:
            self._open[-1][1].append(text)

    def end(self, tag: str) -> None:
        text = "".join(self._open[-1][1]).strip()
        if tag.endswith("}li"):
            self._items.append(text)
        elif not tag.endswith(_LISTS):
            self._add(tag, text or (",".join(self._items) if tag.endswith(_BAND) else ""))
            self._items = []
        self._open.pop()

    def close(self) -> dict[str, str]:
        return self.properties

    def _add(self, name: str, value: str) -> None:
        namespace, _, local = name.rpartition("}")
        prefix = _prefix(namespace, local)
        inside = any(tag.endswith("}" + _STRUCTURE) for tag, _ in self._open) and local in _MEMBERS
        if prefix and value.strip():
            own = f"{_STRUCTURE}.{local}" if inside else local
            self.properties.setdefault(f"{prefix}:{own}", value.strip())


def xmp_properties(packets: Iterable[Any], notes: list[str]) -> dict[str, str]:
    """XMP properties as "prefix:Name" -> text, with the makers' namespaces under their usual prefixes; of one that
    several packets state the first counts.

    notes: gets a word where a packet is malformed. What can be read of it counts all the same.
    """
    properties: dict[str, str] = {}
    for packet in packets:
        text = _text(packet)
        if not text:
            continue
        found, sound = _parsed(text)
        if not sound:
            # Nothing is taken of what declares entities.
            found = {} if "<!DOCTYPE" in text else _parsed(_mended(text))[0] | found
            notes.append(_MALFORMED if found else "XMP block is malformed")
        properties = {**found, **properties}
    return properties


def _text(packet: Any) -> str:
    if isinstance(packet, bytes):
        wide = next((code for mark, code in _WIDE.items() if packet.startswith(mark)), "utf-8-sig")
        packet = packet.decode(wide, "replace")
    return packet.strip("\0 \r\n\t\ufeff") if isinstance(packet, str) else ""


def _parsed(text: str) -> tuple[dict[str, str], bool]:
    """Properties up to the first error, and whether there is none."""
    from xml.etree.ElementTree import ParseError

    from defusedxml.ElementTree import DefusedXMLParser

    collector = _Collector()
    parser = DefusedXMLParser(target=collector)
    try:
        parser.feed(text)
        parser.close()
    except (ParseError, ValueError, LookupError):  # ValueErrors of defusedxml, too
        return collector.properties, False
    return collector.properties, True


def _mended(text: str) -> str:
    """Without what no XML holds, with bare ampersands escaped and every prefix declared."""
    text = _NO_XML.sub("", _DECLARATION.sub("", text))
    text = _BARE_AMPERSAND.sub("&amp;", text)
    unknown = set(_PREFIX_USED.findall(text)) - set(_PREFIX_DECLARED.findall(text)) - {"xml", "xmlns"}
    spaces = "".join(f' xmlns:{prefix}="undeclared/{prefix}/"' for prefix in sorted(unknown))
    return f"<all{spaces}>{text}</all>"


def _prefix(namespace: str, local: str) -> str:
    """The usual prefix of a namespace, "" for one that does not count; some names tell it, too."""
    lowered = namespace.lower() + "/"
    known = next((prefix for prefix in _PREFIXES if prefix in lowered), "")
    if known:
        return known
    if "/camera/" in lowered and "adobe" not in lowered:
        return "Camera"
    standard = next((prefix for prefix in _STANDARD if f"/{prefix}/" in lowered), "")
    return standard or _COPIED.get(local, "")


def xmp_position(xmp: Mapping[str, str]) -> tuple[float | None, float | None, float | None]:
    """Latitude and longitude, both or neither, and altitude. A position of (0, 0) is none."""
    latitude, longitude = _first_degrees(xmp, _LATITUDES, 90.0), _first_degrees(xmp, _LONGITUDES, 180.0)
    altitude = next((number for name in _ALTITUDES if (number := xmp_metres(xmp, name)) is not None), None)
    if altitude is None and (altitude := xmp_metres(xmp, "exif:GPSAltitude")) is not None:
        altitude = -abs(altitude) if xmp.get("exif:GPSAltitudeRef") == "1" else altitude
    if latitude is None or longitude is None or latitude == longitude == 0.0:
        return None, None, altitude
    return latitude, longitude, altitude


def has_signs(xmp: Mapping[str, str]) -> bool:
    """Whether both degrees of the position say on which side they count: by a sign, by a letter, or by a tag."""
    for names in (_LATITUDES, _LONGITUDES):
        stated = next((name for name in names if xmp.get(name)), "")
        if not stated:
            return False
        if not re.search(r"[-+NSEW]", xmp[stated]) and not xmp.get(f"{stated}Ref"):
            return False
    return True


def xmp_metres(xmp: Mapping[str, str], name: str) -> float | None:
    """Of a property that counts in metres, whose unit may stand behind the number."""
    text = xmp.get(name, "")
    number = tag_number(text)
    return metres_of(text) if number is None and "," not in text else number


def unread_numbers(xmp: Mapping[str, str]) -> list[str]:
    """A note on a position, altitudes and angles that XMP states and that are no numbers, as with decimal commas."""
    degrees = {name: _first_degrees(xmp, [name], 180.0) for name in (*_LATITUDES, *_LONGITUDES)}
    metres = {name: xmp_metres(xmp, name) for name in (*_ALTITUDES, "drone-dji:RelativeAltitude")}
    angles = {name: tag_number(xmp.get(name)) for names, _ in _ANGLES for name in names}
    unread = [name.partition(":")[2] for name, number in (degrees | metres | angles).items()
              if name in xmp and number is None]  # fmt: skip
    if not unread:
        return []
    return [f"XMP states {', '.join(unread)} in a form that is not read (numbers have a decimal point): not used"]


def _first_degrees(xmp: Mapping[str, str], names: Iterable[str], largest: float) -> float | None:
    """Degrees as a number, whose hemisphere may stand in a tag of its own or as a letter beside it ("N 52.5"), or in
    Adobe's way: "52,30.5712N", "52,30,34.27N"."""
    for name in names:
        number = _degrees(xmp.get(name, ""), xmp.get(f"{name}Ref", ""))
        if number is not None and abs(number) <= largest:
            return number
    return None


def _degrees(text: str, reference: str) -> float | None:
    """Return the degrees that a text states. reference: the side of the globe of a plain number."""
    number = tag_number(text)
    if number is not None:
        return -abs(number) if reference[:1].upper() in ("S", "W") else number
    parts = _ADOBE_DEGREES.fullmatch(text)
    if parts:
        number = float(parts[1]) + float(parts[2]) / 60.0 + float(parts[3] or 0.0) / 3600.0
        return -number if parts[4] in "SW" else number
    one = _LETTERED.fullmatch(text)
    if one and bool(one[1]) != bool(one[3]):
        return -float(one[2]) if one[1] + one[3] in "SW" else float(one[2])
    return None


def xmp_angles(xmp: Mapping[str, str]) -> CameraAngles | None:
    """Of the first maker whose three tags are angles; three zeros, of a gimbal that was not measured, come last."""
    found = []
    for names, convention in _ANGLES:
        values = [number for name in names if (number := tag_number(xmp.get(name))) is not None]
        if len(values) == len(names) and max(map(abs, values)) <= _LARGEST_ANGLE_DEG:
            found.append(CameraAngles(values[0], values[1], values[2], convention))
    measured = [one for one in found if (one.yaw_deg, one.pitch_deg, one.roll_deg) != (0.0, 0.0, 0.0)]
    return next(iter([*measured, *found]), None)


def xmp_speed_m_s(xmp: Mapping[str, str]) -> tuple[float, float, float] | None:
    """Of the aircraft to true north, to the east and down, metres per second; None where XMP does not state all."""
    north, east, down = (tag_number(xmp.get(f"drone-dji:Flight{axis}Speed")) for axis in "XYZ")
    if north is None or east is None or down is None:
        return None
    return north, east, down


def xmp_band(xmp: Mapping[str, str]) -> str:
    """Name of the band of a multispectral camera, "" where XMP states none, or several: those of a colour picture."""
    band = xmp.get(f"Camera:{_BAND}", "") or xmp.get(f"drone-dji:{_BAND}", "")
    return "" if "," in band else band


def xmp_panel(xmp: Mapping[str, str]) -> bool:
    """Whether a picture shows a panel of known reflectance, as MicaSense and Sequoia state it."""
    marked = (tag_number(xmp.get("Camera:CalibrationPicture")) or 0.0) >= 1.0
    return marked or any(f"Camera:{name}" in xmp for name in ("Albedo", "ReflectArea", "PanelSerial"))


def xmp_serial(xmp: Mapping[str, str]) -> str:
    """Serial number of the aircraft, "" where XMP states none."""
    return next((xmp[name] for name in _SERIALS if xmp.get(name, "").strip("0 ")), "")


def tag_number(value: Any) -> float | None:
    """A finite float of a tag or an XMP text (also "a/b"), or None. Pillow makes NaN of a zero denominator."""
    if isinstance(value, tuple | list) and len(value) == 1:
        value = value[0]
    if isinstance(value, str) and "/" in value:
        numerator, denominator = (tag_number(part) for part in value.split("/", 1))
        return numerator / denominator if numerator is not None and denominator else None
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None
