"""Pictures that keypoints are looked for in: a stored image or its ground view, with places in stored pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.images.depth import to_gray8
from aeromatch_cli.images.files import read_pixels
from benchmarks.peers.base import Scene
from benchmarks.peers.ground import GroundViews
from benchmarks.views import ImageView, away_from_unseen, filled, inside

SOURCE, GROUND = "source", "ground"


@dataclass(frozen=True, eq=False)
class Picture(ImageView):
    """colours: (H, W, 3) uint8 RGB. gray: (H, W) uint8. seen: (H, W), False where the view has seen nothing."""

    colours: NDArray[np.uint8]
    gray: NDArray[np.uint8]
    seen: BoolArray

    @cached_property
    def filled_gray(self) -> NDArray[np.uint8]:
        """(H, W), what was not seen filled from beside, so that its edge draws no keypoints."""
        return filled(np.repeat(self.gray[..., None], 3, axis=2), self.seen)[..., 0].copy()

    def shows(self, stored_px: FloatArray) -> BoolArray:
        """Whether this picture has seen what lies at stored pixels (N, 2)."""
        found = inside(stored_px, self.camera)
        rows = np.flatnonzero(found)
        points = self.from_stored(np.asarray(stored_px)[rows])
        last = np.array(self.seen.shape[::-1]) - 0.5
        within = ((points >= -0.5) & (points <= last)).all(axis=1)
        found[rows] = within & away_from_unseen(points, self.seen, 0.0)
        return found


class Pictures:
    """The pictures of a scene, each made once. frame: SOURCE or GROUND."""

    def __init__(self, scene: Scene, workspace: Path) -> None:
        self._scene = scene
        self._views = GroundViews(scene, workspace)
        self._made: dict[tuple[str, str], Picture] = {}

    def __call__(self, image: str, frame: str) -> Picture:
        if (image, frame) not in self._made:
            self._made[image, frame] = self._on_ground(image) if frame == GROUND else self._source(image)
        return self._made[image, frame]

    def _source(self, image: str) -> Picture:
        pixels = read_pixels(self._scene.images / image, colour=True)
        gray = to_gray8(pixels)
        return Picture(image, self._scene.cameras[image], None, pixels, gray, np.ones(gray.shape, bool))

    def _on_ground(self, image: str) -> Picture:
        found, colours, seen = self._views(image)
        return Picture(image, self._scene.cameras[image], found.view, colours, to_gray8(colours), seen)
