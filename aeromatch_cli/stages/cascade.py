"""cascade: steps from cheap to expensive, each for the pairs that those before it leave with too few matches.

The stages extract, match and filter make each step; its files lie in folders of its name beside those of the block. A
pair takes a further step where its verified matches are few for its overlap or leave parts of it empty, or where
learned features may bring many more. Whether it does depends on this pair, and of steps whose features cost much and
matches little on others of its images: a shard takes such pairs as far as it sees them, the command that ends the work
of all shards the rest. `joined_steps` joins what the steps have found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from aeromatch_cli.config import Settings
from aeromatch_cli.data import FloatArray, Pair
from aeromatch_cli.formats.features import read_keypoints
from aeromatch_cli.formats.rows import VerifiedEntry
from aeromatch_cli.geometry.coverage import covered_share, shared_cells
from aeromatch_cli.stages import extract, filter, match  # noqa: A004
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.pair_statistics import PairStatistics
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.extractors.aliked import Aliked
from aeromatch_cli.strategies.extractors.described import Described
from aeromatch_cli.strategies.extractors.learned import Learned
from aeromatch_cli.strategies.matchers.descriptors.assignment import distinct
from aeromatch_cli.strategies.matchers.descriptors.bidirectional import Bidirectional
from aeromatch_cli.strategies.matchers.descriptors.search import EVERY_PAIR
from aeromatch_cli.strategies.matchers.lightglue.aliked import AlikedLightGlue
from aeromatch_cli.strategies.matchers.lightglue.learned import LearnedLightGlue
from aeromatch_cli.strategies.simulators.neighbours import NeighbourViews
from aeromatch_cli.strategies.simulators.plane import PlaneViews
from aeromatch_cli.strategies.steps import GuidedSearch, LearnedFeatures, Step
from aeromatch_cli.workspace import Workspace

# The first step of every cascade.
FIRST = "first"
# Whose keypoints are held, of each step: images are paired with neighbours, which most blocks list near each other.
_IMAGES_AT_HAND = 1024
# Of features that so small a share of the pairs asks for, the pairs go without whose images a third one ties.
_RARE = 0.02
# Why a pair takes a step that it does not need.
_BOTH_KNOWN = "both images have its features for other pairs"
# The strongest descriptors of a view that LightGlue compares: two rendered city blocks, and every 3rd and 4th image of
# lewis and ochota, have 99 to 101 % of the correct matches and points that twice as many bring. Seconds grow with the
# square.
_SHOWN = 1024
# An image that no step has tied yet may show another place. So many partners, those with most matches, tell.
_TRIED_PARTNERS = 3
# Matches of two steps that are nearer than this in both images are one.
SAME_MATCH_PX = 1.0

Key = tuple[str, str]


def keypoints_of(step: Any, settings: Settings) -> int:
    """Return the largest number of keypoints that a step finds in an image."""
    first: Any = settings.extract  # never a grid, which has no keypoints that a cascade could join
    return int((step.keypoints or first.keypoints) if step.own_features else first.keypoints)


def _reduction(settings: Settings) -> dict[str, float]:
    """Return the reduction of learned keypoints: that of the user's own, none where others of the user have none."""
    own = settings.extract
    taken = isinstance(own, Described) and (isinstance(own, Learned) or own.pixels_per_keypoint == 0.0)
    return {"pixels_per_keypoint": own.pixels_per_keypoint} if taken else {}


def _views(settings: Settings) -> NeighbourViews:
    """Return the views of steps with features of their own: with distant ground where the settings have it."""
    own = settings.simulate
    return NeighbourViews(far_ground=own.far_ground) if isinstance(own, PlaneViews) else NeighbourViews()


def _learned(step: LearnedFeatures, settings: Settings) -> dict[str, Strategy]:
    """Learned features and what matches them."""
    keypoints, reduction = keypoints_of(step, settings), _reduction(settings)
    network = {"precision": step.precision, "device": step.device}
    matcher: Strategy = Bidirectional(ratio=0.9, guided=True)
    if step.features == "aliked":
        if step.lightglue:
            matcher = AlikedLightGlue(**network, max_keypoints=_SHOWN)
        return {"extract": Aliked(keypoints=keypoints, **reduction), "match": matcher}
    if step.lightglue:
        matcher = LearnedLightGlue(**network, max_keypoints=_SHOWN)
    return {"extract": Learned(keypoints=keypoints, **network, **reduction), "match": matcher}


# What a step changes of the settings.
_SETTINGS_OF: Mapping[type[Step], Callable[[Any, Settings], dict[str, Strategy]]] = {
    GuidedSearch: lambda _, settings: {
        # The step has decided: guided search, however many matches there are.
        "match": settings.match.model_copy(update={"guided": True, "guide_below_matches": EVERY_PAIR}),
    },
    LearnedFeatures: lambda step, settings: {"simulate": _views(settings), **_learned(step, settings)},
}


