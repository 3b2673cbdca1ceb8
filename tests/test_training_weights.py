"""Weights that are fitted by scripts/train evidence and probability: what says how far they hold, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from trainings import evidence, probability

from aeromatch_cli.sfm.probability import WEIGHTS, stated
from aeromatch_cli.stages.pair_statistics import PairStatistics, columns
from aeromatch_cli.strategies.steps import LearnedFeatures


def test_errors_of_pairs_are_of_logarithms() -> None:
    pairs = ((100, 190, 390), (300, 490, 240), (40, 140, 140))
    rows = [{"step": "learned", "before": b, "expected": e, "found": f} for b, e, f in pairs]
    # Twice too few, twice too many, right: a root mean square of log 2 times the square root of two thirds.
    factor = math.exp(math.log(2.0) * math.sqrt(2.0 / 3.0))
    assert f"| learned | 3 | 440 | 820 | 770 | 1.06 | {factor:.2f} |" in evidence.table_of(rows)


def test_what_is_expected_is_what_the_step_expects() -> None:
    pair = PairStatistics(300, 0.6, 0.9, 1500, 500, 20.0)
    known = columns(pair, 1000)
    assert known is not None
    row = {"step": "learned", "columns": known.tolist(), "before": 300, "found": 700}
    unknown = {**row, "step": "shadow"}  # of which nothing is expected
    (found,) = evidence.with_expected([row, unknown])
    assert found["expected"] == pytest.approx(pair.expected(LearnedFeatures(), 1000))


def test_classes_of_probability_hold_the_share_that_is_right() -> None:
    values = np.zeros((4, len(WEIGHTS)))
    p = float(stated(values)[0])
    text = probability.table_of(values, np.array([True, True, True, False]))
    assert f"| 4 | {100 * p:.1f} % | 75.0 % |" in text
    assert len(text.splitlines()) == 3


@pytest.mark.parametrize("module", [evidence, probability])
def test_weights_are_not_found_on_the_blocks_that_judge_them(module, capsys: pytest.CaptureFixture[str]) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(SystemExit) as stopped:
        module.main(["--fit", "3,4", "--seed", "4", "--out", "nowhere"])
    assert stopped.value.code == 2
    assert "--fit holds 4" in capsys.readouterr().err
