"""Tables of coordinates, and tables of image measurements.

Coordinates, as Pix4D writes them: `label,c1,c2,z[,accuracy_horizontal,accuracy_vertical][,type]`; in degrees the
latitude stands first; a CRS is not stated, unless a first line is its code, a comment names it, or a .prj of the same
name lies beside.
With a header the columns go by their names; Metashape's reference is such a table: `# CoordinateSystem: WKT`, then
`#Label,[Enable,]X/Easting,Y/Northing,Z/Altitude,Accuracy_X_(m),...`, longitude before latitude; what is not enabled is
a check point. `type`: check points are named as such, all else is a control point. Names of columns and comments may
state units, as in pose lists (`poses`).

Image measurements, as Pix4D writes its marks: `image,label,x,y[,accuracy in pixels]`; or with a header that names these
columns, in any order.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence

from aeromatch_cli.blocks.accuracies import Sigmas, completed_sigmas_m
from aeromatch_cli.blocks.column_names import (
    LATITUDE_SIDES,
    LONGITUDE_SIDES,
    comments_of_columns,
    on_side,
    side,
    words_of_height,
)
from aeromatch_cli.blocks.control_files import odm
from aeromatch_cli.blocks.control_files.survey import Mark, Survey, SurveyedPoint, is_check, mark
from aeromatch_cli.blocks.crs_comments import crs_comment
from aeromatch_cli.blocks.fields import IMAGE
from aeromatch_cli.blocks.pose_files.geodesy import described_crs
from aeromatch_cli.blocks.pose_files.source import Source, is_number
from aeromatch_cli.blocks.statements import Quantity, Statements, statements_of
from aeromatch_cli.blocks.units import Kind, degrees_of, factor, metres_of, named_column, refuse_rounded
from aeromatch_cli.blocks.zeros import is_relative, zero_of
from aeromatch_cli.errors import ConfigError

# A first line of a table that names the CRS alone, as in the lists of points for editors of gcp_list.txt.
_CODE = re.compile(r"\s*(EPSG:\d+(?:\+\d+)?|\+proj=[^,;\t]*?|WGS\s*84[\s/]+UTM[^,;\t]*?)[\s,;]*", re.IGNORECASE)
# Of a line below a code.
_POINT_VALUES = 4
_LARGEST_LONGITUDE_DEG = 180.0
# A mark that is less exact than this, in pixels, is none: Pix4D may write the zoom of the picture there.
_LARGEST_SIGMA_PX = 10.0
_PIXELS = frozenset(("", "px", "pix", "pixel", "pixels"))
_SIDES = {"x": "x", "y": "y", "z": "z", "xy": "xy", "x/y": "xy", "xyz": "xyz", "x/y/z": "xyz", "horizontal": "xy",
          "horz": "xy", "vertical": "z", "vert": "z", "": "xyz"}  # fmt: skip
_POINT_NAMES = ("label", "name", "point", "gcp", "gcp_name", "gcp_label", "point_name", "point_id", "marker", "id")
_COORDINATES: Mapping[str, str] = {
    **dict.fromkeys(_POINT_NAMES, "label"),
    **dict.fromkeys(("x", "easting", "east", "e"), "x"),
    **dict.fromkeys(("y", "northing", "north", "n"), "y"),
    **dict.fromkeys(("lon", "longitude", "lng", "long"), "longitude"),
    **dict.fromkeys(("lat", "latitude"), "latitude"),
    **dict.fromkeys(("z", "alt", "altitude", "height", "elevation", "elev", "h", "up", "ellipsoidal_height"), "z"),
    **dict.fromkeys(("easting/longitude", "x/longitude", "x/lon", "longitude/x", "lon/x"), "x"),
    **dict.fromkeys(("northing/latitude", "y/latitude", "y/lat", "latitude/y", "lat/y"), "y"),
    **dict.fromkeys(("type", "role", "usage", "use"), "type"),
    **dict.fromkeys(("cs_name", "crs", "srs", "epsg", "coordinate_system"), "crs"),
    **{"easting_rms": "sigma_x", "northing_rms": "sigma_y", "elevation_rms": "sigma_z", "lateral_rms": "sigma_xy"},
    **dict.fromkeys(("enable", "enabled"), "enable"),
    **dict.fromkeys(LATITUDE_SIDES, "lat_side") | dict.fromkeys(LONGITUDE_SIDES, "lon_side"),
    **{f"accuracy_{name}".rstrip("_"): f"sigma_{side}" for name, side in _SIDES.items()},
    **{f"{name}_accuracy": f"sigma_{side}" for name, side in _SIDES.items() if name},
    **{f"sigma_{name}": f"sigma_{side}" for name, side in _SIDES.items() if name},
}
_MARKS: Mapping[str, str] = {
    **dict.fromkeys(("image", "image_name", "filename", "file", "photo", "camera", "image_label"), "image"),
    **dict.fromkeys((*_POINT_NAMES, "tie_point", "tie_point_name"), "label"),
    **{f"{stem}{axis}": side for stem in ("", "pixel_", "image_", "im_", "px_", "p")
       for axis, side in (("x", "x"), ("y", "y"), ("u", "x"), ("v", "y"))},
    **{"x_px": "x", "y_px": "y", "accuracy": "sigma_px", "accuracy_px": "sigma_px", "sigma_px": "sigma_px"},
}  # fmt: skip


# Line, and cells by column.
_Record = tuple[int, Mapping[str, str]]


def is_coordinates(source: Source) -> bool:
    """Whether a file is a table of points with three coordinates each."""
    if odm.is_gcp_line(next((record for _, record in source.records()), "")):
        return False
    header, names, _ = _header(source, _COORDINATES)
    if header:
        return {"label", "z"} <= set(names) and ({"x", "y"} <= set(names) or {"longitude", "latitude"} <= set(names))
    return _is_points(_first(source))


def _is_points(cells: Sequence[str]) -> bool:
    """Whether a line is a name and three coordinates, and no image measurement."""
    return len(cells) >= 4 and all(map(is_number, cells[1:4])) and not any(map(IMAGE.fullmatch, cells))


def is_marks(source: Source) -> bool:
    """Whether a file is a table of image measurements."""
    if odm.is_gcp_line(next((record for _, record in source.records()), "")):
        return False
    header, names, _ = _header(source, _MARKS)
    if {"image", "label", "x", "y"} <= set(names):
        return True
    if header or _header(source, _COORDINATES)[0]:
        return False
    cells = _first(source)
    if len(cells) < 4 or not all(map(is_number, cells[2:4])):
        return False
    return bool(IMAGE.fullmatch(cells[0]) or IMAGE.fullmatch(cells[1])) or not is_number(cells[1])


def read_coordinates(source: Source, usual_crs: str | None = None) -> Survey:
    """usual_crs: of grid coordinates where the file names none. Raises ConfigError with file and line."""
    header, names, units = _header(source, _COORDINATES)
    records = list(_rows(source, header))
    said, more = _statements(source, header, records)
    crs, crs_where = _stated_crs(source, said, geographic="latitude" in names)
    crs = crs or _crs_of_column(source, names, records)
    names, remarks = _one_form(source, names, crs)
    not_applied = [*more, *said.remarks]
    if not crs:
        not_applied += said.not_whole
    remarks += tuple(f"{source.path.name}: {words}" for words in not_applied)
    rows = _named_records(names, records) if header else _unnamed_records(source, records)
    stated = dict(zip(names, units, strict=True)) if names else dict.fromkeys((*"xyz", "sigma_xy", "sigma_z"), "")
    points = _points(source, rows, _factors(source, header, stated, said, crs or usual_crs, crs_where))
    geographic = "latitude" in names or _in_degrees(points)
    if crs is None and usual_crs is not None and geographic:
        points = _points(source, rows, _factors(source, header, stated, said, None, crs_where))
    elif crs is None:
        crs = usual_crs
    if not header and crs is None and geographic:  # the latitude stands first
        points = [_exchanged(point) for point in points]
    if "latitude" in names and crs is not None and described_crs(crs_where, crs).kind == "grid":
        crs = None  # of coordinates that the file does not have
    zero = zero_of(re.split(r"[\s_,;/.-]+", _cell_of_heights(source, header, names))) or said.zero
    return Survey(tuple(points), (), crs, crs_where, geographic, remarks, heights=zero)


def _named_records(names: Sequence[str], records: Sequence[tuple[int, list[str], bool]]) -> list[_Record]:
    return [(line, dict(zip(names, cells, strict=False))) for line, cells, _ in records]


def _unnamed_records(source: Source, records: Sequence[tuple[int, list[str], bool]]) -> list[_Record]:
    return [(line, _unnamed(source, line, cells)) for line, cells, _ in records]


def _statements(
    source: Source, header: int, records: Sequence[tuple[int, list[str], bool]]
) -> tuple[Statements, list[str]]:
    """What comments and columns of units state, and what these columns cannot. Raises ConfigError."""
    lines = [text for line, text in enumerate(source.lines, start=1) if line != header]
    if not header:
        return statements_of(lines), []
    cells, _ = _cells(source.lines[header - 1].strip().lstrip("#").strip())
    columns = [re.sub(r"[\s-]+", "_", cell.strip().lower()) for cell in cells]
    rows = (dict(enumerate(cells)) for _, cells, _ in records)
    comments, _, remarks = comments_of_columns(source.at(header), columns, rows)
    return statements_of([*comments, *lines]), remarks


def _cell_of_heights(source: Source, header: int, names: Sequence[str]) -> str:
    """The name of the column of heights as it stands in the header."""
    if not header or "z" not in names:
        return ""
    return _cells(source.lines[header - 1].strip().lstrip("#").strip())[0][list(names).index("z")].lower()


def _points(
    source: Source, rows: Sequence[tuple[int, Mapping[str, str]]], factors: Mapping[str, float]
) -> list[SurveyedPoint]:
    points = [_point(source, line, record, factors) for line, record in rows]
    if not points:
        raise ConfigError(f"{source.path}: no control points follow the header")
    twice = next((point for n, point in enumerate(points) if point.name in {one.name for one in points[:n]}), None)
    if twice is not None:
        raise ConfigError(f"{twice.where}: the point {twice.name} stands in the file twice: keep one of the two lines")
    return points


def read_marks(source: Source) -> Survey:
    """Raises ConfigError with file and line."""
    header, names, units = _header(source, _MARKS)
    for name, unit in zip(names, units, strict=True):
        if name in ("x", "y") and unit.strip(".") not in _PIXELS:
            raise ConfigError(f"{source.at(header, name)}: image measurements in {unit!r}: pixels are needed")
    marks: list[Mark] = []
    for line, cells, comma in _rows(source, header):
        if header:
            record = dict(zip(names, cells, strict=False))
        else:
            names_first = ("label", "image") if len(cells) > 1 and IMAGE.fullmatch(cells[1]) else ("image", "label")
            record = dict(zip((*names_first, "x", "y", "sigma_px"), cells, strict=False))
        if not {"image", "label", "x", "y"} <= record.keys():
            raise ConfigError(f"{source.at(line)}: {len(cells)} values, image, label, x and y are needed")
        stated = record.get("sigma_px", "")
        sigma_px = float(stated.replace(",", ".")) if is_number(stated) else 0.0
        marks.append(
            mark(
                source, line, [record[name] for name in ("label", "image", "x", "y")],
                sigma_px if 0.0 < sigma_px < _LARGEST_SIGMA_PX else None, comma=comma,
            )
        )  # fmt: skip
    return Survey(marks=tuple(marks), measured_in=source.path)


def _first(source: Source) -> list[str]:
    """Values of the first line, of that below a CRS."""
    code = _line_of_code(source)
    for line, record in source.records():
        if line > code:
            cells, _ = _cells(record)
            return cells if not code or len(cells) == _POINT_VALUES else []  # others are those of gcp_list.txt
    return []


def _line_of_code(source: Source) -> int:
    """Number of a first line that is a code of a CRS, 0 for none."""
    line, record = next(iter(source.records()), (0, ""))
    return line if _CODE.fullmatch(record) else 0


def _cells(record: str) -> tuple[list[str], bool]:
    """Values of a line, and whether their numbers may have a decimal comma."""
    separator = next((one for one in (";", "\t", ",") if one in record), None)
    if separator is None:
        return record.split(), True
    try:
        cells = next(csv.reader([record], delimiter=separator, skipinitialspace=True))
    except (csv.Error, StopIteration):
        cells = record.split(separator)
    return [cell.strip() for cell in cells], separator != ","


def _header(source: Source, known: Mapping[str, str]) -> tuple[int, list[str], list[str]]:
    """Line of the header, 0 without one, its columns by their names in `known`, and the units that they state."""
    canonical, code = frozenset(known.values()), _line_of_code(source) if known is _COORDINATES else 0
    for line, text in enumerate(source.lines, start=1):
        stripped = text.strip()
        system = crs_comment(stripped)
        if not stripped or (system is not None and system.crs) or line == code:
            continue
        cells, _ = _cells(stripped.lstrip("#").strip())
        columns = [_column(cell, known) for cell in cells]
        names = [name if name in canonical else "" for name, _ in columns]
        if len({name for name in names if name}) >= 4 and not any(map(is_number, cells)):
            return line, names, [unit for _, unit in columns]
        if not stripped.startswith("#"):
            break
    return 0, [], []


def _column(cell: str, known: Mapping[str, str]) -> tuple[str, str]:
    """easting of `X/Easting`, longitude of `X/Longitude`, accuracy_x/y and m of `Accuracy_X/Y_(m)`."""
    if len(cell) > 100:
        return "", ""  # no name
    name, unit = named_column(re.sub(r"^\s*[xyz]/(?=[a-z]{2})", "", cell, flags=re.IGNORECASE), known)
    if known is _COORDINATES and name not in known.values() and words_of_height(cell)[0]:
        name, unit = "z", words_of_height(cell)[1]
    return ("", "") if name == "z" and is_relative(unit) else (name, unit)


def _factors(
    source: Source, line: int, stated: Mapping[str, str], said: Statements, crs: str | None, crs_where: str
) -> dict[str, float]:
    """Metres or degrees of one unit of every column: by its name, else by what a comment says; of coordinates in a CRS
    as shares of its own units. stated: the units that the names state. Raises ConfigError."""
    if said.relative:
        raise ConfigError(
            f"{source.path}: {said.relative!r} says that heights do not count from a datum: give heights above the "
            "ellipsoid or sea level"
        )
    found = {}
    for name, unit in stated.items():
        quantities: tuple[Quantity, ...] = ("across", "coordinates", "all")
        kind: Kind = "angle" if name in ("longitude", "latitude") else "length"
        if name in ("longitude", "latitude", "x", "y", "z") or name.startswith("sigma_"):
            if name == "z":
                quantities = ("heights", "coordinates", "all")
            elif name.startswith("sigma_"):
                quantities = ("accuracies",)
            text = unit or said.unit(kind, *quantities)
            if text:
                found[name] = factor(source.at(line), name, text, kind)
    if crs is not None and found.keys() & set("xyz"):  # what the columns state counts before the unit of the CRS
        own = described_crs(crs_where, crs)
        found |= {name: found.get(name, own.across_m) / own.across_m for name in "xy"}
        found["z"] = found.get("z", own.up_m) / own.up_m
    return found


def _rows(source: Source, header: int) -> list[tuple[int, list[str], bool]]:
    start = max(header, _line_of_code(source))
    return [(line, *_cells(record)) for line, record in source.records() if line > start]


def _unnamed(source: Source, line: int, cells: list[str]) -> dict[str, str]:
    """Columns of a line of Pix4D's file, with a type where words stand behind the coordinates."""
    if len(cells) < 4:
        raise ConfigError(f"{source.at(line)}: {len(cells)} values, label and three coordinates are needed")
    label, x, y, z, *others = cells
    numbers = [cell for cell in others if is_number(cell)]
    words = [cell for cell in others if cell and not is_number(cell)]
    record = {"label": label, "x": x, "y": y, "z": z, "type": words[0] if words else ""}
    if len(numbers) == 2:
        record["sigma_xy"], record["sigma_z"] = numbers
    return record


