"""Work on a block cut into stretches."""

from __future__ import annotations

import numpy as np
import pytest

from aeromatch_cli.executor import Executor
from aeromatch_cli.geometry.coverage import cells_of
from aeromatch_cli.report.stretches import made_of, stretches


@pytest.mark.parametrize(("items", "parts"), [(10, 3), (2, 5), (0, 2), (7, 1)])
def test_stretches_hold_every_item_once_in_order(items: int, parts: int) -> None:
    cut = stretches(items, parts)
    assert [n for part in cut for n in range(items)[part]] == list(range(items))
    assert len(cut) == parts


def test_what_fails_is_tried_once_more_and_what_is_empty_is_not() -> None:
    calls: list[str] = []

    def make(task: str) -> list[str]:
        calls.append(task)
        if task == "fails once" and calls.count(task) == 1:
            raise ValueError(task)
        return []

    assert made_of(Executor("serial"), make, ["empty", "fails once"], [1, 1]) == [[], []]
    assert calls == ["empty", "fails once", "fails once"]


def test_cells_of_an_image_that_is_no_square() -> None:
    points = np.array([[-0.5, -0.5], [299.4, 99.4], [99.6, 33.0], [199.0, 66.9]])
    np.testing.assert_array_equal(cells_of((300, 100), points, 3), [[0, 0], [2, 2], [1, 1], [2, 1]])
