"""Which columns a pose list has: their names, units and sides of the globe, as the header and comments state them.

`poses` describes the format.
"""

from __future__ import annotations

import csv
import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, cast

from aeromatch_cli.blocks.column_names import (
    LATITUDE_SIDES,
    LONGITUDE_SIDES,
    comments_of_columns,
    is_height,
    seems_height,
    words_of_height,
)
from aeromatch_cli.blocks.fields import IMAGE, words_of
from aeromatch_cli.blocks.statements import Quantity, Statements, statements_of
from aeromatch_cli.blocks.units import Kind, factor, named_column
from aeromatch_cli.blocks.zeros import is_relative, zero_of
from aeromatch_cli.errors import ConfigError

PositionKind = Literal["grid", "geographic"]
AttitudeKind = Literal["omega_phi_kappa", "yaw_pitch_roll", "quaternion", "none"]

POSITIONS: dict[PositionKind, tuple[str, ...]] = {"grid": ("x", "y", "z"), "geographic": ("lat", "lon", "alt")}
ATTITUDES: dict[AttitudeKind, tuple[str, ...]] = {
    "omega_phi_kappa": ("omega_deg", "phi_deg", "kappa_deg"),
    "yaw_pitch_roll": ("yaw_deg", "pitch_deg", "roll_deg"),
    "quaternion": ("qw", "qx", "qy", "qz"),
}
SIGMAS = ("sigma_position_m", "sigma_angle_deg")
AXIS_SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_xy_m")
ANGLE_SIGMAS = ("sigma_omega_deg", "sigma_phi_deg", "sigma_kappa_deg")
ALL_SIGMAS = (*SIGMAS, *AXIS_SIGMAS, *ANGLE_SIGMAS)
# The side of the globe of latitudes and of longitudes.
SIDES = {"lat": ("lat_side", "NS"), "lon": ("lon_side", "EW")}
_SIDE_COLUMNS = tuple(column for column, _ in SIDES.values())
_KNOWN = ("image", *sum([*POSITIONS.values(), *ATTITUDES.values()], ()), "camera", "frame", *ALL_SIGMAS)
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
_HEAD_LINES = 100  # of which one must be the header
_SIDE = re.compile(r"[nsew]|north|south|east|west")
_NORTH = re.compile(r"\b(true|grid|magnetic)(?:[ _-]*north)?\b")


@dataclass(frozen=True)
class Layout:
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
        if "image" in columns and {*POSITIONS["grid"][:2], *POSITIONS["geographic"][:2]} & set(columns):
            return True
    return False


def is_track(lines: Sequence[str]) -> bool:
    """Whether the first line names latitudes and longitudes, and no image."""
    head, *rest = [line.strip().lstrip("#").strip() for line in lines[:_HEAD_LINES] if line.strip()] or [""]
    separator, columns, _ = _columns(head)
    columns, _ = _with_images(columns, _cells(rest[0], separator) if rest else [])
    return {"lat", "lon"} <= set(columns) and "image" not in columns


def read_header(path: Path, lines: list[tuple[int, str]]) -> tuple[int, Layout, list[tuple[int, str]], Statements]:
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


def kind_of(column: str) -> Kind | None:
    """Whether a column holds lengths or angles, None for neither."""
    if column in ("lat", "lon") or column.endswith("_deg"):
        return "angle"
    return "length" if column in ("x", "y", *_HEIGHTS, *ALL_SIGMAS) or is_height(column) else None


def _factors(where: str, columns: Sequence[str], units: Sequence[str], said: Statements) -> dict[str, float]:
    """Metres or degrees of one unit of every column: by its name, else by what a comment says. Raises ConfigError."""
    found: dict[str, float] = {}
    for column, unit in zip(columns, units, strict=True):
        kind = kind_of(column)
        if kind is None:
            continue
        if column in ALL_SIGMAS:
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
        if column in SIDES and unit[:1].upper() in tuple(SIDES[column][1]) and _SIDE.fullmatch(unit):
            sides[column], text = unit[:1].upper(), ""
        elif column == "yaw_deg" and (match := _NORTH.search(unit)):
            north, text = match[1], _NORTH.sub("", unit).strip(" ,;/")
        plain.append(text)
    return tuple(plain), sides, north


def _layout(
    path: Path, number: int, separator: str | None, columns: tuple[str, ...], units: tuple[str, ...],
    said: Statements,
) -> Layout:  # fmt: skip
    where = f"{path}, line {number}"
    columns = _each_once(where, columns)
    stated_in = dict(zip(columns, units, strict=True))
    units, sides, north = _with_sides(columns, units)
    factors = _factors(where, columns, units, said)
    crs_column = next((place for place, name in enumerate(columns) if name in _CRS_COLUMNS), -1)
    columns, not_taken = _one_position(columns, crs_named=said.crs is not None or crs_column >= 0)
    columns, height = _with_height(columns)
    if height in factors:
        factors |= {own: factors[height] for own in ("z", "alt") if own in columns}
    unknown = _unknown(where, columns)
    position = _position_kind(path, where, columns, unknown, said)
    attitude = _form(where, "attitude", ATTITUDES, columns, unknown)
    north = _checked_north(where, north, said, position, attitude)
    taken = height or POSITIONS[position][2]
    zero = zero_of(re.split(r"[\s_,;/.-]+", f"{taken} {stated_in.get(taken, '')}"))
    return Layout(
        separator, columns, position, cast(AttitudeKind, attitude or "none"), unknown, factors, height, crs_column,
        not_taken, zero, sides, north == "true" and position == "grid", _unread_heights(columns, unknown, position),
    )  # fmt: skip


