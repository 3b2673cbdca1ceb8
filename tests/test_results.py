"""docs/results: every table is made by the code as it is, and its command exists; the list of commands."""

from __future__ import annotations

import argparse
import json
import shlex
from pathlib import Path
from typing import Any

import pytest
from benchmarks import __main__ as launcher
from benchmarks import options, pages, results, stamps

from aeromatch_cli.config import load
from aeromatch_cli.errors import AeromatchError
from aeromatch_cli.nets.files import SHIPPED_FOLDER, shipped_weights

PRESENT = stamps.present_versions()
RESULTS = sorted(pages.FOLDER.glob("*.md"))
KEYS = ["command", "commit", "date", "machine", "trained_on", "versions"]
GIVEN = {"DATA": "/data", "WEIGHTS": "/weights", "OUT": "/out"}
RUNS = [run for standing in results.STANDING.values() for run in standing.runs]


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.name)
def test_every_table_is_made_by_the_code_as_it_is(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# ")
    assert pages.outdated_tables(text, PRESENT) == {}, "scripts/bench results --docs makes them again"
    made = dict(pages.stamps(text))
    assert set(made) == set(pages.table_names(text)), "a table is empty: scripts/bench results --docs fills it"
    for name, stamp in made.items():
        assert sorted(stamp) == KEYS, name
        assert stamp["command"].startswith("scripts/bench "), name


def test_there_are_eight_pages_and_an_index() -> None:
    names = {path.name for path in RESULTS}
    assert names == {standing.page for standing in results.STANDING.values()} | {"README.md"}
    assert len(results.STANDING) == 8
    assert sum(standing.minutes for standing in results.STANDING.values()) <= 120
    tables = [name for path in RESULTS for name in pages.table_names(path.read_text(encoding="utf-8"))]
    assert sorted(tables) == sorted(set(tables))


def refused(monkeypatch: pytest.MonkeyPatch) -> list[argparse.Namespace]:
    """What benchmarks are asked for from now on; nothing is run."""
    found: list[argparse.Namespace] = []

    def parse(parser: argparse.ArgumentParser, arguments: list[str], quick: Any = None) -> None:
        found.append(parser.parse_args(arguments))
        raise AeromatchError("nothing is run here")

    monkeypatch.setattr(options, "parse", parse)
    return found


@pytest.mark.parametrize("run", RUNS)
def test_every_run_is_a_command_that_writes_a_table(run: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip(launcher.TABLE[run.split()[0]][0])
    found = refused(monkeypatch)
    assert launcher.main(results.words(run, GIVEN, docs=True)) == AeromatchError.exit_code
    (args,) = found
    assert args.out == Path("/out", run.split()[0])
    assert args.docs


def test_folders_are_put_in_and_weights_may_be_left_out() -> None:
    run = "peers real --data DATA --reference-weights WEIGHTS"
    asked = ["peers", "real", "--data", "/data", "--reference-weights", "/weights", "--out", "/out/peers"]
    assert results.words(run, GIVEN) == asked
    without = {key: value for key, value in GIVEN.items() if key != "WEIGHTS"}
    asked = ["peers", "real", "--data", "/data", "--out", "/out/peers", "--docs", "--quick"]
    assert results.words(run, without, docs=True, quick=True) == asked


def test_commands_are_printed_instead_of_run(capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["results", "--only", "growth,auto", "--list"]
    assert launcher.main(asked) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "# growth: about 5 minutes"
    assert [line.split()[:2] for line in lines if line[0] != "#"] == [
        ["scripts/bench", name] for name in ("growth", "auto", "auto", "auto")
    ]
    assert not any("--docs" in line for line in lines)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["--only", "moon"], "moon are none of auto"),
        (["--only", "growth"], "give a folder for results with --out"),
        (["--only", "growth,peers,auto", "--out", "o"], "give the folder of real blocks with --data, for peers, auto"),
        (["--data", "nowhere", "--out", "o"], "nowhere is no folder"),
        (["--data", ".", "--out", "o", "--docs", "--quick"], "figures without worth"),
    ],
)
def test_wrong_options_are_refused_at_once(asked: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        launcher.main(["results", *asked])
    assert said in capsys.readouterr().err


def test_a_benchmark_that_fails_is_named_and_the_others_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ran: list[str] = []

    def run(asked: list[str]) -> int:
        ran.append(asked[0])
        return int(asked[0] == "growth")

    monkeypatch.setattr(results, "_run", run)
    assert (
        launcher.main(["results", "--data", str(tmp_path), "--only", "growth,robustness", "--out", str(tmp_path)]) == 1
    )
    assert ran == ["growth", "robustness"]
    assert capsys.readouterr().err.startswith("failed: scripts/bench growth --out")


@pytest.mark.parametrize("name", ["calibration", "growth", "speed", "robustness"])
def test_pages_of_rendered_blocks_need_no_folder_of_real_ones(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ran: list[str] = []
    monkeypatch.setattr(results, "_run", lambda asked: ran.append(asked[0]))
    assert launcher.main(["results", "--only", name, "--quick", "--out", str(tmp_path)]) == 0
    assert ran == [name]


def stamp(**versions: Any) -> stamps.Stamp:
    named = {key.replace("_", "."): value for key, value in versions.items()}
    return {
        "command": "scripts/bench methods --out DIR", "commit": "95a1b2c", "date": "2026-11-22",
        "machine": "2 cores, AVX2, no bfloat16", "trained_on": ["sheffield"], "versions": named,
    }  # fmt: skip


def page(**tables: stamps.Stamp) -> str:
    parts = [f"<!-- table {name}: start -->\n{pages.head(one)}\nold\n<!-- table {name}: end -->\n"
             for name, one in tables.items()]  # fmt: skip
    return "# Title\n\nText.\n\n" + "\nBetween.\n\n".join(parts)


def test_a_table_is_outdated_where_any_of_its_versions_is_another_one() -> None:
    sift, chain = PRESENT["extract.sift"], PRESENT["filter.chain"]
    text = page(
        good=stamp(extract_sift=sift, filter_chain=chain),
        doctored=stamp(extract_sift=int(sift) - 1, filter_chain=chain),
        gone=stamp(extract_nowhere=1),
        peers=stamp(),
    )
    assert pages.outdated_tables(text, PRESENT) == {"doctored": ["extract.sift"], "gone": ["extract.nowhere"]}
    assert pages.outdated_tables(text.replace("95a1b2c", "other"), PRESENT).keys() == {"doctored", "gone"}


def test_a_table_is_replaced_with_its_stamp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "FOLDER", tmp_path)
    path = tmp_path / "page.md"
    old, new = stamp(pipeline=0), stamp(pipeline=PRESENT["pipeline"])
    empty = "\n<!-- table three: start -->\n<!-- table three: end -->\n"
    path.write_text(page(one=old, two=old) + empty, encoding="utf-8")
    pages.write_table("two", "| new |\n", new)
    text = path.read_text(encoding="utf-8")
    table = f"<!-- table two: start -->\n<!-- stamp {json.dumps(new)} -->\n\n    scripts/bench methods --out DIR\n\n"
    table += "Commit 95a1b2c, 2026-11-22; 2 cores, AVX2, no bfloat16; networks trained on sheffield.\n\n| new |\n"
    assert text.endswith(f"Between.\n\n{table}<!-- table two: end -->\n{empty}")
    assert text.count("\nold\n") == 1
    assert pages.table_text("two").endswith("| new |")
    assert pages.table_text("three") == ""
    with pytest.raises(SystemExit, match="table four: start"):
        pages.write_table("four", "", new)
    with pytest.raises(ValueError, match="five has no stamp"):
        pages.outdated_tables("# T\n<!-- table five: start -->\n| x |\n<!-- table five: end -->\n", PRESENT)


def test_the_line_of_facts_says_what_is_unknown() -> None:
    without_repository = stamp() | {"commit": None}
    assert stamps.said(without_repository).startswith("Commit unknown, 2026-11-22; 2 cores")
    assert stamps.said(stamp() | {"trained_on": []}).endswith("no bfloat16.")


def test_versions_are_those_of_the_strategies_and_networks_that_settings_use() -> None:
    found = stamps.of_settings(load("fusion"))
    assert {key: PRESENT[key] for key in found} == found
    assert {"pipeline", "filter.chain", "extract.sift", "match.lightglue", "enhance.shadow", "weights.lightglue",
            "weights.shadow"} <= found.keys()  # fmt: skip
    assert "weights.detector" not in found
    assert stamps.trained_on(found) == ["sheffield", "caliterra", "brighton"]
    oblique = stamps.of_settings(load("oblique", ["extract.context=true"]), families=("extract",))
    assert {f"weights.{name}" for name in ("detector", "orientation", "geodesc", "context")} < oblique.keys()
    assert stamps.trained_on(oblique) == ["sheffield", "caliterra", "seneca", "brighton"]
    assert stamps.of_settings() == {}


def test_tables_depend_on_what_they_measure() -> None:
    assert stamps.of_pipeline().keys() == {"pipeline", "stage.orient", "stage.adjust", "stage.consistency"}
    chain = stamps.of_chain("auto", "baseline[match.ratio=0.7]")
    assert {"stage.orient", "stage.adjust", "stage.consistency", "cascade.learned", "weights.detector"} < chain.keys()
    assert chain["preset.auto"] == PRESENT["preset.auto"] != chain["preset.baseline"]
    assert not [key for key in chain if key.startswith("export.")]
    assert stamps.of_chain("auto", exported=True).keys() - chain.keys() == {"export.colmap"}
    matching = stamps.of_matching(load("oblique"))
    assert not [key for key in matching if key.startswith(("stage.", "export.", "orient.", "refine.", "consistency."))]


def test_training_blocks_are_those_of_the_cards() -> None:
    assert stamps.TRAINED_ON.keys() == {entry.architecture for entry in shipped_weights()}
    for name in ("detector", "geodesc", "lightglue"):
        card = (SHIPPED_FOLDER / f"{name}.md").read_text(encoding="utf-8")
        seen = card.partition("real blocks")[2].partition(")")[0]
        blocks = [
            block for block in ("sheffield", "caliterra", "seneca", "brighton", "ochota", "lewis") if block in seen
        ]
        assert tuple(blocks) == stamps.TRAINED_ON[name]


def test_a_stamp_has_every_fact(monkeypatch: pytest.MonkeyPatch) -> None:
    made = stamps.make_stamp("scripts/bench methods --out DIR", {"weights.lightglue": "0", "pipeline": 1})
    assert sorted(made) == KEYS
    assert made["trained_on"] == ["sheffield", "caliterra", "brighton"]
    assert "bfloat16" in made["machine"]
    assert "cores" in made["machine"]
    answers = {"rev-parse": "95a1b2c", "status": " M scripts/test"}
    monkeypatch.setattr(stamps, "_git", lambda _, *words: answers[words[0]])
    assert stamps.commit() == "95a1b2c+changes"
    answers["status"] = ""
    assert stamps.commit() == "95a1b2c"
    answers["rev-parse"] = ""
    assert stamps.commit() is None


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.name)
def test_commands_of_tables_have_options_that_there_are(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = refused(monkeypatch)
    commands = [stamp["command"] for _, stamp in pages.stamps(path.read_text(encoding="utf-8"))]
    for command in commands:
        script, *arguments = shlex.split(command)
        assert script == "scripts/bench"
        assert launcher.main(arguments) == AeromatchError.exit_code
    assert len(found) == len(commands)
