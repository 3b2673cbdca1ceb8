"""SIFT on a view in two steps, tile by tile: detection and description."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, IntArray
from aeromatch_cli.geometry.warps import source_from_view
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.tiles import Tile, tiles

TILE_AREA_PX = 4_000_000
TILE_MARGIN_PX = 128
DESCRIPTOR_LENGTH = 128


@dataclass(frozen=True, eq=False)
class Raw:
    """N detected features: source_px (N, 2) float64, octaves (N,) OpenCV's packed octave, the rest as in Features."""

    source_px: FloatArray
    source_sizes_px: FloatArray
    points_px: FloatArray
    sizes_px: FloatArray
    orientations_deg: FloatArray
    responses: FloatArray
    octaves: IntArray
    view_idx: IntArray

    @classmethod
    def of_points(cls, points_px: FloatArray, sizes_px: FloatArray, responses: FloatArray, view_idx: int) -> Raw:
        """Points (N, 2) of one view with sizes and responses (N,), not turned, of no octave."""
        count, sizes = len(points_px), sizes_px.astype(np.float32)
        return cls(
            source_px=points_px,
            source_sizes_px=sizes,
            points_px=points_px.astype(np.float32),
            sizes_px=sizes,
            orientations_deg=np.zeros(count, np.float32),
            responses=responses.astype(np.float32),
            octaves=np.zeros(count, np.int32),
            view_idx=np.full(count, view_idx, np.int32),
        )

    def take(self, which: IntArray | BoolArray) -> Raw:
        return Raw(**{key: value[which] for key, value in vars(self).items()})

    def starts(self) -> BoolArray:
        """Which features (N,) begin a new point: neighbours of equal view, place and size are its orientations."""
        rows = np.column_stack([self.view_idx, self.points_px, self.sizes_px])
        return np.concatenate([np.ones(min(1, len(rows)), dtype=bool), (rows[1:] != rows[:-1]).any(axis=1)])

    def upright(self) -> Raw:
        """One feature per point, orientation 0."""
        points = self.take(self.starts())
        return Raw(**(vars(points) | {"orientations_deg": np.zeros_like(points.orientations_deg)}))


@dataclass(frozen=True)
class SiftSettings:
    """Of OpenCV's SIFT, as `extract=sift` documents them."""

    contrast_threshold: float = 0.004
    edge_threshold: float = 10.0
    octave_layers: int = 3
    sigma: float = 1.6


SIFT = SiftSettings()
# Up to this size a larger blob is found again more surely, because noise averages out over it; beyond, relief and
# perspective cost as much as that gains (share of keypoints found again in rendered pairs, by size).
_STABLE_SIZE_PX = 6.0


def sift_detector(settings: SiftSettings = SIFT) -> Any:
    """cv2.SIFT, for `detect` and `describe`."""
    import cv2

    return cv2.SIFT.create(
        nfeatures=0,
        nOctaveLayers=settings.octave_layers,
        contrastThreshold=settings.contrast_threshold,
        edgeThreshold=settings.edge_threshold,
        sigma=settings.sigma,
        descriptorType=cv2.CV_8U,
        enable_precise_upscale=True,  # without it every keypoint is off by a quarter pixel
    )


def balanced(raw: Raw) -> FloatArray:
    """What of SIFT's features (N,) is found again most surely: response x size^2, sizes up to _STABLE_SIZE_PX."""
    return raw.responses * np.minimum(raw.sizes_px, _STABLE_SIZE_PX) ** 2


def concatenate(parts: Sequence[Raw]) -> Raw:
    return Raw(**{key: np.concatenate([getattr(part, key) for part in parts]) for key in vars(parts[0])})


def detect(detector: Any, view: ViewPixels, view_idx: int) -> Raw:
    """All features of one view, away from its mask, sorted by tile, then place and size."""
    parts = [_detect_tile(detector, view, tile, view_idx) for tile in _tiles(view)]
    return _away_from_mask(concatenate(parts), view.valid)


def describe(detector: Any, raw: Raw, views: Sequence[ViewPixels]) -> NDArray[np.uint8]:
    """RootSIFT bytes (N, 128) of the features, each from the tile that found it."""
    descriptors = np.zeros((len(raw.view_idx), DESCRIPTOR_LENGTH), np.uint8)
    for view_idx, view in enumerate(views):
        of_view = np.flatnonzero(raw.view_idx == view_idx)
        for tile in _tiles(view):
            owned = of_view[tile.owns(raw.points_px[of_view])]
            if len(owned):
                descriptors[owned] = root_sift(_describe_tile(detector, view, tile, raw.take(owned)))
    return descriptors


def in_source(camera: Camera, view: ViewPixels, raw: Raw) -> Raw:
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
    moved = Raw(**(vars(raw) | {"source_px": source, "source_sizes_px": (raw.sizes_px * scale).astype(np.float32)}))
    return moved.take(inside)


def root_sift(descriptors: NDArray[Any]) -> NDArray[np.uint8]:
    """(N, 128) uint8 of SIFT bytes (N, 128): 512 times the square root of the L1-normalised values, clipped at 255."""
    values = descriptors.astype(np.float32)
    sums = np.maximum(values.sum(axis=1, keepdims=True), 1.0)
    return np.minimum(np.rint(np.sqrt(values / sums) * np.float32(512.0)), 255.0).astype(np.uint8)


def _detect_tile(detector: Any, view: ViewPixels, tile: Tile, view_idx: int) -> Raw:
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
    return Raw(
        source_px=points[order].astype(np.float64),
        source_sizes_px=table[:, 2],
        points_px=points[order],
        sizes_px=table[:, 2],
        orientations_deg=table[:, 3],
        responses=table[:, 4],
        octaves=octaves,
        view_idx=np.full(len(order), view_idx, np.int32),
    )


def _describe_tile(detector: Any, view: ViewPixels, tile: Tile, raw: Raw) -> NDArray[np.uint8]:
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
    return list(tiles(width, height, TILE_AREA_PX, TILE_MARGIN_PX))


def _away_from_mask(raw: Raw, valid: BoolArray | None) -> Raw:
    """Without the features whose blob touches an unseen pixel: a mask's edge is no texture."""
    if valid is None or bool(valid.all()) or len(raw.points_px) == 0:
        return raw
    import cv2

    distance = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    height, width = valid.shape
    x = np.clip(np.rint(raw.points_px[:, 0]).astype(np.int64), 0, width - 1)
    y = np.clip(np.rint(raw.points_px[:, 1]).astype(np.int64), 0, height - 1)
    return raw.take(distance[y, x] > 1.0 + raw.sizes_px)
