"""The steps of a cascade joined: one table of keypoints per image and one row of matches per pair.

A keypoint of a later step that lies on one of an earlier step is that keypoint, so that tracks run through steps. Of
matches that lie together in both images one stays: one that its own step has verified before others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray, JoinedKeypoints, Matches, Pair
from aeromatch_cli.files import write_atomically, write_text
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.formats.features import read_joined, read_keypoints, write_joined
from aeromatch_cli.formats.rows import (
    MatchEntry,
    VerifiedEntry,
    read_match_row,
    read_verified_row,
    write_match_row,
)
from aeromatch_cli.formats.tables import csv_text
from aeromatch_cli.recent import read_once
from aeromatch_cli.results.stages import ExtractResult, MatchResult
from aeromatch_cli.stages import cascade, extract
from aeromatch_cli.stages.cascade import StepContext
from aeromatch_cli.stages.context import Context, JoinedFingerprints
from aeromatch_cli.stages.driver import PairTask, RowResult, run_rows, run_stage
from aeromatch_cli.stages.stage_report import StageReport, gather_failures, result_on_file
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.store.block_store import KnownFeatures, KnownMatches, matches_of
from aeromatch_cli.strategies.matchers.descriptors.assignment import distinct, one_to_one
from aeromatch_cli.workspace import Workspace

VERSION = 1
# Keypoints of two steps that are nearer than this are one.
SAME_PX = 0.5

Key = tuple[str, str]


@dataclass(frozen=True, eq=False)
class KeypointsTask:
    """One image. steps: name and features of those that have looked at it, in order."""

    image_id: str
    steps: tuple[tuple[str, Path], ...]
    workspace: Workspace
    fingerprint: str


@dataclass(frozen=True, eq=False)
class JoinTask:
    """Asks for the merging of all pairs of one image. steps: by image_id1, the name of the step whose features the
    matches use, and the workspace that has them."""

    image_id0: str
    pairs: tuple[PairTask, ...]
    steps: Mapping[str, tuple[tuple[str, Workspace], ...]]
    workspace: Workspace


def joined_context(context: Context, steps: Sequence[StepContext]) -> Context:
    """Return the context of the stages after the cascade. What failed in a step is not among the parts, so that its
    joined files are made again when it is there later."""
    usable = _usable(steps)
    features: dict[str, str] = {}
    for image in context.block.images:
        image_id = image.image_id
        kinds = [(s.name, extract.task_of(s.context, image_id).fingerprint) for s, ready in usable if image_id in ready]
        features[image_id] = fingerprint(VERSION, kinds)
    matches = {}
    for pair in context.pairs:
        key = pair.image_id0, pair.image_id1
        found = []
        for step in _matched(steps, pair):
            verdict = step.context.store.verdicts(key[0]).get(key[1])
            judged = None if verdict is None else verdict.fingerprint
            found.append((step.name, BlockState.of(step.context).wanted_matches(pair), judged))
        matches[key] = fingerprint(VERSION, found, features[key[0]], features[key[1]])
    return context.with_scope(joined=JoinedFingerprints(features, matches))


def _usable(steps: Sequence[StepContext]) -> list[tuple[StepContext, set[str]]]:
    """Steps with features of their own, and the images that have them. A step that --within has tried on one pair and
    left out has matched none: its features count as if they were not there."""
    found = []
    for step in steps:
        if step.own_features:
            matched = step.images if step.name == cascade.FIRST else _matched_images(step)
            found.append((step, BlockState.of(step.context).with_features(matched)))
    return found


def _matched_images(step: StepContext) -> set[str]:
    """Images of the step with a pair that it has matched."""
    store = step.context.store
    matched = {(i, other) for i in {image_id0 for image_id0, _ in step.reasons} for other in store.matches(i)}
    return {image_id for key in step.reasons.keys() & matched for image_id in key}


def _matched(steps: Sequence[StepContext], pair: Pair) -> list[StepContext]:
    """Steps that have matches of a pair."""
    return [step for step in steps if pair.ids in step.reasons and BlockState.of(step.context).are_matched(pair)]


def run(context: Context, steps: Sequence[StepContext]) -> list[StageReport]:
    """Write the joined features and matches, and steps.csv; the reports of extract and match."""
    assert context.scope.joined is not None
    return [_join_keypoints(context, steps), _join_matches(context, steps)]


def _join_keypoints(context: Context, steps: Sequence[StepContext]) -> StageReport:
    assert context.scope.joined is not None
    report = StageReport("extract", items=len(context.block.images))
    _count_seconds(report, steps, ["extract"])
    report.failures = _failures(steps, "extract")
    tasks, joined = [], 0
    usable = _usable(steps)
    for image in context.block.images:
        image_id = image.image_id
        own = [step for step, ready in usable if image_id in ready]
        joined += bool(own)
        wanted = context.scope.joined.features[image_id]
        if own and (context.scope.overwrite or context.store.features_fingerprint(image_id) != wanted):
            paths = tuple((step.name, step.context.workspace.features(image_id)) for step in own)
            tasks.append(KeypointsTask(image_id, paths, context.workspace, wanted))
    for image_id, known in run_stage(context, report, join_keypoints, tasks, [task.image_id for task in tasks]):
        context.store.made_features(image_id, known)
    # An image that fails in one step has the keypoints of the others.
    report.skipped = joined - len(tasks)
    report.result = _sums(steps)
    report.fingerprint = fingerprint(sorted(context.scope.joined.features.values()))
    return report.write(context.workspace)


def _sums(steps: Sequence[StepContext]) -> ExtractResult:
    """Return what the steps have on file of their features together."""
    own = [step for step in steps if step.own_features]
    first, *further = (result_on_file(s.context.workspace, ExtractResult) if s.images else None for s in own)
    known = [found for found in (first, *further) if found is not None]
    total = reduce(ExtractResult.plus, known) if known else ExtractResult()
    return total.model_copy(
        update={
            # One in which a further step finds nothing is not without keypoints.
            "images_without_keypoints": 0 if first is None else first.images_without_keypoints,
            "images_by_step": {step.name: len(step.images) for step in own},
        }
    )


def _failures(steps: Sequence[StepContext], *stages: str) -> list[tuple[str, str]]:
    """Return the failures of these stages of all steps, each item once."""
    found: dict[str, str] = {}
    for step in steps:
        for one, item, reason in gather_failures(step.context.workspace):
            if one in stages:
                found.setdefault(item, reason if step.name == cascade.FIRST else f"{step.name}: {reason}")
    return sorted(found.items())


def _count_seconds(report: StageReport, steps: Sequence[StepContext], stages: Collection[str]) -> None:
    """Count the time of the steps' own stages as part of the stage's time."""
    report.started -= sum(one.seconds for step in steps for one in step.reports if one.stage in stages)


def join_keypoints(task: KeypointsTask) -> tuple[str, KnownFeatures]:
    """Write features/<id>.npz of one image; return what is known of it."""
    parts = [(name, *read_keypoints(path)) for name, path in task.steps]
    joined = joined_keypoints([(name, places, sizes) for name, places, sizes, _ in parts])
    write_atomically(
        task.workspace.features(task.image_id), lambda stream: write_joined(stream, joined, task.fingerprint)
    )
    return task.image_id, KnownFeatures(task.fingerprint, len(joined.keypoints_px))


def joined_keypoints(parts: Sequence[tuple[str, FloatArray, FloatArray]]) -> JoinedKeypoints:
    """Join the keypoints that the steps of a cascade have found in one image. parts: of each step name, places (K, 2)
    and sizes (K,)."""
    from scipy.spatial import cKDTree

    places, sizes = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
    kinds: list[IntArray] = []
    numbers: dict[str, IntArray] = {}
    for kind, (name, own_places, own_sizes) in enumerate(parts):
        number = np.full(len(own_places), -1, np.int64)
        if len(places) and len(own_places):
            apart, nearest = cKDTree(places).query(own_places, distance_upper_bound=SAME_PX)
            near = np.flatnonzero(np.isfinite(apart))
            near = near[one_to_one(near, nearest[near], apart[near])]
            number[near] = nearest[near]
        new = np.flatnonzero(number < 0)
        number[new] = len(places) + np.arange(len(new))
        places, sizes = np.concatenate([places, own_places[new]]), np.concatenate([sizes, own_sizes[new]])
        kinds.append(np.full(len(new), kind))
        numbers[name] = number.astype(np.int32)
    return JoinedKeypoints(
        keypoints_px=places.astype(np.float32),
        sizes_px=sizes.astype(np.float32),
        responses=np.ones(len(places), np.float32),
        kinds=tuple(numbers),
        kind_idx=np.concatenate([np.zeros(0, np.int64), *kinds]).astype(np.uint8),
        numbers=numbers,
    )


def _join_matches(context: Context, steps: Sequence[StepContext]) -> StageReport:
    report = StageReport("match")
    _count_seconds(report, steps, ["match", "filter"])
    tasks, store = _join_tasks(context, steps), context.store
    run_rows(context, report, join_row, tasks, store.matches, store.made_matches)
    # Pairs that a step could not verify take no further step, and the last filter sees but what the others found.
    report.failures += _failures(steps, "match", "filter")
    outcomes = cascade.outcomes(context, steps)
    by = Counter(outcome.settled_by for outcome in outcomes.values())
    report.result = MatchResult(
        matches=sum(known.matches for task in tasks for known in store.matches(task.image_id0).values()),
        settled_by={step.name: by[step.name] for step in steps},
        not_settled=by[""],
    )
    _write_steps(context, steps, outcomes)
    report.fingerprint = fingerprint(sorted(pair.fingerprint for task in tasks for pair in task.pairs))
    return report.write(context.workspace)


def _join_tasks(context: Context, steps: Sequence[StepContext]) -> list[JoinTask]:
    """Return one task per row that has a pair with matches."""
    assert context.scope.joined is not None
    tasks, ready = [], BlockState.of(context).with_features({image.image_id for image in context.block.images})
    for image_id0, pairs in context.rows().items():
        wanted, own = [], {}
        for pair in pairs:
            key = pair.image_id0, pair.image_id1
            # Of several steps with the same features the last one's matches count.
            known = {step.features_of: step.context.workspace for step in _matched(steps, pair)}
            if known and set(key) <= ready:
                features = context.scope.joined.features[key[0]], context.scope.joined.features[key[1]]
                wanted.append(PairTask(context.geometry(pair), context.scope.joined.matches[key], features))
                own[key[1]] = tuple(known.items())
        if wanted:
            tasks.append(JoinTask(image_id0, tuple(wanted), own, context.workspace))
    return tasks


def _write_steps(context: Context, steps: Sequence[StepContext], outcomes: Mapping[Key, cascade.Outcome]) -> None:
    """steps.csv: which steps every pair took, and why, which one settled it, what it lacks in the end, how many
    verified matches it has, and how many were expected."""
    lines: list[tuple[Any, ...]] = []
    for pair in context.pairs:
        key = pair.image_id0, pair.image_id1
        taken = [step for step in steps if key in step.reasons]
        reasons = "; ".join(f"{step.name}: {step.reasons[key]}" for step in taken if step.reasons[key])
        expected = taken[-1].expected.get(key, float("nan"))
        after_last = "" if np.isnan(expected) else round(expected)
        own = outcomes[key]
        names = "+".join(step.name for step in taken)
        lines.append((*key, names, reasons, own.settled_by, own.lacks, own.verified, after_last))
    header = "image_id0", "image_id1", "steps", "reasons", "settled_by", "lacks", "verified", "expected"
    write_text(context.workspace.steps, csv_text(header, lines))


def join_row(task: JoinTask) -> RowResult[KnownMatches]:
    """Write matches/<id0>.npz of one row."""
    keypoints0 = _joined(task.workspace.features(task.image_id0))
    raw = {w: read_match_row(w.matches(task.image_id0)) for w in _workspaces(task)}
    kept = {w: read_verified_row(w.verified(task.image_id0)) for w in raw}
    entries = []
    for pair in task.pairs:
        image_id1 = pair.image_id1
        keypoints1 = _joined(task.workspace.features(image_id1))
        parts = [(name, raw[w][image_id1], kept[w].get(image_id1)) for name, w in task.steps[image_id1]]
        names = "+".join(dict.fromkeys(entry.strategy for _, entry, _ in parts))
        matches = joined_matches(parts, keypoints0, keypoints1)
        entries.append(MatchEntry(image_id1, pair.fingerprint, names, matches, pair.features))
    write_atomically(task.workspace.matches(task.image_id0), lambda stream: write_match_row(stream, entries))
    found = sum(len(entry.matches.indices) for entry in entries)
    return RowResult(task.image_id0, len(entries), found, (), matches_of(entries))


def _workspaces(task: JoinTask) -> set[Workspace]:
    return {workspace for own in task.steps.values() for _, workspace in own}


def joined_matches(
    parts: Sequence[tuple[str, MatchEntry, VerifiedEntry | None]],
    keypoints0: JoinedKeypoints,
    keypoints1: JoinedKeypoints,
) -> Matches:
    """Return matches of one pair, numbered as in the joined keypoints. parts: step, its matches, what it has
    verified."""
    indices, scores, views, costs = [], [], [], []
    for name, entry, verified in parts:
        found = entry.matches
        own = np.column_stack(
            [side.numbers[name][found.indices[:, k]] for k, side in enumerate((keypoints0, keypoints1))]
        )
        held = np.zeros(len(own), dtype=bool)
        if verified is not None and verified.verdict.state == "verified":
            held = _rows_in(found.indices, verified.matches.indices)
        indices.append(own.reshape(-1, 2))
        scores.append(found.scores)
        views.append(found.view_pairs)
        costs.append(1.0 - found.scores + ~held)
    pairs, cost = np.concatenate(indices), np.concatenate(costs)
    kept = one_to_one(pairs[:, 0], pairs[:, 1], cost)
    places = np.concatenate(
        [keypoints0.keypoints_px[pairs[kept, 0]], keypoints1.keypoints_px[pairs[kept, 1]]], axis=1, dtype=np.float64
    )
    kept = kept[distinct(places, cost[kept], cascade.SAME_MATCH_PX)]
    kept = kept[np.argsort(pairs[kept, 0], kind="stable")]
    return Matches(pairs[kept].astype(np.int32), np.concatenate(scores)[kept], np.concatenate(views)[kept])


def _rows_in(rows: IntArray, wanted: IntArray) -> BoolArray:
    """Return which rows (N, 2) of numbers are among the wanted ones (M, 2)."""
    width = int(max(rows.max(initial=0), wanted.max(initial=0))) + 1
    codes, known = (pairs.astype(np.int64) @ [width, 1] for pairs in (rows, wanted))
    return np.isin(codes, known)


@read_once(64)
def _joined(path: Path) -> JoinedKeypoints:
    return read_joined(path)
