"""Pix4D: geolocation without header, and the calibrated camera parameters.

Geolocation: `name,c1,c2,z[,a1,a2,a3][,accuracy_horizontal,accuracy_vertical]`. In degrees latitude stands first
(Pix4D's default); numbers beyond 180 are a grid's. Pix4Dmapper's angles are omega, phi, kappa, Pix4Dmatic's yaw, pitch,
roll from straight down: nothing in the file tells them, so of flights that look down the column that turns most does.

*_calibrated_camera_parameters.txt: eight lines of header, then for every image its name and size, K, radial and
tangential distortion (T1, T2 in OpenCV's order), t (the projection centre less the project's offset) and R
(cam_from_world in OpenCV's axes). The
offset lies beside in *_offset.xyz.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from aeromatch_cli.blocks.accuracies import completed_sigmas_m
from aeromatch_cli.blocks.fields import IMAGE, fields_of
from aeromatch_cli.blocks.pose_columns import AttitudeKind, PositionKind, has_header
from aeromatch_cli.blocks.pose_files.source import (
    CameraShelf,
    Source,
    Units,
    image_name,
    is_number,
    number,
    numbers,
    rotation_row,
    units_of_comments,
)
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.lenses import Nearest, brown

_COUNTS = (4, 6, 7, 9)
_LINES_OF_IMAGE = 10


def is_geolocation(source: Source) -> bool:
    if has_header(source.lines):
        return False
    record = next((line for _, line in source.records()), "")
    if "," not in record and ";" not in record:
        return False
    cells = fields_of(record)[0]
    return len(cells) in _COUNTS and bool(IMAGE.fullmatch(cells[0])) and all(map(is_number, cells[1:]))


def read_geolocation(source: Source, angles: str = "") -> PoseList:
    """angles: "opk" or "ypr", "" to go by the numbers. Raises ConfigError with line and column."""
    said = units_of_comments(source)
    table = list(_lines(source, said))
    places = np.array([values[:2] for _, _, values in table])
    kind: PositionKind = "geographic" if np.abs(places).max() <= 180.0 else "grid"
    exchanged = kind == "geographic" and bool((np.abs(places[:, 0]) > 90.0).any())
    attitudes = np.array([values[3:6] for _, _, values in table if len(values) >= 6])
    chosen = angles or _likely_angles(attitudes)
    form: AttitudeKind = "omega_phi_kappa" if chosen == "opk" else "yaw_pitch_roll"
    rows = tuple(_row(line, name, values, kind, exchanged, form) for line, name, values in table)
    remarks = list(said.remarks(source))
    words = "positions"
    if len(attitudes):
        words, other = ("omega, phi, kappa", "ypr") if chosen == "opk" else ("yaw, pitch, roll", "opk")
        if not angles:
            remarks.append(
                f"{source.path.name}: the angles are read as {words}; --pose-format pix4d-{other} reads them otherwise"
            )
    if exchanged:
        remarks.append(f"{source.path.name}: longitude stands before latitude, as numbers beyond 90 show")
    where = "latitude, longitude" if kind == "geographic" else "grid"
    title = f"Pix4D geolocation, {where}, {words}"
    return PoseList(rows, kind, tuple(remarks), title, heights=said.said.zero)


def _lines(source: Source, said: Units) -> Iterator[tuple[int, str, list[float]]]:
    """Yield the number, the image and the values of every line, in metres and degrees."""
    across_m, up_m, angle_deg, accuracy_m = (
        one or 1.0 for one in (said.across_m, said.up_m, said.angle_deg, said.accuracy_m)
    )
    for line, record in source.records():
        cells, comma = fields_of(record)
        if len(cells) not in _COUNTS:
            raise ConfigError(f"{source.at(line)}: {len(cells)} values, a line of Pix4D's geolocation has 4, 6, 7 or 9")
        values = [
            number(source.at(line, str(column)), cell, decimal_comma=comma) for column, cell in enumerate(cells[1:], 2)
        ]
        units = [across_m, across_m, up_m]
        if len(values) >= 6:
            units += [angle_deg] * 3
        units += [accuracy_m] * (len(values) - len(units))
        yield line, cells[0], [a * b for a, b in zip(values, units[: len(values)], strict=True)]


def _likely_angles(attitudes: np.ndarray) -> str:
    """Of images that look down, the heading turns: the last of omega, phi, kappa, the first of yaw, pitch, roll."""
    if not len(attitudes):
        return "ypr"
    turned = np.median(np.abs(attitudes), axis=0) + np.std(attitudes, axis=0)
    return "opk" if turned[2] > turned[0] else "ypr"


def _row(
    line: int, name: str, values: Sequence[float], kind: PositionKind, exchanged: bool, form: AttitudeKind
) -> PoseRow:
    first, second, height = values[:3]
    angles = tuple(values[3:6]) if len(values) >= 6 else None
    across_m, up_m = values[-2:] if len(values) in (5, 8) else (None, None)
    return PoseRow(
        image=image_name(name), line=line, position=(second, first, height) if exchanged else (first, second, height),
        position_kind=kind, attitude=angles, attitude_kind=form if angles else "none",
        forward=False if angles and form == "yaw_pitch_roll" else None,
        true_north=bool(angles) and form == "yaw_pitch_roll",
        sigmas_m=completed_sigmas_m(z_m=up_m, across_m=across_m),
    )  # fmt: skip


read_as_opk, read_as_ypr = partial(read_geolocation, angles="opk"), partial(read_geolocation, angles="ypr")


def is_camera_parameters(source: Source) -> bool:
    return any("camera position t" in line.lower() or "fileName imageWidth" in line for line in source.lines[:8])


def read_camera_parameters(source: Source) -> PoseList:
    """Raises ConfigError with file and line."""
    offset, remarks = np.zeros(3), []
    beside = next(iter(sorted(source.path.parent.glob("*_offset.xyz"))), None)
    if beside is not None:
        offset = np.array(numbers(str(beside), Source(beside).text.split(), ("x", "y", "z")))
    else:
        remarks.append(f"{source.path.name}: no *_offset.xyz beside it: positions count from the project's offset")
    cameras, known = CameraShelf(source.path.name), dict[str, str]()
    records = [(line, text) for line, text in source.records() if line > 8]
    rows = []
    for start in range(0, len(records), _LINES_OF_IMAGE):
        part = records[start : start + _LINES_OF_IMAGE]
        line, head = part[0]
        name = head.rsplit(maxsplit=2)[0]
        if len(part) < _LINES_OF_IMAGE or not IMAGE.fullmatch(name):
            raise ConfigError(f"{source.at(line)}: an image has ten lines here, beginning with name, width and height")
        lens = _lens(source, head, part)
        key = known.setdefault(repr(lens), f"camera{len(known)}")
        cameras.add(key, lens)
        center = numbers(source.at(part[6][0]), part[6][1].split(), ("t1", "t2", "t3"))
        matrix = [numbers(source.at(n), text.split(), ("r1", "r2", "r3")) for n, text in part[7:10]]
        rows.append(rotation_row(name, line, offset + center, np.array(matrix), camera=cameras.key(key)))
    if not rows:
        raise ConfigError(f"{source.path}: no image follows the eight lines of the header")
    remarks += cameras.remarks
    title = "Pix4D calibrated camera parameters"
    return PoseList(tuple(rows), "grid", tuple(remarks), title, None, cameras.found)


def _lens(source: Source, head: str, part: Sequence[tuple[int, str]]) -> Nearest:
    """Of the ten lines of an image. Raises ConfigError with file and line."""

    def values(place: int, names: Sequence[str]) -> list[float]:
        return numbers(source.at(part[place][0]), part[place][1].split(), names)

    width, height = numbers(source.at(part[0][0]), head.split()[-2:], ("imageWidth", "imageHeight"))
    (fx, _, cx), (_, fy, cy) = values(1, ("fx", "0", "cx")), values(2, ("0", "fy", "cy"))
    tangential = values(5, ("T1", "T2"))
    size = int(width), int(height)
    return brown(size, (fx, fy), (cx, cy), values(4, ("R1", "R2", "R3")), (tangential[0], tangential[1]))
