"""scripts/bench methods: labels, and the goals of hand-made rows."""

from __future__ import annotations

import math
from typing import Any

import pytest
from benchmarks.methods import goals, results
from benchmarks.peers import table

from aeromatch_cli.errors import ConfigError

PLAIN, MORE = "baseline[simulate=none]", "baseline"
Row = dict[str, Any]


def row(method: str, pair: str, correct: int, **more: Any) -> Row:
    """A hard rendered pair with 100 possible matches."""
    return {
        "method": method, "spec": method, "scene": "city", "pair": pair, "condition": "hard", "possible": 100,
        "kept": correct + 10, "correct": correct, "coverage": correct / 200, "shadow_share": 0.0, "mean_error_px": 2.0,
        "unseen": 0, "kept_in_shadow": 0, "correct_in_shadow": 0, "wrong_at_border": 0, "poses": "exact",
        "keypoints": 2048, "seconds": 1.0, **more,
    }  # fmt: skip


def three_methods() -> list[Row]:
    """Pairs a and b are weak (SIFT finds 0 and 9 of 100), c is not; d is easy, e real."""
    correct = {
        "opencv-sift": {"a": 0, "b": 9, "c": 10, "d": 40, "e": 50},
        PLAIN: {"a": 2, "b": 13, "c": 20, "d": 50, "e": 50},
        MORE: {"a": 15, "b": 45, "c": 65, "d": 48, "e": 50},
    }
    kinds: dict[str, Row] = {"d": {"condition": "easy"}, "e": {"possible": None, "scene": "ochota"}}
    return [row(name, pair, n, **kinds.get(pair, {})) for name, pairs in correct.items() for pair, n in pairs.items()]


def test_labels_stand_for_one_method() -> None:
    text = "SIFT=opencv-sift, plain=baseline[simulate=none,match.ratio=0.9],pycolmap"
    assert [(name.label, name.spec) for name in table.named_methods(text)] == [
        ("SIFT", "opencv-sift"), ("plain", "baseline[simulate=none,match.ratio=0.9]"), ("pycolmap", "pycolmap"),
    ]  # fmt: skip
    assert table.named_methods("baseline[match.ratio=0.9]")[0].label == "baseline[match.ratio=0.9]"
    for wrong, said in (
        ("a=baseline,a=opencv-sift", "labels must differ"),
        ("baseline,baseline", "labels must differ"),
        ("pycolmap=baseline", "is a method itself"),
        ("=baseline", "is not a method"),
        ("a=b=baseline", "is not a method"),
    ):
        with pytest.raises(ConfigError, match=said):
            table.named_methods(wrong)


def test_compared_methods_must_be_among_those_that_run() -> None:
    names = table.named_methods(f"SIFT=opencv-sift,plain={PLAIN},baseline")
    assert goals.Comparison.among(names, None, None) == goals.Comparison("SIFT", None)
    assert goals.Comparison.among(names, "SIFT", PLAIN) == goals.Comparison("SIFT", "plain")
    with pytest.raises(ConfigError, match="--methods must have it"):
        goals.Comparison.among(names, None, "fusion[enhance=none]")


def test_goals_worked_by_hand() -> None:
    found = goals.goals(three_methods(), MORE, goals.Comparison("opencv-sift", PLAIN))
    assert (found.hard, found.weak, found.easy) == (3, 2, 1)  # the real pair has no possible matches to compare with
    assert found.weak_correct == 60
    assert found.over_reference == pytest.approx(60 / 9)
    assert found.over_unprocessed == pytest.approx(60 / 15)
    assert (found.enough_weak, found.enough_hard) == (pytest.approx(1 / 2), pytest.approx(2 / 3))
    assert found.recall == pytest.approx(0.65)  # pair c alone
    assert found.coverage_hard == pytest.approx((15 + 45 + 65) / (2 + 13 + 20))
    assert (found.coverage_easy, found.lower_easy) == (pytest.approx(48 / 50), 1)


def test_goals_without_pairs_or_comparison_are_unknown() -> None:
    rows = [row("baseline", "a", 5)]
    found = goals.goals(rows, "baseline", goals.Comparison())
    assert found.weak == 0
    assert all(math.isnan(value) for value in (found.over_reference, found.recall, found.coverage_hard))
    only_zero = [row("opencv-sift", "a", 0), row("baseline", "a", 5)]
    assert math.isinf(goals.goals(only_zero, "baseline", goals.Comparison("opencv-sift")).over_reference)


def test_noise_is_counted_over_the_pairs_of_both() -> None:
    exact = [row("baseline", pair, 50) for pair in "abc"]
    noisy = [row("baseline (noisy poses)", pair, 40, poses="noisy", spec="baseline") for pair in "ab"]
    found = goals.noise([*exact, *noisy], "baseline", "hard")
    assert (found.pairs, found.exact, found.noisy) == (2, 100, 80)
    assert found.loss == pytest.approx(0.2)
    assert goals.goals([*exact, *noisy], "baseline", goals.Comparison()).hard == 3


def test_shadow_is_summed_over_pairs_that_have_it() -> None:
    lit = {"correct_in_shadow": 100, "wrong_at_border": 100}
    plain = {"shadow_share": 0.3, "kept_in_shadow": 12, "correct_in_shadow": 10, "wrong_at_border": 4}
    more = plain | {"correct_in_shadow": 25, "wrong_at_border": 3}
    rows = [row(PLAIN, "a", 9, **lit), row(MORE, "a", 9, **lit), row(PLAIN, "b", 9, **plain), row(MORE, "b", 9, **more)]
    found = goals.shadow(rows, MORE, goals.Comparison(None, PLAIN))
    assert (found.pairs, found.kept, found.correct, found.wrong_at_border) == (1, 12, 25, 3)
    assert found.over_unprocessed == pytest.approx(2.5)
    assert found.without is None  # neither of them enhances


def test_mean_error_weighs_matches_and_leaves_out_what_has_none() -> None:
    rows = [row("baseline", "a", 0, kept=10, unseen=4, mean_error_px=1.0), row("baseline", "b", 0, kept=2, unseen=2)]
    rows += [row("baseline", "c", 0, kept=2, mean_error_px=9.0)]
    assert goals.mean_error_px(rows) == pytest.approx((6 * 1.0 + 2 * 9.0) / 8)


def test_tables_say_what_is_compared() -> None:
    facts = {"asked_keypoints": 2048, "budget": "image", "seed": 1, "threads": 2}
    rows = [one | facts for one in three_methods()]
    comparison = goals.Comparison("opencv-sift", PLAIN)
    text = results.tables(rows, comparison, ("goals", "shadow", "strategies", "noise"))
    assert "3 hard rendered pairs; *weak*: the 2 of them where `opencv-sift` finds less than 10%" in text
    assert f"| `{MORE}` | 50 % | 60 | 6.67 x | 4.00 x | 0.65 | 67 % | 3.57 x | 0.96 x | 1 of 1 |" in text
    line = next(line for line in text.splitlines() if line.startswith(f"| hard | `{PLAIN}` | none | none | nearest"))
    assert "| 3 | 35 | 1.00 x | 65 | 53.8 % | 11.7 % |" in line
    assert "No method was run with both" in text
