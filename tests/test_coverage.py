"""Ninths of an image that other images show."""

from __future__ import annotations

import numpy as np
import pytest

from aeromatch_cli.geometry.coverage import CELLS, shown_ninths


@pytest.mark.parametrize(
    ("columns", "expected"),
    # Columns of an eighth: a ninth has three, two or three of them (0-2, 3-5, 6-7 by their middles).
    [(0, [0, 0, 0]), (1, [0, 0, 0]), (2, [1, 0, 0]), (4, [1, 0, 0]), (5, [1, 1, 0]), (7, [1, 1, 1]), (8, [1, 1, 1])],
)
def test_a_ninth_counts_of_which_half_is_shown(columns: int, expected: list[int]) -> None:
    seen = np.zeros((CELLS, CELLS), dtype=bool)
    seen[:, :columns] = True
    np.testing.assert_array_equal(shown_ninths(seen), np.tile(np.array(expected, bool), (3, 1)))
    np.testing.assert_array_equal(shown_ninths(seen.T), np.tile(np.array(expected, bool), (3, 1)).T)
