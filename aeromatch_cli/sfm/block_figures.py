"""Figures of an adjusted block: sizes, errors, how many images hold each other, and the residuals of every image."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from aeromatch_cli.data import AdjustedBlock, Camera, FloatArray, Image, IntArray, Pose, PoseResidual
from aeromatch_cli.geometry.cameras import corner_params, focal_px
from aeromatch_cli.geometry.components import component_labels
from aeromatch_cli.geometry.reprojection import with_points
from aeromatch_cli.results.adjustment import GroupResult, PoseResiduals, Worst
from aeromatch_cli.results.stages import FEW_POINTS, AdjustedCamera

_UNKNOWN = np.full(3, np.nan)


def block_figures(adjusted: AdjustedBlock, images: Iterable[Image], groups: Sequence[GroupResult]) -> dict[str, Any]:
    """Return fields of AdjustResult that describe the block as a whole. groups: the results of each."""
    placed = [pose for image_id, pose in adjusted.poses.items() if image_id not in adjusted.frames]
    seen = images_per_point(adjusted)
    held = [int((seen[track[:, 1]] >= 3).sum()) for track in adjusted.tracks.values()]
    return {
        "images": len(adjusted.poses),
        "points": len(adjusted.points_m),
        "track_length": round(adjusted.observations / max(1, len(adjusted.points_m)), 3),
        "held_by_pairs": sum(count < FEW_POINTS for count in held),
        "tied_parts": tied_parts(adjusted),
        "reprojection_error_px": mean_error_px(adjusted),
        "ground_pixel_m": _ground_pixel_m(adjusted, {image.image_id: image.camera_id for image in images}),
        # No length is a metre in a frame of a group's own.
        "sigma_position_m": _median([float(np.mean(pose.sigmas_m)) for pose in placed]),
        "sigma_angle_deg": _median([float(np.mean(pose.sigmas_deg)) for pose in adjusted.poses.values()]),
        "groups": list(groups),
        "cameras": {
            camera_id: AdjustedCamera(
                camera.model, camera.width_px, camera.height_px, [*map(float, corner_params(camera))]
            )
            for camera_id, camera in sorted(adjusted.cameras.items())
        },
    }


def mean_error_px(adjusted: AdjustedBlock) -> float | None:
    """Return the mean reprojection error of the points of a block, pixels; None without points."""
    return round(float(np.mean(adjusted.errors_px)), 4) if len(adjusted.errors_px) else None


def images_per_point(adjusted: AdjustedBlock) -> IntArray:
    """Count the images that see each point of the block, (P,)."""
    seen = np.zeros(len(adjusted.points_m), dtype=np.int64)
    for track in adjusted.tracks.values():
        seen[np.unique(track[:, 1])] += 1
    return seen


def tied_parts(adjusted: AdjustedBlock) -> list[int]:
    """Return the sizes of the parts of the block within which images are connected by pairs that share 20 points, the
    largest first."""
    from scipy import sparse

    tracks = [np.unique(track[:, 1]) for track in adjusted.tracks.values()]
    if not tracks:
        return []
    ends = np.cumsum([0, *map(len, tracks)])
    seen = sparse.csr_matrix(
        (np.ones(ends[-1]), np.concatenate(tracks), ends), shape=(len(tracks), len(adjusted.points_m))
    )
    part = component_labels(len(tracks), np.column_stack((seen @ seen.T >= FEW_POINTS).nonzero()))
    return sorted(np.bincount(part).tolist(), reverse=True)


def _ground_pixel_m(adjusted: AdjustedBlock, camera_ids: Mapping[str, str]) -> float | None:
    """Return the size of a pixel on the ground, metres: the median over the images that positions have placed of the
    distance of their points over the focal length; None without any."""
    sizes = []
    for image_id, pose in adjusted.poses.items():
        track = adjusted.tracks.get(image_id)
        if track is not None and len(track) and image_id not in adjusted.frames:
            depths: FloatArray = (adjusted.points_m[track[:, 1]] - pose.center_m) @ pose.rotation[2]
            sizes.append(float(np.median(depths)) / focal_px(adjusted.cameras[camera_ids[image_id]]))
    return _median(sizes)


def _median(values: Sequence[float]) -> float | None:
    """Return the median of the known values; None where none is known."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else None


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
    """Return the residuals of one image. seen: (P,) images of each point."""
    pose = adjusted.poses[image_id]
    position_m, position_sigmas, rotation_deg, rotation_sigmas = (_UNKNOWN,) * 4
    if given is not None:
        position_m = pose.center_m - given.center_m
        position_sigmas = position_m / given.axis_sigmas_m
        if given.world_rotation is not None:
            from scipy.spatial.transform import Rotation

            turn = Rotation.from_matrix(pose.rotation.T @ given.world_rotation)
            rotation_deg = np.asarray(turn.as_rotvec(degrees=True))
            rotation_sigmas = rotation_deg / given.sigma_angle_deg
    nan = float("nan")
    pose_alone = PoseResidual(position_m, position_sigmas, rotation_deg, rotation_sigmas, nan, 0, nan)
    return with_points(pose_alone, adjusted, image_id, camera, keypoints_px, seen)


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
    """Return the image with the largest value; None without any image."""
    if not values:
        return None
    worst = max(values, key=lambda image_id: values[image_id])
    return Worst(names.get(worst, worst), _rounded([values[worst]])[0])
