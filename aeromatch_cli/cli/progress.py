"""Progress: a bar on a terminal, plain lines elsewhere, or JSON lines for machines."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from aeromatch_cli.cli.output import printed

if TYPE_CHECKING:
    from aeromatch_cli.executor import Progress


class ProgressKind(StrEnum):
    """How progress is shown; auto: a bar on a terminal, plain lines elsewhere."""

    AUTO = "auto"
    JSON = "json"


@dataclass(frozen=True)
class _Part:
    """A part of `run`: its stage, the words of its label, and the share of the whole time that it takes, roughly."""

    stage: str
    words: str
    share: float


# What `run` goes through, in order: blocks of eight small images to some of 12 megapixels, preset auto, one job
# (--log-file tells the seconds of every part).
_PARTS = (
    _Part("orient", "first pass on given poses extract", 0.05),
    _Part("orient", "first pass on given poses match", 0.01),
    _Part("orient", "first pass on given poses filter", 0.005),
    _Part("orient", "first pass extract", 0.14), _Part("orient", "first pass match", 0.02),
    _Part("orient", "first pass filter", 0.01), _Part("orient", "first pass mapping", 0.10),
    _Part("pairs", "pairs", 0.005), _Part("extract", "extract", 0.23), _Part("match", "match", 0.21),
    _Part("filter", "filter", 0.02), _Part("refine", "refine", 0.045), _Part("adjust", "adjust", 0.10),
    _Part("consistency", "consistency", 0.01), _Part("export", "export", 0.01), _Part("report", "report", 0.065),
)  # fmt: skip
# While given poses are looked at nobody knows whether they do, or are to be found from the pictures.
_CHANCE = 0.5
# JSON lines come no faster than this, seconds, but for the first and the last of every part.
_JSON_EVERY_S = 0.5


def progress_shown(kind: ProgressKind, *, quiet: bool, stages: Sequence[str] = ()) -> Progress:
    """How a command shows how far it is; quiet: not at all, unless JSON is asked for.

    stages: what the command goes through; each is shown with its place among them.
    """
    from aeromatch_cli.executor import SilentProgress

    if kind is ProgressKind.JSON:
        return JsonProgress(stages)
    if quiet:
        return SilentProgress()
    return TerminalProgress(stages) if sys.stderr.isatty() else LineProgress(stages)


class _Course:
    """Where a command is among its stages, and how long the rest may take.

    The place never goes back: the steps of a cascade, which extract and match again, belong to the part that the first
    of them has reached. The rest is estimated from the parts that have been done so far; one that is left out, as
    everything of it is up to date, tells nothing.
    """

    def __init__(self, stages: Sequence[str]) -> None:
        self._stages = tuple(stages)
        self._parts = [part for part in _PARTS if part.stage in stages]
        self._place = -1
        self.stage = ""  # the present one, "" where it is none of the command's
        self._first_time = False  # whether the present part is done for the first time
        self._begun_s = 0.0
        self._done, self._spent_s = 0.0, 0.0  # shares of parts before, and what they took

    @property
    def number(self) -> int:
        """Of the present stage, from 1."""
        return self._stages.index(self.stage) + 1

    @property
    def count(self) -> int:
        return len(self._stages)

    def begin(self, label: str) -> str:
        """`match` as `4/10 match`."""
        now_s = time.monotonic()
        if self._first_time:
            self._done += self._parts[self._place].share
            self._spent_s += now_s - self._begun_s
        self._begun_s = now_s
        place = self._found(label)
        self._first_time = place > self._place
        self._place = max(place, self._place)
        self.stage = self._parts[self._place].stage if place >= 0 else ""
        return f"{self.number}/{self.count} {label}" if self.stage else label

    def _found(self, label: str) -> int:
        """The part that a label names, the one with most words in common; -1 for none."""
        words = set(label.replace(":", " ").split())
        fitting = [k for k, part in enumerate(self._parts) if words.issuperset(part.words.split())]
        return max(fitting, key=lambda k: len(self._parts[k].words.split()), default=-1)

    def left_s(self, fraction: float) -> float | None:
        """Of the whole command. fraction: of the part that is being done."""
        if not self.stage or fraction <= 0.0:
            return None
        part_s = time.monotonic() - self._begun_s
        done, spent_s = self._done, self._spent_s
        if self._first_time:
            done, spent_s = done + fraction * self._parts[self._place].share, spent_s + part_s
        rate = spent_s / done if done > 0.0 else 0.0
        return part_s * (1.0 - fraction) / fraction + rate * self._later()

    def _later(self) -> float:
        """Shares of the parts after the present one."""
        looking = " given " in self._parts[self._place].words
        later = self._parts[self._place + 1 :]
        return sum(part.share * (_CHANCE if looking and part.stage == "orient" else 1.0) for part in later)


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


class JsonProgress:
    """One JSON object per line, for programs that watch a run.

    stage: one of the command's, null for what comes before them. part: what is being done, in words. number, count: of
    the stage among all. done, total: items of the part. seconds_left: to the end of the command; null where unknown.
    """

    def __init__(self, stages: Sequence[str] = ()) -> None:
        self._course = _Course(stages)

    def start(self, label: str, total: int) -> None:
        self._course.begin(label)
        self._label, self._total, self._done = label, total, 0
        self._print()

    def advance(self, count: int = 1) -> None:
        self._done += count
        if self._done >= self._total or time.monotonic() - self._printed_s >= _JSON_EVERY_S:
            self._print()

    def stop(self) -> None:
        """Nothing to clean up."""

    def _print(self) -> None:
        self._printed_s = time.monotonic()
        stage, left_s = self._course.stage, self._course.left_s(self._done / max(self._total, 1))
        line = {
            "progress": {
                "stage": stage or None,
                "part": self._label,
                "number": self._course.number if stage else None,
                "count": self._course.count or None,
                "done": self._done,
                "total": self._total,
                "seconds_left": None if left_s is None else round(left_s, 1),
            }
        }
        printed(json.dumps(line), err=True)


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
