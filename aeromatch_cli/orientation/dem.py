"""A terrain model from the points of oriented images: robust against wrong points, complete within the block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import FloatArray

# A cell is as wide as holds about this many points; no more cells a side than that.
_POINTS_PER_CELL = 4.0
_MAX_CELLS = 400
_NEIGHBOURS = 16
# Points farther from the median of their neighbours than so many median deviations are wrong.
_OUTLIER_DEVIATIONS = 4.0
_MIN_POINTS = 12
# More points than this say no more of a terrain.
_MOST_POINTS = 50_000
# A terrain of more pictures is the same up to this share of the flying height.
_SAME_SHARE = 0.02


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights on a grid.

    heights_m: (H, W) world heights, rows from north to south, no gaps. west_m, north_m: world position of the centre
    of the first cell. cell_m: spacing, the same both ways.
    """

    heights_m: FloatArray
    west_m: float
    north_m: float
    cell_m: float


def terrain_of(points_m: FloatArray, area_m: FloatArray) -> Terrain | None:
    """Heights over the area of a block, None from too few points.

    points_m: (P, 3) triangulated points, some of them wrong. area_m: (N, 2) world points that the grid must enclose
    (the points are enclosed in any case). A cell's height is the median of the points nearest to its centre, so that
    the surface that most pictures see counts, and single wrong points do not; beyond the points the nearest go on.
    """
    from scipy.ndimage import gaussian_filter
    from scipy.spatial import cKDTree

    points_m = _without_outliers(points_m[:: 1 + len(points_m) // _MOST_POINTS])
    if len(points_m) < _MIN_POINTS:
        return None
    around = np.concatenate([points_m[:, :2], np.asarray(area_m).reshape(-1, 2)])
    low, high = around.min(axis=0), around.max(axis=0)
    # The distance to the fourth nearest point tells the density where most points lie.
    near, _ = cKDTree(points_m[:, :2]).query(points_m[:, :2], k=5)
    spacing = float(np.median(near[:, 4])) * np.sqrt(np.pi / 4.0)
    extent = float((high - low).max())
    cell = max(spacing * np.sqrt(_POINTS_PER_CELL), extent / _MAX_CELLS, 1e-6)
    columns, rows = (np.ceil((high - low) / cell).astype(int) + 1).tolist()
    x = low[0] + cell * np.arange(columns)
    y = low[1] + cell * np.arange(rows)[::-1]
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    _, nearest = cKDTree(points_m[:, :2]).query(centres, k=min(_NEIGHBOURS, len(points_m)))
    heights = np.median(points_m[:, 2][nearest], axis=1).reshape(rows, columns)
    heights = gaussian_filter(heights, 0.7, mode="nearest").astype(np.float32)
    return Terrain(heights, float(x[0]), float(y[0]), cell)


def terrains_of(parts: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[Terrain, ...]:
    """Terrains of flights that may lie anywhere, in the order of the first of them: one for all that lie together.

    parts: of every group of images, its points (P, 3) and its projection centres (N, 3). Flights far apart in one grid
    would have cells as wide as a valley.
    """
    flights: list[list[tuple[FloatArray, FloatArray]]] = []
    for part in parts:
        near = [flight for flight in flights if any(_meet(part[1], other[1]) for other in flight)]
        joined = [one for flight in near for one in flight]
        flights = [flight for flight in flights if not any(flight is one for one in near)]
        flights.append([*joined, part])
    flights.sort(key=lambda flight: min(n for n, part in enumerate(parts) if any(part is one for one in flight)))
    found = [
        terrain_of(np.concatenate([points for points, _ in flight]), np.concatenate([c[:, :2] for _, c in flight]))
        for flight in flights
    ]
    return tuple(terrain for terrain in found if terrain is not None)


def _meet(centers0_m: FloatArray, centers1_m: FloatArray) -> bool:
    """Whether the boxes of two flights (N, 3) meet, each wider by its own extent on every side."""
    boxes = []
    for centers in (centers0_m[:, :2], centers1_m[:, :2]):
        margin = float(np.ptp(centers, axis=0).max())
        boxes.append((centers.min(axis=0) - margin, centers.max(axis=0) + margin))
    (low0, high0), (low1, high1) = boxes
    return bool((low0 <= high1).all() and (low1 <= high0).all())


def continued(old: Terrain, new: Terrain, centers_m: FloatArray) -> Terrain:
    """The old terrain of a block that has grown, with heights of the new one around it; the new one where they differ.

    centers_m: (N, 3) projection centres. Cells of the old terrain keep their places and heights, so that views made of
    it stay as they are.
    """
    inside = _sampled(new, _grid(old)).reshape(old.heights_m.shape)
    height_m = abs(float(np.median(centers_m[:, 2]) - np.median(old.heights_m)))
    if float(np.median(np.abs(inside - old.heights_m))) > _SAME_SHARE * height_m:
        return new
    low, high = _extent(old)
    low_new, high_new = _extent(new)
    before = np.maximum(np.ceil((low - low_new) / old.cell_m - 1e-6), 0).astype(int)
    after = np.maximum(np.ceil((high_new - high) / old.cell_m - 1e-6), 0).astype(int)
    if not before.any() and not after.any():
        return old
    rows, columns = np.array(old.heights_m.shape) + (before + after)[::-1]
    whole = Terrain(
        np.zeros((rows, columns)), old.west_m - before[0] * old.cell_m, old.north_m + after[1] * old.cell_m, old.cell_m
    )
    heights = _sampled(new, _grid(whole)).reshape(rows, columns)
    heights[after[1] : rows - before[1], before[0] : columns - after[0]] = old.heights_m
    return Terrain(heights, whole.west_m, whole.north_m, whole.cell_m)


def _extent(terrain: Terrain) -> tuple[FloatArray, FloatArray]:
    """South-west and north-east corner cell's centres."""
    rows, columns = terrain.heights_m.shape
    south, east = terrain.north_m - (rows - 1) * terrain.cell_m, terrain.west_m + (columns - 1) * terrain.cell_m
    return np.array([terrain.west_m, south]), np.array([east, terrain.north_m])


def _grid(terrain: Terrain) -> FloatArray:
    """(H W, 2) centres of its cells."""
    rows, columns = terrain.heights_m.shape
    x = terrain.west_m + terrain.cell_m * np.arange(columns)
    y = terrain.north_m - terrain.cell_m * np.arange(rows)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _sampled(terrain: Terrain, places_m: FloatArray) -> FloatArray:
    """Bilinear heights (N,), those of the border beyond it."""
    from scipy.ndimage import map_coordinates

    columns = (places_m[:, 0] - terrain.west_m) / terrain.cell_m
    rows = (terrain.north_m - places_m[:, 1]) / terrain.cell_m
    return np.asarray(map_coordinates(terrain.heights_m.astype(float), [rows, columns], order=1, mode="nearest"))


def _without_outliers(points_m: FloatArray) -> FloatArray:
    """Points (P, 3) that are finite and near the median height of their neighbours, and not far off sideways."""
    from scipy.spatial import cKDTree

    points_m = points_m[np.isfinite(points_m).all(axis=1)]
    if len(points_m) < _MIN_POINTS:
        return points_m
    middle = np.median(points_m, axis=0)
    far = np.linalg.norm(points_m[:, :2] - middle[:2], axis=1)
    points_m = points_m[far <= 5.0 * float(np.percentile(far, 75)) + 1e-9]
    _, nearest = cKDTree(points_m[:, :2]).query(points_m[:, :2], k=min(_NEIGHBOURS, len(points_m)))
    around = points_m[:, 2][nearest]
    off = np.abs(points_m[:, 2] - np.median(around, axis=1))
    usual = np.median(np.abs(around - np.median(around, axis=1)[:, None]), axis=1)
    limit = _OUTLIER_DEVIATIONS * np.maximum(usual, float(np.median(usual))) + 1e-9
    return points_m[off <= limit]
