"""Points of a pycolmap model that say of its poses what all of them say: few, and all over every image.

Poses and cameras of a block of 8000 keypoints an image are over-determined a hundredfold, and what limits them are no
random errors: an adjustment of a spread part of the points gives poses as exact in half the time. All points are
triangulated afterwards.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.sfm.bundle.of_model import image_numbers
from aeromatch_cli.sfm.model_arrays import rows_by_number, tracks_of

# Cells of an image along its sides, and points in each.
_COLUMNS, _ROWS, _IN_A_CELL = 10, 8, 5
# Tracks of so many images are as good as longer ones.
_ENOUGH_IMAGES = 3
# A part that is not much smaller is not worth a second triangulation.
_WORTH = 0.6


def thinned(model: Any) -> Any | None:
    """Return a copy with the chosen points alone; None where these are most of them."""
    chosen = chosen_points(model)
    if chosen.sum() > _WORTH * len(chosen):
        return None
    thin = copy.deepcopy(model)
    for number, keep in zip(sorted(model.points3D), chosen.tolist(), strict=True):
        if not keep:
            thin.delete_point3D(number)
    return thin


def chosen_points(model: Any) -> BoolArray:
    """Choose (P,), in the order of the points' numbers, some points of every cell of every image that three images see,
    or more."""
    tracks = tracks_of(model)
    images, keypoints, points = (tracks[f"track_{name}"] for name in ("images", "keypoints", "points"))
    seen = np.bincount(points, minlength=model.num_points3D())
    # By chance: the longest tracks are those that something is wrong with more often than with others.
    rank = np.minimum(seen, _ENOUGH_IMAGES) + np.random.default_rng(0).random(len(seen))
    keep = np.zeros(len(rank), dtype=bool)
    of_image = rows_by_number(images)
    for number in sorted(of_image):
        own, image = of_image[number], model.images[number]
        camera = model.cameras[image.camera_id]
        places = np.array([image.points2D[k].xy for k in keypoints[own].tolist()]).reshape(-1, 2)
        keep[points[own[_spread(places, rank[points[own]], camera.width, camera.height)]]] = True
    return keep


def _spread(places_px: FloatArray, rank: FloatArray, width_px: int, height_px: int) -> IntArray:
    """Rows of places (N, 2) that are kept: of every cell those of the highest rank (N,)."""
    cell = np.clip(places_px * (_COLUMNS, _ROWS) // (width_px, height_px), 0, (_COLUMNS - 1, _ROWS - 1)).astype(int)
    index = cell[:, 1] * _COLUMNS + cell[:, 0]
    order = np.lexsort((-rank, index))
    ordered = index[order]
    first = np.searchsorted(ordered, ordered, side="left")
    return np.asarray(order[np.arange(len(order)) - first < _IN_A_CELL])


def take_poses(model: Any, thin: Any) -> None:
    """Take poses and cameras of the thinned copy for the model; its points stay where they were."""
    for number in thin.cameras:
        model.cameras[number].params = thin.cameras[number].params
    for number in image_numbers(thin):
        image = model.images[number]
        image.frame.set_cam_from_world(image.camera_id, thin.images[number].cam_from_world())
