"""What aircraft write into the XMP of their pictures: angles of the camera, positions, speed, serial number.

Angles come from the camera's tags, never the aircraft's (Flight*Degree): DJI's and newer Autels' Gimbal*Degree,
Skydio's CameraOrientationNED and Parrot's Camera*Degree count from level (`gimbal`: pitch -90 looks down);
Camera:Yaw, Pitch, Roll of the Pix4D namespace (senseFly, MicaSense, Sequoia, older Autels, integrators of Sony
cameras) from straight down with the image's top to the north (`nadir`). Yaw is against true north in all.

DJI's FlightXSpeed, FlightYSpeed and FlightZSpeed are those of the aircraft to true north, to the east and, in the
same axes as its angles (NED), down, in metres per second (Mavic 3E and Zenmuse P1 user manuals, list of XMP fields).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

LATITUDES = ("drone-dji:GpsLatitude", "drone-dji:Latitude", "drone-skydio:Latitude")
# DJI's firmware spelt the tag "GpsLongtitude" for years.
LONGITUDES = (
    "drone-dji:GpsLongitude", "drone-dji:GpsLongtitude", "drone-dji:Longitude", "drone-skydio:Longitude",
)  # fmt: skip
ALTITUDES = ("drone-dji:AbsoluteAltitude", "drone-skydio:AbsoluteAltitude")
_SERIALS = ("drone-dji:DroneSerialNumber", "drone-parrot:SerialNumber")
_PREFIXES = ("drone-dji", "drone-skydio", "drone-parrot")
_BAND = "BandName"
# Structures whose members carry the names of others.
_STRUCTURE = "CameraOrientationNED"
_MEMBERS = ("Yaw", "Pitch", "Roll")
_ANGLES = (
    (tuple(f"drone-dji:Gimbal{name}Degree" for name in _MEMBERS), "gimbal"),
    (tuple(f"drone-skydio:{_STRUCTURE}.{name}" for name in _MEMBERS), "gimbal"),
    (tuple(f"Camera:{name}" for name in _MEMBERS), "nadir"),
    (tuple(f"drone-parrot:Camera{name}Degree" for name in _MEMBERS), "gimbal"),
)


@dataclass(frozen=True)
class CameraAngles:
    """Attitude of the camera, degrees; yaw against true north. convention: "gimbal" or "nadir"."""

    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    convention: str


def xmp_properties(packet: Any, notes: list[str]) -> dict[str, str]:
    """XMP properties as "prefix:Name" -> text, with the makers' namespaces under their usual prefixes.

    notes: gets a word where the packet is malformed.
    """
    from xml.etree.ElementTree import ParseError

    from defusedxml import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    if isinstance(packet, str):
        packet = packet.encode()
    if not isinstance(packet, bytes) or not packet.strip(b"\0 \r\n\t"):
        return {}
    try:
        root = fromstring(packet.strip(b"\0 \r\n\t"))
    except (ParseError, DefusedXmlException, ValueError, LookupError):
        notes.append("XMP block is malformed")
        return {}
    properties: dict[str, str] = {}
    for element in root.iter():
        _, _, own = element.tag.rpartition("}")
        if own == _STRUCTURE:
            for part in element.iter():
                _add(properties, part, f"{_STRUCTURE}.")
        _add(properties, element)
    return properties


def _add(properties: dict[str, str], element: Any, inside: str = "") -> None:
    text = element.text or ""
    if element.tag.endswith(_BAND):  # a list
        text = text.strip() or ",".join(part.text or "" for part in element.iter() if part.tag.endswith("}li"))
    for name, value in [*element.attrib.items(), (element.tag, text)]:
        namespace, _, local = name.rpartition("}")
        prefix = _prefix(namespace)
        if prefix and value.strip():
            properties.setdefault(f"{prefix}:{inside}{local}", value.strip())


def _prefix(namespace: str) -> str:
    lowered = namespace.lower()
    known = next((prefix for prefix in _PREFIXES if prefix in lowered), "")
    if known:
        return known
    if "/camera/" in lowered and "adobe" not in lowered:
        return "Camera"
    return "tiff" if "/tiff/" in lowered else ""


def xmp_angles(xmp: Mapping[str, str]) -> CameraAngles | None:
    """Of the first maker whose three tags are numbers."""
    for names, convention in _ANGLES:
        values = [tag_number(xmp.get(name)) for name in names]
        if None not in values:
            yaw, pitch, roll = (float(value) for value in values if value is not None)
            return CameraAngles(yaw, pitch, roll, convention)
    return None


def xmp_speed_m_s(xmp: Mapping[str, str]) -> tuple[float, float, float] | None:
    """Of the aircraft to true north, to the east and down, metres per second; None where XMP does not state all."""
    north, east, down = (tag_number(xmp.get(f"drone-dji:Flight{axis}Speed")) for axis in "XYZ")
    return None if north is None or east is None or down is None else (north, east, down)


def xmp_band(xmp: Mapping[str, str]) -> str:
    """Name of the band of a multispectral camera, "" where XMP states none, or several: those of a colour picture."""
    band = xmp.get(f"Camera:{_BAND}", "") or xmp.get(f"drone-dji:{_BAND}", "")
    return "" if "," in band else band


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
