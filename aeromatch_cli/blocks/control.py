"""Ground control points: ODM's gcp_list.txt.

First line: the CRS of the coordinates, as a code (EPSG:32633), a PROJ string, or "WGS84 UTM 33N". Then one line for
every point in every image, separated by blanks or tabs:

  geo_x geo_y geo_z im_x im_y image_name [gcp_name] [check]

im_x, im_y: pixels from the upper left corner of the image. A point without a name is known by its coordinates. A point
with the word "check" (or "checkpoint") behind its name takes no part in the transformation. Lines that start with # are
comments.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aeromatch_cli.blocks.cameras import listed
from aeromatch_cli.blocks.crs import LOCAL
from aeromatch_cli.data import ControlPoint, FloatArray, Image, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import given_bytes
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX

# Control points so many extents of the block, and so many metres more, from its middle are elsewhere.
_FAR_EXTENTS, _FAR_M = 5.0, 2000.0
_CHECK = ("check", "checkpoint", "check_point")
_COLUMNS = "geo_x geo_y geo_z im_x im_y image_name [gcp_name] [check]"


def read_control(
    name: str, images: tuple[Image, ...], crs: str, origin_m: tuple[float, float, float]
) -> tuple[tuple[ControlPoint, ...], list[str]]:
    """Points in the world frame, and remarks on images that the block does not have; nothing of no file ("").

    crs, origin_m: of the block; a local block takes the coordinates as they are. Raises ConfigError with file and line
    where the file is malformed, or its CRS cannot be brought to the block's.
    """
    if not name:
        return (), []
    path = Path(name)
    lines = [(n, line.strip()) for n, line in enumerate(_text(path).splitlines(), start=1)]
    lines = [(n, line) for n, line in lines if line and not line.startswith("#")]
    if len(lines) < 2:
        raise ConfigError(f"{path}: no control points: the first line names the CRS, then {_COLUMNS}")
    alike = Counter(Path(image.name).name for image in images)
    ids = {base: image.image_id for image in images if alike[base := Path(image.name).name] == 1}
    ids |= {image.name: image.image_id for image in images}
    rows = [_row(path, number, line) for number, line in lines[1:]]
    positions = _to_block(path, lines[0][1], crs, np.array([row.position for row in rows])) - np.array(origin_m)
    places: dict[str, FloatArray] = {}
    pixels: dict[str, dict[str, FloatArray]] = {}
    for row, position_m in zip(rows, positions, strict=True):
        if not np.allclose(places.setdefault(row.name, position_m), position_m):
            raise ConfigError(f"{path}, line {row.line}: {row.name} has other coordinates than before: one is wrong")
        seen = pixels.setdefault(row.name, {})
        if row.image in ids:
            seen[ids[row.image]] = np.array(row.pixel) - COLMAP_OFFSET_PX
    checks = {row.name for row in rows if row.check}
    points = tuple(ControlPoint(name, place_m, name in checks, pixels[name]) for name, place_m in places.items())
    if unclear := sorted({row.image for row in rows if row.image not in ids and alike[row.image] > 1}):
        raise ConfigError(f"{path}: several images are called {unclear[0]}: write paths relative to the images folder")
    absent = sorted({row.image for row in rows} - ids.keys())
    count = f"{len(absent)} image{'s' if len(absent) > 1 else ''}"
    return points, [f"{path.name} names {count} that the block does not have: {listed(absent)}"] if absent else []


def far_control(points: Sequence[ControlPoint], poses: Mapping[str, Pose], name: str) -> list[str]:
    """One sentence where control points lie far outside the block: in another CRS, or with exchanged columns."""
    if len(points) == 0 or len(poses) < 2:
        return []
    places_m = np.array([pose.center_m[:2] for pose in poses.values()])
    middle_m = np.median(places_m, axis=0)
    extent_m = float(np.linalg.norm(np.ptp(places_m, axis=0)))
    apart_m = float(np.linalg.norm(np.median([point.position_m[:2] for point in points], axis=0) - middle_m))
    if apart_m <= _FAR_EXTENTS * extent_m + _FAR_M:
        return []
    return [
        f"the control points of {Path(name).name} lie {apart_m / 1000.0:,.1f} km from the images: is the CRS in its "
        "first line right, or are x and y exchanged?"
    ]


@dataclass(frozen=True)
class _Row:
    line: int
    position: tuple[float, ...]
    pixel: tuple[float, ...]
    image: str
    name: str
    check: bool


def _text(path: Path) -> str:
    try:
        return given_bytes(path).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        said = getattr(error, "strerror", None) or "not UTF-8 text"
        raise ConfigError(f"control points {path} cannot be read ({said}): give ODM's gcp_list.txt") from error


def _row(path: Path, number: int, line: str) -> _Row:
    cells = [cell.strip() for cell in line.split("\t")] if "\t" in line else line.split()
    if len(cells) < 6:
        raise ConfigError(f"{path}, line {number}: {len(cells)} columns, expected {_COLUMNS}")
    try:
        values = tuple(float(cell) for cell in cells[:5])
    except ValueError as error:
        raise ConfigError(f"{path}, line {number}: {error}: expected {_COLUMNS}") from error
    extras = [cell.lower() for cell in cells[6:]]
    name = cells[6] if len(cells) > 6 and extras[0] not in _CHECK else " ".join(cells[:3])
    return _Row(number, values[:3], values[3:], cells[5], name, any(extra in _CHECK for extra in extras))


def _to_block(path: Path, stated: str, crs: str, positions: FloatArray) -> FloatArray:
    """Positions (N, 3) in the block's CRS; heights stay as they are."""
    if crs == LOCAL:
        return positions
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError

    try:
        source = CRS.from_user_input(_code(stated))
    except CRSError as error:
        raise ConfigError(
            f"{path}, line 1: {stated!r} is no CRS: write a code such as EPSG:32633, or WGS84 UTM 33N"
        ) from error
    x, y = Transformer.from_crs(source.to_2d(), crs, always_xy=True).transform(positions[:, 0], positions[:, 1])
    return np.column_stack([x, y, positions[:, 2]])


def _code(stated: str) -> str:
    """A code or PROJ string; "WGS84 UTM 33N" becomes a code."""
    utm = re.fullmatch(r"WGS\s*84\s+UTM\s+(\d{1,2})\s*([NS])", stated, re.IGNORECASE)
    if utm is None:
        return stated
    return f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}"
