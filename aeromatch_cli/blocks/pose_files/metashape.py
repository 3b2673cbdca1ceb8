"""Agisoft Metashape: the reference file (CSV) and cameras.xml.

Reference: `# CoordinateSystem: WKT`, then `#Label,...`; columns go by their names. x is the easting or longitude. Yaw,
pitch, roll are zero straight down, yaw from true north; omega, phi, kappa (and phi, omega, kappa) count in the grid.
Estimated columns (`_est`) stand before those that were given.

cameras.xml: a camera's `transform` takes camera axes (OpenCV's) to the chunk; the chunk's (or component's) takes these
to geocentric coordinates. `sensor/calibration`: f, cx and cy from the image's centre in pixels; b1 and b2 affinity and
skew, k1 to k4; p1 and p2 are exchanged against OpenCV's.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from aeromatch_cli.blocks.accuracies import completed_sigmas_m
from aeromatch_cli.blocks.lenses import of_metashape
from aeromatch_cli.blocks.pose_columns import PositionKind
from aeromatch_cli.blocks.pose_files.geodesy import StatedCrs, described_crs, geodetic
from aeromatch_cli.blocks.pose_files.source import CameraShelf, Source, image_name, number, rotation_row
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.blocks.units import factor, named_column
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.ellipsoid import enu_from_geocentric
from aeromatch_cli.geometry.frames import CAM_FROM_PHOTO
from aeromatch_cli.geometry.lenses import Nearest
from aeromatch_cli.geometry.rotations import rotation_x, rotation_y, rotation_z
from aeromatch_cli.words import counted, form

_ANGLES = (("yaw", "pitch", "roll"), ("omega", "phi", "kappa"), ("phi", "omega", "kappa"))
_LONGEST_CODE = 20  # longer ones are WKT
_ACCURACIES = ("accuracy_x", "accuracy_y", "accuracy_z", "accuracy_x/y", "accuracy_x/y/z")
# Geocentric coordinates of a place on the ground, and of nothing else.
_EARTH_M = (6.2e6, 6.6e6)


def is_reference(source: Source) -> bool:
    lines = map(_unquoted, source.lines[:3])
    return any(re.match(r"#\s*(coordinatesystem\s*:|label\b)", line, re.IGNORECASE) for line in lines)


def read_reference(source: Source, *, estimated: bool = True) -> PoseList:
    """estimated: take the columns `_est` where a line has them. Raises ConfigError with line and column."""
    system: StatedCrs | None = None
    stated_one = False
    columns: Sequence[str] = ()
    factors: Mapping[str, float] = {}
    rows: list[PoseRow] = []
    used_estimated = disabled = 0
    separator, angles = ",", _ANGLES[0]
    for line, text in enumerate(source.lines, start=1):
        stripped = _unquoted(text)
        stated = re.match(r"#\s*coordinatesystem\s*:\s*(.*)", stripped, re.IGNORECASE)
        if stated:
            system, stated_one = described_crs(source.at(line), stated[1]), True
        elif not columns and re.match(r"#?\s*label\b", stripped, re.IGNORECASE):
            separator = max(",;\t", key=stripped.count)
            columns, units = zip(*map(_column, stripped.lstrip("#").split(separator)), strict=True)
            if system is None:
                system = StatedCrs(kind="geographic" if "longitude" in stripped.lower() else "grid", name="the list")
            factors = _factors(source.at(line), columns, units, system)
            angles = _angle_columns(columns)
        elif stripped and not stripped.startswith("#"):
            if not columns:
                raise ConfigError(f"{source.at(line)}: no line that names the columns (#Label,...) stands before")
            cells = next(csv.reader([text], delimiter=separator))
            record = _by_axis(dict(zip(columns, (cell.strip() for cell in cells), strict=False)))
            if record.get("enable", "1").lower() in ("0", "false"):
                disabled += 1
            row, from_estimate = _row(
                source, line, record, angles, system or StatedCrs(), separator, estimated, factors
            )
            rows.append(row)
            used_estimated += from_estimate
    words = ["estimated"] if used_estimated else []
    words.append("/".join(angles) if any(row.attitude for row in rows) else "positions")
    remarks = []
    if disabled:
        remarks.append(
            f"{source.path.name}: {counted(disabled, 'camera is', 'cameras are')} not enabled there, but used"
        )
    if 0 < used_estimated < len(rows):
        given = len(rows) - used_estimated
        remarks.append(
            f"{source.path.name}: {given} of {len(rows)} images {form(given, 'has', 'have')} no estimated position "
            "there; the given one is used"
        )
    system = system or StatedCrs()
    if stated_one:
        words.append(_crs_words(system))
    title = f"Metashape reference, {', '.join(words)}"
    warnings = (*system.remarks, *remarks)
    return PoseList(tuple(rows), system.kind, warnings, title, system.crs, heights=system.heights)


def _crs_words(system: StatedCrs) -> str:
    """Return in few words what the coordinates count in."""
    if not system.crs:
        return "WGS84" if system.kind == "geographic" else "local"
    return system.crs if len(system.crs) < _LONGEST_CODE else system.name


def _unquoted(line: str) -> str:
    """A comment as it was before a spreadsheet has put it, or its parts between commas, in quotes."""
    text = line.strip()
    if not text.startswith('"#'):
        return text
    return ",".join(next(csv.reader([text]))).rstrip(",; \t")


def _by_axis(record: dict[str, str]) -> dict[str, str]:
    """With a column for every axis in place of one that holds several: `0.03/0.03/0.06` of accuracy_x/y/z."""
    found: dict[str, str] = {}
    for name, cell in record.items():
        axes, values = name.removeprefix("accuracy_").split("/"), cell.split("/")
        if name.startswith("accuracy_") and len(axes) == len(values) > 1:
            found |= {f"accuracy_{axis}": value for axis, value in zip(axes, values, strict=True)}
        else:
            found[name] = cell
    return found


def _column(cell: str) -> tuple[str, str]:
    """x, y, z, yaw, ..., x_est, accuracy_x, ... of Metashape's names, and the unit that they state."""
    name, unit = named_column(cell, {})
    name = re.sub(r"^([xyz])/[a-z]+", r"\1", name)
    return re.sub(r"^(.+)_accuracy$", r"accuracy_\1", name), unit


