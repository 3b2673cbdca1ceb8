"""Overlapping tiles that bound the memory of a detector, with cores that share out the picture exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray

# Tile corners lie on a grid that every octave of a scale pyramid samples in the same way.
_ALIGN_PX = 64


@dataclass(frozen=True)
class Tile:
    """A window [x0, x1) x [y0, y1) to work on, and its core: each pixel is in the core of exactly one tile.

    Core bounds are half-open, too, and infinite at the border of the picture.
    """

    x0: int
    y0: int
    x1: int
    y1: int
    core: tuple[float, float, float, float]

    def owns(self, points_px: FloatArray) -> BoolArray:
        """Which points (N, 2), in pixels of the whole picture, have their centre in the core."""
        left, top, right, bottom = self.core
        x, y = points_px[:, 0], points_px[:, 1]
        owned: BoolArray = (x >= left) & (x < right) & (y >= top) & (y < bottom)
        return owned


def tiles(width_px: int, height_px: int, max_area_px: int, margin_px: int) -> list[Tile]:
    """Tiles of at most max_area_px (if the margin leaves room for it), in rows, with the least total area."""
    best: tuple[int, list[Tile]] | None = None
    for columns in range(1, 1 + max(1, width_px // (2 * margin_px))):
        for rows in range(1, 1 + max(1, height_px // (2 * margin_px))):
            layout = _layout(width_px, height_px, columns, rows, margin_px)
            areas = [(t.x1 - t.x0) * (t.y1 - t.y0) for t in layout]
            if max(areas) <= max_area_px:
                if best is None or sum(areas) < best[0]:
                    best = (sum(areas), layout)
                break  # more rows only add overlap
    if best is not None:
        return best[1]
    columns, rows = max(1, width_px // (2 * margin_px)), max(1, height_px // (2 * margin_px))
    return _layout(width_px, height_px, columns, rows, margin_px)


def _layout(width_px: int, height_px: int, columns: int, rows: int, margin_px: int) -> list[Tile]:
    return [
        Tile(x0, y0, x1, y1, (left, top, right, bottom))
        for y0, y1, top, bottom in _spans(height_px, rows, margin_px)
        for x0, x1, left, right in _spans(width_px, columns, margin_px)
    ]


def _spans(length_px: int, count: int, margin_px: int) -> list[tuple[int, int, float, float]]:
    """Start and end of each tile along one axis, then of its core."""
    # The outer tiles have one margin only, so that equal tiles have unequal cores.
    outer = (length_px + 2 * margin_px * (count - 1)) / count - margin_px
    inner = outer - margin_px
    cuts = [outer + inner * k for k in range(count - 1)]
    aligned = [round(cut / _ALIGN_PX) * _ALIGN_PX for cut in cuts]
    lows, highs = [-np.inf, *(cut - 0.5 for cut in aligned)], [*(cut - 0.5 for cut in aligned), np.inf]
    starts, ends = (
        [0, *(max(0, cut - margin_px) for cut in aligned)],
        [*(cut + margin_px for cut in aligned), length_px],
    )
    return [
        (start, min(end, length_px), float(low), float(high))
        for start, end, low, high in zip(starts, ends, lows, highs, strict=True)
    ]
