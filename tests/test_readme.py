"""The pages name every command, exit code and dependency that there is; the README stays short."""

from __future__ import annotations

import re
import tomllib

import pytest
import typer
from benchmarks import figures, pages
from read_pages import PAGES, ROOT, text_of

from aeromatch_cli.cli import app, weights_app
from aeromatch_cli.cli.output import EXIT_INTERRUPTED, EXIT_SOME_FAILED
from aeromatch_cli.errors import AeromatchError, ConfigError

README = text_of(ROOT / "README.md")
ROWS = [line for page in PAGES for line in text_of(page).splitlines() if line.startswith("|")]
MOST_LINES, MOST_LINES_OF_A_PARAGRAPH = 200, 5


def commands(application: typer.Typer) -> list[str]:
    names = [info.name or getattr(info.callback, "__name__", "") for info in application.registered_commands]
    assert names
    return names


@pytest.mark.parametrize("name", [*commands(app), *commands(weights_app)])
def test_every_command_stands_in_a_table(name: str) -> None:
    table = [line for line in ROWS if line.startswith("| `aeromatch")]
    assert any(re.search(rf"[` ]{name}\b", line) for line in table)


@pytest.mark.parametrize(
    "code", [0, EXIT_SOME_FAILED, ConfigError.exit_code, AeromatchError.exit_code, EXIT_INTERRUPTED]
)
def test_every_exit_code_stands_in_a_table(code: int) -> None:
    assert any(re.match(rf"\| {code} \| \w", line) for line in ROWS)


def test_every_dependency_has_its_reason() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [text for extra, texts in project["optional-dependencies"].items() if extra != "dev" for text in texts]
    needed = [*project["dependencies"], *extras]
    names = {re.match(r"[A-Za-z0-9_-]+", text)[0].lower() for text in needed}  # type: ignore[index]
    section = README.partition("## Dependencies")[2].partition("\n## ")[0].lower()
    reasons = dict(re.findall(r"(?m)^\| ([^|]+) \| ([^|]+) \|$", section))
    named = {name.strip() for cell in reasons for name in cell.split(",")} - {"package"}
    assert names == named
    assert all(len(reason.split()) > 1 for cell, reason in reasons.items() if cell not in ("package", "numpy"))


def test_results_are_those_of_the_tables() -> None:
    assert figures.with_results(README) == README, "scripts/bench results --docs mends it"
    assert README.count("| `scripts/bench ") == len(figures.RESULTS) == 4
    for result in figures.RESULTS:
        for figure in result.figures.values():
            pages.page_of(figure.table)  # raises where there is none


def test_a_figure_is_the_cell_of_one_line() -> None:
    text = "words\n\n| a | b | c |\n|---|---|---|\n| x | 1 | 2.5 (2 to 3) |\n| y | 1 | 4 |\n| y | 2 | 5 |"
    assert figures.read(figures.Figure("t", "c", {"a": "x"}), text) == "2.5 (2 to 3)"
    assert figures.read(figures.Figure("t", "c", {"a": "y", "b": "2"}), text) == "5"
    assert figures.read(figures.Figure("t", "c", {"a": "x"}), "") == ""
    for wrong in (figures.Figure("t", "c", {"a": "y"}), figures.Figure("t", "d", {"a": "x"})):
        with pytest.raises(ValueError, match="t has"):
            figures.read(wrong, text)


def test_the_readme_is_short() -> None:
    lines = README.splitlines()
    assert len(lines) <= MOST_LINES
    # Tables, code and headings are no paragraphs.
    prose = ["" if re.match(r"\||#| {4}|!\[", line) else line for line in lines]
    paragraphs = re.split(r"\n\s*\n", "\n".join(prose))
    assert max(len(part.strip().splitlines()) for part in paragraphs) <= MOST_LINES_OF_A_PARAGRAPH
