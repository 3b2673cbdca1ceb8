"""`scripts/bench NAME` and `scripts/train NAME`: one module of a table, run by its name."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module

from aeromatch_cli.errors import AeromatchError

# Name -> module with `main(arguments)`, imported when it is run, and what it does in a line.
Table = Mapping[str, tuple[str, str]]


def listing(program: str, table: Table) -> str:
    """All names, a line each."""
    width = max(map(len, table))
    lines = [f"  {name:{width}}  {about}" for name, (_, about) in table.items()]
    return "\n".join([f"usage: {program} NAME [OPTION ...]; each has its own --help", "", *lines])


def launch(program: str, table: Table, arguments: Sequence[str]) -> int:
    """Exit code: 2 for an unknown name, that of an error of the package, else the module's own."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(listing(program, table))
        return 0
    name, *rest = arguments
    if name not in table:
        print(f"error: {program} knows no {name!r}\n\n{listing(program, table)}", file=sys.stderr)
        return 2
    try:
        return int(import_module(table[name][0]).main(rest) or 0)
    except AeromatchError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
