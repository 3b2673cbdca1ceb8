"""Progress: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from aeromatch_cli.executor import Progress


def progress_shown(quiet: bool) -> Progress:
    """How a command shows how far it is: nothing if quiet, a bar on a terminal, plain lines elsewhere."""
    from aeromatch_cli.executor import SilentProgress

    if quiet:
        return SilentProgress()
    return TerminalProgress() if sys.stderr.isatty() else LineProgress()


class LineProgress:
    """One plain line per ten percent, for logs and cron."""

    def start(self, label: str, total: int) -> None:
        self._label, self._total, self._count, self._shown = label, total, 0, 0
        self._started = time.monotonic()

    def advance(self) -> None:
        self._count += 1
        percent = 100 * self._count // max(self._total, 1)
        if percent // 10 > self._shown // 10:
            self._shown = percent
            elapsed = time.monotonic() - self._started
            left = elapsed / self._count * (self._total - self._count)
            typer.echo(f"{self._label}: {percent} % ({self._count}/{self._total}), {left:.0f} s left", err=True)

    def stop(self) -> None:
        """Nothing to clean up."""


class TerminalProgress:
    """A bar with counts and time left."""

    def __init__(self) -> None:
        self._bar: Any = None

    def start(self, label: str, total: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description:>9}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=Console(stderr=True))
        self._task = self._bar.add_task(label, total=total)
        self._bar.start()

    def advance(self) -> None:
        self._bar.advance(self._task)

    def stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
