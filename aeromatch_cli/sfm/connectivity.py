"""This module chooses which matches are probable enough to stay, so that no image is cut off from its block."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.geometry.components import labels_by_name

# Matches left to a pair without which images fall apart: enough for a relative orientation, few among all others.
_BRIDGING = 30


def probable_enough(
    ends: Sequence[tuple[str, str]], likely: Sequence[FloatArray | None], least: float, min_matches: int
) -> list[BoolArray | None]:
    """Return, for every pair, which of its matches (M,) are as probable as asked; None where no probabilities are
    known.

    Where images that pairs have tied would fall apart by that, the pairs between the parts keep their best 30 matches:
    a block whose flights lie a few pixels off each other is worth more than flights that nothing connects. ends: image
    ids. likely: probabilities (M,). min_matches: a pair with fewer ties nothing.
    """
    keep = [None if p is None else p >= least for p in likely]
    tied = [both for both, mask in zip(ends, keep, strict=True) if mask is None or mask.sum() >= min_matches]
    part = labels_by_name(sorted({image_id for both in ends for image_id in both}), tied)
    for n, (both, p) in enumerate(zip(ends, likely, strict=True)):
        if p is not None and len(p) >= min_matches and part[both[0]] != part[both[1]]:
            best = np.zeros(len(p), dtype=bool)
            best[np.argsort(-p, kind="stable")[: max(_BRIDGING, min_matches)]] = True
            keep[n] = best | (p >= least)
    return keep
