"""`check --deep` reads every file of a workspace: it finds a changed byte wherever one lies."""

from __future__ import annotations

import re
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from conftest import Site, invoke

# People edit the first; the others are written anew at the end of every command.
WITHOUT_CHECKSUM = ["config.yaml", "failures.csv", "lost.csv", "orientation/first_pass/failures.csv"]


def flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_a_sound_workspace_is_sound(done_site: Site) -> None:
    outcome = invoke("check", "--deep", str(done_site.work), "--json")
    assert outcome.code == 0, outcome.stderr
    files = [path for path in done_site.work.rglob("*") if path.is_file() and path.name != ".lock"]
    assert outcome.facts["files"] == len(files)
    assert outcome.facts["megabytes"] == pytest.approx(sum(path.stat().st_size for path in files) / 1e6, abs=0.06)
    assert outcome.facts["damaged"] == {}
    assert outcome.facts["without_checksum"] == WITHOUT_CHECKSUM


@pytest.mark.slow
def test_a_changed_byte_is_found_in_every_file(done_site: Site) -> None:
    work = done_site.work
    changed = {path.relative_to(work).as_posix() for path in work.rglob("*") if path.is_file() and path.stat().st_size}
    changed -= {".lock", *WITHOUT_CHECKSUM, "index.sqlite"}  # most of a database is not in use
    reports = {name for name in changed if name.startswith("reports/")}  # these say of the others what they were
    assert len(reports) > 8
    for names in (changed - reports, reports):
        for name in names:
            flipped(work / name)
        outcome = invoke("check", "--deep", str(work), "--json")
        assert outcome.code == 1
        assert set(outcome.facts["damaged"]) >= names
        assert len(re.findall(r"(?m)^damaged: ", outcome.stderr)) == len(outcome.facts["damaged"])


def test_a_broken_description_of_the_block_is_one_of_the_damaged_files(done_site: Site) -> None:
    path = done_site.work / "block.json"
    path.write_text(path.read_text(encoding="utf-8").replace('"crs"', "crs"), encoding="utf-8")
    outcome = invoke("check", "--deep", str(done_site.work), "--json")
    assert outcome.code == 1
    assert list(outcome.facts["damaged"]) == ["block.json"]


def test_rows_of_the_index_are_checked(done_site: Site) -> None:
    with closing(sqlite3.connect(done_site.work / "index.sqlite")) as database, database:
        database.execute("UPDATE known SET value = '[\"other\", 5]' WHERE path LIKE 'features/%'")
    outcome = invoke("check", "--deep", str(done_site.work), "--json")
    assert list(outcome.facts["damaged"]) == ["index.sqlite"]
    assert re.fullmatch(r"\d+ of \d+ rows contradict their checksums", outcome.facts["damaged"]["index.sqlite"])


def test_what_is_damaged_is_made_again(done_site: Site) -> None:
    features = sorted((done_site.work / "features").glob("*.npz"))[1]
    flipped(features)
    (done_site.work / "export" / "colmap" / "database.db").unlink()
    outcome = invoke("check", "--deep", str(done_site.work))
    assert outcome.code == 1
    assert f"damaged: {features}: " in outcome.stderr
    assert "database.db: it is missing" in outcome.stderr
    assert "damaged          2 of them: run the same `aeromatch run` again" in outcome.stdout
    assert done_site("run").code == 0
    assert invoke("check", "--deep", str(done_site.work)).code == 0


def test_it_takes_a_workspace_alone(done_site: Site) -> None:
    assert invoke("check", "--workspace", str(done_site.work), "--deep").code == 0
    outcome = invoke("check", "--deep", str(done_site.work), "--images", "IMGS")
    assert outcome.code == 2
    assert "leave out all that is said of the block" in outcome.stderr


def test_a_folder_without_results_is_none(tmp_path: Path) -> None:
    (tmp_path / "block.json").write_text("{}")  # a rendered block has one, too
    outcome = invoke("check", "--deep", str(tmp_path))
    assert outcome.code == 2
    assert "is no workspace of aeromatch" in outcome.stderr
    absent = invoke("check", "--deep", str(tmp_path / "absent"))
    assert absent.code == 2
    assert f"the workspace {tmp_path / 'absent'} does not exist: check its path" in absent.stderr
