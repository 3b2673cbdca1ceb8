"""Places: images that lie too far from each other to show the same ground."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.geometry.components import component_labels

# Farther apart no two aerial images show the same ground: a camera 10 km above it looks at most 50 km far, where the
# ground is seen at 11 degrees. Strips of one flight lie closer together by far.
APART_M = 50_000.0
# Positions are joined to such squares first: what lies apart stays so, and large blocks have few of them.
_SQUARE_M = 1000.0


def place_labels(positions_m: FloatArray) -> IntArray:
    """(N,) number of the place of each position (N, 2 or 3), in the order of their first ones: whoever has a
    neighbour of a place within APART_M lies in that place."""
    from scipy.spatial import cKDTree

    positions_m = np.asarray(positions_m, float)[:, :2]
    if len(positions_m) < 2 or np.hypot(*np.ptp(positions_m, axis=0)) <= APART_M:
        return np.zeros(len(positions_m), dtype=int)
    squares, first, square_of = np.unique(
        np.floor(positions_m / _SQUARE_M), axis=0, return_index=True, return_inverse=True
    )
    order = np.argsort(first)  # squares in the order of the positions that came first
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    ties = cKDTree(squares[order]).query_pairs(APART_M / _SQUARE_M, output_type="ndarray")
    return component_labels(len(squares), ties)[rank[square_of.reshape(-1)]]
