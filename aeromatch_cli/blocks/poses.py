"""The pose list: a CSV or TXT file with a header, one line per image.

Columns, in any order and case (aliases in brackets):

  image [filename, file, name, label, photo, image_name]   path relative to the images folder
  x y z [easting northing]      projection centre in the block's CRS, or
  lat lon alt [latitude, longitude lng long, altitude]     projection centre in WGS84 degrees and metres
  omega_deg phi_deg kappa_deg [omega phi kappa]   relative to the grid, or
  yaw_deg pitch_deg roll_deg [yaw pitch roll]     yaw against grid north with x y z, true north with lat lon alt, or
  qw qx qy qz                   cam_from_world, relative to the grid, or no attitude at all
  camera                        name of the camera (optional)
  sigma_position_m sigma_angle_deg                standard deviations (optional); of the position also by axis:
  sigma_x_m sigma_y_m sigma_z_m [sde sdn sdu, std_e std_n std_u, accuracy_x ..., sd_x ...]   as PPK results have them
  sigma_xy_m                    of both horizontal axes [accuracy_xy, horizontal_accuracy, horz_accuracy, hrms]
  sigma_omega_deg sigma_phi_deg sigma_kappa_deg   the largest counts
  frame                         of orientation.csv: images in a frame of their own have no pose here (optional)

Lengths are metres and angles degrees unless the name of the column says otherwise (`alt_ft`, `x [us-ft]`, `omega_gon`,
`yaw (rad)`, `accuracy_mm`), a column of its own (`altitude_unit`), or a comment (`# angles in gon`, `# heights: feet`,
see `statements`); a cell may have its own unit (`142.6 m`), and latitudes and longitudes may be degrees, minutes and
seconds, with their side of the globe in a column (`latref`).

Beside x y or lat lon, a height under another name (altitude, ellipsoidal height, height, elevation) is taken and said;
heights above ground (relative_altitude, agl) are refused. Columns e and n stand for x and y where no other position is
there.

The separator is a comma, semicolon, tab or blanks, found from the header; lines that start with # are comments (a
header behind # is accepted); a decimal comma is accepted where the separator is another, or in quotes. A line whose
horizontal coordinates are empty or NaN leaves its image without pose and is reported; heights may be empty or missing,
see `observations.oriented`; every other defect is a ConfigError.
"""

from __future__ import annotations

import csv
import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, cast

from aeromatch_cli.blocks.accuracies import Sigmas, completed_sigmas_m, overall_sigma_m
from aeromatch_cli.blocks.column_names import (
    LATITUDE_SIDES,
    LONGITUDE_SIDES,
    comments_of_columns,
    is_height,
    on_side,
    seems_height,
    side,
    words_of_height,
)
from aeromatch_cli.blocks.fields import IMAGE, with_name, words_of
from aeromatch_cli.blocks.gis_columns import with_coordinates
from aeromatch_cli.blocks.statements import Quantity, Statements, statements_of
from aeromatch_cli.blocks.units import Kind, degrees_of, factor, metres_of, named_column, refuse_rounded
from aeromatch_cli.blocks.zeros import is_relative, zero_of
from aeromatch_cli.data import Camera
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import given_bytes, text_encoding

PositionKind = Literal["grid", "geographic"]
AttitudeKind = Literal["omega_phi_kappa", "yaw_pitch_roll", "quaternion", "none"]

_POSITIONS: dict[PositionKind, tuple[str, ...]] = {"grid": ("x", "y", "z"), "geographic": ("lat", "lon", "alt")}
_ATTITUDES: dict[AttitudeKind, tuple[str, ...]] = {
    "omega_phi_kappa": ("omega_deg", "phi_deg", "kappa_deg"),
    "yaw_pitch_roll": ("yaw_deg", "pitch_deg", "roll_deg"),
    "quaternion": ("qw", "qx", "qy", "qz"),
}
_SIGMAS = ("sigma_position_m", "sigma_angle_deg")
_AXIS_SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_xy_m")
# What orientation.csv says of images whose place is arbitrary.
_OWN_FRAME = "own"
_ANGLE_SIGMAS = ("sigma_omega_deg", "sigma_phi_deg", "sigma_kappa_deg")
_ALL_SIGMAS = (*_SIGMAS, *_AXIS_SIGMAS, *_ANGLE_SIGMAS)
# The side of the globe of latitudes and of longitudes.
_SIDES = {"lat": ("lat_side", "NS"), "lon": ("lon_side", "EW")}
_SIDE_COLUMNS = tuple(column for column, _ in _SIDES.values())
_KNOWN = ("image", *sum([*_POSITIONS.values(), *_ATTITUDES.values()], ()), "camera", "frame", *_ALL_SIGMAS)
_LONGEST_NAME = 100  # characters of a column


