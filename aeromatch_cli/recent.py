"""What is costly to make or to read and asked for again, as long as memory allows."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from pathlib import Path
from typing import TypeVar

K = TypeVar("K")
V = TypeVar("V")


def recent(store: dict[K, V], key: K, make: Callable[[], V], most: int) -> V:
    """The value of a key, made where it is not there. Of more than `most` goes the one not asked for longest."""
    value = store.pop(key) if key in store else make()
    store[key] = value  # last in
    if len(store) > most:
        del store[next(iter(store))]
    return value


def read_once(most: int) -> Callable[[Callable[[Path], V]], Callable[[Path], V]]:
    """For a function that reads a file: what it returned of the last `most` files is kept until a file is written
    again, by its size and time. Of a file that is absent nothing is kept."""

    def decorated(read: Callable[[Path], V]) -> Callable[[Path], V]:
        @lru_cache(maxsize=most)
        def kept(path: Path, size: int, time_ns: int) -> V:
            del size, time_ns  # only tell rewritten files apart
            return read(path)

        @wraps(read)
        def reader(path: Path) -> V:
            try:
                status = path.stat()
            except FileNotFoundError:
                return read(path)
            return kept(path, status.st_size, status.st_mtime_ns)

        return reader

    return decorated
