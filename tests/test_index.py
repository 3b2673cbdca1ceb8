"""The index: what is known of files is not read again, and nothing is lost where the index is."""

from __future__ import annotations

import os
import pickle
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from aeromatch_cli.store.index import Index


class Reader:
    """Reads files, and counts how often."""

    def __init__(self) -> None:
        self.read: list[str] = []

    def __call__(self, path: Path) -> Any:
        self.read.append(path.name)
        return {"text": path.read_text(encoding="utf-8"), "numbers": [1, 2.5]}


@pytest.fixture
def reader() -> Reader:
    return Reader()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "features" / "a.txt"
    path.parent.mkdir()
    path.write_text("first", encoding="utf-8")
    return path


def test_a_value_of_the_folder_holds_in_one_state(tmp_path: Path) -> None:
    path = tmp_path / "index.sqlite"
    index = Index(path)
    index.put_state("finished", "a state", {"items": 3})
    index.close()
    again = Index(path, read_only=True)
    assert again.get_state("finished", "a state") == {"items": 3}
    assert again.get_state("finished", "another state") is None
    assert again.get_state("begun", "a state") is None


def test_what_is_known_is_not_read_again_by_another_command(tmp_path: Path, file: Path, reader: Reader) -> None:
    for _ in range(2):
        index = Index(tmp_path / "index.sqlite")
        assert index.read("text", file, reader) == {"text": "first", "numbers": [1, 2.5]}
        index.close()
    assert reader.read == ["a.txt"]


@pytest.mark.parametrize("how", ["other size", "same size", "same size and time"])
def test_a_file_that_is_another_is_read_again(tmp_path: Path, file: Path, reader: Reader, how: str) -> None:
    index, before = Index(tmp_path / "index.sqlite"), file.stat()
    index.read("text", file, reader)
    if how == "same size and time":
        other = file.with_name("other")
        other.write_text("other", encoding="utf-8")
        os.utime(other, ns=(before.st_atime_ns, before.st_mtime_ns))
        other.replace(file)
    else:
        file.write_text("second" if how == "other size" else "other", encoding="utf-8")
        os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns + 1))
    assert index.read("text", file, reader)["text"] == file.read_text(encoding="utf-8")
    assert index.read("text", file, reader)["text"] != "first"
    assert reader.read == ["a.txt", "a.txt"]


def test_readers_do_not_share_what_they_find(tmp_path: Path, file: Path, reader: Reader) -> None:
    index = Index(tmp_path / "index.sqlite")
    index.read("text", file, reader)
    assert index.read("length", file, lambda path: len(path.read_text(encoding="utf-8"))) == 5


def test_an_absent_file_is_absent_though_it_was_known(tmp_path: Path, file: Path, reader: Reader) -> None:
    index = Index(tmp_path / "index.sqlite")
    index.read("text", file, reader)
    file.unlink()
    with pytest.raises(FileNotFoundError):
        index.read("text", file, reader)


def test_a_moved_workspace_is_known(tmp_path: Path, file: Path, reader: Reader) -> None:
    index = Index(tmp_path / "index.sqlite")
    index.read("text", file, reader)
    index.close()
    moved = tmp_path.with_name(f"{tmp_path.name}-moved")
    tmp_path.rename(moved)
    assert Index(moved / "index.sqlite").get("text", moved / "features" / "a.txt") is not None


@pytest.mark.parametrize("damage", ["cut", "other file", "changed value", "folder"])
def test_a_damaged_index_is_made_again(tmp_path: Path, file: Path, reader: Reader, damage: str) -> None:
    path = tmp_path / "index.sqlite"
    index = Index(path)
    index.read("text", file, reader)
    index.close()
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:700])
    elif damage == "other file":
        path.write_text("no database", encoding="utf-8")
    elif damage == "folder":
        path.unlink()
        path.mkdir()
    else:
        with sqlite3.connect(path) as database:
            database.execute("UPDATE known SET value = replace(value, 'first', 'first!')")
    again = Index(path)
    assert again.read("text", file, reader)["text"] == "first"
    again.close()
    assert reader.read == ["a.txt", "a.txt"]
    if damage != "folder":
        assert Index(path).get("text", file) is not None


def test_a_shard_s_index_is_taken_over(tmp_path: Path, file: Path, reader: Reader) -> None:
    shard = Index(tmp_path / "index.1-of-2.sqlite")
    shard.read("text", file, reader)
    shard.close()
    (tmp_path / "index.2-of-2.sqlite").write_text("damaged", encoding="utf-8")
    index = Index(tmp_path / "index.sqlite")
    index.merge(sorted(tmp_path.glob("index.*-of-*.sqlite")))
    assert index.get("text", file)["text"] == "first"  # type: ignore[index]
    index.close()
    assert Index(tmp_path / "index.sqlite").get("text", file) is not None
    assert [path.name for path in tmp_path.glob("index*")] == ["index.sqlite"]


def test_what_a_worker_says_of_its_file_is_believed(tmp_path: Path, file: Path, reader: Reader) -> None:
    index = Index(tmp_path / "index.sqlite")
    index.put("text", file, {"text": "told"})
    assert index.read("text", file, reader) == {"text": "told"}
    assert reader.read == []


def test_reading_leaves_no_trace(tmp_path: Path, file: Path, reader: Reader) -> None:
    index = Index(tmp_path / "index.sqlite", read_only=True)
    index.read("text", file, reader)
    index.close()
    assert not (tmp_path / "index.sqlite").exists()
    copy = pickle.loads(pickle.dumps(index))
    copy.read("text", file, reader)
    copy.close()
    assert not (tmp_path / "index.sqlite").exists()


def test_names_that_are_no_text_are_known(tmp_path: Path, reader: Reader) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.txt"))
    path.write_text("x", encoding="utf-8")
    index = Index(tmp_path / "index.sqlite")
    index.read("text", path, reader)
    index.close()
    assert Index(tmp_path / "index.sqlite").get("text", path) is not None


def test_nothing_is_written_where_nothing_is_new(tmp_path: Path, file: Path, reader: Reader) -> None:
    path = tmp_path / "index.sqlite"
    index = Index(path)
    index.read("text", file, reader)
    index.close()
    written = path.stat().st_mtime_ns
    again = Index(path)
    again.read("text", file, reader)
    again.close()
    assert path.stat().st_mtime_ns == written
