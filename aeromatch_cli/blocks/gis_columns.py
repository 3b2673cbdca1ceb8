"""Columns of geometry in tables that GIS programs write, as columns of coordinates.

`POINT Z (x y z)`, `PointZ (x y z)`, `SRID=32633;POINT(x y)`: x, or the longitude, stands first.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence

_NAMES = frozenset(("wkt", "wkt_geom", "geometry", "geom", "the_geom", "ewkt", "shape"))
_NUMBER = r"[-+]?\d+(?:\.\d*)?(?:e[-+]?\d{1,3})?"
_POINT = re.compile(
    rf"\s*(?:SRID=(\d+);)?\s*POINT\s*(?:ZM|Z|M)?\s*\(\s*({_NUMBER})\s+({_NUMBER})(?:\s+({_NUMBER}))?(?:\s+{_NUMBER})?\s*\)\s*",
    re.IGNORECASE,
)
_SEPARATORS = ("\t", ";", ",")
_DEGREES = (180.0, 90.0)
# Other columns of coordinates are not read beside a geometry, and of heights where it has its own.
_COORDINATES = frozenset(
    ("x", "y", "lon", "lat", "long", "lng", "longitude", "latitude", "easting", "northing", "xcoord", "ycoord")
)
_HEIGHTS = frozenset(("z", "alt", "altitude", "height", "elevation"))


def with_coordinates(lines: Sequence[str]) -> list[str]:
    """Lines of a table with its column of points as columns lon, lat, alt or x, y, z, and crs where it states one;
    other lines as they are, and all of a table without such a column."""
    header = next((k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), None)
    if header is None or not any(name in lines[header].lower() for name in _NAMES):
        return list(lines)
    for separator in _SEPARATORS:
        names = [name.strip().strip("\"'").lower() for name in lines[header].split(separator)]
        column = next((k for k, name in enumerate(names) if name in _NAMES), None)
        if column is not None and len(names) > 1:
            return _expanded(lines, header, separator, column)
    return list(lines)


def _expanded(lines: Sequence[str], header: int, separator: str, column: int) -> list[str]:
    plain = (k for k, line in enumerate(lines) if k >= header and line.strip() and not line.lstrip().startswith("#"))
    records = {k: _cells(lines[k], separator) for k in plain}
    points = {k: _POINT.fullmatch(cells[column]) for k, cells in records.items() if k > header and len(cells) > column}
    found = [point for point in points.values() if point is not None]
    if not found:
        return list(lines)
    in_degrees = all(abs(float(point[k])) <= most for point in found for k, most in zip((2, 3), _DEGREES, strict=True))
    own = ("lon", "lat", "alt") if in_degrees else ("x", "y", "z")
    heights, stated = any(point[4] for point in found), any(point[1] for point in found)
    new = [*own[: 3 if heights else 2], *(["crs"] if stated else [])]
    others = _COORDINATES | (_HEIGHTS if heights else frozenset())
    unread = {place for place, name in enumerate(records[header]) if _bare(name) in others} | {column}
    out = list(lines)
    for k, cells in records.items():
        kept = [cell for place, cell in enumerate(cells) if place not in unread]
        if k == header:
            out[k] = _line([*kept, *new], separator)
        elif k in points:
            point = points[k]
            x, y, height, crs = ("", "", "", "") if point is None else (point[2], point[3], point[4], point[1])
            values = [x, y, *([height or ""] if heights else []), *([crs or ""] if stated else [])]
            out[k] = _line([*kept, *values], separator)
    return out


def _bare(name: str) -> str:
    """A column's name without its unit."""
    return re.split(r"[\[(]", name.strip().lower())[0].strip()


def _cells(line: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        return line.split(separator)


def _line(cells: Sequence[str], separator: str) -> str:
    text = io.StringIO()
    csv.writer(text, delimiter=separator, lineterminator="").writerow(cells)
    return text.getvalue()
