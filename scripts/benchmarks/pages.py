"""The results pages of docs/results: benchmarks write their tables there, each with a stamp of what it rests on.

    <!-- table NAME: start -->
    <!-- stamp {"command": ..., "commit": ..., "date": ..., "machine": ..., "trained_on": [...], "versions": {...}} -->

        scripts/bench ...

    Commit ..., DATE; MACHINE; networks trained on ....

    | ... |
    <!-- table NAME: end -->

`versions` holds every number that the table depends on: FAMILY.STRATEGY, "pipeline", "filter.chain", "stage.NAME" and
"weights.NETWORK" (SHA-256, 12 digits). tests/test_results.py fails where one of them is another one now.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

from aeromatch_cli.files import write_text
from benchmarks.stamps import REPOSITORY, Stamp, Versions, changed, said

FOLDER = REPOSITORY / "docs" / "results"
_TABLE = re.compile(r"<!-- table (\S+): start -->\n(.*?)<!-- table \1: end -->", re.DOTALL)
_STAMP = re.compile(r"<!-- stamp (\{.*\}) -->\n")


def page_of(table: str) -> Path:
    """The page of docs/results with the markers of a table. Raises SystemExit where none has them."""
    for path in sorted(FOLDER.glob("*.md")):
        if table in table_names(path.read_text(encoding="utf-8")):
            return path
    raise SystemExit(f"no page of {FOLDER} has the line <!-- table {table}: start -->: add it where the table belongs")


def write_table(name: str, text: str, stamp: Stamp) -> None:
    """Replace what stands between the markers of this name. Raises SystemExit where no page has them."""
    page = page_of(name)
    body = f"<!-- table {name}: start -->\n{head(stamp)}\n{text.strip()}\n<!-- table {name}: end -->"
    old = page.read_text(encoding="utf-8")
    write_text(page, _TABLE.sub(lambda match: body if match[1] == name else match[0], old))


def head(stamp: Stamp) -> str:
    """The lines of a table above its text."""
    stored = f"<!-- stamp {json.dumps(stamp, ensure_ascii=False)} -->"
    return f"{stored}\n\n    {stamp['command']}\n\n{said(stamp)}\n"


def stamps(page_text: str) -> Iterator[tuple[str, Stamp]]:
    """Name and stamp of every table of a page, but for those not made yet. Raises ValueError where one has none."""
    for match in _TABLE.finditer(page_text):
        if not match[2].strip():
            continue
        found = _STAMP.search(match[2])
        if found is None:
            raise ValueError(f"table {match[1]} has no stamp")
        yield match[1], json.loads(found[1])


def table_names(page_text: str) -> list[str]:
    """Of all tables of a page, made or not."""
    return [match[1] for match in _TABLE.finditer(page_text)]


def table_text(name: str) -> str:
    """What stands between a table's markers; "" where it has not been made yet."""
    text = page_of(name).read_text(encoding="utf-8")
    return next(match[2].strip() for match in _TABLE.finditer(text) if match[1] == name)


def outdated_tables(page_text: str, present: Versions) -> dict[str, list[str]]:
    """Tables of a page that depend on versions which are others now, and these."""
    found = {name: list(changed(stamp, present)) for name, stamp in stamps(page_text)}
    return {name: keys for name, keys in found.items() if keys}
