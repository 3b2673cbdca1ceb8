"""--within: what of a run is left out so that it ends in time, and always with an export.

The first pass is made in any case; it is small. Then a few images and a pair are tried, and sizes and keypoints are
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

_UNITS_S = {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}
# Sizes and keypoints are halved so often at most, and fall to no less than this.
_MOST_HALVINGS, _LEAST_KEYPOINTS = 3, 500
# A block is oriented from images of this size where its settings say no other.
_LEAST_SIZE_PX = 1600


def seconds_of(text: str) -> float:
    """Read a duration such as 20m, 1h30m or 90s. Raises ConfigError."""
    parts = re.findall(r"(\d+(?:\.\d+)?)\s*(s|min|m|h)", text.strip().lower())
    seconds = sum(float(number) * _UNITS_S[unit] for number, unit in parts)
    if re.fullmatch(r"(\s*\d+(?:\.\d+)?\s*(s|min|m|h)\s*)+", text.lower()) is None or seconds <= 0.0:
        raise ConfigError(f"--within {text!r}: write a duration such as 20m, 1h or 90s")
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

    def holds(self, more_s: float, context: Context) -> bool:
        """Whether so many seconds, and what follows matching, fit in what is left."""
        done_s = self.spent_s + more_s
        return done_s + check.later_s(context, done_s) <= self.seconds

    def words(self) -> list[str]:
        """Lines for the end of the run."""
        over_s = self.spent_s - self.seconds
        late = f", {check.duration(over_s)} late" if over_s > 0.0 else ""
        left = "; ".join(self.left_out) or "nothing"
        return [
            f"within {self.text}".ljust(16) + f" ended after {check.duration(self.spent_s)}{late}; left out: {left}"
        ]


def fitting(context: Context, deadline: Deadline) -> Settings | None:
    """Return settings with smaller images and fewer keypoints with which a block can be matched in time; None where
    they need not change. What they leave out is noted."""
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
        if deadline.holds(needed_s(), context):
            break
        share /= 2
    return None if share == 1.0 else _reduced(context, share, deadline)


def _reduced(context: Context, share: float, deadline: Deadline) -> Settings:
    """The settings with so many of the pixels and keypoints."""
    settings, update = context.settings, {}
    longest_px = max(max(image.width_px, image.height_px) for image in context.block.images)
    before_px = min(longest_px, settings.block.max_size_px or longest_px)
    least_px = _LEAST_SIZE_PX if settings.first_pass is None else settings.first_pass.size_px
    size_px = max(min(least_px, before_px), round(before_px * share**0.5))
    if size_px < before_px:
        update["block"] = settings.block.model_copy(update={"max_size_px": size_px})
        deadline.left_out.append(f"images larger than {size_px} pixels (they have {before_px})")
    asked = getattr(settings.extract, "keypoints", None)
    if asked is not None and asked > _LEAST_KEYPOINTS:
        keypoints = max(_LEAST_KEYPOINTS, round(asked * share))
        update["extract"] = settings.extract.model_copy(update={"keypoints": keypoints})
        deadline.left_out.append(f"more than {keypoints} keypoints per image (of {asked})")
    return settings.model_copy(update=update)


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
                deadline.left_out += [f"step {name.name}" for name in every[count - 1 :]]
                deadline.left_out[-len(every[count - 1 :])] += f" of {len(step.reasons)} pairs"
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


def page_in_time(context: Context, deadline: Deadline) -> bool:
    """Whether there is time for the page of a report that is asked for."""
    if context.settings.run.report and deadline.spent_s > deadline.seconds:
        deadline.left_out.append("the report page (`aeromatch report` makes it)")
        return False
    return context.settings.run.report


def measured_in_time(context: Context, deadline: Deadline) -> Context:
    """Return the context without the measuring of tie points, where that is not expected to fit."""
    if context.settings.least_squares is None or deadline.holds(0.0, context):
        return context
    deadline.left_out.append("the least-squares measuring of tie points (refine)")
    settings = context.settings.model_copy(update={"refine": REFINERS["none"]()})
    write_text(context.workspace.config, dump(settings))
    return replace(context, settings=settings)