def _axis_names(column: str, *axes: str) -> dict[str, str]:
    """Other names of a standard deviation's column: std_x, sd_x, sdx, x_accuracy, easting_rms, ..."""
    words = ("sigma", "std", "sd", "rms", "accuracy", "stddev", "std_dev", "stdev")
    joined = {f"{word}_{axis}" for word in words for axis in axes} | {
        f"{axis}_{word}" for word in words for axis in axes
    }
    bare = {f"{word}{axis}" for word in ("sd", "std", "accuracy") for axis in axes}
    return dict.fromkeys(sorted(joined | bare | {f"{name}_m" for name in joined}), column)


_ALIASES = {
    **dict.fromkeys(("filename", "file", "name", "label", "photo", "image_name", "imagename", "file_name"), "image"),
    **dict.fromkeys(("photo_name", "photoname", "sourcefile", "image_path", "picture"), "image"),
    **{"easting": "x", "x/easting": "x", "northing": "y", "y/northing": "y", "z/altitude": "z"},
    **{"latitude": "lat", "longitude": "lon", "lng": "lon", "long": "lon", "altitude": "alt"},
    **{"gpslatitude": "lat", "gpslongitude": "lon", "gpsaltitude": "alt"},
    **{"gps_latitude": "lat", "gps_longitude": "lon", "gps_altitude": "alt"},
    **{"x/longitude": "lon", "y/latitude": "lat", "longitude/x": "lon", "latitude/y": "lat", "height/z": "alt"},
    **_axis_names("sigma_x_m", "x", "e", "easting"),
    **_axis_names("sigma_y_m", "y", "n", "northing"),
    **_axis_names("sigma_z_m", "z", "u", "elevation", "vertical", "vert", "altitude", "height"),
    **_axis_names("sigma_xy_m", "xy", "horizontal", "horz", "horizon"),
    **{"hrms": "sigma_xy_m", "vrms": "sigma_z_m", "gpsxyaccuracy": "sigma_xy_m", "gpszaccuracy": "sigma_z_m"},
    **dict.fromkeys(("accuracy", "accuracy_m", "sigma_position"), "sigma_position_m"),
    **{"sigma_angle": "sigma_angle_deg"} | {f"sigma_{name}": f"sigma_{name}_deg" for name in ("omega", "phi", "kappa")},
    **{name: f"{name}_deg" for name in ("omega", "phi", "kappa", "yaw", "pitch", "roll")},
    "heading": "yaw_deg",
    **dict.fromkeys(LATITUDE_SIDES, "lat_side") | dict.fromkeys(LONGITUDE_SIDES, "lon_side"),
}
# Names that count where there is no other image, and no other position.
_OTHER_IMAGES = ("photoid", "photo_id", "picture_name", "bild", "foto")
_OTHER_PLACES = {"e": "x", "east": "x", "n": "y", "north": "y"}
# Columns that are taken for z or alt where there is none, the likeliest first.
_OTHER_HEIGHTS = ("z", "alt", "absolute_altitude", "absalt", "abs_alt", "ellipsoidal_height", "ellipsoid_height",
                  "orthometric_height", "altitude_above_sealevel", "altitude_msl", "height", "elevation",
                  "h")  # fmt: skip
# Those that are taken beside heights above ground, too.
_FROM_DATUM = _OTHER_HEIGHTS[2:-3]
# Heights above ground, or above where the flight began.
_RELATIVE_HEIGHTS = ("relative_altitude", "rltalt", "relalt", "agl", "height_agl", "altitude_agl", "rel_alt", "salt",
                     "height_above_ground", "height_above_takeoff", "altitude_above_ground",
                     "altitude_above_takeoff")  # fmt: skip
# What names the CRS of every line.
_CRS_COLUMNS = ("crs", "srs", "epsg", "cs_name", "coordinate_system")
# Every name of a column, in lower case, and the one that it has here.
_NAMES: Mapping[str, str] = {
    **{name: name for name in (*_KNOWN, *_SIDE_COLUMNS, *_OTHER_HEIGHTS, *_RELATIVE_HEIGHTS, *_CRS_COLUMNS)},
    **_ALIASES,
}
_HEIGHTS = (*_OTHER_HEIGHTS, *_RELATIVE_HEIGHTS)
_BLANKS = frozenset({"", "nan", "na", "n/a", "none", "null", "-"})
_LARGEST_LATITUDE_DEG = 90.0
# So many latitudes that are none are no slip of the pen.
_CERTAINLY = 3
# A latitude beyond 90 degrees may be a longitude: see _with_latitudes.
_RANGES = {"lat": 180.0, "lon": 180.0, "qw": 1.05, "qx": 1.05, "qy": 1.05, "qz": 1.05}
_LARGEST_ANGLE_DEG = 360.0
# What a spreadsheet writes to say what separates.
_SEPARATOR_LINE = re.compile(r"\"?sep=.\"?", re.IGNORECASE)
_HEAD_LINES = 100  # of which one must be the header
_LINES_NAMED = 5  # of those with the same fault
_SIDE = re.compile(r"[nsew]|north|south|east|west")
_NORTH = re.compile(r"\b(true|grid|magnetic)(?:[ _-]*north)?\b")
# Images by line, by what is wrong with it.
_Faults = dict[str, dict[int, str]]


