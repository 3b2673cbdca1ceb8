"""What context is worth: nearest neighbours of unseen pairs with and without it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trainings.context.data import ContextPair, ViewSeen

Array = NDArray[Any]
# Edges of the classes of view angle, degrees.
ANGLES = (0.0, 20.0, 40.0, 60.0, 180.0)
Describe = Callable[[ViewSeen], Array]


def compared(pairs: Sequence[ContextPair], describe: Describe) -> dict[str, dict[str, float]]:
    """By class of view angle: pairs, rank-1 rate and mean average precision of nearest neighbours.

    Rank-1 rate: share of the keypoints with a partner whose nearest descriptor is that of the partner. Average
    precision: all keypoints of a pair ordered by the ratio of the distances to the nearest and the second one; right
    is the partner, unknown ones are left out, recall is over all with a partner.
    """
    table = {}
    known: dict[int, Array] = {}
    for low, high in pairwise(ANGLES):
        rows = [_judged(pair, describe, known) for pair in pairs if low <= pair.angle_deg < high]
        if rows:
            # Plain numbers: a state of others cannot be read back.
            first, precision = np.mean(rows, axis=0).tolist()
            name = f"{low:.0f}-{high:.0f}" if high < ANGLES[-1] else f"> {low:.0f}"
            table[name] = {"pairs": len(rows), "rank1": round(first, 4), "map": round(precision, 4)}
    return table


def _judged(pair: ContextPair, describe: Describe, known: dict[int, Array]) -> tuple[float, float]:
    for view in (pair.view0, pair.view1):
        if id(view) not in known:
            known[id(view)] = describe(view)
    similar = known[id(pair.view0)] @ known[id(pair.view1)].T
    rows = np.arange(len(similar))
    best = similar.argmax(axis=1)
    nearest = similar[rows, best].copy()
    similar[rows, best] = -np.inf
    ratio = np.sqrt(np.maximum(2.0 - 2.0 * nearest, 0.0) / np.maximum(2.0 - 2.0 * similar.max(axis=1), 1e-9))
    mates = pair.truth.of0
    right, has_mate = best == mates, mates >= 0
    order = np.argsort(ratio, kind="stable")
    order = order[mates[order] != -2]
    hits = np.cumsum(right[order])
    precision = hits / np.arange(1, len(order) + 1)
    return float(right[has_mate].mean()), float((precision * right[order]).sum() / max(has_mate.sum(), 1))
