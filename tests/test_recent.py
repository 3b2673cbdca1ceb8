"""What is kept of costly things: the ones asked for lately."""

from __future__ import annotations

from pathlib import Path

import pytest

from aeromatch_cli.recent import read_once, recent


def test_the_one_not_asked_for_longest_goes() -> None:
    store: dict[str, int] = {}
    made: list[str] = []

    def ask(key: str) -> int:
        def make() -> int:
            made.append(key)
            return len(made) - 1  # 0, too, is a value

        return recent(store, key, make, 2)

    assert [ask(key) for key in "abacab"] == [0, 1, 0, 2, 0, 3]
    assert made == ["a", "b", "c", "b"]
    assert list(store) == ["a", "b"]


def test_a_file_is_read_once_until_it_is_written_again(tmp_path: Path) -> None:
    reads: list[str] = []

    @read_once(2)
    def text(path: Path) -> str:
        reads.append(path.name)
        return path.read_text()

    a, b, c = (tmp_path / name for name in "abc")
    for path in (a, b, c):
        path.write_text("old")
    assert [text(a), text(a), text(b)] == ["old"] * 3
    assert reads == ["a", "b"]
    a.write_text("newer")
    assert text(a) == "newer"
    text(c)
    text(b)  # of two files kept, it is the one that went
    assert reads == ["a", "b", "a", "c", "b"]
    with pytest.raises(FileNotFoundError):
        text(tmp_path / "absent")
