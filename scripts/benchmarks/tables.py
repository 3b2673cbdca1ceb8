"""Rows of figures, on file and as Markdown. A row is a JSON object; what is unknown is null there, "-" in a table."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from aeromatch_cli.files import write_text

Row = dict[str, Any]
T = TypeVar("T")
# Title of a column, and how its cell is made of what a line is about.
Column = tuple[str, Callable[[T], object]]


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


def mean(rows: Iterable[Row], field: str) -> float:
    """Over the rows that have a figure, NaN without any."""
    return float(np.mean(found)) if (found := values(rows, field)) else math.nan


def median(rows: Iterable[Row], field: str) -> float:
    """Over the rows that have a figure, NaN without any."""
    return float(np.median(found)) if (found := values(rows, field)) else math.nan


def ratio(part: float, whole: float) -> float:
    """part / whole; inf where only whole is 0, NaN where both are."""
    if whole == 0:
        return math.nan if part == 0 else math.inf
    return part / whole


def code(name: object) -> str:
    """As code in Markdown."""
    return f"`{name}`"


def factor(value: float) -> str:
    return "-" if math.isnan(value) else "inf" if math.isinf(value) else f"{value:.2f} x"


def percent(share: float, digits: int = 0) -> str:
    return "-" if not math.isfinite(share) else f"{100 * share:.{digits}f} %"


def number(value: float, digits: int = 0) -> str:
    return "-" if not math.isfinite(value) else f"{value:.{digits}f}"
