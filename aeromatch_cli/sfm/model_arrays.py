"""This module turns a pycolmap model into arrays for the process that asked for it: poses, points and tracks.

Image numbers are those of the database, from 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.sfm.bundle.of_model import image_numbers

# Errors of points behind a camera are as large as a number can be.
BEHIND_PX = 1e6


def centers_of(model: Any, ids: list[int]) -> FloatArray:
    return np.array([model.images[i].projection_center() for i in ids])


def rotations_of(model: Any, ids: list[int]) -> FloatArray:
    """Return cam_from_world (N, 3, 3) of the images of a model."""
    return np.array([model.images[i].cam_from_world().rotation.matrix() for i in ids]).reshape(-1, 3, 3)


def points_of(model: Any) -> FloatArray:
    return np.array([model.points3D[i].xyz for i in sorted(model.points3D)]).reshape(-1, 3)


def arrays(model: Any, lenses: Mapping[int, FloatArray]) -> dict[str, Any]:
    """Return the arrays of a model that the parent process reads: see `mapping.Model`. lenses: (12,) values by camera
    number, of those that have images."""
    ids, point_ids = image_numbers(model), sorted(model.points3D)
    points = [model.points3D[i] for i in point_ids]
    cameras = sorted(lenses)
    return {
        "images": np.array(ids),
        "rotations": rotations_of(model, ids),
        "centers_m": centers_of(model, ids),
        "cameras": np.array(cameras),
        "points_m": points_of(model),
        "errors_px": np.array([point.error for point in points]),
        **{f"lens{i}": lenses[i] for i in cameras},
    }


def tracks_of(model: Any) -> dict[str, Any]:
    """Return which keypoints see the points: (M,) image numbers, keypoints of these images, and rows of `points_m`."""
    images, keypoints, rows = [], [], []
    for row, number in enumerate(sorted(model.points3D)):
        elements = model.points3D[number].track.elements
        images += [element.image_id for element in elements]
        keypoints += [element.point2D_idx for element in elements]
        rows += [row] * len(elements)
    return {
        "track_images": np.array(images, np.int32),
        "track_keypoints": np.array(keypoints, np.int32),
        "track_points": np.array(rows, np.int32),
    }


def figures(model: Any) -> dict[str, Any]:
    """Counts and errors of a model, JSON-ready. Points behind a camera, whose errors are not finite, do not count."""
    errors_px = np.array([point.error for point in model.points3D.values()])
    errors_px = errors_px[errors_px < BEHIND_PX]
    return {
        "images": model.num_reg_images(),
        "points": model.num_points3D(),
        "track_length": model.compute_mean_track_length(),
        "reprojection_error_px": float(errors_px.mean()) if len(errors_px) else None,
    }


def rows_by_number(numbers: IntArray) -> dict[int, IntArray]:
    """Return, by number, the rows (N,) of an array (M,) that hold it, in order."""
    order = np.argsort(numbers, kind="stable")
    values, starts = np.unique(numbers[order], return_index=True)
    return dict(zip(values.tolist(), np.split(order, starts[1:]), strict=True)) if len(values) else {}
