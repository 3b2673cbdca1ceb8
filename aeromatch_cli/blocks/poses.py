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
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from aeromatch_cli.blocks.accuracies import Sigmas, completed_sigmas_m, overall_sigma_m
from aeromatch_cli.blocks.column_names import (
    on_side,
    side,
)
from aeromatch_cli.blocks.fields import with_name, words_of
from aeromatch_cli.blocks.gis_columns import with_coordinates
from aeromatch_cli.blocks.pose_columns import (
    ALL_SIGMAS,
    ANGLE_SIGMAS,
    ATTITUDES,
    AXIS_SIGMAS,
    POSITIONS,
    SIDES,
    SIGMAS,
    AttitudeKind,
    Layout,
    PositionKind,
    kind_of,
    read_header,
)
from aeromatch_cli.blocks.statements import Statements
from aeromatch_cli.blocks.units import degrees_of, metres_of, refuse_rounded
from aeromatch_cli.data import Camera
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import given_bytes, text_encoding
from aeromatch_cli.words import form, listed

# What orientation.csv says of images whose place is arbitrary.
_OWN_FRAME = "own"
_BLANKS = frozenset({"", "nan", "na", "n/a", "none", "null", "-"})
_LARGEST_LATITUDE_DEG = 90.0
# So many latitudes that are none are no slip of the pen.
_CERTAINLY = 3
# A latitude beyond 90 degrees may be a longitude: see _with_latitudes.
_RANGES = {"lat": 180.0, "lon": 180.0, "qw": 1.05, "qx": 1.05, "qy": 1.05, "qz": 1.05}
_LARGEST_ANGLE_DEG = 360.0
# What a spreadsheet writes to say what separates.
_SEPARATOR_LINE = re.compile(r"\"?sep=.\"?", re.IGNORECASE)
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


def read_poses(path: Path, usual_m: tuple[float, float] = (1.0, 1.0), text: str | None = None) -> PoseList:
    """Reads a pose list. Its `crs` is as the list states it, a code or other text.

    usual_m: metres of one unit of x and y, and of heights, where the list names none. text: instead of the
    file's. Raises ConfigError with file, line and column where the list is malformed.
    """
    text = _text(path) if text is None else text
    lines = [line for line in enumerate(with_coordinates(text.splitlines()), start=1) if line[1].strip()]
    if lines and _SEPARATOR_LINE.fullmatch(lines[0][1].strip()):
        lines = lines[1:]
    header, layout, records, said = read_header(path, lines)
    across_m, up_m = usual_m
    usual = {"x": across_m, "y": across_m, "z": up_m, "alt": up_m}
    layout = replace(layout, factors={**usual, **layout.factors})
    systems: dict[str, int] = {}
    faults: _Faults = {}
    rows: dict[str, PoseRow] = {}
    for number, line in records:
        cells = _split(path, number, line, layout)
        row = _row(path, number, cells, layout, faults)
        if layout.crs_column >= 0 and (system := cells[layout.crs_column].strip()):
            systems.setdefault(f"EPSG:{system}" if system.isdigit() else system, number)
        if row.image in rows:
            raise ConfigError(
                f"{path}, line {number}, column image: {row.image!r} stands in line {rows[row.image].line} already: "
                "keep one of the two lines, or write the paths relative to the images folder"
            )
        rows[row.image] = row
    if not rows:
        raise ConfigError(f"{path}: no line follows the header in line {header}: add one line per image")
    placed, exchanged = _with_latitudes(path, list(rows.values()))
    if len(systems) > 1:
        raise ConfigError(
            f"{path}, line {max(systems.values())}: the list names {len(systems)} coordinate systems: one is needed"
        )
    crs = next(iter(systems), None) or said.crs_of(grid=layout.position_kind == "grid")
    passed_over = _passed_over(layout, said)
    if crs is None:
        passed_over += said.not_whole
    warnings = [_fault(path, fault, images) for fault, images in faults.items()]
    remarks = (*(f"{path.name}: {words}" for words in passed_over), *exchanged, *warnings)
    return PoseList(tuple(placed), layout.position_kind, remarks, crs=crs, heights=layout.zero or said.zero)


def _passed_over(layout: Layout, said: Statements) -> list[str]:
    """Return what is said of columns and comments that are ignored, or taken for what they do not name."""
    remarks = [f"unknown columns ignored: {', '.join(layout.ignored)}"] if layout.ignored else []
    remarks += [*layout.remarks, *said.remarks]
    if said.datum:
        remarks.append(
            f"{said.datum!r}: ground and control points must count from the same zero, or state their own "
            "(EPSG:32633+5773)"
        )
    if layout.not_taken:
        kind = "whose CRS is named" if layout.position_kind == "grid" else "since no CRS of the others is named"
        taken = ", ".join(POSITIONS[layout.position_kind][:2])
        remarks.append(f"of two forms of position {taken} count, {kind}; {layout.not_taken} do not")
    if layout.height:
        own = POSITIONS[layout.position_kind][2]
        remarks.append(f"{layout.height} is taken for the height {own}, which counts from the datum")
    return remarks


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
    return f"{path.name}, {form(len(images), 'line')} {listed(images)}: {fault}: {listed(images.values())}"


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


def _split(path: Path, number: int, line: str, layout: Layout) -> list[str]:
    if layout.separator is None:
        cells = words_of(line)
        more = len(cells) - len(layout.columns)
        return with_name(cells, layout.columns.index("image"), more + 1) if more > 0 else cells
    try:
        return next(csv.reader([line], delimiter=layout.separator, skipinitialspace=True))
    except (csv.Error, StopIteration) as error:
        raise ConfigError(f"{path}, line {number}: not a line of separated values ({error})") from error


