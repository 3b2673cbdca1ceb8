"""auto with one strategy more, or another one, beside auto as it is, on the same blocks: whether it belongs into it.

A strategy is accepted where it brings 2 % more correct matches at no lower correctness, or a fifth fewer wrong ones for
1 % fewer correct ones at most, and where the interval of that ratio does not hold 1.
"""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.auto.blocks import ALL, CONDITIONS
from benchmarks.auto.rendered import by_block, correct_beside, correctness, of_condition, ratio_beside
from benchmarks.auto.runs import JUDGED
from benchmarks.tables import Row, code, grouped, markdown, percent

MORE_CORRECT, FEWER_WRONG, MOST_LOST = 1.02, 0.80, 0.99
# Of correctness: what counts as equal.
_EQUAL = 0.001
ACCEPTED, NOT_ACCEPTED = "accepted", "not accepted"
HEADS = ("strategy", "condition", "blocks", "correct / auto's", "wrong / auto's", "correctness", "auto's", "verdict")


def verdict(ours: Sequence[Row], arm: Sequence[Row]) -> str:
    """The rule on the sums over the same pairs, in the same order; one pair has no interval."""
    more, (least, _) = ratio_beside(arm, ours, "correct")
    wrong, (_, most) = ratio_beside(arm, ours, "wrong")
    equal = correctness(arm) >= correctness(ours) - _EQUAL
    brings = more >= MORE_CORRECT and equal and not least <= 1.0
    better = brings or (wrong <= FEWER_WRONG and more >= MOST_LOST and not most >= 1.0)
    return ACCEPTED if better else NOT_ACCEPTED


def table_of(rows: Sequence[Row]) -> str:
    """A line for every strategy and condition."""
    counted = [{**row, "wrong": (row["kept"] or 0.0) - (row["correct"] or 0.0)} for row in rows]
    ours = by_block([row for row in counted if row["method"] == JUDGED])
    lines = []
    for (method,), every in grouped([row for row in counted if row["method"] != JUDGED], "method"):
        for condition in (*CONDITIONS, ALL):
            arm = of_condition(every, condition)
            if not arm:
                continue
            blocks = by_block(arm)
            beside = [row for name in blocks for row in ours[name]]
            lines.append(
                [code(method), condition, len(blocks), correct_beside(arm, beside),
                 correct_beside(arm, beside, "wrong"), percent(correctness(arm), 1), percent(correctness(beside), 1),
                 verdict(beside, arm)]
            )  # fmt: skip
    return markdown(HEADS, lines)


def asked_of(strategies: Sequence[str]) -> list[str]:
    """Settings of auto that name one strategy each, as methods."""
    return [text if text.startswith(JUDGED) else f"{JUDGED}[{text}]" for text in strategies]