@dataclass(frozen=True)
class PoseRow:
    """One line of a pose list.

    image: as written, with forward slashes. line: 1-based, for messages. position: x, y, z in metres or lat, lon in
    degrees and alt in metres, as `position_kind` says, with a height of NaN where the line gives none; None where it
    gives no horizontal position. attitude: three angles in degrees or a quaternion (w, x, y, z), as `attitude_kind`
    says; None with "none". camera: "" where not given. forward: of yaw, pitch, roll, whether the optical axis is body x
    (gimbal) or down (nadir) at zero angles; None where the format leaves it open. true_north: angles and quaternions of
    grid positions count from true north instead of grid north; those of latitudes and longitudes, too. numbered: the
    image is named by its running number alone. time_s: of the exposure, in GPS time. sigmas_m: standard deviations to
    the east, to the north and of the height.
    """

    image: str
    line: int
    position: tuple[float, float, float] | None
    position_kind: PositionKind
    attitude: tuple[float, ...] | None
    attitude_kind: AttitudeKind
    camera: str = ""
    sigmas_m: Sigmas | None = None
    sigma_angle_deg: float | None = None
    forward: bool | None = None
    true_north: bool = False
    numbered: bool = False
    time_s: float | None = None

    @property
    def sigma_position_m(self) -> float | None:
        """The root mean square of those of the axes."""
        return None if self.sigmas_m is None else overall_sigma_m(self.sigmas_m)


@dataclass(frozen=True)
class PoseList:
    """A pose list as read. warnings: columns that were ignored and lines without usable coordinates. format: what it
    was recognised as, in words. crs: of grid positions, where the file states it. cameras: by the names that rows have.
    heights: what they count from, as of `crs.heights_of`, where the file states it.
    """

    rows: tuple[PoseRow, ...]
    position_kind: PositionKind
    warnings: tuple[str, ...] = ()
    format: str = "list with named columns"
    crs: str | None = None
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    heights: str = ""


@dataclass(frozen=True)
class _Layout:
    separator: str | None  # None: blanks
    columns: tuple[str, ...]
    position_kind: PositionKind
    attitude_kind: AttitudeKind
    ignored: tuple[str, ...]
    factors: Mapping[str, float]  # metres or degrees of one unit, by column
    height: str = ""  # the column that is taken for z or alt under another name
    crs_column: int = -1
    not_taken: str = ""  # columns of a second form of position
    zero: str = ""  # what heights count from by their column, as of `crs.heights_of`
    sides: Mapping[str, str] = field(default_factory=dict)  # of latitudes and longitudes, by their columns
    true_north: bool = False
    remarks: tuple[str, ...] = ()


