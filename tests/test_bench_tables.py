"""Intervals by bootstrap and how they are written, against known distributions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from benchmarks.tables import interval, means, medians, ranged, ratio_of_sums


def test_the_interval_of_a_mean_is_that_of_its_standard_error() -> None:
    values = np.random.default_rng(3).normal(10.0, 2.0, 400)
    low, high = interval(values, means)
    error = values.std() / math.sqrt(400)
    assert (low - values.mean()) / error == pytest.approx(-1.645, abs=0.15)
    assert (high - values.mean()) / error == pytest.approx(1.645, abs=0.15)
    assert interval(values, means) == (low, high)  # seeded


def test_ratios_and_medians_are_of_the_units_together() -> None:
    assert interval([(30.0, 10.0), (60.0, 20.0)], ratio_of_sums) == (3.0, 3.0)
    low, high = interval([(10.0, 10.0), (300.0, 100.0)], ratio_of_sums)
    assert (low, high) == (1.0, 3.0)  # one of four draws has the first twice, one the second
    assert interval([1.0, 1.0, 1.0, 9.0, 9.0], medians) == (1.0, 9.0)


def test_one_unit_has_no_interval() -> None:
    assert all(map(math.isnan, interval([4.0], means)))
    assert ranged(4.0, interval([4.0], means), 1) == "4.0"
    assert ranged(1.794, (1.6, 1.951), 2) == "1.79 (1.60 to 1.95)"
    assert ranged(97.24, (96.6, 97.8), 1, " %") == "97.2 % (96.6 to 97.8)"
    assert ranged(math.nan, (1.0, 2.0), 1) == "-"
