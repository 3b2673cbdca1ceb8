"""Progress: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from aeromatch_cli.cli.output import printed

if TYPE_CHECKING:
    from aeromatch_cli.executor import Progress


# What `run` goes through, in order, and the share of its time that a stage takes, roughly: blocks of twelve small
# images to some of 12 megapixels, preset auto (reports/<stage>.json).
_SHARES = {"orient": 0.3, "pairs": 0.05, "extract": 0.15, "match": 0.25, "filter": 0.03, "refine": 0.05,
           "adjust": 0.13, "consistency": 0.02, "export": 0.01, "report": 0.02}  # fmt: skip
RUN_STAGES = tuple(_SHARES)
# A shard ends there: what follows needs the whole block.
SHARD_STAGES = RUN_STAGES[: RUN_STAGES.index("filter") + 1]


def progress_shown(quiet: bool, stages: Sequence[str] = ()) -> Progress:
    """How a command shows how far it is: nothing if quiet, a bar on a terminal, plain lines elsewhere.

    stages: what the command goes through; each is shown with its place among them.
    """
    from aeromatch_cli.executor import SilentProgress

    if quiet:
        return SilentProgress()
    return TerminalProgress(stages) if sys.stderr.isatty() else LineProgress(stages)


class _Course:
    """Where a command is among its stages, and how long the rest may take.

    The number of the stage never goes back: the steps of a cascade, which extract and match again, belong to the
    stage that the first of them has reached. The rest is estimated from the stages that have done something so far.
    """

    def __init__(self, stages: Sequence[str]) -> None:
        self._stages = stages
        self._place, self._parts = -1, 0
        self._reached = 0.0  # of the present stage, 0-1
        self._known = 0.0  # shares of the stages that have done something before
        self._first: float | None = None
        self._part_begun = 0.0

    def begin(self, label: str) -> str:
        """`match` as `4/9 match`. Parts of a stage begin with its name or end with it."""
        self._part_begun = time.monotonic()
        self._first = self._first or self._part_begun
        words = label.replace(":", " ").split()
        first_pass = words[:2] == ["first", "pass"]
        own = "orient" if first_pass else next((w for w in (words[-1], words[0]) if w in self._stages), "")
        if own not in self._stages:
            return label
        place = max(self._place, self._stages.index(own))
        if place > self._place >= 0:
            self._known += _SHARES[self._stages[self._place]]
        self._parts = 1 if place > self._place else self._parts + 1
        self._place = place
        return f"{place + 1}/{len(self._stages)} {label}"

    def left_s(self, fraction: float) -> float | None:
        """Of the whole command. fraction: of the part that is being done."""
        if self._place < 0 or self._first is None:
            return None
        # How many parts a stage has is not known before: each is taken for half of what is left of it.
        self._reached = 1.0 - 0.5 ** (self._parts - 1) * (1.0 - 0.5 * fraction)
        own = _SHARES[self._stages[self._place]]
        done = self._known + own * self._reached
        later = sum(_SHARES[name] for name in self._stages[self._place + 1 :])
        rest = own * (1.0 - self._reached) + later
        if done <= 0.0:
            return None
        now = time.monotonic()
        # Shares are those of other blocks: what is left of the present part alone may already be more.
        part_s = (now - self._part_begun) * (1.0 - fraction) / fraction if fraction > 0.0 else 0.0
        return max((now - self._first) / done * rest, part_s)


def _words(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100.0 else f"{seconds / 60.0:.0f} min"


class LineProgress:
    """One plain line per ten percent, for logs and cron."""

    def __init__(self, stages: Sequence[str] = ()) -> None:
        self._course = _Course(stages)

    def start(self, label: str, total: int) -> None:
        self._label, self._total, self._count, self._shown = self._course.begin(label), total, 0, 0
        self._started = time.monotonic()

    def advance(self, count: int = 1) -> None:
        self._count += count
        percent = 100 * self._count // max(self._total, 1)
        if percent // 10 > self._shown // 10:
            self._shown = percent
            left = (time.monotonic() - self._started) / self._count * (self._total - self._count)
            whole = self._course.left_s(self._count / max(self._total, 1))
            end = "" if whole is None else f"; about {_words(whole)} to the end"
            printed(f"{self._label}: {percent} % ({self._count}/{self._total}), {_words(left)} left{end}", err=True)

    def stop(self) -> None:
        """Nothing to clean up."""


class TerminalProgress:
    """A bar with counts, time left, and about how long the whole command will take."""

    def __init__(self, stages: Sequence[str] = ()) -> None:
        self._course = _Course(stages)
        self._bar: Any = None

    def start(self, label: str, total: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (
            TextColumn("{task.description:>9}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
            TextColumn("{task.fields[whole]}"),
        )  # fmt: skip
        self._bar = Progress(*columns, console=Console(stderr=True))
        self._total, self._count = max(total, 1), 0
        self._task = self._bar.add_task(self._course.begin(label), total=total, whole="")
        self._bar.start()

    def advance(self, count: int = 1) -> None:
        self._count += count
        whole = self._course.left_s(min(1.0, self._count / self._total))
        self._bar.update(self._task, advance=count, whole="" if whole is None else f"about {_words(whole)} to the end")

    def stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
