"""Images of a model that are turned over: seen from afar, ground that is about level shows nearly the same from one
side as, tilted as much, from the opposite one.

A mapper takes either: what it knows of an image is some dozen of points, and the wrong pose fits them to a few pixels.
The errors that are left once all poses are adjusted to each tell which one it is. A block that needs it: rendered
suburb, flight `mixed`, seed 943, 7 images, noisy poses (0 of 7 attitudes within 2 degrees without it, 7 with it).
Source: of planar points an image has two poses with a small error each (Schweighofer and Pinz, Robust pose estimation
from a planar target, PAMI 2006); under weak perspective both fit alike.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import angle_between_deg
from aeromatch_cli.sfm.bundle.of_model import image_numbers
from aeromatch_cli.sfm.georeferencing import Placement
from aeromatch_cli.sfm.model_adjustment import MIN_OBSERVATIONS
from aeromatch_cli.sfm.model_arrays import BEHIND_PX, centers_of

# An image within so many standard deviations of its given position is not turned over.
_NEAR_SIGMAS = 5.0
# Others are tried if the other pose leaves at most so many times the median error of the present one, so many images at
# most, those first that fit worst; they are turned back if this share of the error is left after an adjustment.
_ALIKE, _MOST_TRIED, _BETTER = 2.0, 10, 0.8
# Poses nearer to each other are one and the same.
_DIFFERENT_DEG = 10.0

Adjust = Callable[[Any], Placement]


@dataclass(frozen=True, eq=False)
class Upright:
    """A model with its placement, and the numbers of the images that were turned back."""

    model: Any
    placement: Placement
    turned: tuple[int, ...] = ()


def turned_back(
    pycolmap: ModuleType,
    model: Any,
    placement: Placement,
    positions_m: FloatArray,
    sigmas_m: FloatArray,
    adjust: Adjust,
) -> Upright:
    """Return the model with images turned back that are turned over. Images near their given positions are not.

    positions_m (N, 3), sigmas_m (N,): one row per image number, NaN where there is none. adjust: adjusts and places a
    model.
    """
    found, ids = Upright(model, placement), image_numbers(model)
    if placement.kind != "level":
        centers_m, rows = centers_of(model, ids), np.array(ids) - 1
        near = np.linalg.norm(centers_m - positions_m[rows], axis=1) <= _NEAR_SIGMAS * sigmas_m[rows]
        ids = [i for i, is_near in zip(ids, near, strict=True) if not is_near]
    others = [_Other.of(pycolmap, model, number) for number in ids]
    doubtful = [other for other in others if other is not None and other.error_px < _ALIKE * other.present_px]
    for other in sorted(doubtful, key=lambda other: -other.present_px)[:_MOST_TRIED]:
        trial, number = copy.deepcopy(found.model), other.number
        # Where another image was turned back since, poses and points are others.
        now = _Other.of(pycolmap, trial, number) if found.turned else other
        if now is None:
            continue
        now.take(trial)
        placement = adjust(trial)
        better = _error_px(trial, number) < _BETTER * _error_px(found.model, number)
        if better and placement.kind == found.placement.kind:
            found = Upright(trial, placement, (*found.turned, number))
    return found


def _observed(model: Any, number: int) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) of an image's keypoints that see points, and these points (N, 3)."""
    seen = model.images[number].get_observation_points2D()
    points_m = [model.points3D[point.point3D_id].xyz for point in seen]
    return np.array([point.xy for point in seen]).reshape(-1, 2), np.array(points_m).reshape(-1, 3)


def _error_px(model: Any, number: int) -> float:
    """Median error of an image's own keypoints."""
    image = model.images[number]
    return _median_px(model.cameras[image.camera_id], image.cam_from_world(), *_observed(model, number))


def _median_px(camera: Any, pose: Any, pixels: FloatArray, points_m: FloatArray) -> float:
    """Median error of keypoints; a point behind the camera has no place, and is as far off as can be."""
    off_px = np.linalg.norm(camera.img_from_cam(pose * points_m) - pixels, axis=1)
    return float(np.median(np.nan_to_num(off_px, nan=BEHIND_PX))) if len(off_px) else BEHIND_PX


@dataclass(frozen=True, eq=False)
class _Other:
    """The other pose of an image, and the median errors of its keypoints by that and by the present one."""

    number: int
    pose: Any
    error_px: float
    present_px: float

    @classmethod
    def of(cls, pycolmap: ModuleType, model: Any, number: int) -> _Other | None:
        """Return the other pose of an image, None where its points lead to no other pose."""
        image, (pixels, points_m) = model.images[number], _observed(model, number)
        if len(pixels) < MIN_OBSERVATIONS:  # weak images leave the model in any case
            return None
        camera, present = model.cameras[image.camera_id], image.cam_from_world()
        start = pycolmap.Rigid3d(other_pose(present.matrix(), points_m))
        if _apart_deg(start, present) < _DIFFERENT_DEG:  # it looks straight down
            return None
        found = pycolmap.refine_absolute_pose(start, pixels, points_m, np.ones(len(pixels), dtype=bool), camera)
        pose = None if found is None else found["cam_from_world"]
        if pose is None or _apart_deg(pose, present) < _DIFFERENT_DEG:
            return None
        return cls(number, pose, *(_median_px(camera, one, pixels, points_m) for one in (pose, present)))

    def take(self, model: Any) -> None:
        """Give the image of a model this pose."""
        image = model.images[self.number]
        image.frame.set_cam_from_world(image.camera_id, self.pose)


def _apart_deg(pose: Any, other: Any) -> float:
    return angle_between_deg(pose.rotation.matrix(), other.rotation.matrix())


def other_pose(pose: FloatArray, points_m: FloatArray) -> FloatArray:
    """Return cam_from_world (3, 4) of the other pose from which points (N, 3), about in a plane, look nearly the same.

    Mirrored at the plane and in depth, about the middle of the points: what lies in the plane keeps its places across
    the line of sight, and nearer and farther are exchanged.
    """
    middle_m = points_m.mean(axis=0)
    normal = np.linalg.svd(points_m - middle_m, full_matrices=False)[2][-1]
    there = pose[:, :3] @ middle_m + pose[:, 3]
    sight = there / np.linalg.norm(there)
    depth, plane = (np.eye(3) - 2.0 * np.outer(axis, axis) for axis in (sight, normal))
    rotation = depth @ pose[:, :3] @ plane
    return np.column_stack([rotation, there - rotation @ middle_m])
