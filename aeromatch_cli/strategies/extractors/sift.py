"""SIFT on overlapping tiles, with an exact budget spread evenly over the image, described by RootSIFT bytes.

Source: Lowe, IJCV 2004; Arandjelovic and Zisserman, CVPR 2012 (RootSIFT). The detector is OpenCV's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import BoolArray, Camera, Features, FloatArray, IntArray
from aeromatch_cli.geometry.warps import source_from_view
from aeromatch_cli.strategies import Strategy, ViewPixels
from aeromatch_cli.strategies.extractors.merging import merge_keypoints
from aeromatch_cli.strategies.extractors.selection import even_selection
from aeromatch_cli.strategies.extractors.tiles import Tile, tiles

_TILE_AREA_PX = 4_000_000
_TILE_MARGIN_PX = 128
_DESCRIPTOR_LENGTH = 128


class Sift(Strategy):
    """SIFT keypoints and RootSIFT descriptors of all views of one image."""

    version: ClassVar[int] = 1
    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    name: Literal["sift"] = "sift"
    keypoints: int = Field(
        4000,
        ge=1,
        description="Descriptors per image over all its views: exactly so many, fewer only where fewer exist. "
        "As in OpenCV and COLMAP, a point with two orientations counts twice.",
    )
    budget: Literal["image", "view"] = Field(
        "image", description="What `keypoints` is for: the whole image over all its views, or each view by itself."
    )
    contrast_threshold: float = Field(0.01, gt=0.0, description="Smallest contrast, divided by octave_layers inside.")
    edge_threshold: float = Field(10.0, gt=1.0, description="Largest ratio of the two curvatures.")
    octave_layers: int = Field(3, ge=1, description="Scales per octave.")
    sigma: float = Field(1.6, gt=0.5, description="Blur of the first scale, pixels of the doubled image.")
    selection: Literal["balanced", "scale", "response"] = Field(
        "balanced",
        description="What a cell gives first: the largest, the most contrasted, or response x size^2 (balanced).",
    )
    colours: bool = Field(False, description="Keep the colour around every keypoint; the filter `colour` reads it.")
    per_cell: int = Field(200, ge=1, description="Keypoints per cell of the even spread; larger is less even.")

    def __call__(self, camera: Camera, views: Sequence[ViewPixels]) -> Features:
        """Features of one image, merged over its views; empty arrays of the right shapes where nothing was found."""
        # Detect, select, describe: describing every point of a forest costs more than detecting it.
        found = [_in_source(camera, view, self._detect(view, index)) for index, view in enumerate(views)]
        budget = self.keypoints
        if self.budget == "view" and len(views) > 1:
            budget *= len(views)
            found = [self._cut(part, view) for part, view in zip(found, views, strict=True)]
        raw = _concatenate(found)
        keypoint_idx, standing = merge_keypoints(raw.source_px, raw.source_sizes_px, raw.view_idx)
        points = raw.take(standing)
        strengths = self._strengths(points)
        costs = np.bincount(keypoint_idx, minlength=len(standing))
        size_px = (camera.width_px, camera.height_px)
        chosen = even_selection(points.source_px, strengths, costs, size_px, budget, self.per_cell)
        described, numbers = _within_budget(raw, keypoint_idx, chosen, budget)
        descriptors = self._describe(described, views)
        return _features(points.take(chosen), described, numbers, descriptors, views)

    def _cut(self, raw: _Raw, view: ViewPixels) -> _Raw:
        """The features of one view that its own budget buys, each orientation by itself."""
        ones, size_px = np.ones(len(raw.view_idx), np.int64), (view.view.width_px, view.view.height_px)
        strengths = self._strengths(raw)
        return raw.take(even_selection(raw.points_px, strengths, ones, size_px, self.keypoints, self.per_cell))

    def _strengths(self, points: _Raw) -> FloatArray:
        if self.selection == "scale":
            return points.source_sizes_px
        if self.selection == "response":
            return points.responses
        return points.responses * points.source_sizes_px**2

    def _detector(self) -> Any:
        import cv2

        return cv2.SIFT.create(
            nfeatures=0,
            nOctaveLayers=self.octave_layers,
            contrastThreshold=self.contrast_threshold,
            edgeThreshold=self.edge_threshold,
            sigma=self.sigma,
            descriptorType=cv2.CV_8U,
            enable_precise_upscale=True,  # without it every keypoint is off by a quarter pixel
        )

    def _detect(self, view: ViewPixels, view_idx: int) -> _Raw:
        detector = self._detector()
        parts = [_detect_tile(detector, view, tile, view_idx) for tile in _tiles(view)]
        return _away_from_mask(_concatenate(parts), view.valid)

    def _describe(self, raw: _Raw, views: Sequence[ViewPixels]) -> NDArray[np.uint8]:
        """RootSIFT bytes (N, 128) of the features, each from the tile that found it."""
        detector = self._detector()
        descriptors = np.zeros((len(raw.view_idx), _DESCRIPTOR_LENGTH), np.uint8)
        for view_idx, view in enumerate(views):
            of_view = np.flatnonzero(raw.view_idx == view_idx)
            for tile in _tiles(view):
                owned = of_view[tile.owns(raw.points_px[of_view])]
                if len(owned):
                    descriptors[owned] = root_sift(_describe_tile(detector, view, tile, raw.take(owned)))
        return descriptors


@dataclass(frozen=True, eq=False)
class _Raw:
    """N detected features: source_px (N, 2) float64, octaves (N,) OpenCV's packed octave, the rest as in Features."""

    source_px: FloatArray
    source_sizes_px: FloatArray
    points_px: FloatArray
    sizes_px: FloatArray
    orientations_deg: FloatArray
    responses: FloatArray
    octaves: IntArray
    view_idx: IntArray

    def take(self, which: IntArray | BoolArray) -> _Raw:
        return _Raw(**{key: value[which] for key, value in vars(self).items()})


