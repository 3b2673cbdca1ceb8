"""The goals of a comparison: every method against the reference (SIFT + ratio) and against the unprocessed images.

Hard and easy as each row has it; only rendered pairs count, whose possible matches are known. *Weak* pairs are the hard
ones where the reference finds less than a tenth of its possible matches.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from aeromatch_cli.config import load, parse_method
from aeromatch_cli.errors import ConfigError
from benchmarks.peers.table import PEERS, Named
from benchmarks.tables import Row, ratio, total

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
