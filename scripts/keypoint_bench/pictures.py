"""Pictures that keypoints are looked for in: a stored image or its ground view, with places in stored pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from methods.base import Scene
from methods.ground import GroundViews, away_from_unseen, filled, on_picture
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, View
from aeromatch_cli.geometry.warps import source_from_view, view_from_source
from aeromatch_cli.images.depth import to_gray8
from aeromatch_cli.images.files import read_pixels

SOURCE, GROUND = "source", "ground"


@dataclass(frozen=True, eq=False)
class Picture:
    """colours: (H, W, 3) uint8 RGB. gray: (H, W) uint8. seen: (H, W), False where the view has seen nothing.

    view: of the image that camera belongs to; None: the stored image itself.
    """

    image: str
    colours: NDArray[np.uint8]
    gray: NDArray[np.uint8]
    seen: BoolArray
    camera: Camera
    view: View | None

    @cached_property
    def filled_gray(self) -> NDArray[np.uint8]:
        """(H, W), what was not seen filled from beside, so that its edge draws no keypoints."""
        return filled(np.repeat(self.gray[..., None], 3, axis=2), self.seen)[..., 0].copy()

    def stored_px(self, points_px: FloatArray) -> FloatArray:
        """Stored pixels (N, 2) of points (N, 2) of this picture; NaN where the image does not see them."""
        points = np.asarray(points_px, np.float64).reshape(-1, 2)
        if self.view is None or len(points) == 0:
            return points
        return source_from_view(self.camera, self.view.undistorted_from_view, points)

    def from_stored(self, stored_px: FloatArray) -> FloatArray:
        """Points (N, 2) of this picture at stored pixels (N, 2)."""
        points = np.asarray(stored_px, np.float64).reshape(-1, 2)
        if self.view is None or len(points) == 0:
            return points
        return view_from_source(self.camera, self.view.undistorted_from_view, points)

    def shows(self, stored_px: FloatArray) -> BoolArray:
        """Whether this picture has seen what lies at stored pixels (N, 2)."""
        found = on_picture(self.camera, stored_px)
        inside = np.flatnonzero(found)
        points = self.from_stored(np.asarray(stored_px)[inside])
        last = np.array(self.seen.shape[::-1]) - 0.5
        within = ((points >= -0.5) & (points <= last)).all(axis=1)
        found[inside] = within & away_from_unseen(points, self.seen, 0.0)
        return found


class Pictures:
    """The pictures of a scene, each made once. frame: SOURCE or GROUND."""

    def __init__(self, scene: Scene, workspace: Path) -> None:
        self._scene = scene
        self._views = GroundViews(scene, workspace)
        self._made: dict[tuple[str, str], Picture] = {}

    @property
    def cameras(self) -> Mapping[str, Camera]:
        return self._scene.cameras

    def __call__(self, image: str, frame: str) -> Picture:
        if (image, frame) not in self._made:
            self._made[image, frame] = self._on_ground(image) if frame == GROUND else self._source(image)
        return self._made[image, frame]

    def _source(self, image: str) -> Picture:
        pixels = read_pixels(self._scene.images / image, colour=True)
        gray = to_gray8(pixels)
        return Picture(image, pixels, gray, np.ones(gray.shape, bool), self.cameras[image], None)

    def _on_ground(self, image: str) -> Picture:
        view, colours, seen = self._views.picture(image)
        return Picture(image, colours, to_gray8(colours), seen, self.cameras[image], None if view.is_source else view)
