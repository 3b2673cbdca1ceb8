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
    header = next((k for k, line in enumerate(lines) if _is_plain(line)), None)
    if header is None or not any(name in lines[header].lower() for name in _NAMES):
        return list(lines)
    for separator in _SEPARATORS:
        names = [name.strip().strip("\"'").lower() for name in lines[header].split(separator)]
        column = next((k for k, name in enumerate(names) if name in _NAMES), None)
        if column is not None and len(names) > 1:
            return _expanded(lines, header, separator, column)
    return list(lines)


def _expanded(lines: Sequence[str], header: int, separator: str, column: int) -> list[str]:
    """Return the lines of a table with its column of points as columns of coordinates."""
    records = {k: _cells(lines[k], separator) for k in range(header, len(lines)) if _is_plain(lines[k])}
    points = {k: _POINT.fullmatch(cells[column]) for k, cells in records.items() if k > header and len(cells) > column}
    found = [point for point in points.values() if point is not None]
    if not found:
        return list(lines)
    heights = any(point[4] for point in found)
    stated = any(point[1] for point in found)
    others = _COORDINATES | (_HEIGHTS if heights else frozenset())
    unread = {place for place, name in enumerate(records[header]) if _bare(name) in others} | {column}
    values = {header: _new_columns(found, heights=heights, stated=stated)}
    for k, point in points.items():
        values[k] = _coordinates(point, heights=heights, stated=stated)
    out = list(lines)
    for k, new in values.items():
        kept = [cell for place, cell in enumerate(records[k]) if place not in unread]
        out[k] = _line([*kept, *new], separator)
    return out


def _new_columns(points: Sequence[re.Match[str]], *, heights: bool, stated: bool) -> list[str]:
    """Return the names of the columns of coordinates. heights, stated: whether there are heights and CRSs."""
    in_degrees = all(_is_in_degrees(point) for point in points)
    names = ["lon", "lat"] if in_degrees else ["x", "y"]
    if heights:
        names.append("alt" if in_degrees else "z")
    if stated:
        names.append("crs")
    return names


def _is_plain(line: str) -> bool:
    """Whether a line is neither empty nor a comment."""
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _is_in_degrees(point: re.Match[str]) -> bool:
    """Whether a point may be a longitude and a latitude."""
    most_x, most_y = _DEGREES
    return abs(float(point[2])) <= most_x and abs(float(point[3])) <= most_y


def _coordinates(point: re.Match[str] | None, *, heights: bool, stated: bool) -> list[str]:
    """Return the values of a point's columns, empty where it has none. heights, stated: whether there are columns of
    heights and of CRSs."""
    crs, x, y, height = ("", "", "", "") if point is None else point.groups(default="")
    values = [x, y]
    if heights:
        values.append(height)
    if stated:
        values.append(crs)
    return values


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
