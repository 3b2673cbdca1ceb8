"""COLMAP's text model of a block: the adjusted cameras, poses and points, else the given poses without points."""

from __future__ import annotations

import signal
import threading
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from aeromatch_cli.data import AdjustedBlock, Block, Camera, FloatArray, Image
from aeromatch_cli.geometry.cameras import colmap_camera
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX
from aeromatch_cli.geometry.rotations import to_quaternion
from aeromatch_cli.strategies.exporters.contents import ExportContents

_NO_POINT = -1


@dataclass(frozen=True)
class Numbers:
    """COLMAP numbers, from 1, in the order of the sorted ids. Rigs are numbered like cameras, frames like images."""

    image: dict[str, int]
    camera: dict[str, int]

    @classmethod
    def of(cls, block: Block) -> Numbers:
        image = {name: number for number, name in enumerate(sorted(i.image_id for i in block.images), start=1)}
        camera = {name: number for number, name in enumerate(sorted(block.cameras), start=1)}
        return cls(image, camera)


def import_pycolmap() -> ModuleType:
    # pycolmap 4.2.1 aborts the process when its own zlib is initialised before Python's.
    zlib.compress(b"")
    # Importing it replaces the handler of SIGTERM by one that prints a stack and dies: no clean-up, no resume message.
    before = signal.getsignal(signal.SIGTERM)
    import pycolmap

    pycolmap.logging.minloglevel = 2  # what it would warn of is raised and said here in words
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    return pycolmap


def write_model(contents: ExportContents, cameras: Mapping[str, Camera], ids: Numbers, sparse: Path) -> int:
    """cameras.txt, images.txt and points3D.txt in the new folder `sparse`; returns the number of images with a pose.

    cameras: by camera_id, those that COLMAP can hold.
    """
    sparse.mkdir()
    block, adjusted = contents.block, contents.adjusted
    posed = _posed_images(block) if adjusted is None else _adjusted_images(block, adjusted)
    (sparse / "cameras.txt").write_text(_cameras_text(cameras, ids), encoding="utf-8")
    with (sparse / "images.txt").open("w", encoding="utf-8") as stream:
        stream.write("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n")
        for image, world_rotation, center_m in posed:
            values = (*to_quaternion(world_rotation), *(-world_rotation @ center_m))
            numbers = " ".join(f"{value:.17g}" for value in values)
            stream.write(f"{ids.image[image.image_id]} {numbers} {ids.camera[image.camera_id]} {image.name}\n")
            stream.write("" if adjusted is None else _observations(contents, adjusted, image.image_id))
            stream.write("\n")
    with (sparse / "points3D.txt").open("w", encoding="utf-8") as stream:
        if adjusted is None:
            stream.write("# Empty: points are triangulated by COLMAP.\n")
        else:
            stream.writelines(_point_lines(adjusted, ids))
    if any(letter.isspace() for image, _, _ in posed for letter in image.name):
        # COLMAP reads names from text up to the first space; its binary model, which it prefers, keeps them whole.
        reconstruction = import_pycolmap().Reconstruction()
        reconstruction.read_text(sparse)
        for image, _, _ in posed:
            reconstruction.images[ids.image[image.image_id]].name = image.name
        reconstruction.write_binary(sparse)
    return len(posed)


def _posed_images(block: Block) -> list[tuple[Image, FloatArray, FloatArray]]:
    """Image, world_rotation (3, 3) and centre (3,) of every image whose position and attitude are known."""
    posed = []
    for image in block.images:
        pose = block.poses.get(image.image_id)
        if pose is not None and pose.world_rotation is not None:
            posed.append((image, pose.world_rotation, pose.center_m))
    return posed


def _adjusted_images(block: Block, adjusted: AdjustedBlock) -> list[tuple[Image, FloatArray, FloatArray]]:
    found = ((image, adjusted.poses.get(image.image_id)) for image in block.images)
    return [(image, pose.rotation, pose.center_m) for image, pose in found if pose is not None]


def _cameras_text(cameras: Mapping[str, Camera], ids: Numbers) -> str:
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for camera_id, number in ids.camera.items():
        camera = cameras[camera_id]
        model, values = colmap_camera(camera)
        params = " ".join(f"{value:.17g}" for value in values)
        lines.append(f"{number} {model} {camera.width_px} {camera.height_px} {params}")
    return "\n".join(lines) + "\n"


def _observations(contents: ExportContents, adjusted: AdjustedBlock, image_id: str) -> str:
    """Every keypoint, as in the database, with the number of its point."""
    keypoints = np.asarray(contents.keypoints_px(image_id), dtype=np.float32).reshape(-1, 2) + COLMAP_OFFSET_PX
    points = np.full(len(keypoints), _NO_POINT)
    track = adjusted.tracks[image_id]
    points[track[:, 0]] = track[:, 1] + 1
    return " ".join(f"{x:.9g} {y:.9g} {point}" for (x, y), point in zip(keypoints, points, strict=True))


def _point_lines(adjusted: AdjustedBlock, ids: Numbers) -> Iterator[str]:
    """Points are numbered from 1 and grey: their colour is not known."""
    yield "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    images = np.concatenate(
        [np.zeros(0, int), *(np.full(len(track), ids.image[i]) for i, track in adjusted.tracks.items())]
    )
    rows = np.concatenate([np.zeros((0, 2), int), *adjusted.tracks.values()])
    order = np.lexsort((rows[:, 0], images, rows[:, 1]))
    images, rows = images[order], rows[order]
    starts = np.searchsorted(rows[:, 1], np.arange(len(adjusted.points_m) + 1))
    for number, (point, error) in enumerate(zip(adjusted.points_m, adjusted.errors_px, strict=True)):
        own = slice(starts[number], starts[number + 1])
        track = " ".join(f"{image} {keypoint}" for image, keypoint in zip(images[own], rows[own, 0], strict=True))
        place = " ".join(f"{value:.17g}" for value in point)
        yield f"{number + 1} {place} 128 128 128 {error:.9g} {track}\n"
