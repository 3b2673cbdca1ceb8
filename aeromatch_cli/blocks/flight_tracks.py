"""Where a camera was while it filmed: DJI's subtitles (SRT) beside a video, or a GPX track."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import given_bytes, text_encoding

_SPAN = re.compile(r"(\d{1,4}):(\d{1,2}):(\d{1,2})[,.](\d{1,9})\s*-->")
_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
# [latitude: 47.1] [longitude: 8.5] [rel_alt: 20.1 abs_alt: 450.2]; older firmware has longtitude, and altitude.
_LATITUDE = re.compile(rf"\[\s*latitude\s*:\s*{_NUMBER}\s*\]", re.IGNORECASE)
_LONGITUDE = re.compile(rf"\[\s*longt?itude\s*:\s*{_NUMBER}\s*\]", re.IGNORECASE)
_HEIGHT = re.compile(rf"abs_alt\s*:\s*{_NUMBER}|\[\s*altitude\s*:\s*{_NUMBER}", re.IGNORECASE)
# GPS(8.5,47.1,16): longitude first, and behind it what is a height in some and a count of satellites in other firmware.
_OLD = re.compile(rf"GPS\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}")
# Farther from all points of a track than this, seconds, nothing is known.
_FAR_S = 2.0


@dataclass(frozen=True, eq=False)
class FlightTrack:
    """times_s: (N,) increasing, of the video; utc: of a GPX track, seconds of the epoch. places: (N, 3) latitude,
    longitude (degrees), height (metres, NaN where it is not stated)."""

    times_s: FloatArray
    places: FloatArray
    utc: bool = False

    def at(self, time_s: float) -> FloatArray | None:
        """(3,) interpolated; None where the track says nothing of that time."""
        if float(np.abs(self.times_s - time_s).min()) > _FAR_S:
            return None
        return np.array([np.interp(time_s, self.times_s, self.places[:, k]) for k in range(3)])


def track_beside(video: Path) -> Path | None:
    """The SRT or GPX file of the same name."""
    found = {path.suffix.lower(): path for path in video.parent.glob(f"{video.stem}.*")}
    return found.get(".srt") or found.get(".gpx")


def read_track(path: Path) -> FlightTrack:
    """Raises ConfigError where the file cannot be read or has no position."""
    try:
        raw = given_bytes(path)
        text = raw.decode(text_encoding(raw))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"the track {path} cannot be read ({error}): give an SRT or GPX file") from error
    gpx = path.suffix.lower() == ".gpx"
    rows = _gpx(path, raw) if gpx else _srt(text)
    if not rows:
        form = "GPX with times" if gpx else "an SRT file of DJI, whose subtitles have latitude and longitude"
        raise ConfigError(f"{path} has no position with a time: {form} is needed; switch subtitles on in the camera")
    table = np.array(sorted({row[0]: row for row in rows}.values()), dtype=np.float64)
    return FlightTrack(table[:, 0], table[:, 1:], gpx)


def _srt(text: str) -> list[tuple[float, ...]]:
    rows: list[tuple[float, ...]] = []
    for block in re.split(r"\r?\n\s*\r?\n", text):
        span = _SPAN.search(block)
        place = _place(block)
        if span and place:
            hours, minutes, seconds = (int(part) for part in span.groups()[:3])
            rows.append((3600.0 * hours + 60.0 * minutes + seconds + float(f"0.{span[4]}"), *place))
    return rows


def _place(block: str) -> tuple[float, float, float] | None:
    """Latitude, longitude, height of a subtitle; None without a fix."""
    latitude, longitude, height = _LATITUDE.search(block), _LONGITUDE.search(block), _HEIGHT.search(block)
    if latitude and longitude:
        place = float(latitude[1]), float(longitude[1])
    elif old := _OLD.search(block):
        place = float(old[2]), float(old[1])
    else:
        return None
    return _known(*place, float(height[1] or height[2]) if height else math.nan)


def _known(latitude: float, longitude: float, height_m: float) -> tuple[float, float, float] | None:
    """A place; None where there was no fix (0, 0), or it is none. A height that is none is NaN."""
    if latitude == 0.0 and longitude == 0.0:
        return None
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        return None
    return latitude, longitude, height_m if math.isfinite(height_m) else math.nan


def _gpx(path: Path, raw: bytes) -> list[tuple[float, ...]]:
    from xml.etree.ElementTree import ParseError

    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    rows: list[tuple[float, ...]] = []
    try:
        for point in fromstring(raw).iter():
            if point.tag.rpartition("}")[2] != "trkpt":
                continue
            inside = {child.tag.rpartition("}")[2]: (child.text or "").strip() for child in point}
            if inside.get("time"):
                where = float(point.attrib["lat"]), float(point.attrib["lon"]), float(inside.get("ele") or "nan")
                if (place := _known(*where)) is not None:
                    rows.append((utc_seconds(inside["time"]), *place))
    except (ParseError, DefusedXmlException, KeyError, ValueError) as error:
        raise ConfigError(f"{path} is no GPX track ({error}): export it anew") from error
    return rows


def utc_seconds(text: str) -> float:
    """Of the epoch, of an ISO time; one without a zone is UTC. Raises ValueError."""
    time = datetime.fromisoformat(text)
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def poses_text(names: Sequence[str], places: Sequence[FloatArray | None]) -> str:
    """A pose list of frames; those without a place have empty cells."""
    lines = ["image,lat,lon,alt"]
    for name, place in zip(names, places, strict=True):
        latitude, longitude, height = (math.nan,) * 3 if place is None else (float(value) for value in place)
        cells = (f"{latitude:.8f}", f"{longitude:.8f}", f"{height:.3f}")
        lines.append(",".join([name, *("" if cell == "nan" else cell for cell in cells)]))
    return "\n".join(lines) + "\n"
