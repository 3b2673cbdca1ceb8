"""Rows of long arrays by the number that they carry, in one pass over all of them."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import IntArray


def rows_by_number(numbers: IntArray) -> dict[int, IntArray]:
    """Return, by number, the rows (N,) of an array (M,) that hold it, in order."""
    order = np.argsort(numbers, kind="stable")
    values, starts = np.unique(numbers[order], return_index=True)
    return dict(zip(values.tolist(), np.split(order, starts[1:]), strict=True)) if len(values) else {}
