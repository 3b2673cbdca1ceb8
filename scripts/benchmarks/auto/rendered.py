"""Presets and peers on rendered blocks, by condition."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from aeromatch_cli.config import parse_method
from benchmarks.auto.blocks import ALL, CONDITIONS, asked_blocks
from benchmarks.auto.runs import JUDGED, rows_of
from benchmarks.tables import (
    Row,
    code,
    grouped,
    interval,
    markdown,
    median,
    number,
    percent,
    ranged,
    ratio,
    ratio_of_sums,
    total,
)

# It registers pairs of pictures from straight above, and is asked for no others.
NADIR_ONLY = "polar"
HEADS = (
    "condition", "method", "blocks", "pairs", "correct", "correctness", "worst block", "error px", "auto / it", "s",
)  # fmt: skip


def measured(args: argparse.Namespace, methods: Sequence[str]) -> Iterator[list[Row]]:
    """Rows of every method on every block that it is asked for; --jobs methods run at a time, on one core each, while
    the next blocks are rendered."""
    with ThreadPoolExecutor(args.jobs) as pool:
        running = [
            pool.submit(rows_of, args, block, judged, name)
            for block, judged in asked_blocks(args)
            for name in methods
            if block.nadir or parse_method(name)[0] != NADIR_ONLY
        ]
        yield from (run.result() for run in running)


def by_block(rows: Sequence[Row]) -> Mapping[str, list[Row]]:
    """Rows of one method, by block."""
    return {block: own for (block,), own in grouped(rows, "block")}


def correctness(rows: Sequence[Row]) -> float:
    """Share of the kept matches that is correct."""
    return ratio(total(rows, "correct"), total(rows, "kept"))


def of_condition(rows: Sequence[Row], condition: str) -> list[Row]:
    return [row for row in rows if condition in row["conditions"]]


def correct_beside(ours: Sequence[Row], theirs: Sequence[Row], field: str = "correct") -> str:
    """Sum of ours over sum of theirs, with its interval over pairs. Rows of the same pairs, in the same order."""
    return ranged(*ratio_beside(ours, theirs, field), 2)


def ratio_beside(ours: Sequence[Row], theirs: Sequence[Row], field: str) -> tuple[float, tuple[float, float]]:
    """The same as numbers."""
    pairs = [(a[field] or 0.0, b[field] or 0.0) for a, b in zip(ours, theirs, strict=True)]
    return ratio(*np.sum(pairs, axis=0)), interval(pairs, ratio_of_sums)


def table_of(rows: Sequence[Row]) -> str:
    """A line for every condition and method."""
    lines = []
    for condition in (*CONDITIONS, ALL):
        asked = of_condition(rows, condition)
        ours = by_block([row for row in asked if row["method"] == JUDGED])
        for (method,), own in grouped(asked, "method"):
            blocks = by_block(own)
            worst = min(blocks, key=lambda name, known=blocks: correctness(known[name]))  # type: ignore[misc]
            least = percent(correctness(blocks[worst]), 1)
            beside = [row for name in blocks for row in ours[name]]
            kept = [(row["correct"] or 0.0, row["kept"] or 0.0) for row in own]
            lines.append(
                [condition, code(method), len(blocks), len(own), number(total(own, "correct")),
                 _percents(correctness(own), interval(kept, ratio_of_sums)), f"{least} ({worst})",
                 number(median(own, "median_error_px"), 2),
                 "" if method == JUDGED else correct_beside(beside, own),
                 number(total(own, "seconds"))]
            )  # fmt: skip
    return markdown(HEADS, lines)


def _percents(share: float, bounds: tuple[float, float]) -> str:
    return ranged(100.0 * share, (100.0 * bounds[0], 100.0 * bounds[1]), 1, " %")
