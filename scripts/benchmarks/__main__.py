"""`scripts/bench NAME [OPTION ...]`: runs one benchmark; without a name it lists them."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module

# Name -> module with `main(arguments)`, imported when it is run, and what it does in a line.
TABLE: Mapping[str, tuple[str, str]] = {
    "same": ("benchmarks.same", "whether two workspaces hold the same verified matches, array by array"),
    "pages": ("benchmarks.pages", "brings the first lines of docs/results up to date with the tables' stamps"),
}


def listing() -> str:
    """All names, a line each."""
    width = max(map(len, TABLE))
    lines = [f"  {name:{width}}  {about}" for name, (_, about) in TABLE.items()]
    return "\n".join(
        ["usage: scripts/bench NAME [OPTION ...]; scripts/bench NAME --help lists its options", "", *lines]
    )


def main(arguments: Sequence[str]) -> int:
    """Exit code: 2 for a name that is none."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(listing())
        return 0
    name, *rest = arguments
    if name not in TABLE:
        print(f"error: {name!r} is no benchmark\n\n{listing()}", file=sys.stderr)
        return 2
    return int(import_module(TABLE[name][0]).main(rest) or 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
