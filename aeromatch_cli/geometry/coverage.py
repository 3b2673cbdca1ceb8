"""Which part of an image another one shows, by poses and ground, and how much of it matches cover."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import BoolArray, Camera, FloatArray, IntArray, PairGeometry, Pose
from aeromatch_cli.geometry.cameras import project, world_rays

# Cells along each side of an image.
CELLS = 8


@dataclass(frozen=True, eq=False)
class SharedCells:
    """Cells of either image whose middle lies, on the ground, in the other: (CELLS, CELLS) bool, rows downwards."""

    cells0: BoolArray
    cells1: BoolArray

    @property
    def share(self) -> float:
        """Of the cells of the image that shows more of the other."""
        return float(max(self.cells0.mean(), self.cells1.mean()))


def shared_cells(geometry: PairGeometry) -> SharedCells | None:
    """By both attitudes and a level ground; None where one of them is unknown or a camera is below the ground."""
    pose0, pose1, ground_z_m = geometry.pose0, geometry.pose1, geometry.ground_z_m
    if pose0 is None or pose1 is None or ground_z_m is None:
        return None
    if pose0.world_rotation is None or pose1.world_rotation is None:
        return None
    if min(pose0.center_m[2], pose1.center_m[2]) <= ground_z_m:
        return None
    return SharedCells(
        _shown(geometry.camera0, pose0, geometry.camera1, pose1, ground_z_m),
        _shown(geometry.camera1, pose1, geometry.camera0, pose0, ground_z_m),
    )


def _shown(camera: Camera, pose: Pose, other_camera: Camera, other_pose: Pose, ground_z_m: float) -> BoolArray:
    """Cells of one image that the other one shows."""
    steps = (np.arange(CELLS) + 0.5) / CELLS
    x, y = np.meshgrid(steps * camera.width_px - 0.5, steps * camera.height_px - 0.5)
    rays = world_rays(camera, np.asarray(pose.world_rotation), np.column_stack([x.ravel(), y.ravel()]))
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (ground_z_m - pose.center_m[2]) / rays[:, 2]
        ground = pose.center_m + distance[:, None] * rays
        seen = project(other_camera, np.asarray(other_pose.world_rotation), other_pose.center_m, ground)
        inside = (seen >= -0.5) & (seen <= np.array([other_camera.width_px, other_camera.height_px]) - 0.5)
    return np.asarray((inside.all(axis=1) & (distance > 0.0)).reshape(CELLS, CELLS))


def cells_of(size_px: tuple[int, int], points_px: FloatArray, along: int = CELLS) -> IntArray:
    """Row and column (N, 2) of the cell that holds each stored pixel (N, 2). size_px: of the image, width and height.
    along: cells along each side."""
    cells = ((points_px[:, ::-1] + 0.5) * (along / np.array(size_px[::-1]))).astype(np.int64)
    # np.clip takes as long as all the rest on a few hundred matches.
    return np.asarray(np.minimum(np.maximum(cells, 0), along - 1))


def covered_share(shared: BoolArray, camera: Camera, points_px: FloatArray) -> float:
    """Share of the shared cells that hold a point; NaN where no cell is shared."""
    if not shared.any():
        return float("nan")
    held = np.zeros_like(shared)
    cells = cells_of((camera.width_px, camera.height_px), points_px)
    held[cells[:, 0], cells[:, 1]] = True
    return float((held & shared).sum() / shared.sum())


def shown_ninths(seen: BoolArray) -> BoolArray:
    """The ninths (3, 3) of an image of which half the cells (CELLS, CELLS) and more are seen."""
    ninth = np.arange(CELLS) * 3 // CELLS
    parts = (ninth[:, None] == np.arange(3)).astype(np.float64)
    counts = np.outer(parts.sum(axis=0), parts.sum(axis=0))
    return np.asarray(parts.T @ seen @ parts >= 0.5 * counts)