@dataclass(frozen=True, eq=False)
class StepContext:
    """A step with its context. features_of: the step whose features it uses. reasons: why each pair takes it, "" in the
    first. needed: the pairs that lacked something before it. expected: verified matches that pairs may have after it,
    NaN where unknown. reports: of extract, match and filter, where this command has run them."""

    name: str
    features_of: str
    context: Context
    reasons: Mapping[Key, str]
    needed: frozenset[Key] = frozenset()
    expected: Mapping[Key, float] = field(default_factory=dict)
    reports: tuple[StageReport, ...] = ()

    @property
    def own_features(self) -> bool:
        return self.features_of == self.name

    @cached_property
    def images(self) -> frozenset[str]:
        """Return the images that the step looks at: all in the first step, else those of its pairs."""
        if self.name == FIRST:
            return frozenset(image.image_id for image in self.context.block.images)
        return frozenset(image_id for key in self.reasons for image_id in key)


def run(context: Context) -> list[StepContext]:
    """Make what is not up to date of every step of the shard, in order; the steps with their reports."""
    done = []
    for step in _steps(context):
        own = step.context
        # All images in the first step: what failed there is told of those, too, that are in no pair.
        ids = match.images_of_rows(own) if step.name == FIRST else match.paired_images(own)
        # Features of the first step are made once, also where everything is made anew.
        making = own if step.own_features else own.with_scope(overwrite=False)
        reports = [extract.run_own_first(making, ids), match.run(own), filter.run(own)]
        for report in reports:
            report.part = own.scope.part
        done.append(replace(step, reports=tuple(reports)))
    return done


def steps_on_file(context: Context) -> list[StepContext]:
    """Return the steps as far as they are on file."""
    return list(_steps(context))


def _steps(context: Context) -> Iterator[StepContext]:
    """Each step, with the pairs that the results on file of those before it leave to it. It is chosen when it is asked
    for: by then the caller has made the one before."""
    settings = context.settings
    chosen = {(pair.image_id0, pair.image_id1): "" for pair in context.pairs}
    steps = [_step(context, FIRST, FIRST, settings.model_copy(update={"cascade": ()}), chosen)]
    yield steps[0]
    for recipe in settings.cascade:
        found = evidence_of(steps)
        most = keypoints_of(recipe, settings)
        reasons = {key: evidence.asks_for(recipe, most) for key, evidence in found.items()}
        left = {key: reason for key, reason in reasons.items() if reason and not found[key].shows_nothing}
        if recipe.own_features:
            left = _with_few_partners(left, found)
            if len(left) <= _RARE * len(reasons):
                left = _not_tied_by_a_third(
                    left, [key for key, evidence in found.items() if not evidence.lacks(recipe)]
                )
        if recipe.cheap_to_match:
            looked_at = {image_id for key in left for image_id in key}
            known = [key for key in reasons if key not in left and set(key) <= looked_at]
            left |= {key: reasons[key] or _BOTH_KNOWN for key in known}
        needed = frozenset(key for key in left if found[key].lacks(recipe))
        expected = {key: found[key].expected(recipe, most) for key in left}
        steps.append(replace(_further_step(context, recipe, left), needed=needed, expected=expected))
        yield steps[-1]


def _with_few_partners(left: Mapping[Key, str], found: Mapping[Key, PairStatistics]) -> dict[Key, str]:
    """The pairs left without most of those of images that no step has tied to another."""
    tied = {image_id for key, evidence in found.items() if evidence.verified for image_id in key}
    pairs_of: dict[str, list[Key]] = {}
    for key in left:
        for image_id in set(key) - tied:
            pairs_of.setdefault(image_id, []).append(key)
    dropped: set[Key] = set()
    for pairs in pairs_of.values():
        best = sorted(pairs, key=lambda key: (-found[key].candidates, key))
        dropped.update(best[_TRIED_PARTNERS:])
    return {key: reason for key, reason in left.items() if key not in dropped}


def _not_tied_by_a_third(left: Mapping[Key, str], enough: Iterable[Key]) -> dict[Key, str]:
    """Return the pairs whose images no third image ties: none has pairs with both that have enough matches."""
    settled: dict[str, set[str]] = {}
    for id0, id1 in enough:
        settled.setdefault(id0, set()).add(id1)
        settled.setdefault(id1, set()).add(id0)
    return {key: reason for key, reason in left.items() if not settled.get(key[0], set()) & settled.get(key[1], set())}


def feature_workspaces(settings: Settings, workspace: Workspace) -> list[Workspace]:
    """Return the workspaces in which views and features are made: the workspace itself, or a cascade's first step and
    those with their own."""
    if not settings.cascade:
        return [workspace]
    names = FIRST, *(recipe.name for recipe in settings.cascade if recipe.own_features)
    return [workspace.of_step(name, name) for name in names]


def further_steps(context: Context) -> list[StepContext]:
    """Return the steps after the first, each with all pairs."""
    reasons = {(pair.image_id0, pair.image_id1): "" for pair in context.pairs}
    return [_further_step(context, recipe, reasons) for recipe in context.settings.cascade]


def strategies_of(step: Step, settings: Settings) -> dict[str, Strategy]:
    """Return, by family, the strategy that a step takes instead of the settings' own."""
    return _SETTINGS_OF[type(step)](step, settings)


