"""Rendered blocks as the detector sees them: north-up ground views from noisy poses, with the depth of every pixel.

A view's depth comes from the depth raster of its picture, whose inverse is linear over a plane. Where it mixes two
surfaces within a pixel, the point hangs in the air and no other view confirms it.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Camera
from aeromatch_cli.geometry.cameras import calibration_matrix
from aeromatch_cli.geometry.warps import source_from_view
from aeromatch_cli.lab.synthetic.truth import _camera, _read_poses
from aeromatch_cli.lab.synthetic.write import depth_path, read_raster
from aeromatch_cli.stages import simulate
from trainings.lightglue.blocks import prepared
from trainings.lightglue.data import save_arrays

# A point is confirmed by another view whose surface is this near, in pixels of the view.
_SAME_PX = 2.0
# Inverse depths that differ by so much are of two surfaces.
_MIXED = 0.003
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sight:
    """One view. gray: (H, W) uint8. nearness: (H, W) float32, 1 / depth along the rays below, NaN for nothing seen.

    world_from_view: (3, 3), view pixel (x, y, 1) -> ray. center_m: (3,). gsd_m: ground metres per pixel.
    """

    name: str
    gray: NDArray[np.uint8]
    nearness: NDArray[np.float32]
    world_from_view: Array
    center_m: Array
    gsd_m: float

    @property
    def valid(self) -> NDArray[np.bool_]:
        return np.isfinite(self.nearness)

    def points_m(self, places_px: Array) -> Array:
        """World points (N, 3) seen at pixels (N, 2), NaN where none; of the nearest pixel's surface."""
        height, width = self.nearness.shape
        with np.errstate(invalid="ignore"):
            columns, rows = np.clip(np.rint(np.nan_to_num(places_px)), 0, [width - 1, height - 1]).astype(int).T
        nearest, inverse = self.nearness[rows, columns], _bilinear(self.nearness, places_px)
        with np.errstate(invalid="ignore"):
            mixed = np.abs(inverse - nearest) > _MIXED * nearest
        inverse = np.where(mixed, nearest, inverse)
        with np.errstate(divide="ignore", invalid="ignore"):
            rays = np.column_stack([places_px, np.ones(len(places_px))]) @ self.world_from_view.T
            return np.asarray(self.center_m + rays / inverse[:, None])

    def places_px(self, points_m: Array) -> Array:
        """Pixels (N, 2) of world points (N, 3), wherever they are; NaN behind."""
        seen = (points_m - self.center_m) @ np.linalg.inv(self.world_from_view).T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(seen[:, 2:] > 0.0, seen[:, :2] / seen[:, 2:], np.nan)

    def rays(self, points_m: Array) -> Array:
        """Unit directions (N, 3) from the projection centre."""
        away = points_m - self.center_m
        return np.asarray(away / np.linalg.norm(away, axis=1, keepdims=True))


def transfer(view0: Sight, view1: Sight, places_px: Array, step_px: float = 1.0) -> Array:
    """Places (N, 2) in view 1 of pixels (N, 2) of view 0, NaN where view 1 does not show the same point.

    step_px: pixels of the view that one of the level in use has, which the tolerance follows.
    """
    points = view0.points_m(places_px)
    there = view1.places_px(points)
    with np.errstate(invalid="ignore"):
        away = np.linalg.norm(view1.points_m(there) - points, axis=1)
        there[~(away < _SAME_PX * step_px * view0.gsd_m)] = np.nan
    return there


def angles_deg(view0: Sight, view1: Sight, points_m: Array) -> Array:
    """(N,) between the rays of two views to world points (N, 3)."""
    cosine = (view0.rays(points_m) * view1.rays(points_m)).sum(axis=1)
    return np.asarray(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))


def sights(folder: Path) -> list[Sight]:
    """All ground views of a rendered block; images whose ground no view shows are left out."""
    block = json.loads((folder / "block.json").read_text(encoding="utf-8"))
    lenses: dict[str, Camera] = {key: _camera(lens) for key, lens in block["cameras"].items()}
    poses, cameras = _read_poses(folder / "poses.csv", lenses)
    found = []
    with tempfile.TemporaryDirectory() as scratch:
        context = prepared(folder, scratch, ("pairs=exhaustive",))
        for image in context.block.images:
            task = simulate.make_task(context, image)
            picture = simulate.render(task)[0][0]
            view, pose = picture.view, poses[image.name]
            if view.is_source or view.gsd_m is None:
                continue
            camera = task.enhance.source.working_camera
            rotation = np.asarray(pose.world_rotation)
            world_from_view = rotation.T @ np.linalg.inv(calibration_matrix(cameras[image.name]))
            nearness = _nearness(camera, view.undistorted_from_view, picture.gray.shape, folder, image.name)
            if picture.valid is not None:
                nearness[~picture.valid] = np.nan
            found.append(
                Sight(image.name, picture.gray, nearness, world_from_view @ view.undistorted_from_view,
                      np.asarray(pose.center_m), view.gsd_m)
            )  # fmt: skip
    return found


def _nearness(
    camera: Camera, undistorted_from_view: Array, shape: tuple[int, ...], folder: Path, name: str
) -> NDArray[np.float32]:
    """(H, W) of `Sight`, NaN for sky and unseen; its rays are as long as the homography's third coordinate."""
    height, width = shape
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    places = np.column_stack([x.ravel(), y.ravel()])
    source = source_from_view(camera, undistorted_from_view, places)
    third = places @ undistorted_from_view[2, :2] + undistorted_from_view[2, 2]
    found = _bilinear(1.0 / read_raster(depth_path(folder, name)), source) * third
    with np.errstate(invalid="ignore"):
        found[~(found > 0.0)] = np.nan
    return np.asarray(found.reshape(height, width), np.float32)


def _bilinear(values: NDArray[np.float32], places_px: Array) -> Array:
    """Values (N,) of a map at places (N, 2); NaN outside and where a neighbour is NaN."""
    safe = np.nan_to_num(places_px, nan=-10.0).clip(-10.0, 30_000.0).astype(np.float32)
    wide = -(-len(safe) // 4096)
    padded = np.full((wide * 4096, 2), -10.0, np.float32)
    padded[: len(safe)] = safe
    maps = padded.reshape(wide, 4096, 2)
    out = cv2.remap(values, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT,
                    borderValue=float("nan"))  # fmt: skip
    return np.asarray(out.ravel()[: len(safe)], np.float64)


def write_sights(path: Path, found: list[Sight]) -> None:
    arrays = {f"{n}.{key}": np.asarray(value) for n, sight in enumerate(found) for key, value in vars(sight).items()}
    save_arrays(path, arrays)


def read_sights(path: Path) -> list[Sight]:
    with np.load(path) as content:
        count = len({key.split(".")[0] for key in content.files})
        rows = [{key: content[f"{n}.{key}"] for key in Sight.__dataclass_fields__} for n in range(count)]
    return [Sight(**(row | {"name": str(row["name"]), "gsd_m": float(row["gsd_m"])})) for row in rows]
