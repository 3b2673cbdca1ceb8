"""The workspace's CSV tables: images, cameras, poses, pairs."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from aeromatch_cli.data import (
    Camera,
    FloatArray,
    Image,
    Pair,
    PictureQuality,
    Pose,
)
from aeromatch_cli.formats.reading import readable
from aeromatch_cli.geometry.rotations import from_quaternion, to_quaternion

T = TypeVar("T")
_QUATERNION_DIGITS = 14
_QUALITY_DIGITS = 4
_NONE: Mapping[str, PictureQuality] = MappingProxyType({})


def csv_text(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """CSV with every float at full precision; NaN and None become empty."""
    return "".join(",".join(map(_cell, row)) + "\n" for row in (header, *rows))


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    text = repr(float(value)) if isinstance(value, float) else str(value)
    # csv.writer leaves a lone carriage return unquoted, and the reader would end the row there.
    if any(mark in text for mark in ',"\r\n'):
        return '"' + text.replace('"', '""') + '"'
    return text


def read_csv(path: Path) -> list[dict[str, str]]:
    """Rows of a workspace CSV. Raises BrokenFileError when it is missing or broken."""
    with readable(path, ValueError, csv.Error), path.open(encoding="utf-8", newline="") as stream:
        reader = csv.DictReader(stream)
        if reader.fieldnames is None:
            raise ValueError("it is empty")
        rows = list(reader)
        if any(None in row or None in row.values() for row in rows):
            raise ValueError("a row has not as many cells as the header")
        return rows


def images_text(
    images: Iterable[Image], fingerprints: Mapping[str, str], quality: Mapping[str, PictureQuality] = _NONE
) -> str:
    columns = ("image_id", "name", "width_px", "height_px", "camera_id", "exif_orientation", "time")
    unknown = (None,) * len(PictureQuality._fields)
    rows = (
        (
            *(getattr(image, name) for name in columns),
            fingerprints[image.image_id],
            *(cell if isinstance(cell, str) else _short(cell) for cell in quality.get(image.image_id, unknown)),
        )
        for image in images
    )
    return csv_text((*columns, "fingerprint", *PictureQuality._fields), rows)


def _short(value: float | None) -> float | None:
    return None if value is None else round(value, _QUALITY_DIGITS)


def read_picture_quality(path: Path) -> dict[tuple[str, str], PictureQuality]:
    """By image_id and fingerprint of the file; pictures that were not measured are absent."""
    return {
        (row["image_id"], row["fingerprint"]): quality
        for row in read_csv(path)
        if (quality := _quality(path, row)) is not None
    }


def _quality(path: Path, row: Mapping[str, str]) -> PictureQuality | None:
    cells = [row.get(name, "") for name in PictureQuality._fields]
    if not cells[1]:  # of an earlier version, or not read
        return None
    with readable(path, ValueError):
        blur, black, white = (float(cell or "nan") for cell in cells[:3])
        return PictureQuality(blur, black, white, *cells[3:])


def cameras_text(cameras: Mapping[str, Camera]) -> str:
    rows = (
        (k, c.model, c.width_px, c.height_px, " ".join(repr(float(p)) for p in c.params))
        for k, c in sorted(cameras.items())
    )
    return csv_text(("camera_id", "model", "width_px", "height_px", "params"), rows)


def poses_text(poses: Mapping[str, Pose]) -> str:
    header = ("image_id", "x", "y", "z", "qw", "qx", "qy", "qz", "sigma_position_m", "sigma_angle_deg")
    rows = []
    for image_id, pose in sorted(poses.items()):
        q: Sequence[float | None] = (None,) * 4 if pose.world_rotation is None else _settled(pose.world_rotation)
        rows.append((image_id, *map(float, pose.center_m), *q, pose.sigma_position_m, pose.sigma_angle_deg))
    return csv_text(header, rows)


def _settled(rotation: FloatArray) -> tuple[float, ...]:
    """A quaternion that stays the same to the last digit when it is read and written again: results depend on poses."""
    found = _rounded(rotation)
    for _ in range(20):  # one or two in practice
        again = _rounded(from_quaternion(*found))
        if again == found:
            break
        found = again
    return found


def _rounded(rotation: FloatArray) -> tuple[float, ...]:
    return tuple(round(value, _QUATERNION_DIGITS) for value in to_quaternion(rotation))


def pairs_text(pairs: Iterable[Pair]) -> str:
    header = ("image_id0", "image_id1", "overlap", "view_angle_deg", "reason")
    return csv_text(header, ((p.image_id0, p.image_id1, p.overlap, p.view_angle_deg, p.reason) for p in pairs))


def _parsed(path: Path, parse: Callable[[Mapping[str, str]], T]) -> list[T]:
    """Rows of a workspace CSV, parsed. Raises BrokenFileError also where a cell cannot be parsed."""
    with readable(path, KeyError, ValueError, TypeError, AttributeError):
        return [parse(row) for row in read_csv(path)]


def read_images(path: Path) -> tuple[Image, ...]:
    return tuple(_parsed(path, _image))


def _image(row: Mapping[str, str]) -> Image:
    return Image(
        row["image_id"],
        row["name"],
        int(row["width_px"]),
        int(row["height_px"]),
        row["camera_id"],
        int(row["exif_orientation"]),
        row["time"],
    )


def read_cameras(path: Path) -> dict[str, Camera]:
    return dict(_parsed(path, _camera))


def _camera(row: Mapping[str, str]) -> tuple[str, Camera]:
    params = tuple(float(value) for value in row["params"].split())
    return row["camera_id"], Camera(row["model"], int(row["width_px"]), int(row["height_px"]), params)


def read_poses(path: Path) -> dict[str, Pose]:
    return dict(_parsed(path, _pose))


def _pose(row: Mapping[str, str]) -> tuple[str, Pose]:
    rotation = from_quaternion(*(float(row[k]) for k in ("qw", "qx", "qy", "qz"))) if row["qw"] else None
    center = np.array([float(row[key]) for key in "xyz"])
    return row["image_id"], Pose(center, rotation, float(row["sigma_position_m"]), float(row["sigma_angle_deg"]))


def read_pairs(path: Path) -> list[Pair]:
    return _parsed(path, _pair)


def _pair(row: Mapping[str, str]) -> Pair:
    overlap, angle = float(row["overlap"] or "nan"), float(row["view_angle_deg"] or "nan")
    return Pair(row["image_id0"], row["image_id1"], overlap, angle, row["reason"])
