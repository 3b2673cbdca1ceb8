"""BlocksExchange XML of Bentley (ContextCapture, iTwin) and Metashape.

`Pose/Rotation` is cam_from_world in the camera axes that `CameraOrientation` names (XRightYDown unless it says
otherwise), as M_00 to M_22 or as Omega, Phi, Kappa with M = (Rx(omega) Ry(phi) Rz(kappa))'; `Center` is in the spatial
reference system of the block or photo group, x being the easting or longitude. The photo group is the camera:
`PrincipalPoint` counts from the centre of the first pixel; distortion is Brown's, with P1 and P2 exchanged against
OpenCV's p1 and p2 (P1 goes with r^2 + 2 u^2); Skew is in pixels.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from aeromatch_cli.blocks.pose_files.geodesy import StatedCrs, described_crs
from aeromatch_cli.blocks.pose_files.source import CameraShelf, Source, number, rotation_row
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.lenses import Nearest, brown
from aeromatch_cli.geometry.rotations import rotation_x, rotation_y, rotation_z
from aeromatch_cli.words import counted

# Directions in OpenCV's camera axes.
_DIRECTIONS = {"Right": (1.0, 0.0, 0.0), "Left": (-1.0, 0.0, 0.0), "Down": (0.0, 1.0, 0.0), "Up": (0.0, -1.0, 0.0)}


def is_blocks_exchange(source: Source) -> bool:
    return source.xml is not None and source.xml.tag == "BlocksExchange"


def read_blocks_exchange(source: Source) -> PoseList:
    """Raises ConfigError naming the photo."""
    root = source.xml_root()
    systems = {srs.findtext("Id"): srs.findtext("Definition") or "" for srs in root.iter("SRS")}
    rows: list[PoseRow] = []
    found: dict[str, StatedCrs] = {}
    cameras = CameraShelf(source.path.name)
    unposed = 0
    groups = [(block, group) for block in root.iter("Block") for group in block.iter("Photogroup")]
    for count, (block, group) in enumerate(groups):
        key = f"group{count}"
        cameras.add(key, _lens(group))
        identifier = group.findtext("SRSId") or block.findtext("SRSId")
        definition = systems.get(identifier, "") if identifier else ""
        system = described_crs(str(source.path), definition) if definition else StatedCrs()
        axes = _cam_from_axes(source, group.findtext("CameraOrientation") or "XRightYDown")
        for photo in group.iter("Photo"):
            if photo.find("Pose/Center") is None:
                unposed += 1
                continue
            found[system.name] = system
            rows.append(_row(source, photo, len(rows) + 1, system, axes, cameras.key(key)))
    if len(found) > 1:
        raise ConfigError(f"{source.path}: photo groups are in different reference systems: export them in one")
    if not rows:
        raise ConfigError(f"{source.path}: no photo of this BlocksExchange file has a pose")
    _, system = found.popitem()
    crs, kind = system.crs, system.kind
    remarks = [*system.remarks]
    if unposed:
        remarks.append(f"{source.path.name}: {counted(unposed, 'photo has', 'photos have')} no pose there")
    words = crs or ("degrees" if kind == "geographic" else "local frame")
    remarks += cameras.remarks
    title = f"BlocksExchange, {words}"
    return PoseList(tuple(rows), kind, tuple(remarks), title, crs, cameras.found, system.heights)


def _row(source: Source, photo: Any, number: int, system: StatedCrs, axes: FloatArray, camera: str) -> PoseRow:
    """Return what a photo with a centre says. axes: (3, 3) camera from the axes of its group; camera: of the group."""
    path = (photo.findtext("ImagePath") or "").replace("\\", "/")
    x, y, z = (_value(source, path, photo.find("Pose/Center"), axis) for axis in "xyz")
    at = system.position(f"{source.path}, photo {path}", x, y, z)
    rotation = _rotation(source, path, photo.find("Pose/Rotation"))
    cam = None if rotation is None else axes @ rotation
    return rotation_row(_short(path), number, at, cam, system.kind, camera=camera)


def _lens(group: Any) -> Nearest | None:
    """The camera of a photo group, in axes that go right and down; None where it is incomplete."""

    def number_of(path: str, otherwise: float | None = None) -> float:
        text = group.findtext(path)
        if text is None and otherwise is not None:
            return otherwise
        return float(text)

    if (group.findtext("CameraModelType") or "Perspective").strip() != "Perspective":
        return Nearest(None)
    try:
        size = int(number_of("ImageDimensions/Width")), int(number_of("ImageDimensions/Height"))
        if group.find("FocalLengthPixels") is not None:
            focal = number_of("FocalLengthPixels")
        else:
            focal = number_of("FocalLength") * max(size) / number_of("SensorSize")
        middle = (
            number_of("PrincipalPoint/x", (size[0] - 1) / 2.0) + 0.5,
            number_of("PrincipalPoint/y", (size[1] - 1) / 2.0) + 0.5,
        )
        radial = [number_of(f"Distortion/K{k}", 0.0) for k in (1, 2, 3)]
        tangential = number_of("Distortion/P2", 0.0), number_of("Distortion/P1", 0.0)
        ratio, skew = number_of("AspectRatio", 1.0), number_of("Skew", 0.0)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    if not focal > 0.0 or min(size) < 1:
        return None
    return brown(size, (focal, focal * ratio), middle, radial, tangential, skew)


def _short(path: str) -> str:
    """The path without a drive or a root; its folders tell images of one name apart."""
    return re.sub(r"^([A-Za-z]:)?/+", "", path)


def _value(source: Source, photo: str, element: Any, key: str) -> float:
    return number(f"{source.path}, photo {photo}, {key}", element.findtext(key) or "")


def _rotation(source: Source, photo: str, element: Any) -> FloatArray | None:
    """M; None where the photo has no rotation."""
    if element is None:
        return None
    if element.find("M_00") is not None:
        return np.array([[_value(source, photo, element, f"M_{i}{j}") for j in range(3)] for i in range(3)])
    if element.find("Omega") is not None:
        omega, phi, kappa = (_value(source, photo, element, key) for key in ("Omega", "Phi", "Kappa"))
        return (rotation_x(omega) @ rotation_y(phi) @ rotation_z(kappa)).T
    raise ConfigError(
        f"{source.path}, photo {photo}: the rotation is neither a matrix nor Omega, Phi, Kappa: export one of these"
    )


def _cam_from_axes(source: Source, orientation: str) -> FloatArray:
    match = re.fullmatch(r"X(Right|Left|Up|Down)Y(Right|Left|Up|Down)", orientation.strip())
    if match is None:
        raise ConfigError(f"{source.path}: CameraOrientation {orientation!r} is unknown, it is such as XRightYDown")
    x, y = (np.array(_DIRECTIONS[word]) for word in match.groups())
    return np.column_stack([x, y, np.cross(x, y)])
