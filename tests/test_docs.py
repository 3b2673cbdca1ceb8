"""docs/results: every table has a stamp, and says in its first line what has changed in the code since."""

from __future__ import annotations

import argparse
import json
import shlex
from pathlib import Path
from typing import Any

import pytest
from benchmarks import __main__ as launcher
from benchmarks import options, pages, stamps

from aeromatch_cli.config import load
from aeromatch_cli.errors import AeromatchError
from aeromatch_cli.nets.files import SHIPPED_FOLDER, shipped_weights

PRESENT = stamps.present_versions()
RESULTS = sorted(pages.FOLDER.glob("*.md"))
KEYS = ["command", "commit", "date", "machine", "trained_on", "versions"]


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.name)
def test_every_table_has_a_stamp_and_says_whether_it_is_older_than_the_code(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# ")
    assert text == pages.refreshed(text, PRESENT), "scripts/bench pages mends it"
    made = [name for name, _ in pages.stamps(text)]
    assert made == pages.table_names(text), "a table is empty: its benchmark fills it with --docs"
    for name, stamp in pages.stamps(text):
        assert pages.PAGES[name] == path.name
        assert sorted(stamp) == KEYS, name
        assert stamp["command"].startswith("scripts/bench "), name


def stamp(**versions: Any) -> stamps.Stamp:
    named = {key.replace("_", "."): value for key, value in versions.items()}
    return {
        "command": "scripts/bench methods --out DIR", "commit": "95a1b2c", "date": "2026-11-22",
        "machine": "2 cores, AVX2, no bfloat16", "trained_on": ["sheffield"], "versions": named,
    }  # fmt: skip


def page(**tables: stamps.Stamp) -> str:
    parts = [f"<!-- table {name}: start -->\n{pages.head(one, PRESENT)}\nold\n<!-- table {name}: end -->\n"
             for name, one in tables.items()]  # fmt: skip
    return "# Title\n\nText.\n\n" + "\nBetween.\n\n".join(parts)


def test_a_table_is_outdated_where_any_of_its_versions_is_another_one() -> None:
    sift, chain = PRESENT["extract.sift"], PRESENT["filter.chain"]
    text = page(
        good=stamp(extract_sift=sift, filter_chain=chain),
        doctored=stamp(extract_sift=int(sift) - 1, filter_chain=chain),
        gone=stamp(extract_nowhere=1),
        unknown=stamp(extract_sift=None),
        peers=stamp(),
        none=stamp() | {"versions": None},
    )
    assert pages.outdated_tables(text) == ["doctored", "gone", "unknown", "none"]
    assert [line for line in text.splitlines() if line.startswith("Older")] == [
        "Older than the code; changed since: extract.sift.",
        "Older than the code; changed since: extract.nowhere.",
        "Older than the code; changed since: extract.sift.",
        "Older than the code; what it rests on is not known.",
    ]
    two = page(two=stamp(extract_sift=0, extract_nowhere=1))
    assert "\n\nOlder than the code; changed since: extract.sift, extract.nowhere.\n\n    scripts/bench" in two
    assert pages.outdated_tables(text.replace("95a1b2c", "other")) == pages.outdated_tables(text)


def test_a_table_is_replaced_with_its_stamp_and_the_others_first_lines_follow(tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    old, new = stamp(pipeline=0), stamp(pipeline=PRESENT["pipeline"])
    path.write_text(page(one=old, two=old), encoding="utf-8")
    pages.write_table(path, "two", "| new |\n", new)
    text = path.read_text(encoding="utf-8")
    assert text.count("Older than the code; changed since: pipeline.") == 1
    assert text.index("Older than") < text.index("table two")
    table = f"<!-- table two: start -->\n<!-- stamp {json.dumps(new)} -->\n\n    scripts/bench methods --out DIR\n\n"
    table += "Commit 95a1b2c, 2026-11-22; 2 cores, AVX2, no bfloat16; networks trained on sheffield.\n\n| new |\n"
    assert text.endswith(f"Between.\n\n{table}<!-- table two: end -->\n")
    assert text.count("\nold\n") == 1
    pages.write_table(path, "one", "| new |\n", new)
    assert "Older" not in path.read_text(encoding="utf-8")
    with pytest.raises(SystemExit, match="table three: start"):
        pages.write_table(path, "three", "", new)
    with pytest.raises(ValueError, match="four has no stamp"):
        pages.outdated_tables("# T\n<!-- table four: start -->\n| x |\n<!-- table four: end -->\n")


def test_the_line_of_facts_says_what_is_unknown() -> None:
    assert stamps.said(dict.fromkeys(KEYS)) == (
        "Commit unknown, date unknown; machine unknown; networks trained on unknown blocks."
    )
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
    monkeypatch.setattr(stamps, "_git", lambda *words: answers[words[0]])
    assert stamps.commit() == "95a1b2c+changes"
    answers["status"] = ""
    assert stamps.commit() == "95a1b2c"
    answers["rev-parse"] = ""
    assert stamps.commit() is None


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.name)
def test_commands_of_tables_have_options_that_there_are(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []

    def parse(parser: argparse.ArgumentParser, arguments: list[str], quick: Any = None) -> None:
        parser.parse_args(arguments)
        read.append(parser.prog)
        raise AeromatchError("nothing is run here")

    monkeypatch.setattr(options, "parse", parse)
    commands = [stamp["command"] for _, stamp in pages.stamps(path.read_text(encoding="utf-8"))]
    for command in commands:
        script, *arguments = shlex.split(command)
        assert script == "scripts/bench"
        assert launcher.main(arguments) == AeromatchError.exit_code
    assert len(read) == len(commands)
