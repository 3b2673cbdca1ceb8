"""Rows of scripts/bench_blocks as Markdown, one table per section."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from methods.goal_tables import factor, markdown, number, percent
from methods.goals import ratio

Row = dict[str, Any]


def blocks_table(rows: Sequence[Row]) -> str:
    """A line per block, thinning and method: matches, and what mapping makes of them."""
    columns = (
        "block", "every", "method", "keypoints", "seconds", "pairs", "matches", "unique", "within 3 px", "within 5 px",
        "cells filled", "registered", "points", "track length", "error px",
    )  # fmt: skip
    lines = []
    for row in rows:
        cells = [row["block"], str(row["every"]), f"`{row['method']}`", f"{row['keypoints_mean']:.0f}"]
        cells += [_seconds(row), str(row["pairs"]), str(row["matches"]), str(row["unique_matches"])]
        cells += [str(row["within_3px"]), str(row["within_5px"])]
        cells += [percent(row["filled_cells"]) if "filled_cells" in row else "-"]
        cells += [f"{row['registered']} of {row['images']}" if "registered" in row else "-"]
        cells += [str(row.get("points", "-"))]
        cells += [number(row.get(key, float("nan")), 2) for key in ("track_length", "reprojection_error_px")]
        lines.append(cells)
    return markdown(columns, lines)


def cross_table(rows: Sequence[Row]) -> str:
    """A line per method: the pairs across two series. Factors are against the first method of the block."""
    columns = (
        "block", "method", "pairs across", "verified", "share", "matches a pair", "x first", "within 3 px",
        "within 5 px", "at 2 px spacing: matches a pair", "x first", "within 3 px", "within 5 px", "seconds",
    )  # fmt: skip
    lines = []
    for row in rows:
        first = next(other for other in rows if other["block"] == row["block"])
        asked = row["asked_pairs"]
        cells = [row["block"], f"`{row['method']}`", str(asked), str(row["pairs"]), percent(row["pairs"] / asked)]
        for count, within in (("unique_matches", "within"), ("thinned", "thinned")):
            cells += [number(row[count] / asked, 0), factor(ratio(row[count], first[count]))]
            cells += [percent(ratio(row[f"{within}_{px}px"], row[count]), 1) for px in (3, 5)]
        lines.append([*cells, _seconds(row)])
    return markdown(columns, lines)


def easy_table(rows: Sequence[Row]) -> str:
    """A line per block and method: matches and time. Factors are against the first method of the block."""
    columns = (
        "block", "method", "pairs", "matches", "unique", "x first (goal 1)", "within 3 px", "x first", "seconds",
        "x first (goal <= 1.6)", "processor seconds", "x first",
    )  # fmt: skip
    lines = []
    for row in rows:
        first = next(other for other in rows if other["block"] == row["block"])

        def over(key: str, row: Row = row, first: Row = first) -> str:
            return factor(ratio(row.get(key) or 0.0, first.get(key) or 0.0))

        cells = [row["block"], f"`{row['method']}`", str(row["pairs"]), str(row["matches"])]
        cells += [str(row["unique_matches"]), over("unique_matches"), str(row["within_3px"]), over("within_3px")]
        cells += [_seconds(row), over("seconds")]
        cells += [number(row.get("processor_seconds", float("nan")), 1), over("processor_seconds")]
        lines.append(cells)
    return markdown(columns, lines)


def _seconds(row: Row) -> str:
    return "-" if row["seconds"] is None else f"{row['seconds']:.1f}"
