"""Images of a model that are turned over: seen from afar, ground that is about level shows nearly the same from one
side as, tilted as much, from the opposite one.

A mapper takes either: what it knows of an image is some dozen of points, and the wrong pose fits them to a few pixels.
The given positions tell which one it is, else the errors that are left once all poses are adjusted to each.
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
from aeromatch_cli.orientation.placing import Placement
from aeromatch_cli.orientation.results import centers_of, image_numbers

# An image so many standard deviations from its position may be turned over, and is where its other pose brings it
# nearer than this share of the distance.
_FAR_SIGMAS, _NEARER = 5.0, 0.5
# The other pose fits the image's points to so many pixels by the median: they lie where the wrong one has put them.
_FITS_PX = 8.0
# The model may fit so much worse with images turned back by positions: wrong poses are found because they fit.
_WORSE = 1.2
# Without positions images are tried whose other pose fits so many times as well, and which differs by so many degrees;
# so many at most, those first that fit worst as they are. Turned back they have to fit to this share of the errors.
_ALIKE, _DIFFERENT_DEG, _MOST_TRIED, _BETTER = 2.0, 10.0, 10, 0.8
# Fewer points leave a pose open.
_LEAST_POINTS = 6

Adjust = Callable[[Any], Placement]


def turned_back(
    pycolmap: ModuleType,
    model: Any,
    placement: Placement,
    positions_m: FloatArray,
    sigmas_m: FloatArray,
    adjust: Adjust,
) -> tuple[Any, Placement]:
    """The model and its placement without images that are turned over, by their positions or by their errors.

    positions_m (N, 3), sigmas_m (N,): one row per image number. adjust: adjusts and places a model.
    """
    if placement.kind != "level":
        model, placement = _by_positions(pycolmap, model, placement, positions_m, sigmas_m, adjust)
    return _by_errors(pycolmap, model, placement, adjust)


def _by_positions(
    pycolmap: ModuleType,
    model: Any,
    placement: Placement,
    positions_m: FloatArray,
    sigmas_m: FloatArray,
    adjust: Adjust,
) -> tuple[Any, Placement]:
    far = [i for i in image_numbers(model) if _off_m(model, i, positions_m) > _FAR_SIGMAS * sigmas_m[i - 1]]
    trial, turned = copy.deepcopy(model) if far else model, []
    for number in far:
        before_m, before = _off_m(trial, number, positions_m), trial.images[number].cam_from_world()
        other = _Other.of(pycolmap, trial, number)
        if other is not None and other.error_px < _FITS_PX:
            other.take(trial)
            if _off_m(trial, number, positions_m) < _NEARER * before_m:
                turned.append(number)
            else:
                trial.images[number].frame.set_cam_from_world(trial.images[number].camera_id, before)
    if not turned:
        return model, placement
    found = adjust(trial)
    for one in (model, trial):
        one.update_point_3d_errors()
    worse = trial.compute_mean_reprojection_error() > _WORSE * model.compute_mean_reprojection_error()
    nearer = all(_off_m(trial, i, positions_m) < _NEARER * _off_m(model, i, positions_m) for i in turned)
    return (trial, found) if nearer and not worse and found.kind != "level" else (model, placement)


def _by_errors(pycolmap: ModuleType, model: Any, placement: Placement, adjust: Adjust) -> tuple[Any, Placement]:
    others = [_Other.of(pycolmap, model, number) for number in image_numbers(model)]
    doubtful = [o for o in others if o is not None and o.error_px < _ALIKE * o.present_px]
    for number in [o.number for o in sorted(doubtful, key=lambda o: -o.present_px)[:_MOST_TRIED]]:
        trial = copy.deepcopy(model)
        other = _Other.of(pycolmap, trial, number)
        if other is None:
            continue
        other.take(trial)
        found = adjust(trial)
        if found.kind == placement.kind and _error_px(trial, number) < _BETTER * _error_px(model, number):
            model, placement = trial, found
    return model, placement


def _off_m(model: Any, number: int, positions_m: FloatArray) -> float:
    return float(np.linalg.norm(centers_of(model, [number])[0] - positions_m[number - 1]))


def _error_px(model: Any, number: int) -> float:
    """Mean error, in all their images, of the points that an image sees."""
    model.update_point_3d_errors()
    seen = [model.points3D[p.point3D_id].error for p in model.images[number].points2D if p.has_point3D()]
    return float(np.mean(seen)) if seen else np.inf


@dataclass(frozen=True, eq=False)
class _Other:
    """The other pose of an image, and the median errors of its points by that and by the present one."""

    number: int
    pose: Any
    error_px: float
    present_px: float

    @classmethod
    def of(cls, pycolmap: ModuleType, model: Any, number: int) -> _Other | None:
        """None where an image has no other pose that its points lead to."""
        image = model.images[number]
        seen = [(p.xy, model.points3D[p.point3D_id].xyz) for p in image.points2D if p.has_point3D()]
        if len(seen) < _LEAST_POINTS:
            return None
        pixels, points_m = (np.array(values, dtype=np.float64) for values in zip(*seen, strict=True))
        camera, present = model.cameras[image.camera_id], image.cam_from_world()
        start = pycolmap.Rigid3d(other_pose(present.matrix(), points_m))
        if _apart_deg(start, present) < _DIFFERENT_DEG:  # it looks straight down
            return None
        found = pycolmap.refine_absolute_pose(start, pixels, points_m, np.ones(len(pixels), dtype=bool), camera)
        pose = None if found is None else found["cam_from_world"]
        if pose is None or _apart_deg(pose, present) < _DIFFERENT_DEG:
            return None
        errors_px = [np.linalg.norm(camera.img_from_cam(one * points_m) - pixels, axis=1) for one in (pose, present)]
        return cls(number, pose, float(np.median(errors_px[0])), float(np.median(errors_px[1])))

    def take(self, model: Any) -> None:
        """Give the image of a model this pose."""
        image = model.images[self.number]
        image.frame.set_cam_from_world(image.camera_id, self.pose)


def _apart_deg(pose: Any, other: Any) -> float:
    return angle_between_deg(pose.rotation.matrix(), other.rotation.matrix())


def other_pose(pose: FloatArray, points_m: FloatArray) -> FloatArray:
    """(3, 4) cam_from_world of the other pose from which points (N, 3), about in a plane, look nearly the same.

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