def _point(source: Source, line: int, record: Mapping[str, str], factors: Mapping[str, float]) -> SurveyedPoint:
    def value(column: str) -> float:
        cell, unit = record.get(column, ""), factors.get(column, 1.0)
        if not cell:
            raise ConfigError(f"{source.at(line, column)}: empty: a control point has three coordinates")
        if column in ("longitude", "latitude"):
            degrees = degrees_of(cell, "EW" if column == "longitude" else "NS")
            found = None if degrees is None else degrees * unit
            place, sides = ("lon_side", "EW") if column == "longitude" else ("lat_side", "NS")
            where = source.at(line, f"{column}, side")
            found = None if found is None else on_side(where, found, side(where, record.get(place, ""), sides))
        else:
            refuse_rounded(source.at(line, column), cell)
            found = metres_of(cell, unit)
        if found is None or not math.isfinite(found):
            raise ConfigError(f"{source.at(line, column)}: {cell!r} is not a number")
        return found

    name = record.get("label", "")
    if not name:
        raise ConfigError(f"{source.at(line)}: the name of the point is missing")
    x, y = ("longitude", "latitude") if "latitude" in record else ("x", "y")
    disabled = record.get("enable", "1").lower() in ("0", "false", "no")
    check = disabled or is_check(record.get("type", ""))
    place = value(x), value(y), value("z")
    return SurveyedPoint(name, source.at(line), place, _sigmas_m(record, factors), check)


