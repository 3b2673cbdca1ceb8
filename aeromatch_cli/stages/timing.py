"""How long things take: trials of images and pairs, what follows matching, and durations in words.

Trials run in the workers, as the stages do: in this process, whose libraries use every core, the same takes up to ten
times as long on a busy machine.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from aeromatch_cli.data import Features, FloatArray, Pair
from aeromatch_cli.formats.features import read_features
from aeromatch_cli.images.source import Source, read_source
from aeromatch_cli.stages import extract, simulate
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.driver import PairTask
from aeromatch_cli.stages.filter import candidates
from aeromatch_cli.stages.match import compared
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.store.block_store import KnownFeatures
from aeromatch_cli.strategies import Matcher
from aeromatch_cli.strategies.filters import apply_chain
from aeromatch_cli.strategies.filters.chain import Filter

# How much smaller the picture is with which a worker gets ready.
_WARM_UP_SCALE = 0.25
# Seconds of a stage, of every image, and of every keypoint that the images have on average: measuring (refine), and
# adjustment, consistency and export together. Set by the reports of 595 runs of 2 to 30 images and of 1,000, on two
# cores that were more or less busy: half of them took from half to twice as long.
_MEASURING_S, _ADJUSTING_S = (0.2, 0.02, 0.2 / 8000), (1.5, 0.06, 0.8 / 8000)
# The report page takes some in any block.
_PAGE_S = 3.0


@dataclass(frozen=True, eq=False)
class ImageTrial:
    """An image to decode; `sample`: also find its features and time that; `keep`: these go on file."""

    task: extract.ExtractTask
    sample: bool
    keep: bool = False


@dataclass(frozen=True, eq=False)
class PairTrial:
    """A pair to match and to judge, in memory. ready: it is not the first of its worker's that counts, as networks are
    loaded then."""

    features: tuple[Features, Features]
    pair: PairTask
    matcher: Matcher
    chain: tuple[Filter, ...]
    sources: tuple[Source, Source] | None
    ready: bool


@dataclass(frozen=True, eq=False)
class Tried:
    """start_s: what a worker does once (imports, networks). seconds: what every further item takes.

    features: of a sampled image. matches: of a sampled pair, before verification; verified: stored pixels (M, 2) of
    either image of those that are left.
    """

    start_s: float
    seconds: float
    features: Features | None = None
    matches: int = 0
    verified: tuple[FloatArray, FloatArray] = field(default_factory=lambda: (np.zeros((0, 2)), np.zeros((0, 2))))


@dataclass(frozen=True, eq=False)
class TriedPair:
    """Seconds of an image (0 where the features of both were on file) and of the pair, in one worker; keypoints of an
    image; and verified matches as in `Tried`."""

    image_s: float
    pair_s: float
    keypoints: float
    verified: tuple[FloatArray, FloatArray]


def try_image(trial: ImageTrial) -> Tried:
    """Decode an image, and find its features where it is a sample."""
    views = trial.task.views
    started = time.perf_counter()
    if not trial.sample:
        read_source(views.enhance.source, colour=False)
        return Tried(0.0, time.perf_counter() - started)
    source = views.enhance.source
    reduced = replace(views.enhance, source=replace(source, scale=source.scale * _WARM_UP_SCALE))
    _features(trial.task, replace(views, enhance=reduced))
    ready = time.perf_counter()
    if trial.keep:
        extract.run_task(trial.task)
        features = read_features(trial.task.path)
    else:
        features = _features(trial.task, views)
    return Tried(ready - started, time.perf_counter() - ready, features)


def _features(task: extract.ExtractTask, views: simulate.SimulateTask) -> Features:
    pictures, _ = simulate.render(views)
    source = views.enhance.source
    return extract.in_stored_frame(task.extractor(source.working_camera, pictures), source.scale)


def _try_pair(trial: PairTrial) -> Tried:
    started = time.perf_counter()
    if trial.ready:
        _match(trial)
    ready = time.perf_counter()
    matches, verified = _match(trial)
    seconds = time.perf_counter() - ready
    return Tried(max(ready - started - seconds, 0.0), seconds, matches=matches, verified=verified)


def _match(trial: PairTrial) -> tuple[int, tuple[FloatArray, FloatArray]]:
    """Return how many matches there are before they are judged, and the places of those that are left."""
    matches = compared(trial.matcher, trial.features, trial.pair.geometry, trial.sources)
    sides = [(features.keypoints_px, features.colours) for features in trial.features]
    judged = candidates(matches, *sides)
    verdict = apply_chain(trial.chain, judged, trial.pair.geometry, trial.pair.seed)
    kept = judged.take(np.flatnonzero(verdict.keep))
    return len(judged), (kept.points0_px, kept.points1_px)


def time_pairs(
    context: Context, pairs: Sequence[Pair], features: Mapping[str, Features], *, ready: bool = True
) -> list[Tried]:
    """Match and judge those of the pairs both images of which have features, in memory, as a run does it. ready: as in
    `PairTrial`."""
    trials, settings, state = [], context.settings, BlockState.of(context)
    for pair in pairs:
        if not features.keys() >= set(pair.ids):
            continue
        task = PairTask(context.geometry(pair), "", ("", ""), state.seed(pair))
        shown = None
        if settings.match.reads_pixels:
            tasks = [extract.task_of(context, image_id) for image_id in pair.ids]
            shown = tasks[0].views.enhance.source, tasks[1].views.enhance.source
        sides = features[pair.image_id0], features[pair.image_id1]
        trials.append(PairTrial(sides, task, settings.match, settings.filter, shown, ready))
    outcomes = context.executor.run(_try_pair, trials, "trial", network=settings.match.network)
    return [outcome.value for outcome in outcomes if outcome.value is not None]


def tried_pair(context: Context, pair: Pair, *, keep: bool = False) -> TriedPair | None:
    """A trial of one pair and its images; None where these cannot be read.

    keep: what is found in images goes on file where there is nothing yet, and what is up to date there is not found
    again. A trial of settings that the run goes on with takes no time from it then, but for the pair.
    """
    store = context.store
    anew = context.scope.overwrite or not keep
    known = set[str]() if anew else BlockState.of(context).with_features(pair.ids)
    tasks = [extract.task_of(context, image_id) for image_id in pair.ids if image_id not in known]
    trials = [ImageTrial(task, sample=True, keep=keep and store.features(task.image_id) is None) for task in tasks]
    outcomes = context.executor.run(try_image, trials, "trial", network=context.settings.extract.network)
    features, seconds = {i: read_features(context.workspace.features(i)) for i in known}, []
    for trial, outcome in zip(trials, outcomes, strict=True):
        if outcome.value is None or outcome.value.features is None:
            return None
        task, found = trial.task, outcome.value.features
        features[task.image_id] = found
        seconds.append(outcome.value.seconds)
        if trial.keep:
            store.made_features(task.image_id, KnownFeatures(task.fingerprint, len(found.keypoints_px)))
    context.index.flush()
    tried = time_pairs(context, [pair], features, ready=not keep or context.settings.match.network)
    if not tried:
        return None
    keypoints = mean([len(found.keypoints_px) for found in features.values()])
    return TriedPair(mean(seconds), tried[0].seconds, keypoints, tried[0].verified)


def measuring_s(context: Context, keypoints: float) -> float:
    """Estimate the seconds of the stage refine. keypoints: of an image, on average."""
    return 0.0 if context.settings.least_squares is None else _later_s(context, keypoints, *_MEASURING_S)


def adjusting_s(context: Context, keypoints: float) -> float:
    """Estimate the seconds of adjustment, consistency and export. keypoints: of an image, on average."""
    return _later_s(context, keypoints, *_ADJUSTING_S)


def _later_s(context: Context, keypoints: float, once_s: float, image_s: float, keypoint_s: float) -> float:
    settings = context.settings
    if settings.first_pass is None or settings.match.reads_pixels:
        return 0.0
    return once_s + len(context.block.images) * (image_s + keypoint_s * keypoints)


def page_s(context: Context) -> float:
    """Estimate the seconds of the report page."""
    return _PAGE_S * context.settings.run.report


def mean(values: Sequence[float]) -> float:
    """Return the mean, 0 of nothing."""
    return sum(values) / len(values) if values else 0.0


def duration(seconds: float) -> str:
    """Say how long something takes."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