@dataclass(frozen=True)
class _Line:
    """A line of a pose list. image: as written, with forward slashes. record: its cells, stripped, by column."""

    path: Path
    number: int
    image: str
    record: Mapping[str, str]
    layout: Layout

    def value(self, column: str) -> float | None:
        """Return the number in a column, metres or degrees; None where there is no such column or its cell is empty."""
        if column not in self.record:
            return None
        factor_of_column = self.layout.factors.get(column, 1.0)
        return _number(self.path, self.number, column, self.record[column], factor_of_column)

    @property
    def across(self) -> tuple[str, ...]:
        """The columns of both horizontal coordinates."""
        return POSITIONS[self.layout.position_kind][:2]

    @property
    def in_own_frame(self) -> bool:
        return self.record.get("frame", "").startswith(_OWN_FRAME)


def _row(path: Path, number: int, cells: list[str], layout: Layout, faults: _Faults) -> PoseRow:
    """Return what a line says; what it lacks is added to the faults."""
    line = _line(path, number, cells, layout)
    sigmas_m, sigma_angle_deg = _sigmas(line)
    x, y = _horizontal(line)
    z = line.value(POSITIONS[layout.position_kind][2])
    names = ATTITUDES[layout.attitude_kind] if layout.attitude_kind != "none" else ()
    values = tuple(line.value(name) for name in names)
    position = None
    if x is None or y is None:
        missing = line.across[0 if x is None else 1]
        faults.setdefault(f"no number in column {missing}, treated as unposed", {})[number] = line.image
    elif line.in_own_frame:
        faults.setdefault("in a frame of its own, treated as unposed", {})[number] = line.image
        values = ()
    elif layout.position_kind == "geographic" and x == 0.0 and y == 0.0:
        faults.setdefault("position (0, 0), treated as unposed", {})[number] = line.image
    else:
        position = x, y, math.nan if z is None else z
    attitude, lacks = _whole_attitude(line, values)
    if lacks and x is not None and y is not None:
        faults.setdefault(f"{lacks}, position only", {})[number] = line.image
    return PoseRow(
        image=line.image,
        line=number,
        position=position,
        position_kind=layout.position_kind,
        attitude=attitude or None,
        attitude_kind=layout.attitude_kind if attitude else "none",
        camera=line.record.get("camera", ""),
        sigmas_m=sigmas_m,
        sigma_angle_deg=sigma_angle_deg,
        true_north=layout.true_north,
        numbered=line.image.isdigit(),
    )


def _line(path: Path, number: int, cells: list[str], layout: Layout) -> _Line:
    """Return the cells of a line by column. Raises ConfigError where they are not as many, or name no image."""
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
    return _Line(path, number, image, record, layout)


def _sigmas(line: _Line) -> tuple[Sigmas | None, float | None]:
    """Return the standard deviations of a line: of the position by axis, and of the angles, the largest of them."""
    overall_m, angle_deg = (line.value(name) for name in SIGMAS)
    x_m, y_m, z_m, across_m = (line.value(name) for name in AXIS_SIGMAS)
    turns = [line.value(name) for name in ANGLE_SIGMAS]
    if angle_deg is None:
        angle_deg = max((turn for turn in turns if turn is not None), default=None)
    return completed_sigmas_m(x_m, y_m, z_m, across_m=across_m, overall_m=overall_m), angle_deg


def _whole_attitude(line: _Line, values: Sequence[float | None]) -> tuple[tuple[float, ...], str]:
    """Return an attitude, () where values are missing, and what it lacks, in words. Raises ConfigError for a quaternion
    that is none."""
    attitude = tuple(value for value in values if value is not None)
    if len(attitude) < len(values):
        return (), "attitude is incomplete" if attitude else "no attitude"
    if len(attitude) == 4 and abs(math.hypot(*attitude) - 1.0) > 0.05:
        where = f"{line.path}, line {line.number}"
        raise ConfigError(f"{where}: qw,qx,qy,qz has length {math.hypot(*attitude):.3g}, not 1")
    return attitude, ""


def _horizontal(line: _Line) -> tuple[float | None, float | None]:
    """Return x and y in metres, or latitude and longitude in degrees with the sign of their side of the globe."""
    first, second = line.across
    x, y = line.value(first), line.value(second)
    if line.layout.position_kind == "grid":
        return x, y
    return _on_side(line, first, x), _on_side(line, second, y)


def _on_side(line: _Line, column: str, degrees: float | None) -> float | None:
    """Return degrees with the sign of the side of the globe that another column, or the name of this one, states."""
    if degrees is None:
        return None
    column_of_side, sides = SIDES[column]
    stated = line.record.get(column_of_side, "")
    where = f"{line.path}, line {line.number}"
    found = side(f"{where}, side of {column}", stated, sides) or line.layout.sides.get(column, "")
    return on_side(f"{where}, column {column}", degrees, found)


def _number(path: Path, line: int, column: str, cell: str, unit: float) -> float | None:
    """The value of a cell in metres or degrees, None where it is empty or NaN. unit: one of the column's, in these.

    Raises ConfigError where it is no number or out of range.
    """
    where = f"{path}, line {line}, column {column}"
    if cell.lower() in _BLANKS:
        return None
    kind = kind_of(column)
    if kind == "length":
        if column not in ALL_SIGMAS:
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
    if column in ALL_SIGMAS and value <= 0:
        raise ConfigError(f"{where}: {cell} is out of range: a standard deviation is positive")
    return value
