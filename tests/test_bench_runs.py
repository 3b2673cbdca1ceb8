"""scripts/bench fusion and oblique: every run of their lists is a command that there is."""

from __future__ import annotations

import argparse
import re
import shlex
from typing import Any

import pytest
from benchmarks import __main__ as launcher
from benchmarks import fusion, oblique, options
from benchmarks.pages import PAGES
from benchmarks.peers.table import check_method, named_methods
from benchmarks.runs import words

from aeromatch_cli.errors import ConfigError

GIVEN = {"DATA": "/data", "WEIGHTS": "/weights", "SEED": "7", "OUT": "/out"}


@pytest.mark.usefixtures("arms")
@pytest.mark.parametrize("run", [*fusion.RUNS, *oblique.RUNS], ids=lambda run: re.sub(r"--methods \S+", "", run)[:60])
def test_every_run_is_a_command_with_methods_that_there_are(run: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[argparse.Namespace] = []

    def parse(parser: argparse.ArgumentParser, arguments: list[str], quick: Any = None) -> None:
        found.append(parser.parse_args(arguments))
        raise ConfigError("nothing is run here")

    monkeypatch.setattr(options, "parse", parse)
    arguments = words(run, GIVEN, docs=True)
    assert launcher.main(arguments) == ConfigError.exit_code
    (args,) = found
    assert str(args.out).startswith("/out")
    assert args.docs == "" or args.docs in PAGES
    for name in named_methods(getattr(args, "methods", "") or ""):
        if not name.spec.startswith("pycolmap"):
            check_method(name.spec)


def test_without_docs_no_page_is_written_and_places_are_put_in() -> None:
    assert words("blocks easy --data DATA --docs --out OUT/x", GIVEN, docs=False) == shlex.split(
        "blocks easy --data /data --out /out/x"
    )
    run = words("methods --seed SEED --docs bench_fusion --out OUT", GIVEN, docs=False)
    assert run == ["methods", "--seed", "7", "--out", "/out"]


def test_a_list_is_printed_instead_of_run(capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["oblique", "--data", "/d", "--reference-weights", "/w", "--seed", "3", "--out", "/o", "--list"]
    assert launcher.main(asked) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(oblique.RUNS)
    assert all(line.startswith("scripts/bench ") and "--docs" not in line for line in lines)
    assert sum("--seed 3" in line for line in lines) == 3
