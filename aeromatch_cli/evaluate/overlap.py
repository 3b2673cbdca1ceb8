"""What two images both see: samples of the overlap, its share, the angle between both views, its texture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pose
from aeromatch_cli.evaluate.texture import Texture, read_texture
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.geometry.footprints import view_angles_deg

# Samples per image, on an even grid: several for each cell of the coverage grid, whatever the image's size.
_SAMPLES = 16384
_COARSE = 16  # every so many of them for a first look


class Sight(Protocol):
    """Who can say what an image shows. Images go by name."""

    @property
    def cameras(self) -> Mapping[str, Camera]: ...

    @property
    def poses(self) -> Mapping[str, Pose]: ...

    def surface_points(self, image: str, points_px: FloatArray) -> FloatArray:
        """World points (N, 3) shown at stored pixels (N, 2), NaN for none."""
        ...

    def unblocked(self, image: str, points_m: FloatArray) -> BoolArray:
        """Whether nothing stands between an image's projection centre and world points (N, 3), finite ones."""
        ...


@dataclass(frozen=True, eq=False)
class Overlap:
    """samples0_px, samples1_px: (S, 2) places of each image, from an even grid, that the other image sees.

    overlap: the larger of both shares of all samples. view_angle_deg: median over both sides' samples, NaN without.
    """

    samples0_px: FloatArray
    samples1_px: FloatArray
    overlap: float
    view_angle_deg: float


@dataclass(frozen=True, eq=False)
class _Seen:
    """What is kept of a pair: which samples of either image the other sees, and the angle."""

    seen0: BoolArray
    seen1: BoolArray
    view_angle_deg: float


def place_on(sight: Sight, image: str, points_m: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Stored pixels (N, 2) of world points (N, 3), and whether (N,) they lie on the image; NaN points do not."""
    camera, pose = sight.cameras[image], sight.poses[image]
    assert pose.world_rotation is not None
    places = project(camera, pose.world_rotation, pose.center_m, points_m)
    last = np.array([camera.width_px, camera.height_px]) - 0.5
    with np.errstate(invalid="ignore"):
        return places, np.asarray(((places >= -0.5) & (places <= last)).all(axis=1))


def sample_grid(camera: Camera, count: int = _SAMPLES) -> FloatArray:
    """About `count` pixel centres (S, 2) on an even grid, row by row; all of a small image."""
    step = max(1, round(float(np.sqrt(camera.width_px * camera.height_px / count))))
    x, y = np.meshgrid(np.arange(step // 2, camera.width_px, step), np.arange(step // 2, camera.height_px, step))
    return np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)


class OverlapFinder:
    """Overlaps of one block, each computed once."""

    def __init__(self, sight: Sight, images_folder: Path | None) -> None:
        self._sight, self._images_folder = sight, images_folder
        self._samples: dict[str, tuple[FloatArray, FloatArray]] = {}
        self._found: dict[tuple[str, str], _Seen] = {}
        self._textures: dict[str, Texture] = {}

    def between(self, name0: str, name1: str) -> Overlap:
        """The overlap of two images."""
        first, second = sorted((name0, name1))
        if (first, second) not in self._found:
            self._found[first, second] = self._find(first, second)
        found = self._found[first, second]
        masks = {first: found.seen0, second: found.seen1}
        samples0_px, samples1_px = (self._of(name)[0][masks[name]] for name in (name0, name1))
        share = max(float(mask.mean()) for mask in masks.values())
        return Overlap(samples0_px, samples1_px, share, found.view_angle_deg)

    def at_most(self, name0: str, name1: str) -> float:
        """An upper estimate of the overlap, from a coarse grid, with nothing in the way."""
        shares = [self._on_other(a, b, _COARSE).mean() for a, b in ((name0, name1), (name1, name0))]
        return float(max(shares))

    def texture(self, name0: str, name1: str) -> float:
        """The smaller of both images' textures in the overlap, NaN where the images are not at hand."""
        if self._images_folder is None:
            return float("nan")
        found = self.between(name0, name1)
        sides = ((name0, found.samples0_px), (name1, found.samples1_px))
        texture0, texture1 = (self._texture_of(name).over(px) for name, px in sides)
        return float(np.fmin(texture0, texture1))

    def _find(self, name0: str, name1: str) -> _Seen:
        seen0, seen1 = self._visible(name0, name1), self._visible(name1, name0)
        common_m = np.concatenate([self._of(name0)[1][seen0], self._of(name1)[1][seen1]])
        angles = view_angles_deg(self._sight.poses[name0].center_m, self._sight.poses[name1].center_m, common_m)
        return _Seen(seen0, seen1, float(np.median(angles)) if len(angles) else float("nan"))

    def _visible(self, name: str, other: str) -> BoolArray:
        """Which samples of one image the other sees."""
        points_m = self._of(name)[1]
        seen = self._on_other(name, other, 1)
        asked = np.flatnonzero(seen)
        seen[asked] = self._sight.unblocked(other, points_m[asked])
        return seen

    def _on_other(self, name: str, other: str, every: int) -> BoolArray:
        return place_on(self._sight, other, self._of(name)[1][::every])[1]

    def _of(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Samples (S, 2) of an image and the world points (S, 3) they show."""
        if name not in self._samples:
            grid_px = sample_grid(self._sight.cameras[name])
            self._samples[name] = grid_px, self._sight.surface_points(name, grid_px)
        return self._samples[name]

    def _texture_of(self, name: str) -> Texture:
        assert self._images_folder is not None
        if name not in self._textures:
            self._textures[name] = read_texture(self._images_folder / name)
        return self._textures[name]
