"""Tables of the rows of `bench polar`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from benchmarks.polar.rows import ADJUSTED, RIGHT_PX
from benchmarks.tables import Column, Row, grouped, table, total, values

_Rows = Sequence[Row]
# "Within 1 %" of a translation, and of a turn, but of a small one so many degrees.
_SHARE, _LEAST_TURN_DEG = 0.01, 0.1


def tables(rows: _Rows) -> str:
    parts = []
    for (size,), own in grouped([row for row in rows if row["section"] == "known"], "size"):
        parts.append(f"Known parameters, {size}:\n\n{known_table(own)}")
    parts += [time_table(rows), unknown_table(rows), agreement_table(rows), honesty_table(rows)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _by_method(rows: _Rows, section: str) -> list[tuple[tuple[str, str], _Rows]]:
    """Kind, method and rows; methods in the same order for every kind."""
    own = [row for row in rows if row["section"] == section]
    order = list(dict.fromkeys(row["method"] for row in own))
    return list(grouped(sorted(own, key=lambda row: order.index(row["method"])), "kind", "method"))


def _median(field: str, digits: str, of: Callable[[_Rows], _Rows] = list) -> Callable[[_Rows], str]:
    def cell(rows: _Rows) -> str:
        found = values(of(rows), field)
        return f"{np.median(found):{digits}}" if found else "-"

    return cell


def _spread(field: str, digits: str) -> Callable[[_Rows], str]:
    def cell(rows: _Rows) -> str:
        found = values(_accepted(rows), field)
        return f"{np.median(found):{digits}} / {np.percentile(found, 95):{digits}}" if found else "-"

    return cell


def _accepted(rows: _Rows) -> _Rows:
    return [row for row in rows if row["accepted"]]


def _right(rows: _Rows) -> str:
    return f"{total(rows, 'tie_points_right') / max(total(rows, 'tie_points'), 1):.3f}"


_KNOWN: tuple[Column[_Rows], ...] = (
    ("pairs", len),
    ("accepted", lambda rows: len(_accepted(rows))),
    (
        f"of them > {RIGHT_PX:.0f} px off",
        lambda rows: sum(row["translation_error_px"] > RIGHT_PX for row in _accepted(rows)),
    ),
    ("displacement px, median / 95 %", _spread("translation_error_px", ".3f")),
    ("turn degrees", _spread("rotation_error_deg", ".4f")),
    ("scale", _spread("scale_error", ".1e")),
    ("seconds", _median("seconds", ".2f")),
    ("with tie points", _median("seconds_tie_points", ".2f")),
    ("tie points", _median("tie_points", ".0f", _accepted)),
    ("right", lambda rows: _right(_accepted(rows))),
    ("error px", _median("tie_point_error_px", ".3f", _accepted)),
    ("coverage", _median("coverage", ".2f", _accepted)),
)
_UNKNOWN: tuple[Column[_Rows], ...] = (
    ("pairs", len),
    ("registered", lambda rows: sum(row["right"] for row in _accepted(rows))),
    ("wrongly", lambda rows: sum(not row["right"] for row in _accepted(rows))),
    ("tie points", _median("tie_points", ".0f")),
    ("right", _right),
    ("right a pair", _median("tie_points_right", ".0f")),
    ("error px", _median("tie_point_error_px", ".2f", lambda rows: [row for row in rows if row["tie_points"]])),
    ("coverage (mean of all pairs)", lambda rows: f"{np.mean([row['coverage'] for row in rows]):.2f}"),
    ("seconds", _median("seconds_tie_points", ".2f")),
)


def _near(row: Row) -> bool:
    return bool(row["translation_error_px"] <= _SHARE * row["translation_px"])


def _alike(row: Row) -> bool:
    return bool(row["rotation_error_deg"] <= max(_LEAST_TURN_DEG, _SHARE * row["rotation_deg"]))


def _differs(rows: _Rows) -> str:
    shares = [row["translation_error_px"] / row["translation_px"] for row in _accepted(rows)]
    return f"{np.median(shares):.2%}" if shares else "-"


_AGREEMENT: tuple[Column[_Rows], ...] = (
    ("pairs that SIFT registers", len),
    ("and polar", lambda rows: len(_accepted(rows))),
    ("translation within 1 %", lambda rows: sum(map(_near, _accepted(rows)))),
    ("turn within 0.1 degrees or 1 %", lambda rows: sum(map(_alike, _accepted(rows)))),
    ("translation differs by, median", _differs),
    ("turn differs by, degrees", _median("rotation_error_deg", ".3f", _accepted)),
)
_HONESTY: tuple[Column[_Rows], ...] = (
    ("pairs", len),
    ("accepted", lambda rows: len(_accepted(rows))),
    ("seconds", _median("seconds", ".2f")),
)
# Seconds (3, N) of SIFT, of polar's registration, and with tie points.
_TIMES: tuple[Column[np.ndarray], ...] = (
    ("pairs", lambda times: times.shape[1]),
    ("SIFT seconds", lambda times: f"{np.median(times[0]):.2f}"),
    ("polar seconds", lambda times: f"{np.median(times[1]):.2f}"),
    ("with tie points", lambda times: f"{np.median(times[2]):.2f}"),
    ("registration / SIFT", lambda times: f"{np.median(times[1] / times[0]):.1%}"),
    ("with tie points / SIFT", lambda times: f"{np.median(times[2] / times[0]):.1%}"),
    ("slowest registration / SIFT", lambda times: f"{np.max(times[1] / times[0]):.1%}"),
)


def _unless_empty(heads: Sequence[str], lines: Sequence, columns: Sequence) -> str:
    return table(heads, lines, columns) if lines else ""


def known_table(rows: _Rows) -> str:
    return _unless_empty(("ground", "method"), _by_method(rows, "known"), _KNOWN)


def time_table(rows: _Rows) -> str:
    """Of pairs that SIFT took at full size: polar's seconds over its."""

    def lines() -> Iterator[tuple[tuple[str, str, str], np.ndarray]]:
        for section, sift, method in (
            ("known", "sift", "polar"),
            ("known", "sift", ADJUSTED),
            ("unknown", "sift 0.8", "polar"),
        ):
            for (size,), own in grouped([row for row in rows if row["section"] == section], "size"):
                pairs: dict[str, dict[Any, Row]] = {sift: {}, method: {}}
                for row in own:
                    pairs.setdefault(row["method"], {})[row["kind"], row["pair"]] = row
                other, mine = pairs[sift], pairs[method]
                if both := sorted(other.keys() & mine.keys()):
                    times = [[other[at]["seconds"], mine[at]["seconds"], mine[at]["seconds_tie_points"]] for at in both]
                    yield (section, method, size), np.array(times).T

    return _unless_empty(("parameters", "method", "size"), list(lines()), _TIMES)


def unknown_table(rows: _Rows) -> str:
    return _unless_empty(("block", "method"), _by_method(rows, "unknown"), _UNKNOWN)


def agreement_table(rows: _Rows) -> str:
    """How polar agrees with SIFT where that works."""
    both = [row for row in rows if row.get("translation_px") is not None]
    return _unless_empty(("block", "method"), _by_method(both, "unknown"), _AGREEMENT)


def honesty_table(rows: _Rows) -> str:
    lines = [((kind,), own) for (kind, _), own in _by_method(rows, "honesty")]
    return _unless_empty(("content",), lines, _HONESTY)
