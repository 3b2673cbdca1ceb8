"""Tables of photogrammetric programs: lines without header (BINGO, ORIMA, MicMac's OriExport), PATB, Inpho's project.

Lines without header are `name x y z a1 a2 a3`. Nothing in them says what the angles are; omega, phi, kappa in degrees
are taken unless one is beyond 360, which only gon are, and --pose-format opk-gon, pok or pok-gon say otherwise.

BINGO's own records are `ORIA name x y z omega phi kappa`, in gon; others in the file are passed over.

PATB (three records of fixed width): number, x, y, z; a11 to a22; a23 to a33. Programs write the matrix in one direction
or the other: the one is taken by which the flight goes along a side of the images.

Inpho: $PHOTO ... $END with $PHOTO_FILE and $EXT_ORI: `focal x y z` and a matrix photo_from_world.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import PureWindowsPath

import numpy as np

from aeromatch_cli.blocks.fields import fields_of, with_name, words_of
from aeromatch_cli.blocks.pose_columns import has_header
from aeromatch_cli.blocks.pose_files.geodesy import StatedCrs, described_crs
from aeromatch_cli.blocks.pose_files.source import (
    Source,
    image_name,
    is_number,
    number,
    numbers,
    rotation_row,
    units_of_comments,
)
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.blocks.units import factor
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.frames import CAM_FROM_PHOTO
from aeromatch_cli.geometry.rotations import rotation_x, rotation_y, rotation_z

_NAMES = ("name", "x", "y", "z", "a1", "a2", "a3")
_GON_DEG = 0.9
_ORIA = "ORIA"
_FULL_DEG = 360.0
# A number of a strip or a camera, or a mark, behind the angles.
_FURTHER = re.compile(r"\d{1,6}")


def is_plain_table(source: Source) -> bool:
    if has_header(source.lines):
        return False
    records = [record for _, (_, record) in zip(range(3), source.records(), strict=False)]
    tables = [_without_further(with_name(fields_of(record)[0], 0)) for record in records]
    return bool(tables) and all(len(cells) == len(_NAMES) and all(map(is_number, cells[1:])) for cells in tables)


def _without_further(cells: list[str]) -> list[str]:
    """Without one whole number behind the angles."""
    return cells[:-1] if len(cells) == len(_NAMES) + 1 and _FURTHER.fullmatch(cells[-1]) else cells


def read_plain_table(source: Source, order: str = "", unit: str = "") -> PoseList:
    """order: "opk" or "pok". unit: "deg" or "gon". "" for what is usual. Raises ConfigError with line and column."""
    table = list(_plain_lines(source))
    angles = np.array([values[3:] for _, _, values, _ in table])
    said = units_of_comments(source)
    gon = unit == "gon" or (not unit and bool(len(angles)) and float(np.abs(angles).max()) > _FULL_DEG)
    one_deg = _GON_DEG if gon else 1.0
    if not unit and said.angle_deg is not None:
        one_deg = said.angle_deg
    metres = (said.across_m or 1.0, said.across_m or 1.0, said.up_m or 1.0)
    rows = []
    for (line, name, values, _), angles_deg in zip(table, angles * one_deg, strict=True):
        place = [a * b for a, b in zip(values, metres, strict=False)]
        rows.append(replace(_plain_row(line, name, place, angles_deg, order), numbered=is_number(name)))
    unit_words = {_GON_DEG: "gon", 1.0: "degrees"}.get(one_deg, "radians")
    words = f"{'phi, omega, kappa' if order == 'pok' else 'omega, phi, kappa'} in {unit_words}"
    remarks = []
    if not (order or unit):
        remarks.append(
            f"{source.path.name}: no header says what the angles are; they are read as {words}; --pose-format opk, "
            "opk-gon, pok or pok-gon reads them otherwise"
        )
    if any(further for *_, further in table):
        remarks.append(f"{source.path.name}: what stands behind the angles is not read")
    title = f"table without header, {words}"
    return PoseList(tuple(rows), "grid", (*remarks, *said.remarks(source)), title, heights=said.said.zero)


def _plain_lines(source: Source) -> Iterator[tuple[int, str, list[float], bool]]:
    """Yield the number, the image and the values of every line, and whether a number stands behind the angles."""
    for line, record in source.records():
        fields, comma = fields_of(record)
        named = with_name(fields, 0)
        cells = _without_further(named)
        if len(cells) != len(_NAMES):
            raise ConfigError(f"{source.at(line)}: {len(cells)} values instead of {', '.join(_NAMES)}")
        values = [
            number(source.at(line, name), cell, decimal_comma=comma)
            for name, cell in zip(_NAMES[1:], cells[1:], strict=True)
        ]
        yield line, cells[0], values, cells != named


def _plain_row(line: int, name: str, place: Sequence[float], angles_deg: FloatArray, order: str) -> PoseRow:
    """Return a row of a position (3,) in metres and of angles (3,) in an order: "pok", else omega, phi, kappa."""
    first, second, kappa = angles_deg
    if order == "pok":
        photo = rotation_y(first) @ rotation_x(second) @ rotation_z(kappa)
        return rotation_row(name, line, place, CAM_FROM_PHOTO @ photo.T)
    x, y, z = place
    return PoseRow(
        image=image_name(name), line=line, position=(x, y, z), position_kind="grid",
        attitude=(float(first), float(second), float(kappa)), attitude_kind="omega_phi_kappa",
    )  # fmt: skip


read_opk, read_opk_gon = (
    partial(read_plain_table, order="opk", unit="deg"),
    partial(read_plain_table, order="opk", unit="gon"),
)
read_pok, read_pok_gon = (
    partial(read_plain_table, order="pok", unit="deg"),
    partial(read_plain_table, order="pok", unit="gon"),
)


def is_oria(source: Source) -> bool:
    return any(
        record.split(maxsplit=1)[0] == _ORIA for _, (_, record) in zip(range(100), source.records(), strict=False)
    )


def read_oria(source: Source) -> PoseList:
    """Raises ConfigError with line and column."""
    rows, more, said = [], False, units_of_comments(source)
    metres = said.across_m or 1.0, said.across_m or 1.0, said.up_m or 1.0
    for line, record in source.records():
        cells = words_of(record)
        if cells[0] != _ORIA:
            continue
        values = numbers(source.at(line), cells[2:], ("x", "y", "z", "omega", "phi", "kappa"))
        more |= len(cells) > 2 + len(values)
        omega, phi, kappa = ((said.angle_deg or _GON_DEG) * angle for angle in values[3:])
        x, y, z = (value * one for value, one in zip(values, metres, strict=False))
        rows.append(
            PoseRow(
                image=image_name(cells[1]), line=line, position=(x, y, z),
                position_kind="grid", attitude=(omega, phi, kappa), attitude_kind="omega_phi_kappa",
                numbered=is_number(cells[1]),
            )
        )  # fmt: skip
    remarks = (f"{source.path.name}: what stands behind kappa in {_ORIA} is not read",) if more else ()
    title = f"BINGO, {_ORIA}, omega, phi, kappa in {'the unit of a comment' if said.angle_deg else 'gon'}"
    return PoseList(tuple(rows), "grid", (*remarks, *said.remarks(source)), title, heights=said.said.zero)


def is_patb(source: Source) -> bool:
    counts = [len(record.split()) for _, (_, record) in zip(range(6), source.records(), strict=False)]
    return len(counts) >= 3 and counts[:3] == [4, 5, 4] and counts[3:] == [4, 5, 4][: len(counts) - 3]


def read_patb(source: Source) -> PoseList:
    """Raises ConfigError with line and column."""
    records = list(source.records())
    if len(records) % 3:
        raise ConfigError(
            f"{source.path}: {len(records)} lines, a photo has three (number and centre, two of the matrix)"
        )
    names, lines, centers, matrices = [], [], [], []
    for start in range(0, len(records), 3):
        parts = [(line, record.split()) for line, record in records[start : start + 3]]
        for (line, cells), count in zip(parts, (4, 5, 4), strict=True):
            if len(cells) != count:
                raise ConfigError(f"{source.at(line)}: {len(cells)} values instead of {count}")
        (line, first), (line1, second), (line2, third) = parts
        names.append(first[0])
        lines.append(line)
        centers.append(numbers(source.at(line), first[1:], ("x", "y", "z")))
        matrix = numbers(source.at(line1), second, ("a11", "a12", "a13", "a21", "a22"))
        matrices.append(matrix + numbers(source.at(line2), third, ("a23", "a31", "a32", "a33")))
    places, photos = np.array(centers), np.array(matrices).reshape(-1, 3, 3)
    transposed = _along_track(places, photos.transpose(0, 2, 1)) > _along_track(places, photos)
    world_from_photo = photos.transpose(0, 2, 1) if transposed else photos
    rows = [
        replace(rotation_row(name, line, place, CAM_FROM_PHOTO @ matrix.T), numbered=is_number(name))
        for name, line, place, matrix in zip(names, lines, places, world_from_photo, strict=True)
    ]
    words = "matrix from ground to photo" if transposed else "matrix from photo to ground"
    return PoseList(tuple(rows), "grid", (), f"PATB, {words}")


def _along_track(centers_m: FloatArray, world_from_photo: FloatArray) -> float:
    """How well steps from photo to photo go along a side of the images: 1 for all, 0.5 and less for none."""
    steps = np.diff(centers_m, axis=0)
    lengths = np.linalg.norm(steps[:, :2], axis=1)
    far = lengths > 1e-6
    if not far.any():
        return 0.0
    towards = np.einsum("nij,ni->nj", world_from_photo[:-1][far], steps[far] / lengths[far, None])
    return float(np.median(np.abs(towards[:, :2]).max(axis=1)))


def is_inpho(source: Source) -> bool:
    return "$PHOTO_FILE" in source.text and "$EXT_ORI" in source.text


def _exterior_orientation(
    source: Source, line: int, following: Sequence[tuple[int, str]]
) -> tuple[Sequence[float], FloatArray]:
    """Return the centre and the matrix (3, 3) of the lines behind $EXT_ORI, which stands in `line`."""
    if len(following) < 4:
        raise ConfigError(f"{source.at(line)}: four lines follow $EXT_ORI: focal length and centre, and a matrix")
    (first, text), *others = following
    matrix = [numbers(source.at(number), row.split(), ("value",) * 3) for number, row in others]
    _, *center = numbers(source.at(first), text.split(), ("focal", "x", "y", "z"))
    return center, np.array(matrix)


def read_inpho(source: Source) -> PoseList:
    """Raises ConfigError with file and line."""
    turns = dict(_mounts(source.lines))
    system = StatedCrs()
    stated = re.search(r"\$COORDINATE_SYSTEM\s*:\s*(\S.*)", source.text)
    if stated and stated[1].strip().upper().startswith(("PROJCS", "PROJCRS", "EPSG", "GEOGCS", "GEOGCRS", "COMPD")):
        system = described_crs(str(source.path), stated[1])
    unit = re.search(r"\$LINEAR_UNITS_OBJECT\s*:\s*(\S.*)", source.text)
    if unit:
        one_m = factor(str(source.path), "$LINEAR_UNITS_OBJECT", unit[1].strip(), "length")
        system = replace(system, across_m=one_m, up_m=one_m)
    rows: list[PoseRow] = []
    name, camera = "", ""
    lines = list(source.records("%"))
    for place, (line, text) in enumerate(lines):
        key, _, value = (part.strip() for part in text.partition(":"))
        if key == "$PHOTO_FILE":
            path = PureWindowsPath(value.strip('"'))
            name = path.relative_to(path.anchor).as_posix()
        elif key == "$PHOTO_NUM" and not name:
            name = value
        elif key == "$CAMERA_ID":
            camera = value
        elif key == "$EXT_ORI":
            center, rotation = _exterior_orientation(source, line, lines[place + 1 : place + 5])
            photo_from_world = rotation_z(-turns.get(camera, 0.0)) @ rotation
            at = system.position(source.at(line), *center)
            rows.append(rotation_row(name, line, at, CAM_FROM_PHOTO @ photo_from_world, system.kind))
        elif key == "$END":
            name = ""
    if not rows:
        raise ConfigError(f"{source.path}: no photo of this Inpho project has $EXT_ORI: export it after orientation")
    words = system.name or "its coordinate system is not stated"
    return PoseList(
        tuple(rows), system.kind, system.remarks, f"Inpho project, {words}", system.crs, heights=system.heights
    )


def _mounts(lines: Sequence[str]) -> Iterator[tuple[str, float]]:
    """Camera -> $CAMERA_MOUNT_ROTATION in degrees."""
    camera = ""
    for text in lines:
        key, _, value = (part.strip() for part in text.partition(":"))
        if key == "$CAMERA_ID":
            camera = value
        elif key == "$CAMERA_MOUNT_ROTATION" and is_number(value):
            yield camera, float(value)