def _factors(where: str, columns: Sequence[str], units: Sequence[str], system: StatedCrs) -> dict[str, float]:
    """What numbers of the columns that state a unit are multiplied by: coordinates count in units of the CRS then, all
    else in metres and degrees. Raises ConfigError naming the column."""
    found = {}
    geographic = system.kind == "geographic"
    for name, unit in zip(columns, units, strict=True):
        parts = set(name.removeprefix("accuracy_").removesuffix("_est").split("/"))
        turns = bool(parts & set(_ANGLES[0] + _ANGLES[1])) or (geographic and name[:1] in "xy" and parts <= {"x", "y"})
        if unit and (turns or parts <= {"x", "y", "z", "accuracy"}):
            stem = name.removesuffix("_est")
            one = 1.0
            if stem == "z":
                one = system.up_m
            elif stem in ("x", "y"):
                one = system.across_m
            found[name] = factor(where, name, unit, "angle" if turns else "length") / one
            if name.startswith("accuracy_"):
                found |= {f"accuracy_{part}": found[name] for part in parts}
    return found


def _angle_columns(columns: Sequence[str]) -> tuple[str, str, str]:
    places = {name: columns.index(name) for three in _ANGLES for name in three if name in columns}
    if "yaw" in places:
        return _ANGLES[0]
    if {"omega", "phi"} <= places.keys():
        return _ANGLES[1] if places["omega"] < places["phi"] else _ANGLES[2]
    return _ANGLES[0]


def _row(
    source: Source, line: int, record: Mapping[str, str], angles: tuple[str, str, str], system: StatedCrs,
    separator: str, estimated: bool, factors: Mapping[str, float],
) -> tuple[PoseRow, bool]:  # fmt: skip
    def value(name: str) -> float:
        cell = record.get(name, "")
        if not cell:
            return math.nan
        return number(source.at(line, name), cell, decimal_comma=separator != ",") * factors.get(name, 1.0)

    def triple(names: Sequence[str]) -> tuple[tuple[float, ...], bool]:
        own = tuple(value(f"{name}_est") for name in names)
        use = estimated and all(math.isfinite(v) for v in own)
        return (own if use else tuple(value(name) for name in names)), use

    (x, y, z), from_estimate = triple(("x", "y", "z"))
    attitude, _ = triple(angles)
    x_m, y_m, z_m, across_m, overall_m = (value(name) for name in _ACCURACIES)
    overall_m = overall_m if overall_m > 0.0 else value("accuracy")
    sigmas_m = completed_sigmas_m(x_m, y_m, z_m, across_m=across_m, overall_m=overall_m)
    turns = [v for name in (*angles, "/".join(angles)) if (v := value(f"accuracy_{name}")) > 0.0]
    row = PoseRow(
        image=image_name(record.get("label", "")), line=line,
        position=system.position(source.at(line), x, y, z) if math.isfinite(x + y) else None,
        position_kind=system.kind, attitude=None, attitude_kind="none", forward=False, true_north=angles[0] == "yaw",
        sigmas_m=None if from_estimate else sigmas_m, sigma_angle_deg=max(turns, default=None),
    )  # fmt: skip
    if not all(math.isfinite(v) for v in attitude):
        return row, from_estimate
    return _with_attitude(row, attitude, angles), from_estimate


