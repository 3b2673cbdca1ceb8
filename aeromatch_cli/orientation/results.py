"""What a pycolmap model holds, as arrays for the process that asked for it: poses, points, tracks and precision.

Image numbers are those of the database, from 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.orientation.precision import Observations, pose_sigmas

# No coordinate of a keypoint is measured more exactly, in pixels.
_LEAST_ERROR_PX = 0.03
# Errors of points behind a camera are as large as a number can be.
BEHIND_PX = 1e6


def image_numbers(model: Any) -> list[int]:
    return sorted(int(image_id) for image_id, image in model.images.items() if image.has_pose)


def centers_of(model: Any, ids: list[int]) -> FloatArray:
    return np.array([model.images[i].projection_center() for i in ids])


def points_of(model: Any) -> FloatArray:
    return np.array([model.points3D[i].xyz for i in sorted(model.points3D)]).reshape(-1, 3)


def arrays(model: Any) -> dict[str, Any]:
    """What the parent reads: see `mapping.Model`."""
    ids, point_ids = image_numbers(model), sorted(model.points3D)
    model.update_point_3d_errors()
    points = [model.points3D[i] for i in point_ids]
    cameras = sorted(model.cameras)
    return {
        "images": np.array(ids),
        "rotations": np.array([model.images[i].cam_from_world().rotation.matrix() for i in ids]),
        "centers_m": centers_of(model, ids),
        "cameras": np.array(cameras),
        "points_m": points_of(model),
        "errors_px": np.array([point.error for point in points]),
        **{f"params{i}": np.array(model.cameras[i].params) for i in cameras},
    }


def tracks_of(model: Any) -> dict[str, Any]:
    """Which keypoints see the points: (M,) image numbers, keypoints of these, and rows of `points_m`."""
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


def sigmas_of(
    model: Any, sigmas_m: FloatArray, cameras: dict[str, Any], attitudes_deg: Mapping[int, float], level_deg: float
) -> dict[str, Any]:
    """Standard deviations (N, 3) of the poses of `arrays`: x, y, z in metres and omega, phi, kappa in degrees.

    sigmas_m: of the observed positions, by number, NaN where there is none. attitudes_deg: those of the observed
    attitudes. level_deg: of the block's tilt, see `pose_sigmas`.
    """
    ids, tracks, lenses = image_numbers(model), tracks_of(model), sorted(model.cameras)
    known = np.isin(tracks["track_images"], ids)
    seen = Observations(
        image=np.searchsorted(ids, tracks["track_images"][known]),
        point=tracks["track_points"][known],
        camera=np.array([lenses.index(model.images[i].camera_id) for i in ids]),
        rotations=np.array([model.images[i].cam_from_world().rotation.matrix() for i in ids]),
        centers_m=centers_of(model, ids),
        focal_px=np.array([model.cameras[k].mean_focal_length() for k in lenses]),
        points_m=points_of(model),
        error_px=_error_px(model),
    )
    given_m = np.where(np.isfinite(sigmas_m), sigmas_m, np.inf)[np.array(ids) - 1]
    given_deg = np.array([attitudes_deg.get(i, np.inf) for i in ids])
    focal = np.array([cameras[str(k)]["sigma"] for k in lenses])
    of_position, of_angles = pose_sigmas(seen, given_m, given_deg, focal, level_deg)
    return {"sigmas_m": of_position, "sigmas_deg": of_angles}


def _error_px(model: Any) -> float:
    """Standard deviation of a keypoint's coordinate, from the residuals and what the unknowns have taken from them.

    Distances of normally distributed residuals have the mean sqrt(pi / 2) times the standard deviation of a coordinate.
    Points behind a camera tell nothing.
    """
    coordinates = 2 * model.compute_num_observations()
    unknowns = 3 * model.num_points3D() + 6 * model.num_reg_images()
    taken = np.sqrt(coordinates / max(coordinates - unknowns, 1))
    points = [(point.error, len(point.track.elements)) for point in model.points3D.values() if point.error < BEHIND_PX]
    errors_px, counts = np.array(points).reshape(-1, 2).T
    spread_px = float(errors_px @ counts / max(counts.sum(), 1.0)) / np.sqrt(np.pi / 2.0)
    return max(float(spread_px * taken), _LEAST_ERROR_PX)


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
