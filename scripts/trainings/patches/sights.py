"""Pictures of a place, as taken and as north-up ground views, and where ground points lie in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pose
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.geometry.warps import source_from_view, view_from_source
from aeromatch_cli.stages import simulate
from aeromatch_cli.stages.context import Context
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.learned import Learned
from aeromatch_cli.strategies.extractors.pyramid import SUPPORT, Level, levels_of
from aeromatch_cli.strategies.extractors.sift import Sift

# Of a patch's half side that must lie on what the picture saw.
_SEEN_SHARE = 0.6


@dataclass(frozen=True, eq=False)
class Picture:
    """What was seen, and the camera of the image that it was made of. light: pictures of another number had another."""

    pixels: ViewPixels
    camera: Camera
    light: int

    @property
    def upright(self) -> bool:
        """Whether things keep their orientation from picture to picture."""
        return self.pixels.view.north_up

    @cached_property
    def levels(self) -> list[Level]:
        return levels_of(self.pixels.gray)

    @cached_property
    def _room_px(self) -> NDArray[np.float32]:
        """(H, W) distance to what the picture did not see."""
        gray, valid = self.pixels.gray, self.pixels.valid
        seen = np.zeros((gray.shape[0] + 2, gray.shape[1] + 2), np.uint8)
        seen[1:-1, 1:-1] = 1 if valid is None else valid
        return cv2.distanceTransform(seen, cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1]

    def shows(self, points_px: FloatArray, sizes_px: FloatArray) -> BoolArray:
        """Whether most of the patch around each point (N, 2) lies on what the picture saw."""
        height, width = self.pixels.gray.shape
        rounded = np.rint(np.nan_to_num(points_px, nan=-1e6))
        inside = ((rounded >= 0) & (rounded < [width, height])).all(axis=1)
        column, row = np.where(inside[:, None], rounded, 0).astype(np.int64).T
        needed = _SEEN_SHARE * SUPPORT / 2.0 * np.nan_to_num(sizes_px)
        return np.asarray(inside & (self._room_px[row, column] >= needed))

    def keypoints(self, count: int, *, by: Literal["sift", "network"] = "sift") -> tuple[FloatArray, FloatArray]:
        """Places (N, 2) and diameters (N,) of at most `count` keypoints, evenly spread: of SIFT, or of the detector
        network that ships."""
        detector = Sift if by == "sift" else Learned
        found = detector(keypoints=count, orientation="upright")(self.camera, [self.pixels])
        return found.view_keypoints_px.astype(np.float64), found.view_size_px.astype(np.float64)


@dataclass(frozen=True, eq=False)
class Sight(Picture):
    """A picture of a known place: as taken, or a ground view, made with an approximate pose. pose: the true one."""

    image: str
    pose: Pose

    def source_px(self, points_px: FloatArray) -> FloatArray:
        """Stored pixels (N, 2) of the picture's own."""
        view = self.pixels.view
        return points_px if view.is_source else source_from_view(self.camera, view.undistorted_from_view, points_px)

    def places_px(self, points_m: FloatArray) -> FloatArray:
        """The picture's pixels (N, 2) of world points (N, 3), wherever they lie; NaN behind the camera."""
        assert self.pose.world_rotation is not None
        there = project(self.camera, self.pose.world_rotation, self.pose.center_m, points_m)
        view = self.pixels.view
        return there if view.is_source else view_from_source(self.camera, view.undistorted_from_view, there)


def sights_of(
    context: Context, cameras: Mapping[str, Camera] | None, poses: Mapping[str, Pose] | None, suns: Mapping[str, int]
) -> list[Sight]:
    """Every image of a block as its preset looks at it; set `simulate.keep_source=true` for the pictures as taken, too.

    cameras, poses: the true ones by name where they are not those of the block.
    """
    found = []
    for image in context.block.images:
        task = simulate.make_task(context, image)
        pose = context.block.poses[image.image_id] if poses is None else poses[image.name]
        own = task.enhance.source.working_camera if cameras is None else cameras[image.name]
        pictures: list[Any] = simulate.render(task)[0]
        found += [Sight(picture, own, suns.get(image.name, 0), image.name, pose) for picture in pictures]
    return found