def read_poses(path: Path, usual_m: tuple[float, float] = (1.0, 1.0), text: str | None = None) -> PoseList:
    """Reads a pose list. Its `crs` is as the list states it, a code or other text.

    usual_m: metres of one unit of x and y, and of heights, where the list names none. text: instead of the
    file's. Raises ConfigError with file, line and column where the list is malformed.
    """
    text = _text(path) if text is None else text
    lines = [line for line in enumerate(with_coordinates(text.splitlines()), start=1) if line[1].strip()]
    if lines and _SEPARATOR_LINE.fullmatch(lines[0][1].strip()):
        lines = lines[1:]
    header, layout, records, said = _header(path, lines)
    across_m, up_m = usual_m
    usual = {"x": across_m, "y": across_m, "z": up_m, "alt": up_m}
    layout = replace(layout, factors={**usual, **layout.factors})
    systems: dict[str, int] = {}
    faults: _Faults = {}
    rows: list[PoseRow] = []
    lines_of: dict[str, int] = {}
    for number, line in records:
        cells = _split(path, number, line, layout)
        row = _row(path, number, cells, layout, faults)
        if layout.crs_column >= 0 and (text := cells[layout.crs_column].strip()):
            systems.setdefault(f"EPSG:{text}" if text.isdigit() else text, number)
        if row.image in lines_of:
            raise ConfigError(
                f"{path}, line {number}, column image: {row.image!r} stands in line {lines_of[row.image]} already: "
                "keep one of the two lines, or write the paths relative to the images folder"
            )
        lines_of[row.image] = number
        rows.append(row)
    if not rows:
        raise ConfigError(f"{path}: no line follows the header in line {header}: add one line per image")
    rows, exchanged = _with_latitudes(path, rows)
    ignored = [f"{path.name}: unknown columns ignored: {', '.join(layout.ignored)}"] if layout.ignored else []
    ignored += [f"{path.name}: {words}" for words in (*layout.remarks, *said.remarks)]
    if said.datum:
        ignored.append(
            f"{path.name}: {said.datum!r}: ground and control points must count from the same zero, or state their own "
            "(EPSG:32633+5773)"
        )
    if layout.not_taken:
        kind = "whose CRS is named" if layout.position_kind == "grid" else "since no CRS of the others is named"
        taken = ", ".join(_POSITIONS[layout.position_kind][:2])
        ignored.append(f"{path.name}: of two forms of position {taken} count, {kind}; {layout.not_taken} do not")
    if layout.height:
        own = _POSITIONS[layout.position_kind][2]
        ignored.append(f"{path.name}: {layout.height} is taken for the height {own}, which counts from the datum")
    warnings = [_fault(path, fault, images) for fault, images in faults.items()]
    if len(systems) > 1:
        raise ConfigError(
            f"{path}, line {max(systems.values())}: the list names {len(systems)} coordinate systems: one is needed"
        )
    crs = next(iter(systems), None) or said.crs_of(grid=layout.position_kind == "grid")
    if crs is None:
        ignored += [f"{path.name}: {words}" for words in said.not_whole]
    remarks = (*ignored, *exchanged, *warnings)
    return PoseList(tuple(rows), layout.position_kind, remarks, crs=crs, heights=layout.zero or said.zero)


def is_position(name: str, *, height: bool) -> bool:
    """Whether a column of this name holds a coordinate. height: or a height that counts from a datum."""
    column, _ = _canonical(name)
    return column in ("x", "y", "lat", "lon") or (height and column in _OTHER_HEIGHTS)


def has_header(lines: Sequence[str]) -> bool:
    """Whether a comment names the columns of lines that could do without."""
    for line in lines:
        text = line.strip()
        if text and not text.startswith("#"):
            return False
        _, columns, _ = _columns(text.lstrip("#").strip())
        if "image" in columns and {*_POSITIONS["grid"][:2], *_POSITIONS["geographic"][:2]} & set(columns):
            return True
    return False


def is_track(lines: Sequence[str]) -> bool:
    """Whether the first line names latitudes and longitudes, and no image."""
    head, *rest = [line.strip().lstrip("#").strip() for line in lines[:_HEAD_LINES] if line.strip()] or [""]
    separator, columns, _ = _columns(head)
    columns, _ = _with_images(columns, _cells(rest[0], separator) if rest else [])
    return {"lat", "lon"} <= set(columns) and "image" not in columns


def _with_latitudes(path: Path, rows: list[PoseRow]) -> tuple[list[PoseRow], list[str]]:
    """Rows whose latitudes are such, and a remark where the list has them exchanged with the longitudes.

    Raises ConfigError where only some, or fewer than three, are beyond 90 degrees, and where both columns are.
    """
    if not rows or rows[0].position_kind != "geographic":
        return rows, []
    placed = [(row, row.position) for row in rows if row.position is not None]
    beyond = [(row, place[0]) for row, place in placed if abs(place[0]) > _LARGEST_LATITUDE_DEG]
    if not beyond:
        return rows, []
    if len(beyond) < max(len(placed), _CERTAINLY) or any(abs(place[1]) > _LARGEST_LATITUDE_DEG for _, place in placed):
        row, latitude = beyond[0]
        limits = f"between {-_LARGEST_LATITUDE_DEG:g} and {_LARGEST_LATITUDE_DEG:g}"
        raise ConfigError(
            f"{path}, line {row.line}, column lat: {latitude:g} is out of range: expected a number {limits}"
        )
    turned = {row.line: replace(row, position=(place[1], place[0], place[2])) for row, place in placed}
    remark = f"{path.name}: lat and lon are exchanged, as latitudes beyond 90 degrees show: they were put right"
    return [turned.get(row.line, row) for row in rows], [remark]


def _fault(path: Path, fault: str, images: Mapping[int, str]) -> str:
    """One warning about all lines that have the same fault. images: by line."""
    lines, names = [str(line) for line in images][:_LINES_NAMED], list(images.values())[:_LINES_NAMED]
    more = len(images) - len(lines)
    also = f" and {more:,} more" if more else ""
    plural = "s" if len(images) > 1 else ""
    return f"{path.name}, line{plural} {', '.join(lines)}{also}: {fault}: {', '.join(names)}{', ...' if more else ''}"


