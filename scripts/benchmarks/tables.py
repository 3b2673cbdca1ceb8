"""Rows of figures, on file and as Markdown. A row is a JSON object; what is unknown is null there, "-" in a table."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.files import write_text

Row = dict[str, Any]
T = TypeVar("T")
# Title of a column, and how its cell is made of what a line is about.
Column = tuple[str, Callable[[T], object]]
# Maps samples (draws, N, ...) to the statistic of each (draws,).
Statistic = Callable[[FloatArray], FloatArray]
_DRAWS, _LEVEL = 1000, 0.90


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """All of them at once, atomically: a killed run leaves the rows it had made."""
    write_text(path, "[\n" + ",\n".join(json.dumps(row, allow_nan=False) for row in rows) + "\n]\n")


def plain(value: Any) -> Any:
    """A figure for a row: rounded, null for NaN and infinity."""
    if not isinstance(value, float | np.floating):
        return value
    return round(float(value), 6) if math.isfinite(value) else None


def markdown(columns: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    head = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return "\n".join([*head, *("| " + " | ".join(map(str, line)) + " |" for line in lines)])


def table(heads: Sequence[str], groups: Iterable[tuple[Sequence[object], T]], columns: Sequence[Column[T]]) -> str:
    """A line for every group: its labels below `heads`, then the columns' cells of what it holds."""
    lines = [[*labels, *(cell(held) for _, cell in columns)] for labels, held in groups]
    return markdown([*heads, *(title for title, _ in columns)], lines)


def grouped(rows: Iterable[Row], *keys: str | Callable[[Row], Any]) -> Iterator[tuple[tuple[Any, ...], list[Row]]]:
    """Rows that are alike in these fields, and these: nested in the order in which values come first."""
    if not keys:
        yield (), list(rows)
        return
    first, *rest = keys
    value_of = first if callable(first) else lambda row: row[first]
    members: dict[Any, list[Row]] = {}
    for row in rows:
        members.setdefault(value_of(row), []).append(row)
    for value, own in members.items():
        for labels, found in grouped(own, *rest):
            yield (value, *labels), found


def values(rows: Iterable[Row], field: str) -> list[float]:
    """Those that are known."""
    return [float(row[field]) for row in rows if row.get(field) is not None]


def total(rows: Iterable[Row], field: str) -> float:
    return math.fsum(values(rows, field))


def median(rows: Iterable[Row], field: str) -> float:
    """Over the rows that have a figure, NaN without any."""
    return float(np.median(found)) if (found := values(rows, field)) else math.nan


def ratio(part: float, whole: float) -> float:
    """part / whole; inf where only whole is 0, NaN where both are."""
    if whole == 0:
        return math.nan if part == 0 else math.inf
    return part / whole


def interval(units: Sequence[Any] | FloatArray, statistic: Statistic) -> tuple[float, float]:
    """The 90 % interval of a statistic by bootstrap: `units` (N, ...), of pairs or blocks, are drawn N at a time with
    replacement, 1,000 times, with a fixed seed. NaN where there are fewer than two."""
    values = np.asarray(units, np.float64)
    if len(values) < 2:
        return math.nan, math.nan
    drawn = np.random.default_rng(0).integers(len(values), size=(_DRAWS, len(values)))
    with np.errstate(divide="ignore", invalid="ignore"):
        found = statistic(values[drawn])
    found = found[~np.isnan(found)]
    if not len(found):
        return math.nan, math.nan
    low, high = np.quantile(found, [0.5 - _LEVEL / 2, 0.5 + _LEVEL / 2], method="nearest")
    return float(low), float(high)


def ratio_of_sums(samples: FloatArray) -> FloatArray:
    """For `interval`: of units (N, 2), the sum of the first over that of the second."""
    parts: FloatArray = samples.sum(axis=1)
    return np.asarray(parts[:, 0] / parts[:, 1])


def means(samples: FloatArray) -> FloatArray:
    """For `interval`."""
    return np.asarray(samples.mean(axis=1))


def medians(samples: FloatArray) -> FloatArray:
    """For `interval`."""
    return np.asarray(np.median(samples, axis=1))


def ranged(value: float, bounds: tuple[float, float], digits: int, unit: str = "") -> str:
    """A figure with its interval: "1.79 (1.60 to 1.95)"."""
    if not math.isfinite(value):
        return "-"
    text = f"{value:.{digits}f}{unit}"
    return text if math.isnan(bounds[0]) else f"{text} ({bounds[0]:.{digits}f} to {bounds[1]:.{digits}f})"


def extremes(figures: Sequence[float]) -> tuple[float, float]:
    """The least and the most, for `ranged`; NaN of a single one."""
    return (min(figures), max(figures)) if len(figures) > 1 else (math.nan, math.nan)


def code(name: object) -> str:
    """As code in Markdown."""
    return f"`{name}`"


def factor(value: float) -> str:
    return "-" if math.isnan(value) else "inf" if math.isinf(value) else f"{value:.2f} x"


def percent(share: float, digits: int = 0) -> str:
    return "-" if not math.isfinite(share) else f"{100 * share:.{digits}f} %"


def number(value: float, digits: int = 0) -> str:
    return "-" if not math.isfinite(value) else f"{value:.{digits}f}"
