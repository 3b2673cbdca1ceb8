"""The index says what is known of files, so that nobody reads a file twice to learn the same thing.

What a reader has found in a file holds as long as the file's status does: size, inode, and the times of the last change
of its contents and of itself. All of it can be read from the files again: an index that is gone, damaged or cannot be
written costs time and nothing else. Only the process that coordinates a command keeps one; workers are told what they
need. Shards write an index each; the command that ends their work merges them into its own.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import sqlite3
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from aeromatch_cli.errors import BrokenFileError

log = logging.getLogger("aeromatch")

_SCHEMA = """
CREATE TABLE IF NOT EXISTS known (
    what TEXT NOT NULL, path TEXT NOT NULL, status TEXT NOT NULL, value TEXT NOT NULL, checksum INTEGER NOT NULL,
    PRIMARY KEY (what, path)
) WITHOUT ROWID
"""
# What SQLite raises where the file is damaged, in use by another process, or on a disk that cannot be written.
_FAULTS = (sqlite3.Error, OSError)

Row = tuple[str, str, str, str, int]


class Index:
    """What is known of the files below one folder, and of pictures elsewhere.

    path: the database; None for one in memory, which is forgotten with the process. read_only: nothing is written.
    """

    def __init__(self, path: Path | None = None, *, read_only: bool = False) -> None:
        self._path, self._read_only = path, read_only
        self._folder = "" if path is None else f"{path.parent}{os.sep}"
        self._found: dict[tuple[str, str], tuple[str, Any]] = {}
        self._new: dict[tuple[str, str], Row] = {}
        self._reader: sqlite3.Connection | None = None

    def read(self, what: str, path: Path, read: Callable[[Path], Any]) -> Any:
        """Return what `read` finds in a file, without reading it where that is known.

        what: names the reader; raise its number, as in "features 2", when it finds something else in the same file.
        The value is made of what JSON has: lists, dictionaries with names as keys, numbers and text. Raises
        FileNotFoundError and what `read` raises.
        """
        if (value := self.get(what, path)) is not None:
            return value
        status, key = _status(path), (what, self._name(path))
        value = read(path)
        if _status(path) == status:  # else it was written again meanwhile
            self._keep(key, status, value)
        return value

    def get(self, what: str, path: Path) -> Any | None:
        """Return what `read` has found in a file as it is now, None where that is not known. Raises
        FileNotFoundError."""
        status, key = _status(path), (what, self._name(path))
        held = self._found.get(key) or self._stored(key)
        if held is None or held[0] != status:
            return None
        self._found[key] = held
        return held[1]

    def put(self, what: str, path: Path, value: Any) -> None:
        """Keep what `read` would find in a file that has just been written, by the word of the worker that wrote it."""
        self._keep((what, self._name(path)), _status(path), value)

    def put_state(self, what: str, state: str, value: Any) -> None:
        """Keep one value of the whole folder, which holds in a state that a digest tells."""
        self._keep((what, ""), state, value)

    def get_state(self, what: str, state: str) -> Any | None:
        """Return what was kept of the folder in this state; None where that is not known."""
        held = self._found.get((what, "")) or self._stored((what, ""))
        return held[1] if held is not None and held[0] == state else None

    def _keep(self, key: tuple[str, str], status: str, value: Any) -> None:
        self._found[key] = status, value
        text = json.dumps(value)
        self._new[key] = (*key, status, text, _checksum(*key, status, text))

    def flush(self) -> None:
        """Write what is new."""
        if not self._new or self._path is None or self._read_only:
            self._new.clear()
            return
        self._close()
        for attempt in range(2):
            try:
                with _connected(f"{self._path.as_uri()}?mode=rwc") as database:
                    database.execute(_SCHEMA)
                    database.executemany("INSERT OR REPLACE INTO known VALUES (?, ?, ?, ?, ?)", self._new.values())
                break
            except _FAULTS as error:
                log.debug("%s: %s", self._path, error)
                if attempt == 0:  # a damaged one is begun anew
                    with contextlib.suppress(OSError):
                        self._path.unlink(missing_ok=True)
        self._new.clear()

    def merge(self, others: Iterable[Path]) -> None:
        """Take over what the indexes of shards say, and remove them."""
        for path in others:
            try:
                with _connected(f"{path.as_uri()}?mode=ro") as database:
                    rows = [row for row in database.execute("SELECT * FROM known") if _is_sound(row)]
            except _FAULTS as error:
                log.debug("%s: %s", path, error)
                rows = []
            for row in rows:
                self._new.setdefault(row[:2], row)
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)

    def _stored(self, key: tuple[str, str]) -> tuple[str, Any] | None:
        if (new := self._new.get(key)) is not None:  # merged
            return new[2], json.loads(new[3])
        if self._path is None:
            return None
        try:
            if self._reader is None:
                self._reader = sqlite3.connect(f"{self._path.as_uri()}?mode=ro", uri=True)
            row = self._reader.execute("SELECT * FROM known WHERE what = ? AND path = ?", key).fetchone()
        except _FAULTS:  # none is there yet, or it is damaged
            self._close()
            return None
        return (row[2], json.loads(row[3])) if row is not None and _is_sound(row) else None

    def _name(self, path: Path) -> str:
        """The name of a file below the folder of the index, so that a workspace may be moved; else its whole path."""
        name = os.fspath(path).removeprefix(self._folder)
        return os.fsencode(name).decode("utf-8", "backslashreplace")  # SQLite takes no bytes that are no text

    def _close(self) -> None:
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def close(self) -> None:
        """Write what is new, and let go of the file."""
        self.flush()
        self._close()

    def __getstate__(self) -> dict[str, Any]:
        """A copy in another process knows nothing and writes nothing."""
        return {"_path": None, "_folder": "", "_read_only": True, "_found": {}, "_new": {}, "_reader": None}


def check_index(path: Path) -> None:
    """Compare every row of an index with its checksum. Raises BrokenFileError."""
    try:
        with _connected(f"{path.absolute().as_uri()}?mode=ro") as database:
            sound = [_is_sound(row) for row in database.execute("SELECT * FROM known")]
    except _FAULTS as error:
        raise BrokenFileError(str(path), str(error)) from None
    if not all(sound):
        raise BrokenFileError(str(path), f"{len(sound) - sum(sound)} of {len(sound)} rows contradict their checksums")


@contextlib.contextmanager
def _connected(address: str) -> Iterator[sqlite3.Connection]:
    """A connection whose changes are kept together, or not at all. No fsync: what a power cut takes is found again."""
    with contextlib.closing(sqlite3.connect(address, uri=True)) as database:
        database.execute("PRAGMA synchronous = OFF")
        with database:
            yield database


def _status(path: Path) -> str:
    status = path.stat()
    return f"{status.st_size} {status.st_mtime_ns} {status.st_ctime_ns} {status.st_ino}"


def _checksum(*parts: str) -> int:
    return zlib.crc32("\0".join(parts).encode("utf-8", "surrogateescape"))


def _is_sound(row: Row) -> bool:
    """Whether a row says what was written: of a database with a changed byte SQLite tells nothing."""
    return all(isinstance(part, str) for part in row[:4]) and _checksum(*row[:4]) == row[4]