def _text(path: Path) -> str:
    try:
        raw = given_bytes(path)
    except OSError as error:
        raise ConfigError(
            f"pose list {path} cannot be read ({error.strerror}): give a CSV file, or exif, with --poses"
        ) from error
    encoding = text_encoding(raw)
    try:
        text = raw.decode(encoding)
    except UnicodeDecodeError as error:
        kind = "UTF-16" if encoding == "utf-16" else "UTF-8"
        raise ConfigError(f"pose list {path} is not {kind} text: save it as UTF-8 CSV") from error
    if "\0" in text:
        raise ConfigError(f"pose list {path} is a binary file: give a CSV or TXT file")
    return text


def _header(path: Path, lines: list[tuple[int, str]]) -> tuple[int, _Layout, list[tuple[int, str]], Statements]:
    """Line number of the header, what it says, the lines behind it without comments, and what comments state."""
    if not lines:
        raise ConfigError(f"pose list {path} is empty: its first line names the columns, such as image,x,y,z")
    first = next((place for place, (_, line) in enumerate(lines) if not line.lstrip().startswith("#")), len(lines))
    places = [first] if first < len(lines) else []
    # A header behind a comment mark counts only where the first plain line is none.
    for place in [*places, *range(first - 1, -1, -1)]:
        number, line = lines[place]
        separator, columns, units = _columns(line.lstrip().lstrip("#").strip() if place < first else line.strip())
        records = [(n, text) for n, text in lines[place + 1 :] if not text.lstrip().startswith("#")]
        columns, taken = _with_images(columns, _cells(records[0][1], separator) if records else [])
        if "image" in columns and len(columns) > 1:
            where = f"{path}, line {number}"
            cells = (dict(enumerate(_cells(text, separator))) for _, text in records)
            more, unit_columns, unknown = comments_of_columns(where, columns, cells)
            said = statements_of([*more, *(text for n, text in lines if n != number)])
            columns = tuple("" if k in unit_columns else name for k, name in enumerate(columns))
            layout = _layout(path, number, separator, columns, units, said)
            return number, replace(layout, remarks=(*taken, *unknown, *layout.remarks)), records, said
    number, line = lines[min(first, len(lines) - 1)]
    found = ", ".join(_columns(line.strip())[1])[:120]
    raise ConfigError(
        f"{path}, line {number}: no header with a column 'image' (found {found}): the first line must name the "
        "columns, such as image,x,y,z,omega_deg,phi_deg,kappa_deg"
    )


def _cells(line: str, separator: str | None) -> list[str]:
    """Values of a line, which may be cut in other places than by `_split`."""
    if separator is None:
        return words_of(line)
    try:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        return line.split(separator)


def _with_images(columns: tuple[str, ...], first: Sequence[str]) -> tuple[tuple[str, ...], list[str]]:
    """Columns with one of images, and a remark where its name is none that is known; as they are where there is one,
    and in lines that name no position. first: values of the line below."""
    names = {_OTHER_PLACES.get(name, name) for name in columns}
    if "image" in columns or not ({"x", "y"} <= names or {"lat", "lon"} <= names):
        return columns, []
    place = next((columns.index(name) for name in _OTHER_IMAGES if name in columns), -1)
    if place < 0:
        place = next((k for k, cell in enumerate(first[: len(columns)]) if IMAGE.fullmatch(cell.strip())), -1)
    if place < 0:
        return columns, []
    changed = tuple("image" if k == place else name for k, name in enumerate(columns))
    return changed, [f"column {columns[place]!r} is taken for the names of the images"]


def _columns(line: str) -> tuple[str | None, tuple[str, ...], tuple[str, ...]]:
    """The separator under which most column names are known, the canonical names, and the units that they state."""
    best: tuple[int, str | None, list[tuple[str, str]]] = (-1, None, [])
    for separator in (",", ";", "\t", None):
        cells = line.split(separator) if separator else line.split()
        columns = [_canonical(cell) for cell in cells]
        known = sum(name in _KNOWN for name, _ in columns)
        if known > best[0]:
            best = (known, separator, columns)
    return best[1], tuple(name for name, _ in best[2]), tuple(unit for _, unit in best[2])


def _canonical(cell: str) -> tuple[str, str]:
    if len(cell) > _LONGEST_NAME:
        return cell[:_LONGEST_NAME], ""  # no name, and the pattern would take hours for a hundred thousand brackets
    name, unit = named_column(cell, _NAMES)
    if name not in _NAMES.values() and words_of_height(cell)[0]:
        name, unit = words_of_height(cell)
        name = _NAMES.get(name, name)
    return (_RELATIVE_HEIGHTS[0], "") if name in _OTHER_HEIGHTS and is_relative(unit) else (name, unit)


