"""One match per keypoint: what every matcher ends with."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray


def one_to_one(idx0: IntArray, idx1: IntArray, costs: FloatArray) -> IntArray:
    """Positions (int64) of the matches that remain when every keypoint of either side keeps its cheapest match.

    The same as taking matches greedily by ascending cost (first come first on equal costs).
    """
    order = np.argsort(costs, kind="stable")
    kept: list[IntArray] = []
    while len(order):
        first0, first1 = is_first(idx0[order]), is_first(idx1[order])
        chosen = order[first0 & first1]
        kept.append(chosen)
        order = order[~(np.isin(idx0[order], idx0[chosen]) | np.isin(idx1[order], idx1[chosen]))]
    return np.concatenate(kept) if kept else np.zeros(0, np.int64)


def distinct(places_px: FloatArray, costs: FloatArray, radius_px: float) -> IntArray:
    """Positions (int64), ascending, of matches (M, 4), x0, y0, x1, y1, that have no cheaper one which is itself kept
    within the radius in both images.
    """
    from scipy.spatial import cKDTree

    kept = np.ones(len(costs), dtype=bool)
    if len(costs):
        together = cKDTree(places_px).query_pairs(radius_px * np.sqrt(2.0), output_type="ndarray")
        apart = places_px[together[:, 0]] - places_px[together[:, 1]]
        near = np.maximum(np.hypot(apart[:, 0], apart[:, 1]), np.hypot(apart[:, 2], apart[:, 3])) <= radius_px
        rank = np.empty(len(costs), np.int64)
        rank[np.argsort(costs, kind="stable")] = np.arange(len(costs))
        better = np.sort(rank[together[near]], axis=1)
        position = np.argsort(rank)
        for first, second in better[np.lexsort((better[:, 1], better[:, 0]))]:
            kept[position[second]] &= not kept[position[first]]
    return np.flatnonzero(kept)


def is_first(values: IntArray) -> BoolArray:
    """Whether each (N,) has no equal before it."""
    flags = np.zeros(len(values), dtype=bool)
    flags[np.unique(values, return_index=True)[1]] = True
    return flags
