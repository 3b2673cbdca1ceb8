"""A pycolmap model as a network, and back: its image points, poses, points and lenses.

Numbers are those of the database, from 1. pycolmap's pixels count from the corner of the first, a network's from its
centre. pycolmap's models have no skew and no rolling shutter: lenses are kept beside the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX
from aeromatch_cli.sfm.bundle.network import LENS, Unknowns

Lenses = dict[int, FloatArray]


def image_numbers(model: Any) -> list[int]:
    return sorted(int(image_id) for image_id, image in model.images.items() if image.has_pose)


def image_points(model: Any, images: list[int], points: list[int]) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Return, for M image points, rows of the images, rows of the points, keypoints, and (M, 2) pixels from the
    centre of the first one."""
    row = {number: k for k, number in enumerate(images)}
    seen: list[tuple[int, int, int]] = []
    for k, number in enumerate(points):
        elements = model.points3D[number].track.elements
        seen += [(row[e.image_id], k, e.point2D_idx) for e in elements if e.image_id in row]
    image, point, keypoint = np.array(seen, dtype=np.int64).reshape(-1, 3).T
    xy_px = np.empty((len(image), 2))
    order = np.argsort(image, kind="stable")
    for k, own in zip(*_grouped(image[order], order), strict=True):
        places = model.images[images[k]].points2D
        xy_px[own] = [places[n].xy for n in keypoint[own].tolist()]
    return image, point, keypoint, xy_px - COLMAP_OFFSET_PX


def _grouped(values: IntArray, order: IntArray) -> tuple[list[int], list[IntArray]]:
    """Different values of a sorted array, and what belongs to each."""
    different, starts = np.unique(values, return_index=True)
    return different.tolist(), np.split(order, starts[1:]) if len(starts) else []


def lens_of(camera: Any) -> FloatArray:
    """Return the values (12,), by LENS, of a pycolmap camera."""
    values = dict.fromkeys(LENS, 0.0)
    named = dict(zip(camera.params_info.replace(" ", "").split(","), camera.params.tolist(), strict=True))
    f = named.pop("f", 0.0)
    named = {"fx": f, "fy": f, "k": 0.0} | named
    values |= {"f": named["fy"], "b1": named["fx"] - named["fy"], "k1": named["k"]}
    values |= {name: named[name] for name in ("k1", "k2", "k3", "p1", "p2") if name in named}
    values |= {"p1": named["k4"]} if camera.model.name == "OPENCV_FISHEYE" else {}
    values |= {name: named[name] - COLMAP_OFFSET_PX for name in ("cx", "cy")}
    return np.array([values[name] for name in LENS])


def set_lens(pycolmap: ModuleType, camera: Any, lens: FloatArray, fisheye: bool) -> None:
    """Give a pycolmap camera the values (12,), but for what it has no parameter for."""
    f, cx, cy, k1, k2, k3, p1, p2, b1 = lens[:9].tolist()
    head = [f + b1, f, cx + COLMAP_OFFSET_PX, cy + COLMAP_OFFSET_PX]
    name = "OPENCV_FISHEYE" if fisheye else "FULL_OPENCV"
    if camera.model.name != name:
        camera.model = getattr(pycolmap.CameraModelId, name)
    camera.params = head + ([k1, k2, k3, p1] if fisheye else [k1, k2, p1, p2, k3, 0.0, 0.0, 0.0])


def unknowns_of(
    model: Any, images: list[int], points: list[int], lens: FloatArray, mounts: int, flights: int
) -> Unknowns:
    """Return the unknowns of a pycolmap model. lens: (K, 12)."""
    poses = [model.images[i].cam_from_world() for i in images]
    rotations = np.array([pose.rotation.matrix() for pose in poses]).reshape(-1, 3, 3)
    shifts = np.array([pose.translation for pose in poses]).reshape(-1, 3)
    points_m = np.array([model.points3D[i].xyz for i in points]).reshape(-1, 3)
    centers_m = -np.einsum("nji,nj->ni", rotations, shifts)
    return Unknowns(rotations, centers_m, points_m, lens, np.zeros((mounts, 6)), np.zeros((flights, 6)))


def take(
    pycolmap: ModuleType,
    model: Any,
    images: list[int],
    points: list[int],
    state: Unknowns,
    cameras: Mapping[int, tuple[FloatArray, bool]],
) -> None:
    """Give a model the poses, points and lenses of a network. cameras: number -> lens and whether it is a fisheye."""
    for number, (lens, fisheye) in cameras.items():
        set_lens(pycolmap, model.cameras[number], lens, fisheye)
    for number, rotation, center_m in zip(images, state.rotations, state.centers_m, strict=True):
        image = model.images[number]
        pose = pycolmap.Rigid3d(np.column_stack([rotation, -rotation @ center_m]))
        image.frame.set_cam_from_world(image.camera_id, pose)
    for number, point_m in zip(points, state.points_m, strict=True):
        model.points3D[number].xyz = point_m