def _kind(column: str) -> Kind | None:
    """Whether a column holds lengths or angles, None for neither."""
    if column in ("lat", "lon") or column.endswith("_deg"):
        return "angle"
    return "length" if column in ("x", "y", *_HEIGHTS, *_ALL_SIGMAS) or is_height(column) else None


def _factors(where: str, columns: Sequence[str], units: Sequence[str], said: Statements) -> dict[str, float]:
    """Metres or degrees of one unit of every column: by its name, else by what a comment says. Raises ConfigError."""
    found: dict[str, float] = {}
    for column, unit in zip(columns, units, strict=True):
        kind = _kind(column)
        if kind is None:
            continue
        if column in _ALL_SIGMAS:
            quantities: tuple[Quantity, ...] = ("accuracies",)
        elif column in ("x", "y", "lat", "lon"):
            quantities = ("across", "coordinates", "all")
        else:
            quantities = ("angles", "all") if kind == "angle" else ("heights", "coordinates", "all")
        text = unit or said.unit(kind, *quantities)
        if text:
            found[column] = factor(where, column, text, kind)
    return found


def _with_sides(columns: Sequence[str], units: Sequence[str]) -> tuple[tuple[str, ...], dict[str, str], str]:
    """Units without what is none: sides of the globe (`latitude (S)`), by their columns, and the north that headings
    count from (`yaw (true north)`), "" for none."""
    plain, sides, north = [], {}, ""
    for column, unit in zip(columns, units, strict=True):
        text = unit
        if column in _SIDES and unit[:1].upper() in tuple(_SIDES[column][1]) and _SIDE.fullmatch(unit):
            sides[column], text = unit[:1].upper(), ""
        elif column == "yaw_deg" and (match := _NORTH.search(unit)):
            north, text = match[1], _NORTH.sub("", unit).strip(" ,;/")
        plain.append(text)
    return tuple(plain), sides, north


def _layout(
    path: Path, number: int, separator: str | None, columns: tuple[str, ...], units: tuple[str, ...],
    said: Statements,
) -> _Layout:  # fmt: skip
    where = f"{path}, line {number}"
    first = columns.index("image")
    columns = tuple("" if name == "image" and place != first else name for place, name in enumerate(columns))
    twice = sorted({name for name in columns if name and columns.count(name) > 1})
    if twice:
        raise ConfigError(f"{where}: column {twice[0]!r} is named twice: keep one")
    renamed = tuple(_OTHER_PLACES.get(name, name) for name in columns)
    if {"x", "y"} <= set(renamed) and not {"x", "y", "lat", "lon"} & set(columns):
        columns = renamed
    stated_in = dict(zip(columns, units, strict=True))
    units, sides, north = _with_sides(columns, units)
    factors = _factors(where, columns, units, said)
    crs_column = next((place for place, name in enumerate(columns) if name in _CRS_COLUMNS), -1)
    columns, not_taken = _one_position(columns, crs_named=said.crs is not None or crs_column >= 0)
    columns, height = _with_height(columns)
    if height in factors:
        factors |= {own: factors[height] for own in ("z", "alt") if own in columns}
    known = (*_KNOWN, *_SIDE_COLUMNS, *_CRS_COLUMNS)
    unknown = tuple(name for name in columns if name and name not in known)
    for name in unknown:
        near = difflib.get_close_matches(name, [one for one in _KNOWN if one not in columns], n=1, cutoff=0.75)
        if near and len(name) > 2 and name not in _HEIGHTS and not is_height(name):
            raise ConfigError(f"{where}: unknown column {name!r}: did you mean {near[0]!r}?")
    position = _form(where, "position", _POSITIONS, columns, unknown)
    if position is None:
        raise ConfigError(f"{where}: no position: add the columns x,y,z or lat,lon,alt")
    own = _POSITIONS[cast(PositionKind, position)][2]
    if said.relative and own in columns:
        raise ConfigError(
            f"{path}: {said.relative!r} says that heights do not count from a datum: leave the column out, or give "
            "heights above the ellipsoid or sea level"
        )
    attitude = _form(where, "attitude", _ATTITUDES, columns, unknown)
    north = _checked_north(where, north, said, position, attitude)
    taken = height or own
    zero = zero_of(re.split(r"[\s_,;/.-]+", f"{taken} {stated_in.get(taken, '')}"))
    heights = [name for name in unknown if own not in columns and seems_height(name) and name not in _RELATIVE_HEIGHTS]
    remarks = [f"{', '.join(heights)} may be heights and are not read: name the column of heights {own}"]
    return _Layout(
        separator, columns, cast(PositionKind, position), cast(AttitudeKind, attitude or "none"), unknown, factors,
        height, crs_column, not_taken, zero, sides, north == "true" and position == "grid",
        tuple(remarks if heights else ()),
    )  # fmt: skip


