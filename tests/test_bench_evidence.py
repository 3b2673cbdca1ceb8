"""The table of what steps of auto are expected to bring: sums, gains and errors."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from benchmarks.evidence import draw, main, table_of, with_expected

from aeromatch_cli.stages.pair_statistics import PairStatistics, columns
from aeromatch_cli.strategies.steps import LearnedFeatures


def rows(*pairs: tuple[int, int, int]) -> list[dict[str, object]]:
    """Of matches before, expected and found."""
    return [
        {"block": "city:mixed, seed 1, 2000", "step": "learned", "before": before, "expected": expected, "found": found}
        for before, expected, found in pairs
    ]


def test_gains_and_errors_are_of_sums_and_of_logarithms() -> None:
    text = table_of(rows((100, 190, 390), (300, 490, 240), (40, 140, 140)))
    # Twice too few, twice too many, right: a root mean square of log 2 times the square root of two thirds.
    factor = math.exp(math.log(2.0) * math.sqrt(2.0 / 3.0))
    assert f"| city:mixed, seed 1, 2000 | learned | 3 | 440 | 820 | 770 | 1.06 | {factor:.2f} |" in text
    assert "| learned | 1.5 to 2 | 2 | 1.70 | 1.57 | 2.00 |" in text
    assert "| learned | 3 and more | 1 | 3.50 | 3.50 | 1.00 |" in text


def test_what_is_expected_is_what_the_step_expects() -> None:
    pair = PairStatistics(300, 0.6, 0.9, 1500, 500, 20.0)
    known = columns(pair, 1000)
    assert known is not None
    row = {"block": "x", "step": "learned", "columns": known.tolist(), "before": 300, "found": 700}
    unknown = {**row, "step": "shadow"}  # of which nothing is expected
    (found,) = with_expected([row, unknown])
    assert found["expected"] == pytest.approx(pair.expected(LearnedFeatures(), 1000))


@pytest.mark.slow
def test_the_picture_is_the_same_each_time(tmp_path: Path) -> None:
    found = rows(*((n, 2 * n, 2 * n + 7) for n in range(20, 200)))
    for name in ("a.svg", "b.svg"):
        draw(tmp_path / name, found)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert "verified matches expected after the step" in (tmp_path / "a.svg").read_text()
    draw(tmp_path / "few.svg", found[:3])


def test_weights_are_not_found_on_the_blocks_that_judge_them(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["--fit", "3,4", "--seed", "4", "--out", "nowhere"])
    assert stopped.value.code == 2
    assert "--fit holds 4" in capsys.readouterr().err