def _concatenate(parts: list[_Raw]) -> _Raw:
    return _Raw(**{key: np.concatenate([getattr(part, key) for part in parts]) for key in vars(parts[0])})


def _detect_tile(detector: Any, view: ViewPixels, tile: Tile, view_idx: int) -> _Raw:
    window = (slice(tile.y0, tile.y1), slice(tile.x0, tile.x1))
    seen = view.valid is None or bool(view.valid[window].any())
    keypoints = detector.detect(view.gray[window], None) if seen else ()
    table = np.array([(*k.pt, k.size, k.angle, k.response, k.octave) for k in keypoints], np.float64).reshape(-1, 6)
    points = (table[:, :2] + [tile.x0, tile.y0]).astype(np.float32)
    # A fixed order, whatever the detector's: by place, then size; orientations of a point stay side by side.
    order = np.lexsort((table[:, 3], table[:, 2], points[:, 0], points[:, 1]))
    order = order[tile.owns(points[order])]
    octaves = table[order, 5].astype(np.int32)
    table = table[order].astype(np.float32)
    return _Raw(
        source_px=points[order].astype(np.float64),
        source_sizes_px=table[:, 2],
        points_px=points[order],
        sizes_px=table[:, 2],
        orientations_deg=table[:, 3],
        responses=table[:, 4],
        octaves=octaves,
        view_idx=np.full(len(order), view_idx, np.int32),
    )


def _describe_tile(detector: Any, view: ViewPixels, tile: Tile, raw: _Raw) -> NDArray[np.uint8]:
    """SIFT bytes (N, 128) of features of one tile, in their order."""
    import cv2

    window = view.gray[tile.y0 : tile.y1, tile.x0 : tile.x1]
    places = raw.points_px - np.array([tile.x0, tile.y0], np.float32)
    rows = zip(places.tolist(), raw.sizes_px, raw.orientations_deg, raw.responses, raw.octaves, strict=True)
    keypoints = [cv2.KeyPoint(x, y, float(s), float(a), float(r), int(o)) for (x, y), s, a, r, o in rows]
    kept, descriptors = detector.compute(window, keypoints)
    if len(kept) != len(keypoints):
        raise RuntimeError(f"OpenCV described {len(kept)} of {len(keypoints)} keypoints")
    return np.asarray(descriptors, dtype=np.uint8)


def _tiles(view: ViewPixels) -> list[Tile]:
    height, width = view.gray.shape
    return list(tiles(width, height, _TILE_AREA_PX, _TILE_MARGIN_PX))