def _checked_north(where: str, north: str, said: Statements, position: str, attitude: str | None) -> str:
    """The north that headings count from, by their column, else by a comment; "" for the usual one. Raises ConfigError
    for one that cannot be applied."""
    if attitude is None or (attitude != "yaw_pitch_roll" and said.north != "magnetic"):
        return ""
    found, words = (north, f"column yaw names {north} north") if north else (said.north, f"{said.north_in!r}")
    if found == "magnetic":
        raise ConfigError(
            f"{where}: {words}: headings from magnetic north lack the declination: add it, and give them from true "
            "north"
        )
    if found == "grid" and position == "geographic":
        raise ConfigError(
            f"{where}: {words}: beside lat and lon headings count from true north: give x and y in the CRS of the "
            "grid, or headings from true north"
        )
    return found


def _one_position(columns: tuple[str, ...], *, crs_named: bool) -> tuple[tuple[str, ...], str]:
    """Columns with one form of position, and the columns that do not count: of grid coordinates beside degrees the
    former count where their CRS is named."""
    if not {"x", "y", "lat", "lon"} <= set(columns):
        return columns, ""
    own, other = ("grid", "geographic") if crs_named else ("geographic", "grid")
    left_out = set(_POSITIONS[cast(PositionKind, other)])
    if _POSITIONS[cast(PositionKind, own)][2] not in columns:
        left_out -= {"z", "alt"}
    kept = tuple("" if name in left_out else name for name in columns)
    return kept, ", ".join(name for name in columns if name in left_out)


def _with_height(columns: tuple[str, ...]) -> tuple[tuple[str, ...], str]:
    """Columns in which z or alt stands for a height under another name, and that name, "" for none."""
    for across, own in ((("x", "y"), "z"), (("lat", "lon"), "alt")):
        if set(across) <= set(columns) and own not in columns:
            relative = bool(set(columns) & set(_RELATIVE_HEIGHTS))
            other = next((name for name in (_FROM_DATUM if relative else _OTHER_HEIGHTS) if name in columns), "")
            more = [name for name in columns if is_height(name) and name not in _HEIGHTS]
            other = other or (more[0] if len(more) == 1 else "")
            if other:
                return tuple(own if name == other else name for name in columns), other
    return columns, ""


def _form(
    where: str, what: str, forms: Mapping[Any, tuple[str, ...]], columns: tuple[str, ...], unknown: tuple[str, ...]
) -> str | None:
    """The one form of position or attitude that the columns give, None without any."""
    # The first two columns of a form tell it best: people write lat, lon, z and x, y, alt.
    present = [kind for kind, names in forms.items() if any(name in columns for name in names[:2])]
    present = present or [kind for kind, names in forms.items() if any(name in columns for name in names)]
    if len(present) > 1:
        both = " and ".join(",".join(forms[kind]) for kind in present)
        raise ConfigError(f"{where}: two forms of {what} ({both}): delete the columns of one")
    if not present:
        return None
    missing = [name for name in forms[present[0]] if name not in columns]
    relative = [name for name in columns if name in _RELATIVE_HEIGHTS and missing[:1] in (["z"], ["alt"])]
    if missing and (relative or missing not in (["z"], ["alt"])):
        hint = f" ({relative[0]!r} counts from the ground; if it does not, name it {missing[0]!r})" if relative else ""
        raise ConfigError(
            f"{where}: column {missing[0]!r} is missing: {what} needs {','.join(forms[present[0]])}{hint}"
        )
    return str(present[0])


def _split(path: Path, number: int, line: str, layout: _Layout) -> list[str]:
    if layout.separator is None:
        cells = words_of(line)
        more = len(cells) - len(layout.columns)
        return with_name(cells, layout.columns.index("image"), more + 1) if more > 0 else cells
    try:
        return next(csv.reader([line], delimiter=layout.separator, skipinitialspace=True))
    except (csv.Error, StopIteration) as error:
        raise ConfigError(f"{path}, line {number}: not a line of separated values ({error})") from error


