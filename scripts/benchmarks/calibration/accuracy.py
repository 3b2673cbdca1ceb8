"""What an adjusted block is worth: check points intersected with its cameras and poses, and its lenses, by truth.

Errors of check points are in ground pixels (their metres over the ground sampling distance).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from aeromatch_cli.data import AdjustedBlock, Camera, FloatArray
from aeromatch_cli.geometry.cameras import calibration_matrix, focal_px, world_rays
from aeromatch_cli.sfm.georeferencing import similarity
from benchmarks.calibration.simulate import SimulatedBlock
from benchmarks.tables import Row, plain

# What a check point is measured with.
_CHECK_SIGMA_PX = 0.3
_FEWEST_CHECKED = 4
_STREAM = 301


@dataclass(frozen=True, eq=False)
class Found:
    """Cameras by camera_id; cam_from_world rotations (3, 3) and centres (3,) by image_id, all in one frame. sigmas_m:
    standard deviations (3,) of the centres, where they are stated."""

    cameras: Mapping[str, Camera]
    rotations: Mapping[str, FloatArray]
    centers_m: Mapping[str, FloatArray]
    sigmas_m: Mapping[str, FloatArray] = field(default_factory=dict)

    @classmethod
    def of(cls, adjusted: AdjustedBlock) -> Found:
        """The images of the frame that most are in."""
        frames = [adjusted.frames.get(image_id, 0) for image_id in adjusted.poses]
        frame = max(set(frames), key=frames.count, default=0)
        poses = {i: pose for i, pose in adjusted.poses.items() if adjusted.frames.get(i, 0) == frame}
        return cls(
            adjusted.cameras,
            {image_id: pose.rotation for image_id, pose in poses.items()},
            {image_id: pose.center_m for image_id, pose in poses.items()},
            {image_id: pose.sigmas_m for image_id, pose in poses.items()},
        )


def judged(block: SimulatedBlock, found: Found) -> Row:
    """Figures of one result, null where too few check points are seen.

    horizontal_px, height_px: medians of absolute errors after the best similarity to truth; bend_px: 95 % of the
    heights are within. absolute_...: without it, where positions are exact enough. focal_percent, centre_px: the
    median camera. stated_ratio: see `_stated_ratio`.
    """
    used = {block.camera_of[image_id] for image_id in found.rotations}
    true = {k: block.cameras[k] for k in used}
    centres = [
        np.linalg.norm((calibration_matrix(found.cameras[k]) - calibration_matrix(camera))[:2, 2])
        for k, camera in true.items()
    ]
    focal = [abs(focal_px(found.cameras[k]) / focal_px(camera) - 1.0) for k, camera in true.items()]
    row: Row = {
        "oriented": len(found.rotations),
        "focal_percent": 100.0 * float(np.median(focal)) if focal else None,
        "centre_px": float(np.median(centres)) if centres else None,
    }
    row["stated_ratio"] = _stated_ratio(block, found)
    points = intersected(block, found)
    known = np.isfinite(points).all(axis=1)
    row["checked"] = int(known.sum())
    if known.sum() >= _FEWEST_CHECKED:
        true_m = block.check_points_m[known]
        scale, rotation, shift = similarity(points[known], true_m)
        row |= _errors("", scale * points[known] @ rotation.T + shift - true_m, block.gsd_m)
        if block.positions == "rtk2cm":
            row |= _errors("absolute_", points[known] - true_m, block.gsd_m)
    return {key: plain(value) for key, value in row.items()}


def _stated_ratio(block: SimulatedBlock, found: Found) -> float | None:
    """Root mean square error of the projection centres over that of their stated standard deviations: as they are with
    RTK, of the block's shape (after a similarity) without positions. None with GPS: what drifts has no deviation.
    """
    known = [i for i, sigmas in sorted(found.sigmas_m.items()) if np.isfinite(sigmas).all()]
    if block.positions == "gps5m" or len(known) < _FEWEST_CHECKED:
        return None
    centers_m = np.array([found.centers_m[i] for i in known])
    true_m = np.array([block.poses[i].center_m for i in known])
    scale = 1.0
    if block.positions == "nothing":
        scale, rotation, shift = similarity(centers_m, true_m)
        centers_m = scale * centers_m @ rotation.T + shift
    stated_m = scale * np.array([found.sigmas_m[i] for i in known])
    return float(np.sqrt(((centers_m - true_m) ** 2).mean() / (stated_m**2).mean()))


def _errors(prefix: str, errors_m: FloatArray, gsd_m: float) -> Row:
    across, up = np.hypot(errors_m[:, 0], errors_m[:, 1]) / gsd_m, np.abs(errors_m[:, 2]) / gsd_m
    return {
        f"{prefix}horizontal_px": np.median(across),
        f"{prefix}height_px": np.median(up),
        f"{prefix}bend_px": np.percentile(up, 95.0),
    }


def intersected(block: SimulatedBlock, found: Found) -> FloatArray:
    """Check points (C, 3) from their noisy pixels, by linear least squares of rays; NaN seen by fewer than two."""
    rng = np.random.default_rng([block.seed, _STREAM])
    count = len(block.check_points_m)
    normal, right, rays = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros(count)
    for image_id, exact in block.check_px.items():
        pixels = exact + _CHECK_SIGMA_PX * rng.standard_normal(exact.shape)  # the same whichever images are found
        if image_id not in found.rotations:
            continue
        camera = found.cameras[block.camera_of[image_id]]
        directions = world_rays(camera, found.rotations[image_id], pixels)
        seen = np.flatnonzero(np.isfinite(directions).all(axis=1))
        across = np.eye(3) - directions[seen, :, None] * directions[seen, None, :]
        normal[seen] += across
        right[seen] += across @ found.centers_m[image_id]
        rays[seen] += 1
    points = np.full((count, 3), np.nan)
    enough = rays >= 2
    points[enough] = np.linalg.solve(normal[enough], right[enough][:, :, None])[:, :, 0]
    return points
