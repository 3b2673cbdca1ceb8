"""COLMAP: images.txt, images.bin, or the folder that has one of them; cameras.txt or cameras.bin beside.

`IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME` and a line of points, which may be empty. The quaternion is
cam_from_world (Hamilton, scalar first) in OpenCV's axes; the projection centre is -R't. The world has no CRS.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from aeromatch_cli.blocks.camera_files import read_camera_file
from aeromatch_cli.blocks.pose_files.source import CameraShelf, Source, numbers, rotation_row, world_beside
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.lenses import Nearest, of_colmap
from aeromatch_cli.geometry.rotations import from_quaternion
from aeromatch_cli.words import counted

_FLOAT = r"[-+0-9.eE]+"
_IMAGE = re.compile(rf"\d+[ ,]+(?:{_FLOAT}[ ,]+){{7}}\d+[ ,]+\S.*[A-Za-z_./].*")
_POINTS = re.compile(rf"(?:{_FLOAT}[ ,]+{_FLOAT}[ ,]+-?\d+(?:[ ,]+|$))+")
_NAMES = ("IMAGE_ID", "QW", "QX", "QY", "QZ", "TX", "TY", "TZ", "CAMERA_ID")
# COLMAP's numbers of the models that are known here, and how many parameters all of them have.
_MODEL_IDS = {0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV", 5: "OPENCV_FISHEYE",
              6: "FULL_OPENCV"}  # fmt: skip
_PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12}


def is_model(source: Source) -> bool:
    if source.is_folder:
        return source.beside("images.txt", "images.bin") is not None
    if source.name == "images.bin":
        return True
    first = next((line for _, line in source.records()), "")
    return bool(_IMAGE.fullmatch(first))


def read_model(source: Source) -> PoseList:
    """Raises ConfigError with file and line, or byte."""
    images = (source.beside("images.bin", "images.txt") or source) if source.is_folder else source
    binary = images.name.endswith(".bin")
    cameras = _cameras(images)
    rows = tuple(_binary_rows(images, cameras) if binary else _text_rows(images, cameras))
    if not rows:
        raise ConfigError(f"{images.path}: the model has no image")
    known = f", {counted(len(cameras.found), 'camera')}" if cameras.found else ""
    crs, origin_m = world_beside(source)  # of a model that this program has exported
    if crs is not None:
        rows = tuple(
            replace(row, position=(row.position[0] + origin_m[0], row.position[1] + origin_m[1],
                                   row.position[2] + origin_m[2]))
            for row in rows if row.position is not None
        )  # fmt: skip
        known += f", {crs} by world.json"
    return PoseList(rows, "grid", tuple(cameras.remarks), f"COLMAP {images.path.name}{known}", crs, cameras.found)


def _text_rows(source: Source, cameras: CameraShelf) -> Iterator[PoseRow]:
    points = False  # whether the next line holds the points of the image before
    for line, text in enumerate(source.lines, start=1):
        if text.lstrip().startswith("#"):
            continue
        if points:
            points = False
            if not _IMAGE.fullmatch(text.strip()) or _POINTS.fullmatch(text.strip()):
                continue
        elif not text.strip():
            continue
        fields = re.split(r"\s*,\s*|\s+", text.strip(), maxsplit=9)
        values = numbers(source.at(line), fields, _NAMES)
        if len(fields) < 10:
            raise ConfigError(f"{source.at(line)}: no NAME behind CAMERA_ID")
        yield _row(source, line, values[1:8], fields[8], fields[9], cameras)
        points = True


def _row(
    source: Source, line: int, pose: list[float] | tuple[float, ...], camera: str, name: str, cameras: CameraShelf
) -> PoseRow:
    try:
        rotation = from_quaternion(*pose[:4])
    except ValueError as error:
        raise ConfigError(f"{source.at(line)}, column QW: {error}") from error
    center = -rotation.T @ np.array(pose[4:7])
    return rotation_row(name, line, center, rotation, camera=cameras.key(camera))


def _binary_rows(source: Source, cameras: CameraShelf) -> Iterator[PoseRow]:
    raw, place = source.raw, 8
    try:
        (count,) = struct.unpack_from("<Q", raw, 0)
        for row in range(1, count + 1):
            _, *pose, camera = struct.unpack_from("<i7di", raw, place)
            place += 4 + 56 + 4
            end = raw.index(b"\0", place)
            name = raw[place:end].decode("utf-8")
            (points,) = struct.unpack_from("<Q", raw, end + 1)
            place = end + 9 + 24 * points
            yield _row(source, row, pose, str(camera), name, cameras)
    except (struct.error, ValueError, OverflowError) as error:
        raise ConfigError(f"{source.path}, byte {place}: not COLMAP's images.bin ({error})") from error


def _cameras(images: Source) -> CameraShelf:
    """Those beside the images whose model is known here."""
    found = images.beside("cameras.bin" if images.name.endswith(".bin") else "cameras.txt")
    cameras = CameraShelf("" if found is None else found.path.name)
    if found is None:
        return cameras
    if found.name.endswith(".txt"):
        content = read_camera_file(found.path)
        return CameraShelf(found.path.name, dict(content.cameras), list(content.remarks))
    raw, place = found.raw, 8
    try:
        (count,) = struct.unpack_from("<Q", raw, 0)
        for _ in range(count):
            identifier, model, width, height = struct.unpack_from("<iiQQ", raw, place)
            place += 24
            parameters = struct.unpack_from(f"<{_PARAMETERS[model]}d", raw, place)
            place += 8 * _PARAMETERS[model]
            known = _MODEL_IDS.get(model)
            cameras.add(str(identifier), of_colmap(known, width, height, parameters) if known else Nearest(None))
    except (struct.error, KeyError, ValueError, OverflowError) as error:
        raise ConfigError(f"{found.path}, byte {place}: not COLMAP's cameras.bin ({error!r})") from error
    return cameras
