"""A terrain model from the points of oriented images: robust against wrong points, complete within the block."""

from __future__ import annotations

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


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights on a grid.

    heights_m: (H, W) float32 world heights, rows from north to south, no gaps. west_m, north_m: world position of the
    centre of the first cell. cell_m: spacing, the same both ways. spread_m: median distance of the points used from
    the heights.
    """

    heights_m: FloatArray
    west_m: float
    north_m: float
    cell_m: float
    spread_m: float


def terrain_of(points_m: FloatArray, area_m: FloatArray) -> Terrain | None:
    """Heights over the area of a block, None from too few points.

    points_m: (P, 3) triangulated points, some of them wrong. area_m: (N, 2) world points that the grid must enclose
    (the points are enclosed in any case). A cell's height is the median of the points nearest to its centre, so that
    the surface that most pictures see counts, and single wrong points do not; beyond the points the nearest go on.
    """
    from scipy.ndimage import gaussian_filter
    from scipy.spatial import cKDTree

    points_m = _without_outliers(points_m)
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
    at = np.rint((points_m[:, :2] - [x[0], y[0]]) / [cell, -cell]).astype(int)
    spread = float(np.median(np.abs(points_m[:, 2] - heights[at[:, 1], at[:, 0]])))
    return Terrain(heights, float(x[0]), float(y[0]), cell, spread)


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