def _sigmas_m(record: Mapping[str, str], factors: Mapping[str, float]) -> Sigmas | None:
    names = [f"sigma_{side}" for side in ("x", "y", "z", "xy", "xyz")]
    values = [metres_of(record.get(name, ""), factors.get(name, 1.0)) for name in names]
    x, y, z, across, overall = (one if one is not None and one < math.inf else None for one in values)
    return completed_sigmas_m(x, y, z, across_m=across, overall_m=overall)


def _stated_crs(source: Source, said: Statements, *, geographic: bool) -> tuple[str | None, str]:
    """CRS and its place: in the file, or in a .prj beside it. geographic: of degrees, which a datum alone states."""
    code = _line_of_code(source)
    stated = _CODE.fullmatch(source.lines[code - 1]) if code else None
    found = stated[1] if stated else said.crs_of(grid=not geographic)
    if found:
        return found, source.at(code or _line_of_crs(source))
    beside, where = source.crs_beside()
    return (beside, where) if beside else (None, str(source.path))


def _line_of_crs(source: Source) -> int:
    found = (line for line, text in enumerate(source.lines, start=1) if (one := crs_comment(text)) and one.crs)
    return next(found, 1)


def _crs_of_column(source: Source, names: Sequence[str], records: Sequence[tuple[int, list[str], bool]]) -> str | None:
    """The CRS that a column names, None where there is none. Raises ConfigError where lines name several."""
    if "crs" not in names:
        return None
    place = names.index("crs")
    lines = {cells[place]: line for line, cells, _ in records if len(cells) > place and cells[place]}
    if len(lines) > 1:
        raise ConfigError(f"{source.at(max(lines.values()))}: the file names {len(lines)} coordinate systems")
    text = next(iter(lines), None)
    return f"EPSG:{text}" if text and text.isdigit() else text


