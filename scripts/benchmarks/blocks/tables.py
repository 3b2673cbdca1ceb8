"""Rows of `bench blocks` as Markdown, one table per section."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from benchmarks.tables import Column, Row, code, factor, number, percent, ratio, table

# A row, and that of the first method of its block.
_Both = tuple[Row, Row]


def _known(field: str, digits: int) -> Callable[[Row], str]:
    return lambda row: "-" if row.get(field) is None else number(row[field], digits)


_SECONDS: Column[Row] = ("seconds", _known("seconds", 1))
_COUNTS: tuple[Column[Row], ...] = (
    ("pairs", lambda row: row["pairs"]),
    ("matches", lambda row: row["matches"]),
    ("unique", lambda row: row["unique_matches"]),
)
_BLOCKS: tuple[Column[Row], ...] = (
    ("keypoints", _known("keypoints_mean", 0)),
    _SECONDS,
    *_COUNTS,
    ("within 3 px", lambda row: row["thinned_3px"]),
    ("within 5 px", lambda row: row["thinned_5px"]),
    ("cells filled", lambda row: percent(row["filled_cells"]) if "filled_cells" in row else "-"),
    ("ninths", lambda row: percent(row["filled_ninths"]) if "filled_ninths" in row else "-"),
    ("registered", lambda row: f"{row['registered']} of {row['images']}" if "registered" in row else "-"),
    ("by global mapping", lambda row: f"{row['global']['registered']}" if "global" in row else "-"),
    ("points", lambda row: row.get("points", "-")),
    ("track length", _known("track_length", 2)),
    ("error px", _known("reprojection_error_px", 2)),
)


def _mine(columns: Sequence[Column[Row]]) -> list[Column[_Both]]:
    return [(title, lambda both, cell=cell: cell(both[0])) for title, cell in columns]  # type: ignore[misc]


def _over_first(title: str, field: str) -> Column[_Both]:
    return title, lambda both: factor(ratio(*((row.get(field) or 0.0) for row in both)))


def _spaced(count: str, within: str, title: str) -> list[Column[_Both]]:
    """Matches of a pair, and shares of those near their epipolar lines."""
    shares: list[Column[Row]] = [
        (f"within {px} px", lambda row, px=px: percent(ratio(row[f"{within}_{px}px"], row[count]), 1))  # type: ignore[misc]
        for px in (3, 5)
    ]
    mean: Column[Row] = (title, lambda row: number(row[count] / row["asked_pairs"]))
    return [*_mine([mean]), _over_first("x first", count), *_mine(shares)]


_CROSS: list[Column[_Both]] = [
    *_mine([
        ("pairs across", lambda row: row["asked_pairs"]),
        ("verified", lambda row: row["pairs"]),
        ("share", lambda row: percent(row["pairs"] / row["asked_pairs"])),
    ]),
    *_spaced("unique_matches", "within", "matches a pair"),
    *_spaced("thinned", "thinned", "at 2 px spacing: matches a pair"),
    *_mine([_SECONDS]),
]  # fmt: skip
_EASY: list[Column[_Both]] = [
    *_mine(_COUNTS),
    _over_first("x first (goal 1)", "unique_matches"),
    *_mine([("within 3 px", lambda row: row["thinned_3px"])]),
    _over_first("x first", "thinned_3px"),
    *_mine([_SECONDS]),
    _over_first("x first (goal <= 1.6)", "seconds"),
    *_mine([("processor seconds", _known("processor_seconds", 1))]),
    _over_first("x first", "processor_seconds"),
]


def _per_minute(field: str) -> Callable[[Row], str]:
    return lambda row: "-" if row.get(field) is None else number(60.0 * row[field] / row["seconds"])


# Columns of a preset's stages; COLMAP matches and verifies in one.
_SHARES: Mapping[str, Sequence[str]] = {
    "orient": ("orient",), "pairs": ("pairs",), "extract": ("enhance", "simulate", "extract"),
    "match": ("match", "match+verify"), "filter": ("filter",), "adjust": ("refine", "adjust", "consistency"),
    "export": ("export", "report"),
}  # fmt: skip


def _share(stages: Sequence[str]) -> Callable[[Row], str]:
    return lambda row: percent(sum(row["stages"].get(stage, 0.0) for stage in stages) / sum(row["stages"].values()))


_SPEED: list[Column[_Both]] = [
    *_mine([
        ("images", lambda row: row["images"]),
        _SECONDS,
    ]),
    _over_first("x first", "seconds"),
    *_mine([
        ("pairs tried", lambda row: row.get("tried_pairs", "-")),
        ("tried a minute", _per_minute("tried_pairs")),
        ("verified", lambda row: row["pairs"]),
        ("verified a minute", _per_minute("pairs")),
        ("within 3 px", lambda row: row["thinned_3px"]),
        ("within 3 px a minute", _per_minute("thinned_3px")),
        *((title, _share(stages)) for title, stages in _SHARES.items()),
    ]),
]  # fmt: skip


def blocks_table(rows: Sequence[Row]) -> str:
    """A line per block, thinning and method: matches, and what mapping makes of them."""
    lines = [((row["block"], row["every"], code(row["method"]), row["poses"] or "-"), row) for row in rows]
    return table(("block", "every", "method", "poses"), lines, _BLOCKS)


def cross_table(rows: Sequence[Row]) -> str:
    """A line per method: the pairs across two series. Factors are against the first method of the block."""
    return table(("block", "method"), _beside_first(rows), _CROSS)


def easy_table(rows: Sequence[Row]) -> str:
    """A line per block and method: matches and time. Factors are against the first method of the block."""
    return table(("block", "method"), _beside_first(rows), _EASY)


def speed_table(rows: Sequence[Row]) -> str:
    """A line per block and method: pairs and matches a minute, and the share of every stage. Factors as in `easy`."""
    return table(("block", "method"), _beside_first(rows), _SPEED)


def _beside_first(rows: Sequence[Row]) -> list[tuple[tuple[str, str], _Both]]:
    first = {row["block"]: row for row in reversed(rows)}
    return [((row["block"], code(row["method"])), (row, first[row["block"]])) for row in rows]