def _further_step(context: Context, recipe: Step, reasons: Mapping[Key, str]) -> StepContext:
    changed = {"cascade": (), **strategies_of(recipe, context.settings)}
    features_of = recipe.name if recipe.own_features else FIRST
    # A step with the first one's features goes on from its matches.
    context = context.with_scope(continues=None if recipe.own_features else context.settings.match)
    return _step(context, recipe.name, features_of, context.settings.model_copy(update=changed), reasons)


def _step(context: Context, name: str, features_of: str, settings: Settings, reasons: Mapping[Key, str]) -> StepContext:
    own = replace(
        context,
        settings=settings,
        workspace=context.workspace.of_step(name, features_of),
        scope=replace(context.scope, chosen=frozenset(reasons), part=f"step {name}: "),
    )
    return StepContext(name, features_of, own, reasons)


def evidence_of(steps: Sequence[StepContext]) -> dict[Key, PairStatistics]:
    """Return, by pair, what the steps have found together, for the pairs that the last of their steps has judged."""
    judged = [_InOrder(BlockState.of(step.context).judged_pairs()) for step in steps]
    readers = [_keypoint_reader(step) for step in steps]
    found = {}
    for pair in steps[0].context.pairs:
        key = pair.image_id0, pair.image_id1
        # By the step that has made the features: of several steps with the same ones the last counts.
        places: dict[str, tuple[FloatArray, FloatArray]] = {}
        candidates, known = 0, False
        for step, entries, read in zip(steps, judged, readers, strict=True):
            entry = entries.of(key)
            if key not in step.reasons:
                continue
            known = entry is not None
            if entry is not None:
                candidates = max(candidates, entry.matches_in)
                rows = entry.matches.indices if entry.verdict.state == "verified" else entry.matches.indices[:0]
                places[step.features_of] = read(key[0])[rows[:, 0]], read(key[1])[rows[:, 1]]
        if known:
            fewer = min(len(readers[0](image_id)) for image_id in key)
            found[key] = _evidence(steps[0].context, pair, [*places.values()], keypoints=fewer, candidates=candidates)
    return found


class _InOrder:
    """Judged pairs of one step, asked for in the order of all pairs: those of a large block are never held at once."""

    def __init__(self, judged: Iterable[tuple[Pair, VerifiedEntry]]) -> None:
        self._rest = iter(judged)
        self._next = next(self._rest, None)

    def of(self, key: Key) -> VerifiedEntry | None:
        """Return the verified entry of a pair, None where the step has not judged it."""
        if self._next is None or (self._next[0].image_id0, self._next[0].image_id1) != key:
            return None
        entry, self._next = self._next[1], next(self._rest, None)
        return entry


def _keypoint_reader(step: StepContext) -> Callable[[str], FloatArray]:
    """Places of an image's keypoints."""
    return lru_cache(_IMAGES_AT_HAND)(lambda image_id: read_keypoints(step.context.workspace.features(image_id))[0])


def _evidence(
    context: Context, pair: Pair, found: Sequence[tuple[FloatArray, FloatArray]], *, keypoints: int, candidates: int
) -> PairStatistics:
    """found: verified places of either image, by step."""
    geometry = context.geometry(pair)
    points0, points1 = (np.concatenate([one[side] for one in found]) for side in range(2))
    if len(found) > 1:
        places = np.column_stack([points0, points1]).astype(np.float64)
        once = distinct(places, np.zeros(len(places)), SAME_MATCH_PX)
        points0, points1 = points0[once], points1[once]
    shared, overlap, coverage = shared_cells(geometry), float("nan"), float("nan")
    if shared is not None:
        overlap = shared.share
        if shared.cells0.mean() >= shared.cells1.mean():
            coverage = covered_share(shared.cells0, geometry.camera0, points0)
        else:
            coverage = covered_share(shared.cells1, geometry.camera1, points1)
    pixels = min(camera.width_px * camera.height_px for camera in (geometry.camera0, geometry.camera1))
    sought = getattr(context.settings.extract, "keypoints", 0)
    return PairStatistics(len(points0), overlap, coverage, keypoints, candidates, pair.view_angle_deg, pixels, sought)


@dataclass(frozen=True)
class Outcome:
    """Holds what became of a pair: the step after which it needed nothing more, or ""; what it lacks in the end; and
    the verified matches of all steps, those that two of them have found counted once."""

    settled_by: str
    lacks: str
    verified: int


def outcomes(context: Context, steps: Sequence[StepContext]) -> dict[Key, Outcome]:
    """Return the outcome of every pair. One that took a step though it lacked nothing is settled by one before it."""
    found, last = evidence_of(steps), context.settings.cascade[-1]
    answer: dict[Key, Outcome] = {}
    for pair in context.pairs:
        key = pair.image_id0, pair.image_id1
        lacks = found[key].lacks(last) if key in found else "not matched"
        needed = [step.name for step in steps[1:] if key in step.needed]
        settled = "" if lacks else needed[-1] if needed else FIRST
        answer[key] = Outcome(settled, lacks, found[key].verified if key in found else 0)
    return answer