def _one_form(source: Source, names: Sequence[str], crs: str | None) -> tuple[list[str], tuple[str, ...]]:
    """Columns with one form of coordinates, and what is said where there are grid coordinates and degrees: the former
    count where their CRS is known. Of two heights the first goes with the grid, the last with the degrees."""
    found = list(names)
    both = {"x", "y", "longitude", "latitude"} <= set(names)
    grid = ("x", "y") if not both or crs is not None else ()
    heights = [place for place, name in enumerate(names) if name == "z"]
    for place in heights[1:] if grid or not both else heights[:-1]:
        found[place] = ""
    if not both:
        return found, ()
    found = ["" if name in (("longitude", "latitude") if grid else ("x", "y")) else name for name in found]
    words = f"easting and northing in {crs}" if grid else "latitude and longitude, since no CRS of the others is named,"
    return found, (f"{source.path.name}: of two forms of coordinates {words} and the height beside them count",)


def _in_degrees(points: list[SurveyedPoint]) -> bool:
    return all(max(abs(point.position[0]), abs(point.position[1])) <= _LARGEST_LONGITUDE_DEG for point in points)


def _exchanged(point: SurveyedPoint) -> SurveyedPoint:
    first, second, height = point.position
    return SurveyedPoint(point.name, point.where, (second, first, height), point.sigmas_m, point.check)
