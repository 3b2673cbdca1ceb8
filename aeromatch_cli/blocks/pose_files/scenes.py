"""Reconstructions that are handed on for pictures: Bundler, NVM, NeRF's transforms.json. Their world has no CRS.

Bundler: p = R X + t with x right, y up, looking along -z; names in list.txt beside. NVM: `name f qw qx qy qz cx cy cz k
0`, cam_from_world in OpenCV's axes and the centre. transforms.json: 4 x 4 world_from_camera with OpenGL's axes;
nerfstudio's applied_transform and applied_scale are undone.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from aeromatch_cli.blocks.pose_files.source import CameraShelf, Source, number, numbers, rotation_row
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.frames import CAM_FROM_PHOTO
from aeromatch_cli.geometry.lenses import Nearest, brown, fisheye
from aeromatch_cli.geometry.rotations import from_quaternion

_NVM = ("f", "qw", "qx", "qy", "qz", "x", "y", "z")


def is_bundler(source: Source) -> bool:
    return bool(source.lines) and source.lines[0].startswith("# Bundle file")


def read_bundler(source: Source) -> PoseList:
    """Raises ConfigError with the line, and where list.txt is missing."""
    names_file = source.beside("list.txt", f"{source.path.stem}.list.txt", "list_focal.txt")
    if names_file is None:
        raise ConfigError(f"{source.path}: Bundler's file has no image names: put its list.txt beside it")
    names = [line.split()[0] for _, line in names_file.records()]
    records = list(source.records())
    count = int(numbers(source.at(records[0][0]), records[0][1].split(), ("cameras",))[0])
    if count != len(names):
        raise ConfigError(
            f"{source.path} has {count} cameras, {names_file.path} {len(names)} names: they do not belong together"
        )
    if len(records) < 1 + 5 * count:
        raise ConfigError(f"{source.path}: {count} cameras of five lines each are announced, the file ends before")
    rows = []
    for place, name in enumerate(names):
        lines = records[1 + 5 * place : 6 + 5 * place]
        focal, *matrix, shift = (numbers(source.at(n), text.split(), ("1", "2", "3")) for n, text in lines)
        if focal[0] <= 0.0:
            continue
        bundler = np.array(matrix)
        rows.append(rotation_row(name, lines[0][0], -bundler.T @ np.array(shift), CAM_FROM_PHOTO @ bundler))
    return _list(source, rows, f"Bundler, {len(rows)} of {count} cameras registered")


def is_nvm(source: Source) -> bool:
    return bool(source.lines) and source.lines[0].startswith("NVM_V3")


def read_nvm(source: Source) -> PoseList:
    """The first model. Raises ConfigError with the line."""
    records = list(source.records())
    place = next((p for p, (_, text) in enumerate(records[1:], 1) if len(text.split()) == 1), len(records) - 1)
    line, text = records[place]
    count = int(number(source.at(line, "number of cameras"), text))
    rows = []
    for line, text in records[place + 1 : place + 1 + count]:
        name, *cells = text.split("\t") if "\t" in text else text.split()
        cells = " ".join(cells).split()
        _, *pose = numbers(source.at(line), cells, _NVM)
        try:
            rotation = from_quaternion(*pose[:4])
        except ValueError as error:
            raise ConfigError(f"{source.at(line)}, column qw: {error}") from error
        rows.append(rotation_row(name, line, pose[4:], rotation))
    return _list(source, rows, f"NVM, {len(rows)} cameras of the first model")


def is_transforms(source: Source) -> bool:
    frames = source.tree.get("frames") if isinstance(source.tree, dict) else None
    return isinstance(frames, list) and bool(frames) and "transform_matrix" in frames[0]


def read_transforms(source: Source) -> PoseList:
    """Raises ConfigError naming the frame."""
    tree = source.tree
    applied = np.eye(4)
    try:
        scale = float(tree.get("applied_scale", 1.0))
        if "applied_transform" in tree:
            applied[:3] = np.array(tree["applied_transform"], dtype=np.float64).reshape(-1, 4)[:3]
        turn = np.linalg.inv(applied)
    except (TypeError, ValueError, OverflowError, np.linalg.LinAlgError) as error:
        raise ConfigError(f"{source.path}: applied_transform or applied_scale is malformed ({error})") from error
    rows: list[PoseRow] = []
    cameras = CameraShelf(source.path.name)
    for count, frame in enumerate(tree["frames"], start=1):
        where = f"{source.path}, frame {count}"
        try:
            matrix = np.array(frame["transform_matrix"], dtype=np.float64).reshape(-1, 4)[:3].reshape(3, 4)
            name = str(frame["file_path"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ConfigError(f"{where}: no file_path and transform_matrix of 4 x 4 ({error!r})") from error
        center = turn[:3, :3] @ (matrix[:, 3] / scale) + turn[:3, 3]
        world_from_photo = turn[:3, :3] @ matrix[:, :3]
        lens = _lens(tree | frame)
        key = ""
        if lens is not None:
            of_frame = {"fl_x", "camera_angle_x"} & frame.keys()
            key = f"camera{count}" if of_frame else "camera"
        cameras.add(key, lens)
        short = name.rsplit("images/", 1)[-1]
        rows.append(rotation_row(short, count, center, CAM_FROM_PHOTO @ world_from_photo.T, camera=cameras.key(key)))
    return _list(source, rows, "transforms.json", cameras)


def _lens(facts: dict[str, Any]) -> Nearest | None:
    try:
        width, height = int(facts["w"]), int(facts["h"])
        half_rad = 0.5 * float(facts.get("camera_angle_x", "nan"))
        fx = float(facts["fl_x"]) if "fl_x" in facts else 0.5 * width / math.tan(half_rad)
        fy = float(facts.get("fl_y", fx))
        middle = float(facts.get("cx", width / 2.0)), float(facts.get("cy", height / 2.0))
        radial = [float(facts.get(name, 0.0)) for name in ("k1", "k2", "k3", "k4")]
        tangential = float(facts.get("p1", 0.0)), float(facts.get("p2", 0.0))
    except (KeyError, TypeError, ValueError, OverflowError, ZeroDivisionError):
        return None
    if not math.isfinite(fx):
        return None
    if facts.get("camera_model") == "OPENCV_FISHEYE":
        return fisheye((width, height), (fx, fy), middle, radial)
    return brown((width, height), (fx, fy), middle, radial, tangential)


def _list(source: Source, rows: list[PoseRow], words: str, cameras: CameraShelf | None = None) -> PoseList:
    if not rows:
        raise ConfigError(f"{source.path}: no camera is oriented there")
    remarks, found = (cameras.remarks, cameras.found) if cameras is not None else ([], {})
    return PoseList(tuple(rows), "grid", tuple(remarks), f"{words}, local frame", None, found)
