"""The tables of the goals, as Markdown."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from methods.goals import (
    COVERAGE,
    ENOUGH_CORRECT,
    EXACT,
    IN_SHADOW,
    NOISE_LOSS,
    OVER_REFERENCE,
    OVER_UNPROCESSED,
    RECALL,
    WEAK_SHARE,
    Comparison,
    Row,
    goals,
    mean_error_px,
    noise,
    ratio,
    rendered_rows,
    shadow,
    strategies,
)


def goals_table(rows: Sequence[Row], comparison: Comparison) -> str:
    """One line per method: matches where the reference is weak, recall elsewhere, coverage."""
    labels = _labels(rows)
    hard = max((goals(rows, label, comparison).hard for label in labels), default=0)
    weak = max((goals(rows, label, comparison).weak for label in labels), default=0)
    text = (
        f"{hard} hard rendered pairs; *weak*: the {weak} of them where `{comparison.reference}` finds less than "
        f"{WEAK_SHARE:.0%} of its possible matches. Factors are ratios of sums (of mean coverages) over the same "
        f"pairs, against `{comparison.reference}` and against unprocessed images"
        f"{f' (`{comparison.unprocessed}`)' if comparison.unprocessed else ''}."
    )
    columns = (
        "method", f"weak: >= {ENOUGH_CORRECT} correct", "weak: correct", f"x reference (goal {OVER_REFERENCE:g})",
        f"x unprocessed (goal {OVER_UNPROCESSED:g})", f"other hard: recall (goal {RECALL:g})",
        f"hard: >= {ENOUGH_CORRECT} correct", f"hard: coverage x (goal {COVERAGE:g})", "easy: coverage x (goal 1)",
        "easy pairs with lower coverage",
    )  # fmt: skip
    lines = []
    for label in labels:
        found = goals(rows, label, comparison)
        lower = f"{found.lower_easy} of {found.easy}" if found.easy else "-"
        cells = [percent(found.enough_weak), str(found.weak_correct), factor(found.over_reference)]
        cells += [factor(found.over_unprocessed), number(found.recall, 2), percent(found.enough_hard)]
        cells += [factor(found.coverage_hard), factor(found.coverage_easy), lower]
        lines.append([f"`{label}`", *cells])
    return f"{text}\n\n{markdown(columns, lines)}"


def shadow_table(rows: Sequence[Row], comparison: Comparison) -> str:
    """One line per method: matches in shadow, wrong ones along its borders."""
    columns = (
        "method", "pairs with shadow", "kept in shadow", "correct in shadow", "x unprocessed", "without enhancement",
        f"x correct in shadow (goal {IN_SHADOW:g})", "wrong at borders", "x wrong at borders (goal <= 1)",
    )  # fmt: skip
    lines = []
    for label in _labels(rows):
        found = shadow(rows, label, comparison)
        cells = [str(found.pairs), str(found.kept), str(found.correct), factor(found.over_unprocessed)]
        cells += [f"`{found.without}`" if found.without else "-", factor(found.over_without)]
        cells += [str(found.wrong_at_border), factor(found.border_over_without)]
        lines.append([f"`{label}`", *cells])
    return markdown(columns, lines)


def strategies_table(rows: Sequence[Row], comparison: Comparison) -> str:
    """One line per method and condition, the strategies named: what each adds, alone and combined."""
    specs = {row["method"]: row["spec"] for row in rows}
    columns = (
        "condition", "method", "enhance", "views", "match", "filter", "pairs", "correct", "x unprocessed", "kept",
        "correctness", "recall", f">= {ENOUGH_CORRECT} correct", "mean error px", "coverage", "descriptors", "seconds",
    )  # fmt: skip
    lines = []
    for condition in ("hard", "easy"):
        plain = _of(rows, comparison.unprocessed, condition)
        for label in _labels(rows):
            mine = _of(rows, label, condition)
            if mine:
                head = [condition, f"`{label}`", *strategies(specs[label])]
                lines.append([*head, *_strategy_cells(mine, plain)])
    return markdown(columns, lines)


def _strategy_cells(mine: Sequence[Row], plain: Sequence[Row]) -> list[str]:
    def total(rows: Sequence[Row], field: str) -> float:
        return sum(float(row[field] or 0.0) for row in rows)

    def median(field: str) -> float:
        values = sorted(float(row[field] or 0.0) for row in mine)
        middle = len(values) // 2
        return values[middle] if len(values) % 2 else (values[middle - 1] + values[middle]) / 2

    correct, kept = total(mine, "correct"), total(mine, "kept")
    return [
        str(len(mine)),
        f"{correct:.0f}",
        factor(ratio(correct, total(plain, "correct"))) if plain else "-",
        f"{kept:.0f}",
        percent(ratio(correct, kept), 1),
        percent(ratio(correct, total(mine, "possible")), 1),
        percent(sum(row["correct"] >= ENOUGH_CORRECT for row in mine) / len(mine)),
        number(mean_error_px(mine), 1),
        number(total(mine, "coverage") / len(mine), 3),
        f"{total(mine, 'keypoints') / len(mine):.0f}",
        number(median("seconds"), 2),
    ]


def noise_table(rows: Sequence[Row]) -> str:
    """One line per method and condition that was run with exact and with noisy poses."""
    columns = (
        "condition", "method", "pairs", "correct, exact poses", "correct, noisy poses", f"loss (goal {NOISE_LOSS:.0%})",
    )  # fmt: skip
    lines = []
    for condition in ("hard", "easy"):
        for label in _labels(rows):
            found = noise(rows, label, condition)
            if found.pairs:
                cells = [str(found.pairs), str(found.exact), str(found.noisy), percent(found.loss, 1)]
                lines.append([condition, f"`{label}`", *cells])
    return markdown(columns, lines) if lines else "No method was run with both (`--poses both`)."


def _labels(rows: Iterable[Row]) -> list[str]:
    """Methods with exact poses that have rendered pairs, in the order of the rows."""
    return list(
        dict.fromkeys(r["method"] for r in rows if r["possible"] is not None and r.get("poses", EXACT) == EXACT)
    )


def _of(rows: Sequence[Row], label: str | None, condition: str) -> list[Row]:
    return [row for row in rendered_rows(rows, label).values() if row["condition"] == condition]


def markdown(columns: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    head = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return "\n".join([*head, *("| " + " | ".join(line) + " |" for line in lines)])


def factor(value: float) -> str:
    return "-" if math.isnan(value) else "inf" if math.isinf(value) else f"{value:.2f} x"


def percent(share: float, digits: int = 0) -> str:
    return "-" if not math.isfinite(share) else f"{100 * share:.{digits}f} %"


def number(value: float, digits: int) -> str:
    return "-" if not math.isfinite(value) else f"{value:.{digits}f}"
