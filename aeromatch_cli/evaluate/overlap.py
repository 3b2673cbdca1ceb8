"""What two images both see: samples of the overlap, its share, the angle between both views, its texture.

Texture is measured by grey levels alone. The image is reduced to 1000 px on its longer side (so that images of all
sizes compare), smoothed lightly (Gaussian, 1 px: sensor noise goes, structure stays) and cut into cells of 16 px. Each
cell has a relative deviation, standard deviation over mean grey level, so that exposure cancels. The texture of an
overlap is the upper quartile over its cells: matches live on the better part.

Classes (scores.TEXTURE_CLASSES) are set by the mean over whole images: rendered desert 0.04, grass 0.04 and a ploughed
field in false colour 0.05 (poor up to here); rendered farmland 0.06, bare earth 0.10 (medium); suburb and meadow with
trees 0.16, city 0.20 real and rendered, forest 0.23 (rich). Single pairs spread by half of these figures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pose
from aeromatch_cli.geometry.footprints import view_angles_deg
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.recent import recent

# Samples per image, on an even grid: several for each cell of the coverage grid, whatever the image's size.
_SAMPLES = 16384
_COARSE = 16  # every so many of them for a first look
_MARGIN = 0.25  # of the extent of what an image shows
# 0.7 MB and 32 kB each.
_IMAGES_KEPT, _PAIRS_KEPT = 256, 1024
_LONGER_SIDE_PX, _CELL_PX = 1000, 16
_SMOOTHING_PX, _PERCENTILE = 1.0, 75
_DARKEST = 8.0  # grey levels; below, a ratio to the mean says nothing


class Sight(Protocol):
    """Who can say what an image shows. Images go by name."""

    @property
    def cameras(self) -> Mapping[str, Camera]: ...

    @property
    def poses(self) -> Mapping[str, Pose]: ...

    def surface_points(self, image: str, points_px: FloatArray) -> FloatArray:
        """World points (N, 3) shown at stored pixels (N, 2), NaN for none."""
        ...

    def project(self, image: str, points_m: FloatArray) -> FloatArray:
        """Stored pixels (N, 2) of world points (N, 3), NaN where an image has none for them."""
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
    camera, places = sight.cameras[image], sight.project(image, points_m)
    last = np.array([camera.width_px, camera.height_px]) - 0.5
    with np.errstate(invalid="ignore"):
        return places, np.asarray(((places >= -0.5) & (places <= last)).all(axis=1))


def sample_grid(camera: Camera, count: int = _SAMPLES) -> FloatArray:
    """About `count` pixel centres (S, 2) on an even grid, row by row; all of a small image."""
    step = max(1, round(float(np.sqrt(camera.width_px * camera.height_px / count))))
    x, y = np.meshgrid(np.arange(step // 2, camera.width_px, step), np.arange(step // 2, camera.height_px, step))
    return np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)


class OverlapFinder:
    """Overlaps of one block, each computed once as long as it is asked for now and then."""

    def __init__(self, sight: Sight, images_folder: Path | None) -> None:
        self._sight, self._images_folder = sight, images_folder
        self._samples: dict[str, tuple[FloatArray, FloatArray]] = {}
        self._found: dict[tuple[str, str], _Seen] = {}
        self._textures: dict[str, Texture] = {}
        self._boxes: dict[str, FloatArray] = {}

    def between(self, name0: str, name1: str) -> Overlap:
        """The overlap of two images."""
        first, second = sorted((name0, name1))
        found = recent(self._found, (first, second), lambda: self._find(first, second), _PAIRS_KEPT)
        masks = {first: found.seen0, second: found.seen1}
        samples0_px, samples1_px = (self._of(name)[0][masks[name]] for name in (name0, name1))
        share = max(float(mask.mean()) for mask in masks.values())
        return Overlap(samples0_px, samples1_px, share, found.view_angle_deg)

    def near(self, name: str, others: Sequence[str]) -> BoolArray:
        """Which of the others (N,) show ground whose box meets that of an image; the rest share nothing with it."""
        low, high = self._box(name)
        boxes = np.array([self._box(other) for other in others]).reshape(-1, 2, 2)
        return np.asarray(((boxes[:, 0] <= high) & (boxes[:, 1] >= low)).all(axis=1))

    def _box(self, name: str) -> FloatArray:
        """(2, 2) lowest and highest x and y of the ground that an image shows, with a margin, as samples do not reach
        its edges; of an image without ground everywhere."""
        if name not in self._boxes:
            grid_px = sample_grid(self._sight.cameras[name])[::_COARSE]
            ground_m = self._sight.surface_points(name, grid_px)[:, :2]
            ground_m = ground_m[np.isfinite(ground_m).all(axis=1)]
            self._boxes[name] = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
            if len(ground_m):
                low, high = ground_m.min(axis=0), ground_m.max(axis=0)
                margin = _MARGIN * (high - low)
                self._boxes[name] = np.array([low - margin, high + margin])
        return self._boxes[name]

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
        return recent(self._samples, name, lambda: self._sampled(name), _IMAGES_KEPT)

    def _sampled(self, name: str) -> tuple[FloatArray, FloatArray]:
        grid_px = sample_grid(self._sight.cameras[name])
        return grid_px, self._sight.surface_points(name, grid_px)

    def _texture_of(self, name: str) -> Texture:
        assert self._images_folder is not None
        path = self._images_folder / name
        return recent(self._textures, name, lambda: read_texture(path), _IMAGES_KEPT)


@dataclass(frozen=True, eq=False)
class Texture:
    """deviations: (rows, columns) of the cells; cell_px: side of a cell in stored pixels."""

    deviations: FloatArray
    cell_px: float

    def over(self, overlap_px: FloatArray) -> float:
        """Upper quartile of the cells that hold samples (S, 2) of the overlap, stored pixels; NaN without any."""
        if not len(overlap_px):
            return float("nan")
        rows, columns = self.deviations.shape
        column, row = np.clip((overlap_px + 0.5) // self.cell_px, 0, [columns - 1, rows - 1]).astype(int).T
        return float(np.percentile(self.deviations.reshape(-1)[np.unique(row * columns + column)], _PERCENTILE))


def read_texture(path: Path) -> Texture:
    """The texture of an image. Raises ItemError where it cannot be read."""
    import cv2

    gray: NDArray[Any] = read_pixels(path, colour=False).astype(np.float32)
    scale = min(1.0, _LONGER_SIDE_PX / max(gray.shape))
    if scale < 1.0:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    gray = cv2.GaussianBlur(gray, (0, 0), _SMOOTHING_PX)
    rows, columns = (max(side // _CELL_PX, 1) for side in gray.shape)
    cut = gray[: rows * _CELL_PX, : columns * _CELL_PX]
    cells = cut.reshape(rows, cut.shape[0] // rows, columns, cut.shape[1] // columns)
    return Texture(cells.std(axis=(1, 3)) / np.maximum(cells.mean(axis=(1, 3)), _DARKEST), _CELL_PX / scale)
