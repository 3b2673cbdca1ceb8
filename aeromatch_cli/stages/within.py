"""--within: what a run does without so that it ends in time, and always with an export.

The first pass is made in any case; it is small. Then it is planned how many pixels and keypoints the images have, by
what is not on file yet and a trial of one pair. Further steps of a cascade, the measuring of tie points and the report
page are taken as long as what they need is expected to fit as well. Nothing that has begun is stopped.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

from aeromatch_cli.config import Settings, dump
from aeromatch_cli.data import Pair
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.files import read_record, write_text
from aeromatch_cli.results.record import StageRecord
from aeromatch_cli.stages import cascade, refine
from aeromatch_cli.stages.block import with_gsd
from aeromatch_cli.stages.cascade import StepContext
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.stages.timing import TriedPair, adjusting_s, duration, mean, measuring_s, page_s, tried_pair
from aeromatch_cli.strategies.refiners import REFINERS
from aeromatch_cli.words import counted

_UNITS_S = {"s": 1.0, "m": 60.0, "h": 3600.0}
_PART = r"(\d+(?:\.\d+)?)\s*(s(?:ec(?:ond)?s?)?|m(?:in(?:ute)?s?)?|h(?:(?:ou)?rs?)?)"
# Shares of the pixels and keypoints that are planned with one after the other, until what follows fits.
_SMALLER = (1 / 2, 1 / 4, 1 / 8)
# What they do not fall below: keypoints of an image, and its longer side where there is no first pass whose images
# would be larger.
_LEAST_KEYPOINTS, _LEAST_SIZE_PX = 500, 1600
# Share of the time that is planned for: a pair and its images do not tell exactly what the others need.
_PLANNED = 0.9
# Share of the time that fewer pixels and keypoints, no measuring, or a step left out after its trial must save: what
# costs little stays.
_WORTH = 0.05
# What workers take to load a network.
_NETWORK_S = 3.0
# How what is said of a step that is left out begins.
_STEP = "without the step "


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
    """When a run is to end. text: as it was given. left_out: what it does without, in words. short: whether it is
    expected to end late all the same."""

    text: str
    seconds: float = field(init=False)
    left_out: list[str] = field(default_factory=list)
    short: bool = False
    started: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.seconds = seconds_of(self.text)

    @property
    def spent_s(self) -> float:
        return time.monotonic() - self.started

    @property
    def is_kept(self) -> bool:
        """Whether the run is as it was asked for, and not late."""
        return not self.left_out and self.spent_s <= self.seconds

    def holds(self, more_s: float) -> bool:
        """Whether so many seconds more are planned for: the one rule by which all is taken or left out."""
        return self.spent_s + more_s <= _PLANNED * self.seconds

    def is_worth(self, saved_s: float) -> bool:
        """Whether it is worth while to do without what takes so many seconds."""
        return saved_s >= _WORTH * self.seconds

    def plan(self) -> str:
        """Say what is left out from the start."""
        aim = f"{self.text} is likely too short; to end as early as it can" if self.short else f"to end in {self.text}"
        return f"within           {aim}: {'; '.join(self.left_out)}"

    def line(self) -> str:
        """Say at the end of the run when it ended, and what it did without."""
        over_s = self.spent_s - self.seconds
        late = f", {duration(over_s)} late" if over_s >= 0.5 else ""
        done = f"for that: {'; '.join(self.left_out)}" if self.left_out else "nothing was left out"
        return f"within {self.text}".ljust(16) + f" ended after {duration(self.spent_s)}{late}; {done}"


@dataclass(frozen=True)
class _Todo:
    """What of a step, or of a block without steps, is to be made. Verdicts alone count as nothing: they take a tenth of
    what matching does, or less."""

    images: frozenset[str]
    pairs: tuple[Pair, ...]
    jobs: int

    @classmethod
    def of(cls, context: Context, image_ids: Collection[str]) -> _Todo:
        state, anew = BlockState.of(context), context.scope.overwrite
        images = frozenset(image_ids) - (set() if anew else state.with_features(image_ids))
        pairs = list[Pair]()
        for image_id0, row in context.rows().items():
            made_of = {} if anew else {i: known.fingerprint for i, known in context.store.matches(image_id0).items()}
            pairs += [p for p in row if p.image_id1 not in made_of or made_of[p.image_id1] != state.wanted_matches(p)]
        return cls(images, tuple(pairs), context.executor.jobs)

    def seconds(self, image_s: float, pair_s: float) -> float:
        return (len(self.images) * image_s + len(self.pairs) * pair_s) / self.jobs

    def sample(self, pairs: Collection[Pair]) -> Pair:
        """The pair that is tried: of those with most images to be made the middle one, whose cost is likely to be that
        of others."""
        lacking = [len(self.images & set(pair.ids)) for pair in pairs]
        most = max(lacking)
        best = [pair for pair, count in zip(pairs, lacking, strict=True) if count == most]
        return best[len(best) // 2]


@dataclass(frozen=True, eq=False)
class _Option:
    """Settings with a share of the pixels and keypoints. first: the context of the block, or of its first step, with
    them. pixels: share of the pixels that is left. keypoints: of an image at most. left_out: in words."""

    settings: Settings
    first: Context
    todo: _Todo
    pixels: float
    keypoints: float
    left_out: tuple[str, ...]

    @classmethod
    def of(cls, context: Context, share: float) -> _Option:
        settings, update, left_out = context.settings, {}, []
        longest_px = max(max(image.width_px, image.height_px) for image in context.block.images)
        before_px = min(longest_px, settings.block.max_size_px or longest_px)
        least_px = _LEAST_SIZE_PX if settings.first_pass is None else settings.first_pass.size_px
        size_px = max(min(least_px, before_px), round(before_px * share**0.5))
        if size_px < before_px:
            update["block"] = settings.block.model_copy(update={"max_size_px": size_px})
            left_out.append(f"images are reduced to {size_px} pixels (from {before_px})")
        name = next((name for name in ("keypoints", "points") if hasattr(settings.extract, name)), "")
        asked = getattr(settings.extract, name, 0)
        count = max(min(_LEAST_KEYPOINTS, asked), round(asked * share))
        if count < asked:
            update["extract"] = settings.extract.model_copy(update={name: count})
            left_out.append(f"{count} {name} per image instead of {asked}")
        settings = settings.model_copy(update=update)
        block = context.block
        if "block" in update:
            block = with_gsd(block, (block.gsd_m, block.reduced_gsd_m), size_px)
        first = _first(replace(context, settings=settings, block=block) if update else context)
        todo = _Todo.of(first, [image.image_id for image in block.images])
        keypoints = float(count) if name else math.inf
        return cls(settings, first, todo, (size_px / before_px) ** 2, keypoints, tuple(left_out))

    def seconds(self, tried: TriedPair) -> float:
        """What is to be made of the images and pairs, and what follows. tried: with the settings as asked for. Features
        take as long as their pictures are large, and pairs as keypoints are many, squared."""
        keypoints = min(tried.keypoints, self.keypoints)
        pair_s = tried.pair_s * (keypoints / max(tried.keypoints, 1.0)) ** 2
        return self.todo.seconds(tried.image_s * self.pixels, pair_s) + _later_s(self.first, keypoints)


def fitting(context: Context, deadline: Deadline) -> Settings | None:
    """Return settings with smaller images and fewer keypoints with which a block can be matched in time, or as early as
    it can; None where they stay as they are. What they leave out is noted.

    What is on file counts as done: where the features are there, nothing is reduced, as all would be made anew.
    """
    asked = chosen = _Option.of(context, 1.0)
    if not asked.todo.images:
        return None
    started = len(asked.todo.images) < len(context.block.images)
    if not started and not deadline.holds(_least_s(context) + _later_s(context, _LEAST_KEYPOINTS)):
        chosen, deadline.short = _Option.of(context, _SMALLER[-1]), True  # and no time is spent on a trial
    else:
        tried = tried_pair(asked.first, asked.todo.sample(context.pairs), keep=True)
        if tried is None:  # its images cannot be read; the stages say so
            return None
        left = _Todo.of(asked.first, asked.todo.images)  # without what the trial has made
        asked = chosen = replace(asked, todo=left)
        for share in _SMALLER:
            if deadline.holds(chosen.seconds(tried)):
                break
            option = _Option.of(context, share)
            if deadline.is_worth(chosen.seconds(tried) - option.seconds(tried)):
                chosen = option
        deadline.short = not deadline.holds(chosen.seconds(tried))
    deadline.left_out += chosen.left_out
    return chosen.settings if chosen.left_out else None


def _first(context: Context) -> Context:
    """The context of the first step of a cascade, or that of the block where there is none."""
    if not context.settings.cascade:
        return context
    settings = context.settings.model_copy(update={"cascade": ()})
    return cascade.steps_on_file(replace(context, settings=settings))[0].context


def _least_s(context: Context) -> float:
    """Seconds that the images take at least: those of the first pass, where they are no larger; nothing is known of a
    network, which a GPU may make faster."""
    record = read_record(context.workspace.first_pass.stage_report("extract"), StageRecord)
    if record is None or not record.done or context.settings.extract.network:
        return 0.0
    return len(context.block.images) * record.seconds / record.done


def _later_s(context: Context, keypoints: float) -> float:
    """Seconds of what always follows matching. The page does not count: it goes first."""
    return measuring_s(context, keypoints) + adjusting_s(context, keypoints)


def _keypoints(context: Context) -> float:
    """Keypoints of an image on file, on average."""
    found = (context.store.features(image.image_id) for image in context.block.images)
    return mean([known.keypoints for known in found if known is not None])


def keep_asked(context: Context) -> None:
    """Keep the settings as they were asked for, for `aeromatch run WORK`: before anything else has reduced ones."""
    if not context.workspace.asked.is_file():
        write_text(context.workspace.asked, dump(context.settings))


def steps_in_time(context: Context, deadline: Deadline) -> list[StepContext]:
    """Run the steps of a cascade as long as the next one is expected to fit; return those that were run."""
    every = context.settings.cascade
    done: list[StepContext] = []
    for count in range(len(every) + 1):
        part = replace(context, settings=context.settings.model_copy(update={"cascade": every[:count]}))
        if count:
            step = cascade.steps_on_file(part)[-1]
            if not _fits(step, done[0], deadline):
                # Each step has a limit of its own, and pairs are settled that have what the last one asks for.
                limit = f"by its limit (below_matches {every[count - 1].below_matches})"
                asking = counted(len(step.reasons), "pair")
                deadline.left_out.append(f"{_STEP}{step.name}, which {asking} would have taken {limit}")
                deadline.left_out += [f"{_STEP}{other.name}" for other in every[count:]]
                break
        reports = [step.reports for step in done]
        steps = cascade.run(part)
        done = [replace(step, reports=before) for step, before in zip(steps, reports, strict=False)] + steps[-1:]
    return done


def without_steps(left_out: Sequence[str]) -> list[str]:
    """What is still left out once all steps of the cascade are made."""
    return [words for words in left_out if not words.startswith(_STEP)]


def _fits(step: StepContext, first: StepContext, deadline: Deadline) -> bool:
    """Whether there is time for a step. It is tried on a pair, whose features stay on file, only if there would be time
    where its images and pairs took no longer than those of the first step, which is cheaper, did in this run."""
    context, later_s = step.context, _later_s(first.context, _keypoints(first.context))
    images = step.images if step.own_features else ()
    todo = _Todo.of(context, images)
    if not todo.images and not todo.pairs:
        return True
    image_s, pair_s = (report.seconds * todo.jobs / max(report.done, 1) for report in first.reports[:2])
    start_s = _NETWORK_S * bool(todo.images and context.settings.extract.network)
    if not deadline.holds(start_s + todo.seconds(image_s, pair_s) + later_s):
        return False
    pairs = [pair for row in context.rows().values() for pair in row]
    tried = tried_pair(context, todo.sample(todo.pairs or pairs), keep=True)
    if tried is None:  # its images cannot be read; the stages say so
        return True
    rest_s = _Todo.of(context, images).seconds(tried.image_s, tried.pair_s)
    return deadline.holds(rest_s + later_s) or not deadline.is_worth(rest_s)


def measured_in_time(context: Context, deadline: Deadline) -> Context:
    """Return the context without the measuring of tie points, where that is not expected to fit and takes more than a
    little."""
    keypoints = _keypoints(context)
    if deadline.holds(_later_s(context, keypoints)) or not deadline.is_worth(measuring_s(context, keypoints)):
        return context
    if refine.is_current(context):
        return context
    deadline.left_out.append("without the least-squares measuring of tie points (refine)")
    keep_asked(context)
    settings = context.settings.model_copy(update={"refine": REFINERS["none"]()})
    write_text(context.workspace.config, dump(settings))
    return replace(context, settings=settings)


def page_in_time(context: Context, deadline: Deadline) -> bool:
    """Whether there is time for the page of a report; that it is left out is noted."""
    if deadline.holds(page_s(context)):
        return True
    deadline.left_out.append("without the report page (`aeromatch report` makes it)")
    return False