def root_sift(descriptors: NDArray[Any]) -> NDArray[np.uint8]:
    """(N, 128) uint8 of SIFT bytes (N, 128): 512 times the square root of the L1-normalised values, clipped at 255."""
    values = descriptors.astype(np.float32)
    sums = np.maximum(values.sum(axis=1, keepdims=True), 1.0)
    return np.minimum(np.rint(np.sqrt(values / sums) * np.float32(512.0)), 255.0).astype(np.uint8)


def _away_from_mask(raw: _Raw, valid: BoolArray | None) -> _Raw:
    """Without the features whose blob touches an unseen pixel: a mask's edge is no texture."""
    if valid is None or bool(valid.all()) or len(raw.points_px) == 0:
        return raw
    import cv2

    distance = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    height, width = valid.shape
    x = np.clip(np.rint(raw.points_px[:, 0]).astype(np.int64), 0, width - 1)
    y = np.clip(np.rint(raw.points_px[:, 1]).astype(np.int64), 0, height - 1)
    return raw.take(distance[y, x] > 1.0 + raw.sizes_px)


def _in_source(camera: Camera, view: ViewPixels, raw: _Raw) -> _Raw:
    """The same with source_px and source_sizes_px filled in; features that the source cannot see are left out."""
    if view.view.is_source or len(raw.points_px) == 0:
        return raw
    warp = view.view.undistorted_from_view
    points = raw.points_px.astype(np.float64)
    ring = [
        source_from_view(camera, warp, points + step) for step in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))
    ]
    along_x, along_y = ring[0] - ring[1], ring[2] - ring[3]
    scale = np.sqrt(np.abs(along_x[:, 0] * along_y[:, 1] - along_x[:, 1] * along_y[:, 0]))
    source = source_from_view(camera, warp, points)
    limits = np.array([camera.width_px, camera.height_px]) - 0.5
    with np.errstate(invalid="ignore"):
        inside = np.isfinite(scale) & (source >= -0.5).all(axis=1) & (source < limits).all(axis=1)
    moved = _Raw(**(vars(raw) | {"source_px": source, "source_sizes_px": (raw.sizes_px * scale).astype(np.float32)}))
    return moved.take(inside)


def _within_budget(raw: _Raw, keypoint_idx: IntArray, chosen: IntArray, budget: int) -> tuple[_Raw, IntArray]:
    """Features (D,) of the chosen keypoints, those of one keypoint side by side, and the keypoint of each.

    What exceeds the budget are second features, dropped from the end of the list: no keypoint loses its first.
    """
    number = np.full(int(keypoint_idx.max(initial=-1)) + 1, -1, np.int64)
    number[chosen] = np.arange(len(chosen))
    numbers = number[keypoint_idx]
    order = np.argsort(numbers, kind="stable")
    order = order[numbers[order] >= 0]
    further = np.flatnonzero(numbers[order][1:] == numbers[order][:-1]) + 1
    order = np.delete(order, further[len(further) - max(0, len(order) - budget) :])
    return raw.take(order), numbers[order].astype(np.int32)


def _features(
    points: _Raw, described: _Raw, numbers: IntArray, descriptors: NDArray[np.uint8], views: Sequence[ViewPixels]
) -> Features:
    return Features(
        keypoints_px=points.source_px.astype(np.float32),
        sizes_px=points.source_sizes_px,
        responses=points.responses,
        descriptors=descriptors,
        descriptor_keypoint_idx=numbers,
        view_idx=described.view_idx,
        view_keypoints_px=described.points_px,
        view_size_px=described.sizes_px,
        view_orientation_deg=described.orientations_deg,
        view_sizes_px=np.array([(v.view.width_px, v.view.height_px) for v in views], np.int32).reshape(-1, 2),
        view_angles_deg=np.array([v.view.angle_deg for v in views], np.float32),
        view_directions=np.array([_or_nan(v.view.world_direction, 3) for v in views], np.float32).reshape(-1, 3),
        view_gsd_m=np.array([_or_nan(v.view.gsd_m) for v in views], np.float32).reshape(-1),
    )


def _or_nan(value: FloatArray | float | None, length: int = 1) -> FloatArray:
    return np.full(length, np.nan) if value is None else np.asarray(value, np.float64).reshape(length)
