"""Words of messages that follow a count or a list of names."""

from __future__ import annotations

from collections.abc import Iterable, Sized

# Names that a message gives of many, and where a person goes through them.
_NAMED, MANY = 5, 10


def form(count: int, one: str, several: str = "") -> str:
    """The form of a noun or verb after a count; by default the plural of a noun has an s more."""
    return one if count == 1 else several or f"{one}s"


def counted(count: int, one: str, several: str = "") -> str:
    """A count and what it counts: `1 pair`, `2,000 matches`."""
    return f"{count:,} {form(count, one, several)}"


def listed(names: Iterable[object], shown: int = _NAMED, between: str = ", ") -> str:
    """The first names and how many more there are: `a, b and 3 more`.

    between: "; " where names hold commas or `and`.
    """
    words = [str(name) for name in names]
    if len(words) <= shown:
        return between.join(words)
    last = " and" if between == ", " else f"{between}and"
    return f"{between.join(words[:shown])}{last} {len(words) - shown:,} more"


def of_images(names: Iterable[object], total: Sized, one: str = "", several: str = "") -> str:
    """How many of all images these are, and the first of their names: `2 of 9 images (a, b)`.

    one, several: the verb that follows, in its two forms.
    """
    some = list(names)
    verb = f" {form(len(some), one, several)}" if one else ""
    return f"{len(some):,} of {len(total):,} images ({listed(some)}){verb}"
