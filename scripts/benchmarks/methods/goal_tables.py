"""The tables of the goals, as Markdown: one line per method, or per method and condition."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from benchmarks.methods.goals import (
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
    Goals,
    Noise,
    Shadow,
    goals,
    mean_error_px,
    noise,
    rendered_rows,
    shadow,
    strategies,
)
from benchmarks.tables import Column, Row, code, factor, median, number, percent, ratio, table, total

# Rows of a method, and of that without enhancement and views.
_Both = tuple[Sequence[Row], Sequence[Row]]

_GOALS: tuple[Column[Goals], ...] = (
    (f"weak: >= {ENOUGH_CORRECT} correct", lambda found: percent(found.enough_weak)),
    ("weak: correct", lambda found: found.weak_correct),
    (f"x reference (goal {OVER_REFERENCE:g})", lambda found: factor(found.over_reference)),
    (f"x unprocessed (goal {OVER_UNPROCESSED:g})", lambda found: factor(found.over_unprocessed)),
    (f"other hard: recall (goal {RECALL:g})", lambda found: number(found.recall, 2)),
    (f"hard: >= {ENOUGH_CORRECT} correct", lambda found: percent(found.enough_hard)),
    (f"hard: coverage x (goal {COVERAGE:g})", lambda found: factor(found.coverage_hard)),
    ("easy: coverage x (goal 1)", lambda found: factor(found.coverage_easy)),
    ("easy pairs with lower coverage", lambda found: f"{found.lower_easy} of {found.easy}" if found.easy else "-"),
)
_SHADOW: tuple[Column[Shadow], ...] = (
    ("pairs with shadow", lambda found: found.pairs),
    ("kept in shadow", lambda found: found.kept),
    ("correct in shadow", lambda found: found.correct),
    ("x unprocessed", lambda found: factor(found.over_unprocessed)),
    ("without enhancement", lambda found: code(found.without) if found.without else "-"),
    (f"x correct in shadow (goal {IN_SHADOW:g})", lambda found: factor(found.over_without)),
    ("wrong at borders", lambda found: found.wrong_at_border),
    ("x wrong at borders (goal <= 1)", lambda found: factor(found.border_over_without)),
)
_NOISE: tuple[Column[Noise], ...] = (
    ("pairs", lambda found: found.pairs),
    ("correct, exact poses", lambda found: found.exact),
    ("correct, noisy poses", lambda found: found.noisy),
    (f"loss (goal {NOISE_LOSS:.0%})", lambda found: percent(found.loss, 1)),
)


def _over(both: _Both) -> str:
    mine, plain = both
    return factor(ratio(total(mine, "correct"), total(plain, "correct"))) if plain else "-"


_STRATEGIES: tuple[Column[_Both], ...] = (
    ("pairs", lambda both: len(both[0])),
    ("correct", lambda both: number(total(both[0], "correct"))),
    ("x unprocessed", _over),
    ("kept", lambda both: number(total(both[0], "kept"))),
    ("correctness", lambda both: percent(ratio(total(both[0], "correct"), total(both[0], "kept")), 1)),
    ("recall", lambda both: percent(ratio(total(both[0], "correct"), total(both[0], "possible")), 1)),
    (
        f">= {ENOUGH_CORRECT} correct",
        lambda both: percent(sum(row["correct"] >= ENOUGH_CORRECT for row in both[0]) / len(both[0])),
    ),
    ("mean error px", lambda both: number(mean_error_px(both[0]), 1)),
    ("coverage", lambda both: number(total(both[0], "coverage") / len(both[0]), 3)),
    ("descriptors", lambda both: number(total(both[0], "keypoints") / len(both[0]))),
    ("seconds", lambda both: number(median(both[0], "seconds"), 2)),
)


def goals_table(rows: Sequence[Row], comparison: Comparison) -> str:
    """Matches where the reference is weak, recall elsewhere, coverage."""
    found = {label: goals(rows, label, comparison) for label in _labels(rows)}
    hard = max((one.hard for one in found.values()), default=0)
    weak = max((one.weak for one in found.values()), default=0)
    text = (
        f"{hard} hard rendered pairs; *weak*: the {weak} of them where `{comparison.reference}` finds less than "
        f"{WEAK_SHARE:.0%} of its possible matches. Factors are ratios of sums (of mean coverages) over the same "
        f"pairs, against `{comparison.reference}` and against unprocessed images"
        f"{f' (`{comparison.unprocessed}`)' if comparison.unprocessed else ''}."
    )
    return f"{text}\n\n{table(('method',), (((code(label),), one) for label, one in found.items()), _GOALS)}"


def shadow_table(rows: Sequence[Row], comparison: Comparison) -> str:
    """Matches in shadow, wrong ones along its borders."""
    lines = (((code(label),), shadow(rows, label, comparison)) for label in _labels(rows))
    return table(("method",), lines, _SHADOW)


def strategies_table(rows: Sequence[Row], comparison: Comparison) -> str:
    """By condition too, the strategies named: what each adds, alone and combined."""
    specs = {row["method"]: row["spec"] for row in rows}

    def lines() -> Iterator[tuple[tuple[str, ...], _Both]]:
        for condition in ("hard", "easy"):
            plain = _of(rows, comparison.unprocessed, condition)
            for label in _labels(rows):
                if mine := _of(rows, label, condition):
                    yield (condition, code(label), *strategies(specs[label])), (mine, plain)

    return table(("condition", "method", "enhance", "views", "match", "filter"), lines(), _STRATEGIES)


def noise_table(rows: Sequence[Row]) -> str:
    """Methods and conditions that were run with exact and with noisy poses."""
    every = [((kind, code(name)), noise(rows, name, kind)) for kind in ("hard", "easy") for name in _labels(rows)]
    lines = [(labels, found) for labels, found in every if found.pairs]
    return table(("condition", "method"), lines, _NOISE) if lines else "No method was run with both (`--poses both`)."


def _labels(rows: Iterable[Row]) -> list[str]:
    """Methods with exact poses that have rendered pairs, in the order of the rows."""
    known = (row for row in rows if row["possible"] is not None and row.get("poses", EXACT) == EXACT)
    return list(dict.fromkeys(row["method"] for row in known))


def _of(rows: Sequence[Row], label: str | None, condition: str) -> list[Row]:
    return [row for row in rendered_rows(rows, label).values() if row["condition"] == condition]
