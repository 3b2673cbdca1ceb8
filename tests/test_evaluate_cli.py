"""`aeromatch evaluate` as a user meets it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from conftest import invoke

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(finished: Path, rendered: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("evaluated")
    shutil.copytree(finished / "work", root / "work")
    outcome = invoke("evaluate", root / "work", "--truth", rendered, "--no-mapping", "--json")
    assert outcome.code == 0, outcome.stderr
    (root / "out.txt").write_text(outcome.stdout)
    return root


def test_it_prints_a_table_and_one_json_line(site: Path) -> None:
    *lines, last = (site / "out.txt").read_text().strip().splitlines()
    facts = json.loads(last)
    assert facts["exit_code"] == 0
    assert facts["truth_kind"] == "rendered"
    figures = facts["totals"]
    assert 0.9 < figures["correctness"] <= 1.0
    assert figures["correctness"] == pytest.approx(figures["correct"] / figures["kept"])
    shown = next(line for line in lines if line.startswith("correct "))
    assert f"{figures['correct']} (correctness {figures['correctness']:.3f})" in shown
    assert any(line.startswith("view angle") for line in lines)


def test_the_report_shows_it(site: Path) -> None:
    page = (site / "work" / "report" / "index.html").read_text()
    assert "<h2>Evaluation</h2>" in page
    assert page.count('<img src="data:image/png;base64') == len(list((site / "work" / "evaluation").glob("*.png"))) == 3
    assert "Matches were verified again" not in page


def test_wrong_arguments_say_what_to_do(site: Path, tmp_path: Path) -> None:
    missing = invoke("evaluate", site / "work", "--truth", tmp_path, "--no-mapping")
    assert missing.code == 2
    assert str(tmp_path) in missing.stderr
    nothing = invoke("evaluate", tmp_path, "--truth", tmp_path)
    assert nothing.code == 2
    assert "no workspace" in nothing.stderr


def test_figures_of_an_archive_that_nobody_may_write_are_said(site: Path, rendered: Path, tmp_path: Path) -> None:
    shutil.copytree(site / "work", tmp_path / "work")
    shutil.rmtree(tmp_path / "work" / "evaluation", ignore_errors=True)
    (tmp_path / "work" / "evaluation").write_text("a file where the folder belongs")
    outcome = invoke("evaluate", tmp_path / "work", "--truth", rendered, "--no-mapping", "--json")
    assert outcome.code == 1
    assert outcome.facts["totals"]["correct"] > 100
    assert "not written: cannot write" in outcome.stdout