def _row(path: Path, number: int, cells: list[str], layout: _Layout, faults: _Faults) -> PoseRow:
    """What a line says; what it lacks is added to the faults."""
    while len(cells) > len(layout.columns) and not cells[-1].strip():
        cells = cells[:-1]
    if len(cells) != len(layout.columns):
        raise ConfigError(
            f"{path}, line {number}: {len(cells)} values, but the header names {len(layout.columns)} columns: "
            "check separators and quotes"
        )
    record = dict(zip(layout.columns, (cell.strip() for cell in cells), strict=True))
    image = re.sub(r"^(\./)+", "", record["image"].replace("\\", "/"))
    if not image:
        raise ConfigError(f"{path}, line {number}, column image: empty: name the image")

    def numbers(names: tuple[str, ...]) -> tuple[float | None, ...]:
        return tuple(_number(path, number, name, record[name], layout.factors.get(name, 1.0)) for name in names)

    sigmas = [numbers((name,))[0] if name in record else None for name in _SIGMAS]
    x_m, y_m, z_m, across_m = (numbers((name,))[0] if name in record else None for name in _AXIS_SIGMAS)
    turns = [value for name in _ANGLE_SIGMAS if name in record and (value := numbers((name,))[0]) is not None]
    if sigmas[1] is None and turns:
        sigmas[1] = max(turns)
    across = _POSITIONS[layout.position_kind][:2]
    x, y = numbers(across)
    if layout.position_kind == "geographic":
        x, y = (_on_side(path, number, name, record, layout, one) for name, one in zip(across, (x, y), strict=True))
    height = _POSITIONS[layout.position_kind][2]
    z = numbers((height,))[0] if height in record else None
    attitude = numbers(_ATTITUDES[layout.attitude_kind]) if layout.attitude_kind != "none" else ()
    own_frame = record.get("frame", "").startswith(_OWN_FRAME)
    lacking = next((name for name, value in zip(across, (x, y), strict=True) if value is None), None)
    if lacking:
        faults.setdefault(f"no number in column {lacking}, treated as unposed", {})[number] = image
    elif own_frame:
        faults.setdefault("in a frame of its own, treated as unposed", {})[number] = image
        x, attitude = None, ()
    elif layout.position_kind == "geographic" and x == 0.0 and y == 0.0:
        faults.setdefault("position (0, 0), treated as unposed", {})[number] = image
        x = None
    whole = tuple(value for value in attitude if value is not None)
    if len(whole) < len(attitude):
        if not lacking:
            missing = "attitude is incomplete" if whole else "no attitude"
            faults.setdefault(f"{missing}, position only", {})[number] = image
        whole = ()
    if len(whole) == 4 and abs(math.hypot(*whole) - 1.0) > 0.05:
        raise ConfigError(f"{path}, line {number}: qw,qx,qy,qz has length {math.hypot(*whole):.3g}, not 1")
    return PoseRow(
        image=image,
        line=number,
        position=(x, y, math.nan if z is None else z) if x is not None and y is not None else None,
        position_kind=layout.position_kind,
        attitude=whole or None,
        attitude_kind=layout.attitude_kind if whole else "none",
        camera=record.get("camera", ""),
        sigmas_m=completed_sigmas_m(x_m, y_m, z_m, across_m=across_m, overall_m=sigmas[0]),
        sigma_angle_deg=sigmas[1],
        true_north=layout.true_north,
        numbered=image.isdigit(),
    )


def _on_side(
    path: Path, line: int, name: str, record: Mapping[str, str], layout: _Layout, degrees: float | None
) -> float | None:
    """Degrees with the sign of the side of the globe that another column, or the name of this one, states."""
    column, sides = _SIDES[name]
    if degrees is None:
        return None
    found = side(f"{path}, line {line}, side of {name}", record.get(column, ""), sides) or layout.sides.get(name, "")
    return on_side(f"{path}, line {line}, column {name}", degrees, found)


def _number(path: Path, line: int, column: str, cell: str, unit: float) -> float | None:
    """The value of a cell in metres or degrees, None where it is empty or NaN. unit: one of the column's, in these.

    Raises ConfigError where it is no number or out of range.
    """
    where = f"{path}, line {line}, column {column}"
    if cell.lower() in _BLANKS:
        return None
    kind = _kind(column)
    if kind == "length":
        if column not in _ALL_SIGMAS:
            refuse_rounded(where, cell)
        value = metres_of(cell, unit)
    else:
        plain = degrees_of(cell, {"lat": "NS", "lon": "EW"}.get(column, ""))
        value = None if plain is None else plain * unit
    if value is None:
        raise ConfigError(f"{where}: {cell!r} is not a number")
    if math.isnan(value):
        return None
    largest = _RANGES.get(column, _LARGEST_ANGLE_DEG if column.endswith("_deg") else math.inf)
    if math.isinf(value) or abs(value) > largest:
        limits = f" between {-largest:g} and {largest:g}" if largest < math.inf else ""
        raise ConfigError(f"{where}: {cell} is out of range: expected a number{limits}")
    if column in _ALL_SIGMAS and value <= 0:
        raise ConfigError(f"{where}: {cell} is out of range: a standard deviation is positive")
    return value
