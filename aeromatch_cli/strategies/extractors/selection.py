"""Which features of an image to keep: a fixed number, spread evenly, strongest first in each place."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray


def even_selection(
    points_px: FloatArray, strengths: FloatArray, width_px: int, height_px: int, count: int, per_cell: int
) -> IntArray:
    """Indices (ascending, int64) of min(count, N) points (N, 2) by round-robin over square cells.

    Every cell gives its strongest point, then its second strongest, and so on until `count` are taken; the last
    round takes the strongest over all cells. Cells are sized to hold per_cell of `count` points on average. Equal
    strengths are ordered by position in the list.
    """
    if len(points_px) <= count:
        return np.arange(len(points_px))
    side = np.sqrt(width_px * height_px * per_cell / count)
    columns, rows = max(1, round(width_px / side)), max(1, round(height_px / side))
    column = np.clip(((points_px[:, 0] + 0.5) * columns / width_px).astype(np.int64), 0, columns - 1)
    row = np.clip(((points_px[:, 1] + 0.5) * rows / height_px).astype(np.int64), 0, rows - 1)
    order = np.lexsort((-strengths, row * columns + column))
    cells = (row * columns + column)[order]
    starts = np.flatnonzero(np.concatenate([[True], cells[1:] != cells[:-1]]))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    return np.sort(np.lexsort((-strengths, rank))[:count])
