"""--within: what a run does without so that it ends in time, and always with an export.

The first pass is made in any case; it is small. Then a pair and its images are tried, and sizes and keypoints are
halved until what they need fits. Further steps of a cascade, and the measuring of tie points, are taken as long as what
they need is expected to fit as well. Nothing that has begun is stopped.
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, field, replace

from aeromatch_cli.config import Settings, dump
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.files import write_text
from aeromatch_cli.stages import cascade, check
from aeromatch_cli.stages.cascade import StepContext
from aeromatch_cli.stages.context import Context
from aeromatch_cli.strategies.refiners import REFINERS

_UNITS_S = {"s": 1.0, "m": 60.0, "h": 3600.0}
_PART = r"(\d+(?:\.\d+)?)\s*(s|m|h|sec|min|hr|second|minute|hour)s?"
# Sizes and keypoints are halved so often at most, and fall to no less than this.
_MOST_HALVINGS, _LEAST_KEYPOINTS = 3, 500
# A block is oriented from images of this size where its settings say no other.
_LEAST_SIZE_PX = 1600
# Share of the time that is planned for: a pair and its images do not tell exactly what the others need.
_PLANNED = 0.9


def seconds_of(text: str) -> float:
    """Read a duration such as 20m, 1h30m or 90s. Raises ConfigError."""
    said = text.strip().lower()
    seconds = sum(float(number) * _UNITS_S[unit[0]] for number, unit in re.findall(_PART, said, re.ASCII))
    if re.fullmatch(rf"(?:{_PART}\s*)+", said, re.ASCII) is None:
        raise ConfigError(f"--within {text!r}: write a number with its unit, as in 20m, 1h, 1h30m or 90s")
    if seconds < 1.0:
        raise ConfigError(f"--within {text!r}: give a second or more, as in 20m, 1h or 90s")
    return seconds


@dataclass
class Deadline:
    """When a run is to end. text: as it was given. left_out: what it does without, in words."""

    text: str
    left_out: list[str] = field(default_factory=list)
    started: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.seconds = seconds_of(self.text)

    @property
    def spent_s(self) -> float:
        return time.monotonic() - self.started

    def holds(self, more_s: float, context: Context, share: float = 1.0) -> bool:
        """Whether so many seconds, and what follows matching with this share of the keypoints, fit in what is left."""
        return self.spent_s + more_s + check.later_s(context, share) <= _PLANNED * self.seconds

    def line(self) -> str:
        """Say at the end of the run when it ended, and what it did without."""
        over_s = self.spent_s - self.seconds
        late = f", {check.duration(over_s)} late" if over_s > 0.0 else ""
        done = f"for that: {'; '.join(self.left_out)}" if self.left_out else "nothing was left out"
        return f"within {self.text}".ljust(16) + f" ended after {check.duration(self.spent_s)}{late}; {done}"


def fitting(context: Context, deadline: Deadline) -> Settings | None:
    """Return settings with smaller images and fewer keypoints with which a block can be matched in time; None where
    they need not change, or cannot. What they leave out is noted."""
    in_time = deadline.holds(0.0, context)
    tried = check.tried_pair(context, context.pairs[len(context.pairs) // 2]) if in_time else None
    if in_time and tried is None:  # its images cannot be read
        return None
    jobs, share = context.executor.jobs, 1.0

    def needed_s() -> float:
        if tried is None:
            return 0.0
        images_s, pairs_s = len(context.block.images) * tried.image_s, len(context.pairs) * tried.pair_s
        return (images_s * share + pairs_s * share**2) / jobs

    for _ in range(_MOST_HALVINGS):
        if deadline.holds(needed_s(), context, share):
            break
        share /= 2
    return None if share == 1.0 else _reduced(context, share, deadline)


def _reduced(context: Context, share: float, deadline: Deadline) -> Settings | None:
    """The settings with so many of the pixels and of the keypoints, or of the points of a grid; None where they have no
    less to give."""
    settings, update = context.settings, {}
    longest_px = max(max(image.width_px, image.height_px) for image in context.block.images)
    before_px = min(longest_px, settings.block.max_size_px or longest_px)
    least_px = _LEAST_SIZE_PX if settings.first_pass is None else settings.first_pass.size_px
    size_px = max(min(least_px, before_px), round(before_px * share**0.5))
    if size_px < before_px:
        update["block"] = settings.block.model_copy(update={"max_size_px": size_px})
        deadline.left_out.append(f"images are reduced to {size_px} pixels (from {before_px})")
    name = next((name for name in ("keypoints", "points") if hasattr(settings.extract, name)), "")
    asked = getattr(settings.extract, name, 0)
    if asked > _LEAST_KEYPOINTS:
        count = max(_LEAST_KEYPOINTS, round(asked * share))
        update["extract"] = settings.extract.model_copy(update={name: count})
        deadline.left_out.append(f"{count} {name} per image instead of {asked}")
    return settings.model_copy(update=update) if update else None


def steps_in_time(context: Context, deadline: Deadline) -> list[StepContext]:
    """Run the steps of a cascade as long as the next one is expected to fit; return those that were run."""
    every = context.settings.cascade
    done: list[StepContext] = []
    for count in range(len(every) + 1):
        part = replace(context, settings=context.settings.model_copy(update={"cascade": every[:count]}))
        if count:
            step = cascade.steps_on_file(part)[-1]
            in_time = deadline.holds(0.0, context)
            if step.reasons and not (in_time and deadline.holds(_step_s(step), context)):
                asked, *others = every[count - 1 :]
                deadline.left_out.append(f"without the step {asked.name}, for {_pairs(len(step.reasons))}")
                deadline.left_out += [f"without the step {other.name}" for other in others]
                break
        reports = [step.reports for step in done]
        steps = cascade.run(part)
        done = [replace(step, reports=before) for step, before in zip(steps, reports, strict=False)] + steps[-1:]
    return done


def _step_s(step: StepContext) -> float:
    """Seconds that a step takes, by a trial of one of its pairs."""
    context = step.context
    tried = check.tried_pair(context, next(pair for pair in context.pairs if pair.ids in step.reasons))
    if tried is None:
        return 0.0
    return (step.own_features * len(step.images) * tried.image_s + len(step.reasons) * tried.pair_s) / (
        context.executor.jobs
    )


def _pairs(count: int) -> str:
    return f"{count} pair{'s' if count != 1 else ''}"


def page_in_time(context: Context, deadline: Deadline) -> bool:
    """Whether there is time for the page of a report that is asked for."""
    if context.settings.run.report and deadline.spent_s > deadline.seconds:
        deadline.left_out.append("without the report page (`aeromatch report` makes it)")
        return False
    return context.settings.run.report


def measured_in_time(context: Context, deadline: Deadline) -> Context:
    """Return the context without the measuring of tie points, where that is not expected to fit."""
    if context.settings.least_squares is None or deadline.holds(0.0, context):
        return context
    deadline.left_out.append("without the least-squares measuring of tie points (refine)")
    settings = context.settings.model_copy(update={"refine": REFINERS["none"]()})
    write_text(context.workspace.config, dump(settings))
    return replace(context, settings=settings)
