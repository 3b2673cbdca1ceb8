"""Which features of an image to keep: an exact budget, spread evenly, strongest first in each place."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray


def even_selection(
    points_px: FloatArray,
    strengths: FloatArray,
    costs: IntArray,
    size_px: tuple[int, int],
    budget: int,
    per_cell: int,
) -> IntArray:
    """Indices (ascending, int64) of the points (N, 2) that a budget buys, by round-robin over square cells.

    costs (N,): descriptors of each point, >= 1. Every cell gives its strongest point, then its second strongest, and
    so on; the last round takes the strongest over all cells. The last point taken may exceed the budget by its own
    further descriptors, which the caller drops. Cells are sized to hold per_cell of `budget` points on average. Equal
    strengths are ordered by position in the list. size_px: (width, height) of the image.
    """
    if int(costs.sum()) <= budget:
        return np.arange(len(points_px))
    width_px, height_px = size_px
    side = np.sqrt(width_px * height_px * per_cell / budget)
    columns, rows = max(1, round(width_px / side)), max(1, round(height_px / side))
    column = np.clip(((points_px[:, 0] + 0.5) * columns / width_px).astype(np.int64), 0, columns - 1)
    row = np.clip(((points_px[:, 1] + 0.5) * rows / height_px).astype(np.int64), 0, rows - 1)
    order = np.lexsort((-strengths, row * columns + column))
    cells = (row * columns + column)[order]
    starts = np.flatnonzero(np.concatenate([[True], cells[1:] != cells[:-1]]))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    taken = np.lexsort((-strengths, rank))
    spent_before = np.cumsum(costs[taken]) - costs[taken]
    return np.sort(taken[spent_before < budget])