def _with_attitude(row: PoseRow, attitude: tuple[float, ...], angles: tuple[str, str, str]) -> PoseRow:
    """Return a row with an attitude of three angles, degrees, by the names of these."""
    if angles == _ANGLES[0]:
        return replace(row, attitude=attitude, attitude_kind="yaw_pitch_roll")
    if angles == _ANGLES[1]:
        return replace(row, attitude=attitude, attitude_kind="omega_phi_kappa", forward=None)
    phi, omega, kappa = attitude
    photo = rotation_y(phi) @ rotation_x(omega) @ rotation_z(kappa)
    turned = rotation_row(row.image, row.line, (0, 0, 0), CAM_FROM_PHOTO @ photo.T, row.position_kind)
    return replace(row, attitude=turned.attitude, attitude_kind="quaternion", forward=None)


def is_cameras_xml(source: Source) -> bool:
    return source.xml is not None and source.xml.tag == "document" and source.xml.find(".//camera") is not None


def _in_world(matrix: FloatArray, placed: tuple[FloatArray, FloatArray, float]) -> tuple[FloatArray, FloatArray, bool]:
    """Return centre (3,) and cam_from_world (3, 3) of a camera, and whether these are degrees and topocentric axes.

    matrix: (4, 4) chunk_from_camera. placed: rotation, shift and scale from the chunk to the world.
    """
    turn, shift, scale = placed
    center = scale * turn @ matrix[:3, 3] + shift
    rotation = (turn @ matrix[:3, :3]).T
    if not _EARTH_M[0] < float(np.linalg.norm(center)) < _EARTH_M[1]:
        return center, rotation, False
    center = geodetic(center[None])[0]
    return center, rotation @ enu_from_geocentric(*center[:2]).T, True


def read_cameras_xml(source: Source) -> PoseList:
    """Raises ConfigError naming the camera."""
    rows: list[PoseRow] = []
    cameras = CameraShelf(source.path.name)
    unaligned = 0
    georeferenced: set[bool] = set()
    for chunk in source.xml_root().iter("chunk"):
        for sensor in chunk.iter("sensor"):
            cameras.add(f"sensor{sensor.get('id')}", _sensor(sensor))
        whole = _similarity(source, chunk.find("transform"))
        parts = {c.get("id"): _similarity(source, c.find("transform")) for c in chunk.iter("component")}
        for camera in chunk.iter("camera"):
            label, transform = camera.get("label", ""), camera.find("transform")
            if transform is None or not (transform.text or "").strip():
                unaligned += 1
                continue
            matrix = _numbers(source, f"camera {label!r}", transform.text, 16).reshape(4, 4)
            placed = parts.get(camera.get("component_id")) or whole or (np.eye(3), np.zeros(3), 1.0)
            center, rotation, earth = _in_world(matrix, placed)
            georeferenced.add(earth)
            kind: PositionKind = "geographic" if earth else "grid"
            lens = cameras.key(f"sensor{camera.get('sensor_id')}")
            rows.append(rotation_row(label, len(rows) + 1, center, rotation, kind, true_north=earth, camera=lens))
    if len(georeferenced) > 1:
        raise ConfigError(f"{source.path}: some chunks are georeferenced and some are not: export one alone")
    if not rows:
        raise ConfigError(
            f"{source.path}: no camera of this Metashape file is aligned: align the photos, or export the reference"
        )
    some = form(unaligned, "camera is", "cameras are")
    remarks = [f"{source.path.name}: {unaligned} {some} not aligned there"] if unaligned else []
    kind = "geographic" if georeferenced == {True} else "grid"
    words = "georeferenced" if kind == "geographic" else "not georeferenced"
    title = f"Metashape cameras.xml, {words}"
    return PoseList(tuple(rows), kind, (*remarks, *cameras.remarks), title, None, cameras.found)


def _numbers(source: Source, what: str, text: str | None, count: int) -> FloatArray:
    values = [number(f"{source.path}, {what}", cell) for cell in (text or "").split()]
    if len(values) != count:
        raise ConfigError(f"{source.path}, {what}: {len(values)} numbers instead of {count}")
    return np.array(values)


def _similarity(source: Source, element: Any) -> tuple[FloatArray, FloatArray, float] | None:
    if element is None or element.find("rotation") is None:
        return None
    turn = _numbers(source, "rotation of the chunk", element.findtext("rotation"), 9).reshape(3, 3)
    shift = _numbers(source, "translation of the chunk", element.findtext("translation"), 3)
    scale = _numbers(source, "scale of the chunk", element.findtext("scale") or "1", 1)
    return turn, shift, float(scale[0])


def _sensor(sensor: Any) -> Nearest | None:
    """The adjusted calibration; without camera for lenses that no model here describes, None without a calibration."""
    found = [c for c in sensor.findall("calibration") if c.get("class") == "adjusted"] or sensor.findall("calibration")
    if not found:
        return None
    size = found[0].find("resolution")
    size = sensor.find("resolution") if size is None else size
    try:
        width, height = int(size.get("width")), int(size.get("height"))
    except (AttributeError, TypeError, ValueError):
        return None
    return of_metashape(found[0], found[0].get("type", "frame"), width, height)
