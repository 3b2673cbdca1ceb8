"""Tables of the rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from methods.goal_tables import markdown

from polar_bench.rows import RIGHT_PX, Row

# "Within 1 %" of a translation, and of a turn, but of a small one so many degrees.
_SHARE, _LEAST_TURN_DEG = 0.01, 0.1


def tables(rows: Sequence[Row]) -> str:
    parts = []
    for size in _values(rows, "size", "known"):
        some = [row for row in rows if row["size"] == size]
        parts.append(f"Known parameters, {size}:\n\n" + known_table(some))
    parts.append(time_table(rows))
    parts.append(unknown_table(rows))
    parts.append(agreement_table(rows))
    parts.append(honesty_table(rows))
    return "\n\n".join(part for part in parts if part) + "\n"


def _values(rows: Sequence[Row], name: str, section: str) -> list[str]:
    return list(dict.fromkeys(row[name] for row in rows if row["section"] == section))


def _table(columns: str, lines: Sequence[Sequence[object]]) -> str:
    if not lines:
        return ""
    return markdown([column.strip() for column in columns.split("|")], [[str(cell) for cell in line] for line in lines])


def _groups(rows: Sequence[Row], section: str) -> Iterator[tuple[str, str, list[Row]]]:
    for kind in _values(rows, "kind", section):
        for method in _values(rows, "method", section):
            some = [r for r in rows if (r["section"], r["kind"], r["method"]) == (section, kind, method)]
            if some:
                yield kind, method, some


def _median(rows: Sequence[Row], name: str, digits: str) -> str:
    values = [row[name] for row in rows if row.get(name) is not None]
    return f"{np.median(values):{digits}}" if values else "-"


def _right(rows: Sequence[Row]) -> str:
    return f"{sum(row['tie_points_right'] for row in rows) / max(sum(row['tie_points'] for row in rows), 1):.3f}"


def known_table(rows: Sequence[Row]) -> str:
    lines = []
    for kind, method, some in _groups(rows, "known"):
        good = [row for row in some if row["accepted"]]
        spreads = [
            f"{np.median(values):{digits}} / {np.percentile(values, 95):{digits}}" if values else "-"
            for digits, values in (
                (".3f", [row["translation_error_px"] for row in good]),
                (".4f", [row["rotation_error_deg"] for row in good]),
                (".1e", [row["scale_error"] for row in good]),
            )
        ]
        wrong = sum(row["translation_error_px"] > RIGHT_PX for row in good)
        lines.append([
            kind, method, len(some), len(good), wrong, *spreads, _median(some, "seconds", ".2f"),
            _median(some, "seconds_tie_points", ".2f"), _median(good, "tie_points", ".0f"), _right(good),
            _median(good, "tie_point_error_px", ".3f"), _median(good, "coverage", ".2f"),
        ])  # fmt: skip
    return _table(
        f"ground | method | pairs | accepted | of them > {RIGHT_PX:.0f} px off | displacement px, median / 95 % | turn "
        "degrees | scale | seconds | with tie points | tie points | right | error px | coverage",
        lines,
    )


def time_table(rows: Sequence[Row]) -> str:
    """Of pairs that SIFT took at full size: polar's seconds over its."""
    lines = []
    for section, method in (("known", "sift"), ("unknown", "sift 0.8")):
        for size in _values(rows, "size", section):
            some = [row for row in rows if (row["section"], row["size"]) == (section, size)]
            sift = {(row["kind"], row["pair"]): row for row in some if row["method"] == method}
            mine = {(row["kind"], row["pair"]): row for row in some if row["method"] == "polar"}
            both = sorted(sift.keys() & mine.keys())
            if not both:
                continue
            base = np.array([sift[key]["seconds"] for key in both])
            times = [np.array([mine[key][name] for key in both]) for name in ("seconds", "seconds_tie_points")]
            lines.append([
                section, size, len(both), f"{np.median(base):.2f}", *(f"{np.median(own):.2f}" for own in times),
                *(f"{np.median(own / base):.1%}" for own in times), f"{np.max(times[0] / base):.1%}",
            ])  # fmt: skip
    return _table(
        "parameters | size | pairs | SIFT seconds | polar seconds | with tie points | registration / SIFT "
        "| with tie points / SIFT | slowest registration / SIFT",
        lines,
    )


def unknown_table(rows: Sequence[Row]) -> str:
    lines = []
    for kind, method, some in _groups(rows, "unknown"):
        good = [row for row in some if row["accepted"] and row["right"]]
        wrong = sum(row["accepted"] and not row["right"] for row in some)
        filled = [row for row in some if row["tie_points"]]
        lines.append([
            kind, method, len(some), len(good), wrong, _median(some, "tie_points", ".0f"), _right(some),
            _median(some, "tie_points_right", ".0f"), _median(filled, "tie_point_error_px", ".2f"),
            f"{np.mean([row['coverage'] for row in some]):.2f}", _median(some, "seconds_tie_points", ".2f"),
        ])  # fmt: skip
    return _table(
        "block | method | pairs | registered | wrongly | tie points | right | right a pair | error px "
        "| coverage (mean of all pairs) | seconds",
        lines,
    )


def agreement_table(rows: Sequence[Row]) -> str:
    """How polar agrees with SIFT where that works."""
    lines = []
    for kind, method, some in _groups(rows, "unknown"):
        both = [row for row in some if row.get("translation_px") is not None]
        good = [row for row in both if row["accepted"]]
        if not both:
            continue
        near = [row["translation_error_px"] <= _SHARE * row["translation_px"] for row in good]
        turned = [row["rotation_error_deg"] <= max(_LEAST_TURN_DEG, _SHARE * row["rotation_deg"]) for row in good]
        shares = [row["translation_error_px"] / row["translation_px"] for row in good]
        lines.append([
            kind, method, len(both), len(good), sum(near), sum(turned),
            f"{np.median(shares):.2%}" if good else "-", _median(good, "rotation_error_deg", ".3f"),
        ])  # fmt: skip
    return _table(
        "block | method | pairs that SIFT registers | and polar | translation within 1 % | turn within 0.1 degrees or "
        "1 % | translation differs by, median | turn differs by, degrees",
        lines,
    )


def honesty_table(rows: Sequence[Row]) -> str:
    lines = [
        [kind, len(some), sum(row["accepted"] for row in some), _median(some, "seconds", ".2f")]
        for kind, _, some in _groups(rows, "honesty")
    ]
    return _table("content | pairs | accepted | seconds", lines)
