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
        first0, first1 = _is_first(idx0[order]), _is_first(idx1[order])
        chosen = order[first0 & first1]
        kept.append(chosen)
        order = order[~(np.isin(idx0[order], idx0[chosen]) | np.isin(idx1[order], idx1[chosen]))]
    return np.concatenate(kept) if kept else np.zeros(0, np.int64)


def _is_first(values: IntArray) -> BoolArray:
    flags = np.zeros(len(values), dtype=bool)
    flags[np.unique(values, return_index=True)[1]] = True
    return flags
