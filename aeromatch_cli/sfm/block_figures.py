"""Figures of an adjusted block as a whole: sizes, errors, and how many images hold each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from aeromatch_cli.data import AdjustedBlock, FloatArray, Image, IntArray
from aeromatch_cli.geometry.cameras import corner_params, focal_px
from aeromatch_cli.geometry.components import component_labels
from aeromatch_cli.results.adjustment import GroupResult
from aeromatch_cli.results.stages import AdjustedCamera

# Images with fewer points of three images and more are held by their neighbours one by one; pairs that share fewer tie
# no parts.
_FEW_POINTS = 20


def block_figures(adjusted: AdjustedBlock, images: Iterable[Image], groups: Sequence[GroupResult]) -> dict[str, Any]:
    """Return fields of AdjustResult that describe the block as a whole. groups: the results of each."""
    placed = [pose for image_id, pose in adjusted.poses.items() if image_id not in adjusted.frames]
    seen = images_per_point(adjusted)
    held = [int((seen[track[:, 1]] >= 3).sum()) for track in adjusted.tracks.values()]
    return {
        "images": len(adjusted.poses),
        "points": len(adjusted.points_m),
        "track_length": round(adjusted.observations / max(1, len(adjusted.points_m)), 3),
        "held_by_pairs": sum(count < _FEW_POINTS for count in held),
        "tied_parts": tied_parts(adjusted),
        "reprojection_error_px": round(float(np.mean(adjusted.errors_px)), 4) if len(adjusted.errors_px) else None,
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
    part = component_labels(len(tracks), np.column_stack((seen @ seen.T >= _FEW_POINTS).nonzero()))
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
