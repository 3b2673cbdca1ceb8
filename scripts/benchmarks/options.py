"""Options that benchmarks share, the command line that repeats a run, and where its table goes."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from aeromatch_cli.files import write_text
from aeromatch_cli.lab.synthetic import PRESETS
from aeromatch_cli.lab.synthetic.flight_plans import FLIGHTS
from benchmarks.pages import write_table
from benchmarks.stamps import Version, make_stamp


class _Help(argparse.RawDescriptionHelpFormatter):
    """The description as it is written, and the default of every option that has one."""

    def _get_help_string(self, action: argparse.Action) -> str:
        said = action.help or ""
        shown = action.option_strings and action.default not in (None, False, argparse.SUPPRESS)
        return f"{said} (default: {action.default})" if shown else said


def make_parser(name: str, about: str | None) -> argparse.ArgumentParser:
    return argparse.ArgumentParser(prog=f"scripts/bench {name}", description=about, formatter_class=_Help)


def parse(
    parser: argparse.ArgumentParser, arguments: Sequence[str], quick: Mapping[str, Any] | None = None
) -> argparse.Namespace:
    """Arguments as options; with --quick, its values stand where an option is not given."""
    if quick is not None:
        about = "small: " + ", ".join(f"{key} {value}" for key, value in quick.items())
        parser.add_argument("--quick", action="store_true", help=about)
        if "--quick" in arguments:
            parser.set_defaults(**quick)
    return parser.parse_args(arguments)


def names(text: str) -> list[str]:
    """Names between commas."""
    return [part.strip() for part in text.split(",") if part.strip()]


def numbers(text: str) -> list[int]:
    """What `1,2` or `1-4,9` means."""
    ranges = [[int(end) for end in part.split("-")] for part in text.split(",")]
    return [number for ends in ranges for number in range(ends[0], ends[-1] + 1)]


def size_px(text: str) -> tuple[int, int]:
    """Width and height that `WxH` means."""
    width, _, height = text.partition("x")
    return int(width), int(height)


def add_rendered(
    parser: argparse.ArgumentParser, *, scenes: str, size: str, images: int, pairs: int = 0, flights: str = ""
) -> None:
    """Options of rendered blocks. pairs, flights: none where the benchmark has no choice of them."""
    add = parser.add_argument
    choices = f"rendered blocks, comma-separated of {', '.join(PRESETS)}; '' for none"
    add("--scenes", type=names, default=scenes, help=choices)
    if flights:
        about = f"of rendered blocks, comma-separated of {', '.join(FLIGHTS)}; mixed has two suns"
        add("--flights", type=flight_names, default=flights, help=about)
    if pairs:
        add("--pairs", type=positive, default=pairs, help="of each block")
    add("--seed", type=int, default=0, help="another seed gives other blocks, pairs and samples")
    add("--size", metavar="WxH", default=size, help="of rendered images")
    add("--images", type=positive, default=images, help="of each rendered block")


def add_output(parser: argparse.ArgumentParser) -> None:
    """Where results and tables go."""
    parser.add_argument("--docs", action="store_true", help="write into docs/results")
    parser.add_argument("--out", type=Path, required=True, help="folder of results; a killed run goes on where it was")


def section_of(
    name: str, about: str | None, sections: Sequence[str], arguments: Sequence[str]
) -> tuple[str, list[str]]:
    """The first of the arguments, one of the sections of a benchmark, and the others."""
    parser = make_parser(name, f"{about}\nOptions: scripts/bench {name} SECTION --help")
    parser.add_argument("section", choices=sections)
    return parser.parse_args(arguments[:1]).section, list(arguments[1:])


def flight_names(text: str) -> list[str]:
    """For argparse: names of flights."""
    if unknown := set(names(text)) - set(FLIGHTS):
        raise argparse.ArgumentTypeError(f"{', '.join(unknown)} is none of {', '.join(FLIGHTS)}")
    return names(text)


def positive(text: str) -> int:
    """For argparse: a number from 1 on."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return value


def command_line(parser: argparse.ArgumentParser, args: argparse.Namespace, **shown: str) -> str:
    """What repeats the run, without machine paths: DIR in their place. shown: texts in the place of other values."""
    words = [parser.prog]
    for key, value in vars(args).items():
        text = shown.get(key, _text(value))
        if isinstance(value, Path) and value == parser.get_default(key):
            continue
        if key in ("docs", "quick") or value is None or value is False or not (text or parser.get_default(key)):
            continue
        words += [f"--{key.replace('_', '-')}", *([] if value is True else [shlex.quote(text)])]
    return " ".join(words)


def _text(value: Any) -> str:
    if isinstance(value, Path):
        return "FILE" if value.suffix else "DIR"
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def publish(
    args: argparse.Namespace,
    text: str,
    path: Path,
    *,
    table: str,
    command: str,
    versions: Mapping[str, Version],
    page_text: str | None = None,
) -> None:
    """Write a text and print it; with --docs a page of docs/results has it, or `page_text`, too.

    table: that it fills. versions: what it depends on, of `benchmarks.stamps`.
    """
    write_text(path, text)
    print(text)
    if args.docs:
        write_table(table, page_text or text, make_stamp(command, versions))
