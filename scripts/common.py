"""What the benchmark scripts share."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from aeromatch_cli.errors import AeromatchError
from aeromatch_cli.workspace import write_text


def fill_in(args: argparse.Namespace, values: Mapping[str, Any]) -> None:
    """Values of options that were not given."""
    for key, value in values.items():
        if getattr(args, key) is None:
            setattr(args, key, value)


def size_px(text: str) -> tuple[int, int]:
    """Width and height that `WxH` means."""
    width, _, height = text.partition("x")
    return int(width), int(height)


@contextmanager
def errors_as_exits() -> Iterator[None]:
    """The package's errors as message and exit code."""
    try:
        yield
    except AeromatchError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error


def publish(text: str, path: Path, markers: str | None = None, command: str = "") -> None:
    """Write a table and print it; where `markers` are given, the README has it, below its command."""
    write_text(path, text)
    print(text)
    if markers:
        write_readme(f"    {command}\n\n{text}", markers)


def write_readme(text: str, name: str) -> None:
    """Replace what stands between the README's markers of this name; SystemExit where they are missing."""
    path = Path(__file__).parent.parent / "README.md"
    start, end = f"<!-- {name}:start -->", f"<!-- {name}:end -->"
    before, found, rest = path.read_text(encoding="utf-8").partition(start)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        raise SystemExit(f"{path} lacks the markers {start} and {end}: add them where the table belongs")
    path.write_text(f"{before}{start}\n{text}{end}{after}", encoding="utf-8")


def peak_mb() -> float:
    """Largest resident memory of this process; getrusage would count its parent's before the exec, too."""
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024.0
