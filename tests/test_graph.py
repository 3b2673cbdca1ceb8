"""The declarations of stages: what follows from them, and that stages read no file that they do not declare."""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
from conftest import UNORIENTED, Site, invoke

from aeromatch_cli import graph
from aeromatch_cli.cli import stage_commands
from aeromatch_cli.stages import cascade, joined_steps, orient, pairs, run

# Reports, the list of failures and the lock are kept by all stages alike.
BOOKKEEPING = ("reports/*", "failures.csv", "lost.csv", ".lock", "index.sqlite*", "*.tmp")


def test_what_follows_from_the_declarations() -> None:
    assert graph.ORDER.index("refine") < graph.ORDER.index("adjust") < graph.ORDER.index("export")
    assert set(graph.ORDER) - set(graph.RUN) == {"enhance", "simulate"}
    assert [name for name in graph.COMMANDS if graph.sharded(name)] == [
        "orient", "pairs", "enhance", "simulate", "extract", "match", "filter", "run"
    ]  # fmt: skip
    assert graph.course(shard=True) == ("orient", "pairs", "extract", "match", "filter")
    assert graph.per_item() == ("enhance", "simulate", "extract", "match", "filter")
    assert [graph.first_reader(key) for key in ("block.gcp", "block.poses", "cascade", "seed", "run.jobs")] == [
        "adjust", "orient", "match", "filter", ""
    ]  # fmt: skip


def test_the_diagram_of_the_documentation_shows_the_declarations() -> None:
    """Of docs/design.md: stage, unit, what it reads and what it writes, in columns."""
    text = (Path(__file__).parent.parent / "docs" / "design.md").read_text(encoding="utf-8")
    common = re.search(r"M: ([a-z ]+)\n", text)
    assert common is not None
    shown = re.findall(r"(?m)^    (\w+) +(image|pair|block)   (.+?)   +([a-z ]+)$", text)
    for name, unit, reads, writes in shown:
        stage = graph.BY_NAME[name]
        assert unit == stage.unit
        assert set(reads.replace("M", common[1]).split()) == set(stage.reads or "-"), name
        assert tuple(writes.split()) == stage.writes, name
    assert tuple(name for name, *_ in shown) == graph.RUN


def test_every_command_of_a_stage_is_declared() -> None:
    """The command line states them once more, so that its help needs no types of results."""
    assert stage_commands.COMMAND_HELP.keys() == {*graph.COMMANDS, "check"}
    assert {name for names in graph.COMMANDS.values() for name in names} <= set(run.FUNCTIONS)
    assert {*run.FUNCTIONS, "orient", "pairs"} == set(graph.ORDER)


@pytest.mark.parametrize(
    ("path", "stage", "commands"),
    [
        ("features/a.npz", "extract", {"extract", "match", "run"}),
        ("verified/a.npz", "filter", {"filter", "run"}),
        ("orientation/adjusted.npz", "adjust", {"adjust", "export", "run"}),
        ("orientation/final.npz", "consistency", {"adjust", "export", "run"}),
        ("export/colmap/database.db", "export", {"export", "run"}),
        ("reports/refine.json", "refine", {"adjust", "export", "run"}),
        ("orientation/cameras.csv", "orient", set(graph.COMMANDS)),
        ("poses.csv", "pairs", set(graph.COMMANDS)),
    ],
)
def test_every_file_has_a_stage_that_makes_it(path: str, stage: str, commands: set[str]) -> None:
    assert graph.stage_that_makes(PurePosixPath(path)) == stage
    assert {name for name in graph.COMMANDS if graph.makes(name, PurePosixPath(path))} == commands


def test_what_a_stage_reads_is_made_by_earlier_ones() -> None:
    made: set[str] = set()
    for stage in graph.STAGES:
        others = {"evaluation"}  # made by another command
        assert set(stage.reads) <= made | others | set(stage.writes), stage.name
        made |= set(stage.writes)


class Opened:
    """Files below a folder that are opened for reading while a stage runs, by stage."""

    def __init__(self, root: Path) -> None:
        self.root, self.stage, self.of = str(root), "", defaultdict[str, set[str]](set)
        self.listening = True

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and self.listening and self.stage:
            path, mode = str(arguments[0]), arguments[1]
            if path.startswith(self.root) and (mode is None or "r" in str(mode)):
                self.of[self.stage].add(path[len(self.root) + 1 :])

    def during(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            before, self.stage = self.stage, stage
            try:
                return function(*arguments, **named)
            finally:
                self.stage = before

        return call


@pytest.fixture
def opened(site: Site, monkeypatch: pytest.MonkeyPatch) -> Iterator[Opened]:
    found = Opened(site.work)
    sys.addaudithook(found)  # stays for the process, and is deaf afterwards
    monkeypatch.setattr(orient, "run", found.during("orient", orient.run))
    monkeypatch.setattr(pairs, "prepare", found.during("pairs", pairs.prepare))
    for stage, function in run.FUNCTIONS.items():
        wrapped = found.during(stage, function)
        monkeypatch.setitem(run.FUNCTIONS, stage, wrapped)
        monkeypatch.setattr(sys.modules[function.__module__], function.__name__, wrapped)
    # What decides which steps of a cascade a pair takes, and joins them, is a part of matching.
    for module, name in (
        (cascade, "run"),
        (cascade, "steps_on_file"),
        (joined_steps, "run"),
        (joined_steps, "joined_context"),
    ):
        monkeypatch.setattr(module, name, found.during("match", getattr(module, name)))
    yield found
    found.listening = False


def undeclared(opened: Opened) -> dict[str, list[str]]:
    """Files that stages have read though they do not declare it."""
    found = {}
    for name, paths in opened.of.items():
        stage = graph.BY_NAME[name]
        kinds = (*stage.reads, *stage.writes)
        # Only match=polar, whose points are no keypoints, needs the matches themselves.
        kinds = tuple(kind for kind in kinds if (name, kind) != ("adjust", "matches"))
        # orient runs before the tables of an earlier run are replaced, and compares with them.
        kinds += ("tables",) if name == "orient" else ()
        patterns = [*BOOKKEEPING, *(pattern for kind in kinds for pattern in graph.FILES[kind])]
        rest = sorted(path for path in paths if not any(fnmatch(path, pattern) for pattern in patterns))
        if rest:
            found[name] = rest
    return found


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["baseline", "auto"])
def test_stages_read_what_they_declare(site: Site, opened: Opened, preset: str) -> None:
    """In one process, twice: what a stage compares with on the second run counts as well."""
    options = site.options("--executor", "serial", "--jobs", "1")
    for _ in range(2):
        assert invoke("run", preset, *options).code == 0
        for stage in ("enhance", "simulate", "adjust", "export", "report"):
            assert invoke(stage, preset, *options).code == 0
    assert {"orient", "pairs", "refine", "adjust", "consistency", "export", "report"} <= opened.of.keys()
    assert undeclared(opened) == {}


@pytest.mark.slow
def test_a_file_that_is_not_declared_is_found(site: Site, opened: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = run.FUNCTIONS["adjust"]

    def peeking(context: Any) -> Any:
        opened.stage = "adjust"
        next(iter(sorted((context.workspace.root / "matches").glob("*.npz")))).read_bytes()
        return plain(context)

    monkeypatch.setitem(run.FUNCTIONS, "adjust", peeking)
    assert site("run", "--executor", "serial", *UNORIENTED).code == 0
    assert [path.partition("/")[0] for path in undeclared(opened)["adjust"]] == ["matches"]
