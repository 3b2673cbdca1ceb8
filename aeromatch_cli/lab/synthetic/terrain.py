"""Bare ground as a surface of triangles: what rays meet, what truth is asked of, and what the DEM samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from aeromatch_cli.data import FloatArray

# Beyond the area the triangles grow outwards by this factor, up to this distance: hazy country up to the horizon.
_GROWTH, _HORIZON_M = 1.35, 5000.0
_PLANE_CELL_M = 40.0


@dataclass(frozen=True)
class Area:
    """A rectangle of the world plan, metres."""

    x0_m: float
    y0_m: float
    x1_m: float
    y1_m: float

    def grown(self, margin_m: float) -> Area:
        return Area(self.x0_m - margin_m, self.y0_m - margin_m, self.x1_m + margin_m, self.y1_m + margin_m)

    def contains(self, x_m: float, y_m: float) -> bool:
        return self.x0_m <= x_m <= self.x1_m and self.y0_m <= y_m <= self.y1_m


class Terrain(Protocol):
    """The height of the ground everywhere. cell_m: side of the triangles that stand for it, or None for a plane."""

    @property
    def cell_m(self) -> float | None: ...

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """World heights (N,) float64 at plan points (N, 2) float64."""
        ...


@dataclass(frozen=True)
class Flat:
    """The plane z = 0."""

    cell_m: float | None = None

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        return np.zeros(len(xy_m))


@dataclass(frozen=True, eq=False)
class GroundGrid:
    """Heights at the crossings of a grid: even over the area, ever wider beyond it.

    x_m (W,), y_m (H,): ascending. z_m: (H, W). even: the columns and rows (first, last) that are evenly spaced.
    """

    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray
    cell_m: float
    even_columns: tuple[int, int]
    even_rows: tuple[int, int]

    def triangles_m(self) -> FloatArray:
        """(2 (H - 1) (W - 1), 3, 3), counter-clockwise from above."""
        x, y = np.meshgrid(self.x_m, self.y_m)
        corner = np.stack([x, y, self.z_m], axis=2)
        sw, se, nw, ne = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
        lower, upper = np.stack([sw, se, ne], axis=2), np.stack([sw, ne, nw], axis=2)
        return np.stack([lower, upper], axis=2).reshape(-1, 3, 3)

    def even_part(self) -> tuple[float, float, FloatArray]:
        """x and y of the first crossing of the even part, and its heights (h, w)."""
        (c0, c1), (r0, r1) = self.even_columns, self.even_rows
        return float(self.x_m[c0]), float(self.y_m[r0]), self.z_m[r0 : r1 + 1, c0 : c1 + 1]


def sample_terrain(terrain: Terrain, area: Area) -> GroundGrid:
    """The grid of a terrain over an area; crossings lie on multiples of the cell, so that areas share them."""
    cell_m = terrain.cell_m or _PLANE_CELL_M
    x_m, columns = _axis(area.x0_m, area.x1_m, cell_m)
    y_m, rows = _axis(area.y0_m, area.y1_m, cell_m)
    grid = np.stack(np.meshgrid(x_m, y_m), axis=2)
    z_m = np.concatenate([terrain.height_m(row) for row in grid]).reshape(len(y_m), len(x_m))
    return GroundGrid(x_m, y_m, z_m, cell_m, columns, rows)


def _axis(low_m: float, high_m: float, cell_m: float) -> tuple[FloatArray, tuple[int, int]]:
    first, last = np.floor(low_m / cell_m), np.ceil(high_m / cell_m)
    even = np.arange(first, last + 1) * cell_m
    steps = [cell_m * _GROWTH]
    while sum(steps) < _HORIZON_M:
        steps.append(steps[-1] * _GROWTH)
    beyond = np.cumsum(steps)
    axis = np.concatenate([even[0] - beyond[::-1], even, even[-1] + beyond])
    return axis, (len(beyond), len(beyond) + len(even) - 1)
