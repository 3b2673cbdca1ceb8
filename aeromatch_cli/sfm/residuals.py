"""Residuals of the adjusted block: its poses beside those given, and the reprojection errors of each image."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from aeromatch_cli.data import AdjustedBlock, Camera, FloatArray, Image, IntArray, Pose, PoseResidual
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.results.adjustment import PoseResiduals, Worst
from aeromatch_cli.sfm.block_figures import images_per_point

_UNKNOWN = np.full(3, np.nan)


def residuals_of(
    adjusted: AdjustedBlock,
    given: Mapping[str, Pose],
    images: Iterable[Image],
    keypoints_px: Callable[[str], FloatArray],
) -> dict[str, PoseResidual]:
    """Return image_id -> residuals of every adjusted image, in the order of `images`.

    given: image_id -> pose as it was given, in the world of the adjusted block. keypoints_px: image_id -> (K, 2) stored
    pixels that the tracks point into.
    """
    seen = images_per_point(adjusted)
    found = {}
    for image in images:
        if image.image_id in adjusted.poses:
            camera = adjusted.cameras[image.camera_id]
            # In a frame of its own an image lies nowhere beside what was given.
            known = None if image.image_id in adjusted.frames else given.get(image.image_id)
            found[image.image_id] = _residual(adjusted, image.image_id, camera, known, keypoints_px, seen)
    return found


def _residual(
    adjusted: AdjustedBlock,
    image_id: str,
    camera: Camera,
    given: Pose | None,
    keypoints_px: Callable[[str], FloatArray],
    seen: IntArray,
) -> PoseResidual:
    """seen: (P,) images of each point."""
    pose, track = adjusted.poses[image_id], adjusted.tracks.get(image_id, np.zeros((0, 2), np.int32))
    position_m, position_sigmas, rotation_deg, rotation_sigmas = (_UNKNOWN,) * 4
    if given is not None:
        position_m = pose.center_m - given.center_m
        position_sigmas = position_m / given.axis_sigmas_m
        if given.world_rotation is not None:
            from scipy.spatial.transform import Rotation

            turn = Rotation.from_matrix(pose.rotation.T @ given.world_rotation)
            rotation_deg = np.asarray(turn.as_rotvec(degrees=True))
            rotation_sigmas = rotation_deg / given.sigma_angle_deg
    error_px = images_per_point = float("nan")
    if len(track):
        places_px = project(camera, pose.rotation, pose.center_m, adjusted.points_m[track[:, 1]])
        errors_px = np.linalg.norm(places_px - np.asarray(keypoints_px(image_id), np.float64)[track[:, 0]], axis=1)
        error_px, images_per_point = float(np.mean(errors_px)), float(np.mean(seen[track[:, 1]]))
    return PoseResidual(
        position_m, position_sigmas, rotation_deg, rotation_sigmas, error_px, len(track), images_per_point
    )


def residual_figures(residuals: Mapping[str, PoseResidual], names: Mapping[str, str]) -> PoseResiduals:
    """Summarise the residuals of all images. names: of the files, by image_id. The worst image is that with the longest
    residual."""
    figures: dict[str, Any] = {"images": len(residuals)}
    for key in ("position_m", "position_sigmas", "rotation_deg", "rotation_sigmas"):
        values = {i: getattr(one, key) for i, one in residuals.items() if np.isfinite(getattr(one, key)).all()}
        table = np.array(list(values.values())).reshape(-1, 3)
        figures[f"{key}_rms"] = _rounded(np.sqrt((table**2).mean(axis=0))) if len(table) else None
        figures[f"{key}_median"] = _rounded(np.median(np.abs(table), axis=0)) if len(table) else None
        figures[f"{key}_worst"] = _worst({i: float(np.linalg.norm(v)) for i, v in values.items()}, names)
        figures[f"{key.partition('_')[0]}s"] = len(table)
    errors = {i: one.error_px for i, one in residuals.items() if np.isfinite(one.error_px)}
    figures["error_px_median"] = float(_rounded([np.median(list(errors.values()))])[0]) if errors else None
    figures["error_px_worst"] = _worst(errors, names)
    return PoseResiduals(**figures)


def _rounded(values: Iterable[float]) -> list[float]:
    return [float(f"{value:.4g}") for value in values]


def _worst(values: Mapping[str, float], names: Mapping[str, str]) -> Worst | None:
    """The image with the largest value; None of none."""
    if not values:
        return None
    worst = max(values, key=lambda image_id: values[image_id])
    return Worst(names.get(worst, worst), _rounded([values[worst]])[0])
