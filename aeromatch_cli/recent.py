"""What is costly to make and asked for again, as long as memory allows."""

from __future__ import annotations

from collections.abc import Callable
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
