"""`scripts/bench NAME [OPTION ...]`: runs one benchmark; without a name it lists them."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module

from aeromatch_cli.errors import AeromatchError

# Name -> module with `main(arguments)`, imported when it is run, and what it does in a line.
TABLE: Mapping[str, tuple[str, str]] = {
    "methods": ("benchmarks.methods.command", "presets beside peers on the same pairs, by truth"),
    "blocks": ("benchmarks.blocks.command", "whole real blocks beside pycolmap: matches, mapping, time"),
    "fusion": ("benchmarks.fusion", "every table of preset fusion: a list of runs of the others"),
    "oblique": ("benchmarks.oblique", "every table of oblique pairs: a list of runs of the others"),
    "polar": ("benchmarks.polar.command", "registration of texture-poor ground beside SIFT"),
    "keypoints": ("benchmarks.keypoints.command", "detectors, angles and descriptors of one place, by exact truth"),
    "lightglue": ("benchmarks.lightglue.command", "the network beside the ratio test, and its seconds"),
    "extraction": ("benchmarks.extraction", "seconds of an image's features, by extractor"),
    "filters": ("benchmarks.filters", "filters on the same matches, by exact truth"),
    "rectification": ("benchmarks.rectification", "scale and rotation that remain between views of oblique pairs"),
    "shadow": ("benchmarks.shadow", "masks of `enhance=shadow` against rendered truth and hand labels"),
    "scenes": ("benchmarks.contact_sheet", "one picture of every rendered scene: .assets/scenes.jpg"),
    "picture": ("benchmarks.picture", "the README's picture: one hard pair, SIFT beside a preset, by exact truth"),
    "pages": ("benchmarks.pages", "brings the first lines of docs/results up to date with the tables' stamps"),
    "same": ("benchmarks.same", "whether two workspaces hold the same verified matches, array by array"),
}


def listing() -> str:
    """All names, a line each."""
    width = max(map(len, TABLE))
    lines = [f"  {name:{width}}  {about}" for name, (_, about) in TABLE.items()]
    return "\n".join(["usage: scripts/bench NAME [OPTION ...]; each has its own --help", "", *lines])


def main(arguments: Sequence[str]) -> int:
    """Exit code: 2 for a name that is none, that of an error of the package, else the benchmark's own."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(listing())
        return 0
    name, *rest = arguments
    if name not in TABLE:
        print(f"error: {name!r} is no benchmark\n\n{listing()}", file=sys.stderr)
        return 2
    try:
        return int(import_module(TABLE[name][0]).main(rest) or 0)
    except AeromatchError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
