"""The README names every command, exit code and dependency that there is."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import typer

from aeromatch_cli.cli import app, weights_app

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def commands(application: typer.Typer) -> list[str]:
    names = [info.name or getattr(info.callback, "__name__", "") for info in application.registered_commands]
    assert names
    return names


@pytest.mark.parametrize("name", [*commands(app), *commands(weights_app)])
def test_every_command_stands_in_the_table(name: str) -> None:
    table = [line for line in README.splitlines() if line.startswith("| `aeromatch")]
    assert any(re.search(rf"[` ]{name}\b", line) for line in table)


def test_every_dependency_has_its_reason() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    names = {re.match(r"[A-Za-z0-9_-]+", text)[0].lower() for text in project["dependencies"]}  # type: ignore[index]
    reasons = README.partition("## Dependencies")[2].lower()
    assert names == {name for name in names if re.search(rf"\b{re.escape(name)}\b", reasons)}


def test_links_lead_to_files() -> None:
    targets = re.findall(r"\]\(([^)#]+)\)", README)
    assert targets
    assert [target for target in targets if not (ROOT / target).exists()] == []
