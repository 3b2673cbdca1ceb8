"""A finished run of which nothing has changed is not looked into again; whatever changes takes the long way."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest
from conftest import PAGE, UNORIENTED, Site, invoke

from aeromatch_cli.errors import ItemError
from aeromatch_cli.stages import export, pairs, up_to_date

SETTINGS = UNORIENTED


class LongWayError(Exception):
    pass


@dataclass(frozen=True)
class NoLongWay:
    """A finished site whose inputs cannot be read any more. tried: an entry for each time that somebody wanted to."""

    site: Site
    tried: list[str]

    def takes_it(self, *more: object) -> None:
        with pytest.raises((LongWayError, AssertionError)):  # invoke does not let an exception pass
            self.site("run", *more)
        assert len(self.tried) == 1


@pytest.fixture
def no_long_way(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> NoLongWay:
    tried: list[str] = []

    def refuse(*_: object, **__: object) -> None:
        tried.append("prepare")
        raise LongWayError

    monkeypatch.setattr(pairs, "prepare", refuse)
    return NoLongWay(done_site, tried)


def test_the_same_command_again_says_the_same_without_reading_anything(
    done_site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    def said() -> list[str]:
        """Without seconds."""
        lines = invoke("run", "baseline", *done_site.options()).stdout.splitlines()
        return [line.rpartition(",")[0] if line.endswith(" s") else line for line in lines]

    (done_site.work / "index.sqlite").unlink()
    before = said()
    assert any(line.startswith("result") for line in before)
    monkeypatch.setattr(pairs, "prepare", None)
    assert said() == before
    short = done_site("run")
    assert short.code == 0
    assert short.done() == {}
    assert short.facts["stages"]["filter"]["result"]["verified_matches"] > 100


def finished(site: Site) -> tuple[str, ...] | None:
    """The row of the index that tells of a finished run."""
    with closing(sqlite3.connect(site.work / "index.sqlite")) as database:
        row: tuple[str, ...] | None = database.execute("SELECT * FROM known WHERE path = ''").fetchone()
    return row


def _touched(site: Site) -> None:
    os.utime(site.image(2), (1_700_000_000, 1_700_000_000))


def _flipped(site: Site) -> None:
    """A byte of a file of features, with the times of its contents as before."""
    path = sorted((site.work / "features").iterdir())[0]
    status, data = path.stat(), bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def _without_export(site: Site) -> None:
    (site.work / "export" / "colmap" / "database.db").unlink()


def _another_image(site: Site) -> None:
    shutil.copy2(site.image(0), site.images / "zz.png")


def _another_world(site: Site) -> None:
    (site.root / "world.json").write_text("{}")


def _damaged_record(site: Site) -> None:
    (site.work / "index.sqlite").write_text("no database")


@pytest.mark.parametrize(
    "change", [_touched, _flipped, _without_export, _another_image, _another_world, _damaged_record]
)
def test_what_changes_takes_the_long_way(no_long_way: NoLongWay, change: Callable[[Site], None]) -> None:
    assert no_long_way.site("run").done() == {}
    assert no_long_way.tried == []
    change(no_long_way.site)
    no_long_way.takes_it()


@pytest.mark.parametrize("more", [("--set", "match.ratio=0.7"), ("--overwrite",), ("--shard", "1/2"), PAGE])
def test_other_commands_take_the_long_way(no_long_way: NoLongWay, more: tuple[str, ...]) -> None:
    no_long_way.takes_it(*more)


def test_a_version_of_a_library_takes_the_long_way(no_long_way: NoLongWay, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(up_to_date, "library_version", lambda name: f"another {name}")
    no_long_way.takes_it()


def test_a_run_with_failures_is_tried_again(site: Site) -> None:
    site.image(1).write_bytes(site.image(1).read_bytes()[:2000])
    assert site("run").code == 1
    assert finished(site) is None


def test_an_input_that_is_replaced_during_a_run_is_seen(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare = pairs.prepare

    def replacing(*arguments: object, **more: object) -> object:
        found = prepare(*arguments, **more)  # type: ignore[arg-type]
        picture = done_site.image(2)
        picture.write_bytes(picture.read_bytes() + b"x")
        return found

    monkeypatch.setattr(pairs, "prepare", replacing)
    (done_site.work / "index.sqlite").unlink()
    done_site("run")
    monkeypatch.setattr(pairs, "prepare", prepare)
    assert done_site("run").done()


def test_files_of_the_workspace_and_the_record_itself_do_not_count_as_inputs(done_site: Site, tmp_path: Path) -> None:
    before = finished(done_site)
    assert before is not None
    (tmp_path / "site" / "run.log").write_text("of the shell")
    done_site("run")
    assert finished(done_site) == before


def test_an_export_that_failed_is_tried_again(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(task: export.ExportTask) -> dict[str, object]:
        raise ItemError(f"{task.folder.name} cannot be written")

    with monkeypatch.context() as patched:
        patched.setattr(export, "_run_task", fail)
        first = done_site("run", "--set", "export=[opensfm]")
        assert (first.code, done_site.failures()) == (1, [("export", "opensfm")])
        assert done_site("run", "--set", "export=[opensfm]").code == 1
        assert done_site.failures() == [("export", "opensfm")]
    assert done_site("run", "--set", "export=[opensfm]").code == 0
    assert (done_site.work / "export" / "opensfm").is_dir()
