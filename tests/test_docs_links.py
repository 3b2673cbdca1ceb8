"""Links of the documentation lead somewhere, and the real command line understands every command in it."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer
from conftest import invoke
from read_pages import PAGES, ROOT, anchors, commands, inline_code, links, text_of

from aeromatch_cli.cli import app
from aeromatch_cli.cli.look_commands import LOOK
from aeromatch_cli.cli.stage_commands import COMMAND_HELP
from aeromatch_cli.config import load, preset_names
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.lab.synthetic.flight_plans import FLIGHTS
from aeromatch_cli.lab.synthetic.scenes.table import SCENES
from aeromatch_cli.stages.shard import Shard

# What may stand for a preset or a file of the reader's own.
PLACEHOLDERS = ("WORK", "CONFIG", "PRESET", "CONFIG|PRESET")
ADDED = ("match=distance", "match.max_distance=", "export=colmap+tiepoints")
COMMAND_LINE = typer.main.get_command(app)
# What typer raises on words that it does not know; its own copy of click's class.
USAGE_ERROR: Any = typer.BadParameter.__base__
IDS = [page.relative_to(ROOT).as_posix() for page in PAGES]


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_links_lead_to_files_and_headings(page: Path) -> None:
    broken = []
    for target in links(text_of(page)):
        if re.match(r"[a-z]+://", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        if not file.exists() or (anchor and anchor not in anchors(text_of(file))):
            broken.append(target)
    assert broken == []


def test_pages_have_links_and_commands() -> None:
    assert {"README.md", "docs/guide.md", "docs/input.md", "docs/extending.md"} <= set(IDS)
    assert sum(len(links(text_of(page))) for page in PAGES) > 50
    assert sum(len(commands(text_of(page), "aeromatch")) for page in PAGES) > 40


def given_commands() -> list[tuple[str, str, bool]]:
    """(page, command, whole): whole ones stand in code blocks, others may leave out what must be given."""
    found = []
    for name, page in zip(IDS, PAGES, strict=True):
        text = text_of(page)
        found += [(name, command, True) for command in commands(text, "aeromatch")]
        found += [(name, code, False) for code in inline_code(text) if code.startswith("aeromatch ")]
    return sorted(set(found))


@pytest.mark.parametrize(("page", "command", "whole"), given_commands())
def test_every_command_is_understood(page: str, command: str, whole: bool) -> None:
    # Variables of the shell stand for a number: of jobs, of shards.
    words = shlex.split(re.sub(r"\$\{?\w+\}?", "1", command), comments=True)[1:]
    if page == "docs/extending.md":  # it adds strategies; tests/test_docs_extending.py runs them
        words = without(words, ADDED)
    understood(words, whole=whole)


def without(words: list[str], settings: tuple[str, ...]) -> list[str]:
    """Words without the `--set` that begin with one of the settings."""
    pairs = list(zip(words, [*words[1:], ""], strict=True))
    left_out = {k for k, (word, value) in enumerate(pairs) if word == "--set" and value.startswith(settings)}
    return [word for k, word in enumerate(words) if k not in left_out and k - 1 not in left_out]


def understood(words: list[str], *, whole: bool) -> None:
    """Raises where the command line, or the configuration, would refuse these words."""
    node: Any = COMMAND_LINE
    names: list[str] = []
    while words and words[0] in getattr(node, "commands", ()):
        names.append(words[0])
        node, words = node.commands[words[0]], words[1:]
    if hasattr(node, "commands"):
        assert words, "no command"
        assert words[0].startswith("-"), f"no command {words[0]}"
    try:
        given = node.make_context(" ".join(names), list(words)).params
    except typer.Exit:  # --help and --version answer at once
        return
    except USAGE_ERROR as error:
        # In a sentence `aeromatch match` names the command, and `aeromatch match --shard 1/2` its option.
        if whole or type(error).__name__ != "MissingParameter":
            raise
        if names[0] not in COMMAND_HELP:
            return
        given = node.make_context(" ".join(names), ["PRESET", *words]).params
    if names[:1] == ["synth"]:
        assert given["preset"] in SCENES
        assert given["flight"] in FLIGHTS
    elif names and names[0] in COMMAND_HELP:
        valid_configuration(given)


def valid_configuration(given: dict[str, Any]) -> None:
    source = given["config"]
    source = "auto" if source is None else source
    if source in PLACEHOLDERS or Path(source).suffix in (".yaml", ".yml"):
        source = "baseline"  # its own settings are the reader's; what is set beside them must exist
    assert source in preset_names()
    names = ("images", "poses", "cameras", "crs", "ground", "masks")
    block = {name: str(given[name]) for name in names if given.get(name) is not None}
    load(source, given["set_"] or (), block)
    if given["shard"]:
        Shard.parse(given["shard"])


@pytest.mark.parametrize(
    "command",
    [
        "run baseline --image IMGS",
        "run basline --images IMGS",
        "run baseline --set extract.keypoint=3",
        "run baseline --shard 9/8",
        "synth OUT --preset town",
        "runs baseline",
        "evaluate WORK",
    ],
)
def test_a_wrong_command_is_not_understood(command: str) -> None:
    with pytest.raises((USAGE_ERROR, AssertionError, ConfigError)):
        understood(shlex.split(command), whole=True)


def test_a_wrong_option_in_the_text_is_not_understood() -> None:
    understood(["run"], whole=False)
    with pytest.raises(USAGE_ERROR):
        understood(["run", "fusion", "--image", "IMGS"], whole=False)


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_every_script_exists(page: Path) -> None:
    named = {words[0] for words in script_words(text_of(page))}
    assert [name for name in sorted(named) if not (ROOT / "scripts" / name).exists()] == []


@pytest.mark.parametrize(("launcher", "package"), [("bench", "benchmarks"), ("train", "trainings")])
def test_every_benchmark_and_training_exists(launcher: str, package: str) -> None:
    if not (ROOT / "scripts" / package / "__main__.py").exists():
        pytest.skip(f"scripts/{package} has no table yet")
    table = pytest.importorskip(f"{package}.__main__").TABLE
    words = [words for page in PAGES for words in script_words(text_of(page)) if words[0] == launcher and words[1:]]
    names = {words[1] for words in words if words[1] != "NAME" and not words[1].startswith("-")}
    assert names
    assert sorted(names - set(table)) == []


def script_words(text: str) -> list[list[str]]:
    """First words behind `scripts/`, of commands in code blocks and of code in the text."""
    written = [*commands(text, "scripts/[a-z_]+"), *inline_code(text)]
    return [code.removeprefix("scripts/").split() for code in written if re.match(r"scripts/\w", code)]


@pytest.mark.parametrize(
    "name", [*COMMAND_HELP, *LOOK, "evaluate", "synth", "weights list", "weights verify", "weights add"]
)
def test_help_shows_examples_that_are_understood(name: str) -> None:
    shown = invoke(*name.split(), "--help").stdout.partition("Examples:")[2]
    examples = [line.strip() for line in shown.splitlines() if line.strip()]
    assert len(examples) >= 2
    for example in examples:
        assert example.startswith(f"aeromatch {name}")
        understood(shlex.split(example)[1:], whole=True)
