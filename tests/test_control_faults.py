"""Faults of whole lists of control points, from points that lie where they are known to."""

from __future__ import annotations

import numpy as np
import pytest

from aeromatch_cli.sfm.control_adjustment import fault_of_list

RNG = np.random.default_rng(3)
TRUE_M = RNG.uniform([-120.0, -60.0, 5.0], [130.0, 90.0, 25.0], (6, 3))
FOUND_M = TRUE_M + RNG.normal(0.0, 0.05, TRUE_M.shape)


@pytest.mark.parametrize(
    ("stated_m", "fault"),
    [
        (TRUE_M[:, [1, 0, 2]], "their x and y are exchanged"),
        (TRUE_M / 0.3048, "they are in feet, not in metres"),
        (TRUE_M * 0.3048, "they are in metres and were taken as feet"),
        (TRUE_M * [1.0, -1.0, 1.0], "their y has the other sign"),
        (TRUE_M / [1.0, 1.0, 0.3048], "their heights are in feet, not in metres"),
        (TRUE_M + np.array([0.0, 0.0, 47.0]), ""),  # another zero of heights
        (TRUE_M, ""),
    ],
)
def test_a_fault_that_explains_the_list_is_named(stated_m: np.ndarray, fault: str) -> None:
    assert fault_of_list(FOUND_M, stated_m) == fault


def test_one_wrong_point_hides_no_fault_and_is_none() -> None:
    stated_m = TRUE_M[:, [1, 0, 2]].copy()
    stated_m[2] += 30.0
    assert fault_of_list(FOUND_M, stated_m) == "their x and y are exchanged"
    stated_m = TRUE_M.copy()
    stated_m[2] += 30.0
    assert fault_of_list(FOUND_M, stated_m) == ""


def test_two_points_tell_nothing() -> None:
    assert fault_of_list(FOUND_M[:2], TRUE_M[:2, [1, 0, 2]]) == ""