def _each_once(where: str, columns: tuple[str, ...]) -> tuple[str, ...]:
    """Return columns of which none is named twice, with e and n for x and y where no other position is there.

    Further columns of images lose their name. Raises ConfigError for any other that is named twice.
    """
    first = columns.index("image")
    columns = tuple("" if name == "image" and place != first else name for place, name in enumerate(columns))
    twice = sorted({name for name in columns if name and columns.count(name) > 1})
    if twice:
        raise ConfigError(f"{where}: column {twice[0]!r} is named twice: keep one")
    renamed = tuple(_OTHER_PLACES.get(name, name) for name in columns)
    has_position = bool({"x", "y", "lat", "lon"} & set(columns))
    return renamed if {"x", "y"} <= set(renamed) and not has_position else columns


def _unknown(where: str, columns: tuple[str, ...]) -> tuple[str, ...]:
    """Return the columns that are not known. Raises ConfigError for one that is nearly a known one's name."""
    known = (*_KNOWN, *_SIDE_COLUMNS, *_CRS_COLUMNS)
    unknown = tuple(name for name in columns if name and name not in known)
    absent = [name for name in _KNOWN if name not in columns]
    for name in unknown:
        near = difflib.get_close_matches(name, absent, n=1, cutoff=0.75)
        if near and len(name) > 2 and name not in _HEIGHTS and not is_height(name):
            raise ConfigError(f"{where}: unknown column {name!r}: did you mean {near[0]!r}?")
    return unknown


def _position_kind(
    path: Path, where: str, columns: tuple[str, ...], unknown: tuple[str, ...], said: Statements
) -> PositionKind:
    """Return the form of position that the columns give. Raises ConfigError where there is none, and where a comment
    says that its heights do not count from a datum."""
    form = _form(where, "position", POSITIONS, columns, unknown)
    if form is None:
        raise ConfigError(f"{where}: no position: add the columns x,y,z or lat,lon,alt")
    kind = cast(PositionKind, form)
    if said.relative and POSITIONS[kind][2] in columns:
        raise ConfigError(
            f"{path}: {said.relative!r} says that heights do not count from a datum: leave the column out, or give "
            "heights above the ellipsoid or sea level"
        )
    return kind


def _unread_heights(columns: tuple[str, ...], unknown: tuple[str, ...], position: PositionKind) -> tuple[str, ...]:
    """Return a remark on unknown columns that may be the heights that a list lacks."""
    own = POSITIONS[position][2]
    heights = [name for name in unknown if seems_height(name) and name not in _RELATIVE_HEIGHTS]
    if own in columns or not heights:
        return ()
    return (f"{', '.join(heights)} may be heights and are not read: name the column of heights {own}",)


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
    left_out = set(POSITIONS[cast(PositionKind, other)])
    if POSITIONS[cast(PositionKind, own)][2] not in columns:
        left_out -= {"z", "alt"}
    kept = tuple("" if name in left_out else name for name in columns)
    return kept, ", ".join(name for name in columns if name in left_out)


def _with_height(columns: tuple[str, ...]) -> tuple[tuple[str, ...], str]:
    """Return columns in which z or alt stands for a height under another name, and that name, "" for none."""
    for across, own in ((("x", "y"), "z"), (("lat", "lon"), "alt")):
        if set(across) <= set(columns) and own not in columns:
            other = _other_height(columns)
            if other:
                return tuple(own if name == other else name for name in columns), other
    return columns, ""


def _other_height(columns: tuple[str, ...]) -> str:
    """Return the column that is taken for the height where there is no z or alt, "" where none is."""
    relative = bool(set(columns) & set(_RELATIVE_HEIGHTS))
    for name in _FROM_DATUM if relative else _OTHER_HEIGHTS:
        if name in columns:
            return name
    further = [name for name in columns if is_height(name) and name not in _HEIGHTS]
    return further[0] if len(further) == 1 else ""


def _form(
    where: str, what: str, forms: Mapping[Any, tuple[str, ...]], columns: tuple[str, ...], unknown: tuple[str, ...]
) -> str | None:
    """Return the one form of position or attitude that the columns give, None without any.

    Raises ConfigError where they give two, and where a column of the form is missing. A position may lack its height,
    unless it is given above ground.
    """
    # The first two columns of a form tell it best: people write lat, lon, z and x, y, alt.
    present = [kind for kind, names in forms.items() if set(names[:2]) & set(columns)]
    present = present or [kind for kind, names in forms.items() if set(names) & set(columns)]
    if len(present) > 1:
        both = " and ".join(",".join(forms[kind]) for kind in present)
        raise ConfigError(f"{where}: two forms of {what} ({both}): delete the columns of one")
    if not present:
        return None
    missing = [name for name in forms[present[0]] if name not in columns]
    if not missing:
        return str(present[0])
    hint = ""
    if missing[0] in ("z", "alt"):
        relative = [name for name in columns if name in _RELATIVE_HEIGHTS]
        if len(missing) == 1 and not relative:
            return str(present[0])
        if relative:
            hint = f" ({relative[0]!r} counts from the ground; if it does not, name it {missing[0]!r})"
    raise ConfigError(f"{where}: column {missing[0]!r} is missing: {what} needs {','.join(forms[present[0]])}{hint}")
