"""The goals of a comparison: every method against the reference (SIFT + ratio) and against unprocessed images.

Hard and easy as each row has it; only rendered pairs count, whose possible matches are known. *Weak* pairs are the hard
ones where the reference finds less than a tenth of its possible matches.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from aeromatch_cli.config import load, parse_method
from aeromatch_cli.errors import ConfigError
from benchmarks.peers.table import PEERS, Named
from benchmarks.tables import Column, Row, code, factor, median, number, percent, ratio, table, total

Place = tuple[str, str]
WEAK_SHARE = 0.10
ENOUGH_CORRECT = 30
OVER_REFERENCE, OVER_UNPROCESSED, RECALL, COVERAGE, IN_SHADOW, NOISE_LOSS = 5.0, 3.0, 0.6, 1.5, 2.0, 0.10
EXACT, NOISY = "exact", "noisy"


@dataclass(frozen=True)
class Comparison:
    """Labels of two methods that every other one is compared with; None where there is none."""

    reference: str | None = None
    unprocessed: str | None = None

    @classmethod
    def among(cls, names: Sequence[Named], reference: str | None, unprocessed: str | None) -> Comparison:
        """By label or by what it stands for. Raises ConfigError where it is none of the methods."""
        known = {text: name.label for name in names for text in (name.spec, name.label)}
        for text in filter(None, (reference, unprocessed)):
            if text not in known:
                raise ConfigError(f"{text} is compared with, so --methods must have it; it has {', '.join(known)}")
        return cls(known.get(reference or "opencv-sift"), known.get(unprocessed or ""))


@dataclass(frozen=True)
class Goals:
    """The figures of one method. NaN where there is no pair, inf where only the other side found nothing.

    over_*: ratio of the sums of correct matches over weak pairs. recall: correct over possible on the other hard pairs.
    enough_*: share of pairs with 30 correct. coverage_*: ratio of mean coverages, of the unprocessed images' one.
    lower_easy: easy pairs whose coverage is below that of the unprocessed images.
    """

    hard: int
    enough_hard: float
    weak: int
    weak_correct: int
    over_reference: float
    over_unprocessed: float
    enough_weak: float
    recall: float
    coverage_hard: float
    coverage_easy: float
    lower_easy: int
    easy: int


def rendered_rows(rows: Iterable[Row], label: str | None, poses: str = EXACT) -> dict[Place, Row]:
    """Scene and pair -> row of one method, where truth is exact."""
    return {place(row): row for row in rows if row["method"] == label and _counts(row, poses)}


def _counts(row: Row, poses: str) -> bool:
    return row["possible"] is not None and row.get("poses", EXACT) == poses


def place(row: Row) -> Place:
    return row["scene"], row["pair"]


def weak_places(reference: Mapping[Place, Row]) -> set[Place]:
    """Hard pairs where it finds nothing, or less than a tenth of what its keypoints allow."""
    hard = [row for row in reference.values() if row["condition"] == "hard"]
    return {place(row) for row in hard if not row["correct"] or row["correct"] < WEAK_SHARE * row["possible"]}


def goals(rows: Sequence[Row], label: str, comparison: Comparison) -> Goals:
    """The figures of one method, over the pairs that it shares with those it is compared with."""
    mine, reference, plain = (
        rendered_rows(rows, name) for name in (label, comparison.reference, comparison.unprocessed)
    )
    hard = [at for at, row in mine.items() if row["condition"] == "hard"]
    easy = [at for at, row in mine.items() if row["condition"] != "hard"]
    weak = [at for at in hard if at in weak_places(reference)]
    elsewhere = [at for at in hard if at in reference and at not in weak]
    both_easy = [at for at in easy if at in plain]
    return Goals(
        hard=len(hard),
        enough_hard=_share_enough(mine, hard),
        weak=len(weak),
        weak_correct=int(_total(mine, weak, "correct")),
        over_reference=ratio(_total(mine, weak, "correct"), _total(reference, weak, "correct")),
        over_unprocessed=_over(mine, plain, weak, "correct"),
        enough_weak=_share_enough(mine, weak),
        recall=ratio(_total(mine, elsewhere, "correct"), _total(mine, elsewhere, "possible")),
        coverage_hard=_over(mine, plain, hard, "coverage"),
        coverage_easy=_over(mine, plain, easy, "coverage"),
        lower_easy=sum((mine[at]["coverage"] or 0) < (plain[at]["coverage"] or 0) for at in both_easy),
        easy=len(both_easy),
    )


@dataclass(frozen=True)
class Shadow:
    """Over the pairs with shadow: sums of what lies in it (either image) and of wrong matches along its borders.

    without: label of the same method without enhancement, None where it was not run. over_*: ratios of correct ones in
    shadow; border_over_without: of wrong ones at borders.
    """

    pairs: int
    kept: int
    correct: int
    wrong_at_border: int
    over_unprocessed: float
    without: str | None
    over_without: float
    border_over_without: float


def shadow(rows: Sequence[Row], label: str, comparison: Comparison) -> Shadow:
    mine, plain = (rendered_rows(rows, name) for name in (label, comparison.unprocessed))
    places = [at for at, row in mine.items() if (row["shadow_share"] or 0.0) > 0.0]
    without = _without_enhancement(rows, label)
    other = rendered_rows(rows, without)
    return Shadow(
        pairs=len(places),
        kept=int(_total(mine, places, "kept_in_shadow")),
        correct=int(_total(mine, places, "correct_in_shadow")),
        wrong_at_border=int(_total(mine, places, "wrong_at_border")),
        over_unprocessed=_over(mine, plain, places, "correct_in_shadow"),
        without=without,
        over_without=_over(mine, other, places, "correct_in_shadow"),
        border_over_without=_over(mine, other, places, "wrong_at_border"),
    )


def _without_enhancement(rows: Sequence[Row], label: str) -> str | None:
    """The method among the rows that differs from this one in its enhancement alone, and has none."""
    specs = {row["method"]: row["spec"] for row in rows}
    own = _tree(specs[label])
    if own is None or own["enhance"]["name"] == "none":
        return None
    for other, spec in specs.items():
        tree = _tree(spec)
        if tree is not None and tree["enhance"]["name"] == "none" and own | {"enhance": tree["enhance"]} == tree:
            return other
    return None


@cache
def _tree(spec: str) -> dict[str, Any] | None:
    """Every setting of a preset, None for a peer."""
    return None if spec in PEERS else load(*parse_method(spec)).model_dump(mode="json")


def strategies(spec: str) -> tuple[str, str, str, str]:
    """Names of enhancement, views, matcher and filters of a method, "-" for a peer."""
    tree = _tree(spec)
    if tree is None:
        return ("-",) * 4
    guided = " guided" if tree["match"].get("guided") else ""
    chain = "+".join(one["name"] for one in tree["filter"])
    return tree["enhance"]["name"], tree["simulate"]["name"], tree["match"]["name"] + guided, chain


@dataclass(frozen=True)
class Noise:
    """Sums of correct matches over the pairs of one condition with exact and with noisy poses."""

    pairs: int
    exact: int
    noisy: int

    @property
    def loss(self) -> float:
        return 1.0 - ratio(self.noisy, self.exact)


def noise(rows: Sequence[Row], label: str, condition: str) -> Noise:
    """label: of the method with exact poses; its rows with noisy ones carry the label of `noisy_label`."""
    exact, noisy = rendered_rows(rows, label), rendered_rows(rows, noisy_label(label), NOISY)
    places = [at for at, row in exact.items() if at in noisy and row["condition"] == condition]
    return Noise(len(places), int(_total(exact, places, "correct")), int(_total(noisy, places, "correct")))


def noisy_label(label: str) -> str:
    return f"{label} (noisy poses)"


def mean_error_px(rows: Sequence[Row]) -> float:
    """Mean error of all kept matches that have one: sky and what lies off the image has none."""
    counts = [row["kept"] - row["unseen"] for row in rows]
    known = [(count, row["mean_error_px"]) for count, row in zip(counts, rows, strict=True) if count > 0]
    return ratio(sum(count * error for count, error in known), sum(count for count, _ in known))


def _over(mine: Mapping[Place, Row], other: Mapping[Place, Row], places: Iterable[Place], field: str) -> float:
    """Ratio of the sums of a field over the places that both have."""
    common = [at for at in places if at in other]
    return ratio(_total(mine, common, field), _total(other, common, field))


def _total(rows: Mapping[Place, Row], places: Iterable[Place], field: str) -> float:
    return total((rows[at] for at in places if at in rows), field)


def _share_enough(rows: Mapping[Place, Row], places: Sequence[Place]) -> float:
    return float(np.mean([rows[at]["correct"] >= ENOUGH_CORRECT for at in places])) if places else math.nan


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


def _over_plain(both: _Both) -> str:
    mine, plain = both
    return factor(ratio(total(mine, "correct"), total(plain, "correct"))) if plain else "-"


_STRATEGIES: tuple[Column[_Both], ...] = (
    ("pairs", lambda both: len(both[0])),
    ("correct", lambda both: number(total(both[0], "correct"))),
    ("x unprocessed", _over_plain),
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
