"""Lines of values without quotes or with: fields, and names that have blanks in them."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence

# A name that is an image's.
IMAGE = re.compile(
    r".+\.(jpe?g|jpe|jfif|tiff?|jp2|j2k|png|hei[cf]|dng|raw|arw|cr[23]|nef|raf|rw2|orf|iiq|gpr)", re.IGNORECASE
)
_WORD = re.compile(r'"([^"]*)"|(\S+)')
_DECIMAL = re.compile(r"[-+]?\d+,\d+")


def fields_of(record: str) -> tuple[list[str], bool]:
    """Values of a line, and whether their numbers may have a decimal comma.

    Separators are tabs or semicolons, else commas (unless all of these are decimal ones), else blanks, where a name
    with blanks stands in quotes or is put together by `with_name`.
    """
    for separator in ("\t", ";"):
        if separator in record:
            return [cell.strip().strip('"').strip() for cell in record.split(separator)], True
    words = words_of(record)
    if any("," in word and not _DECIMAL.fullmatch(word) for word in words):
        return [cell.strip() for cell in next(csv.reader([record], skipinitialspace=True), [])], False
    return words, True


def words_of(record: str) -> list[str]:
    """Values between blanks; quotes keep blanks together."""
    return [quoted or word for quoted, word in _WORD.findall(record)]


def with_name(cells: Sequence[str], place: int, most: int | None = None) -> list[str]:
    """The values with those from `place` on put together that make up the name of an image, with blanks in it.

    most: of how many values at most. As they are where no such words end like an image's name.
    """
    last = len(cells) if most is None else min(place + most, len(cells))
    for end in range(place + 1, last + 1):
        name = " ".join(cells[place:end])
        if IMAGE.fullmatch(name):
            return [*cells[:place], name, *cells[end:]]
    return list(cells)
