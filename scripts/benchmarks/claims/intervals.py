"""Estimates over pairs with bootstrap intervals, and what they say of a claim."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from benchmarks.tables import Row, interval

# Of the rows of pairs, by their positions (..., N), drawn with replacement: figures (...).
Statistic = Callable[[IntArray], FloatArray]


@dataclass(frozen=True)
class Estimate:
    """Value of a statistic over all pairs, and its 90 % interval."""

    value: float
    low: float
    high: float

    def said(self, form: Callable[[float], str]) -> str:
        if not np.isfinite(self.low):
            return form(self.value)
        return f"{form(self.value)} ({form(self.low)} to {form(self.high)})"


def estimate(statistic: Statistic, pairs: int) -> Estimate:
    """Over pairs 0 to `pairs` - 1."""
    every = np.arange(pairs)
    return Estimate(float(statistic(every)), *interval(every, lambda drawn: statistic(drawn.astype(np.int64))))


def verdict(found: Estimate | None, claimed: float, *, larger: bool) -> str:
    """beaten: the whole interval lies beyond the claimed figure; met: the value reaches it. larger: is better."""
    if found is None or not np.isfinite(found.value):
        return "not run"
    sign = 1.0 if larger else -1.0
    if min(sign * found.low, sign * found.high) > sign * claimed:
        return "beaten"
    return "met" if sign * found.value >= sign * claimed else "missed"


def column(rows: Iterable[Row], field: str) -> FloatArray:
    """(N,) of a field, NaN where it is unknown."""
    return np.array([np.nan if row[field] is None else row[field] for row in rows], float)


def of_sums(part: FloatArray, whole: FloatArray) -> Statistic:
    """Sum of one column over that of another; NaN where that is 0."""

    def statistic(chosen: IntArray) -> FloatArray:
        above, below = (np.nansum(values[chosen], axis=-1) for values in (part, whole))
        return np.asarray(np.where(below > 0.0, above / np.where(below > 0.0, below, 1.0), np.nan))

    return statistic


def difference(first: Statistic, second: Statistic) -> Statistic:
    return lambda chosen: first(chosen) - second(chosen)


def change(first: Statistic, second: Statistic) -> Statistic:
    """Of the first against the second, as a share of it."""
    return lambda chosen: first(chosen) / second(chosen) - 1.0


def median_of(values: FloatArray) -> Statistic:
    return lambda chosen: np.asarray(np.nanmedian(values[chosen], axis=-1))


def mean_of(values: FloatArray) -> Statistic:
    return lambda chosen: np.asarray(np.nanmean(values[chosen], axis=-1))
