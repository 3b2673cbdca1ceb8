"""Progress: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from aeromatch_cli.executor import Progress


# What `run` goes through, in order.
RUN_STAGES = ("orient", "pairs", "extract", "match", "filter", "adjust", "consistency", "export", "report")


def progress_shown(quiet: bool, stages: Sequence[str] = ()) -> Progress:
    """How a command shows how far it is: nothing if quiet, a bar on a terminal, plain lines elsewhere.

    stages: what the command goes through; each is shown with its place among them.
    """
    from aeromatch_cli.executor import SilentProgress

    if quiet:
        return SilentProgress()
    return TerminalProgress(stages) if sys.stderr.isatty() else LineProgress(stages)


def placed(label: str, stages: Sequence[str]) -> str:
    """`match` as `4/9 match`. Parts of a stage begin with its name or end with it."""
    words = label.replace(":", " ").split()
    own = (
        "orient"
        if words[:2] == ["first", "pass"]
        else next((word for word in (words[-1], words[0]) if word in stages), "")
    )
    return f"{stages.index(own) + 1}/{len(stages)} {label}" if own in stages else label


class LineProgress:
    """One plain line per ten percent, for logs and cron."""

    def __init__(self, stages: Sequence[str] = ()) -> None:
        self._stages = stages

    def start(self, label: str, total: int) -> None:
        self._label, self._total, self._count, self._shown = placed(label, self._stages), total, 0, 0
        self._started = time.monotonic()

    def advance(self, count: int = 1) -> None:
        self._count += count
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

    def __init__(self, stages: Sequence[str] = ()) -> None:
        self._stages = stages
        self._bar: Any = None

    def start(self, label: str, total: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description:>9}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=Console(stderr=True))
        self._task = self._bar.add_task(placed(label, self._stages), total=total)
        self._bar.start()

    def advance(self, count: int = 1) -> None:
        self._bar.advance(self._task, count)

    def stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
