"""Words that follow a count."""

from __future__ import annotations


def form(count: int, one: str, several: str = "") -> str:
    """The form of a noun or verb after a count; by default the plural of a noun has an s more."""
    return one if count == 1 else several or f"{one}s"
