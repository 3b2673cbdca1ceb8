"""filter: which matches of every pair hold, and whether the pair is verified."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Candidates, FloatArray, Matches, Pair
from aeromatch_cli.files import read_record, write_atomically
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.formats.features import read_keypoints
from aeromatch_cli.formats.rows import (
    MatchEntry,
    VerifiedEntry,
    read_match_row,
    read_verified_row,
    write_verified_row,
)
from aeromatch_cli.geometry.components import labels_by_name
from aeromatch_cli.recent import read_once
from aeromatch_cli.results.record import StageRecord
from aeromatch_cli.results.stages import FilterResult
from aeromatch_cli.stages import driver
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.driver import PairTask, RowResult, run_rows
from aeromatch_cli.stages.stage_report import StageReport, gather_failures, unexplained
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.store.block_store import KnownVerdict, verdicts_of
from aeromatch_cli.store.matches import match_points, select
from aeromatch_cli.strategies.filters import apply_chain
from aeromatch_cli.strategies.filters.chain import Filter
from aeromatch_cli.workspace import Workspace

# Keypoints (K, 2) of an image, stored pixels, and their colours (K, 3) where the extractor kept them.
Side = tuple[FloatArray, NDArray[np.uint8] | None]
# An image with fewer verified matches than this over all its pairs is called weakly tied.
WEAK_MATCHES = 50


@dataclass(frozen=True, eq=False)
class FilterTask:
    """Asks for the verification of all matched pairs of one image."""

    image_id0: str
    pairs: tuple[PairTask, ...]
    chain: tuple[Filter, ...]
    workspace: Workspace
    overwrite: bool


def make_tasks(context: Context) -> tuple[list[FilterTask], list[Pair]]:
    """Return one task per row of the shard, and the pairs whose matches or features are not up to date: those have
    none.

    Larger rows first, so that none runs last.
    """
    rows, state = context.rows(), BlockState.of(context)
    features = state.with_features(image_id for row in rows.values() for pair in row for image_id in pair.ids)
    tasks, missing = [], []
    for image_id0, pairs in rows.items():
        matched, row = context.store.matches(image_id0), []
        for pair in pairs:
            on_file = matched.get(pair.image_id1)
            if on_file and on_file.fingerprint == state.wanted_matches(pair) and features.issuperset(pair.ids):
                made_of, seed = state.wanted_verdict(pair), state.seed(pair)
                row.append(PairTask(context.geometry(pair), made_of, on_file.features, seed))
            else:
                missing.append(pair)
        tasks.append(
            FilterTask(image_id0, tuple(row), context.settings.filter, context.workspace, context.scope.overwrite)
        )
    return sorted(tasks, key=lambda task: (-len(task.pairs), task.image_id0)), missing


def run_task(task: FilterTask) -> RowResult[KnownVerdict]:
    """Judge what is not up to date in one row."""
    path = task.workspace.verified(task.image_id0)
    old = driver.readable(read_verified_row, path, task.overwrite)
    matched = read_match_row(task.workspace.matches(task.image_id0))
    row = driver.redo(task.image_id0, task.pairs, old, lambda pair: _judge(task, pair, matched[pair.image_id1]))
    write_atomically(path, lambda stream: write_verified_row(stream, row.entries))
    found = sum(len(entry.matches.indices) for entry in row.made)
    return RowResult(task.image_id0, len(row.made), found, row.failures, verdicts_of(row.entries))


def _judge(task: FilterTask, pair: PairTask, entry: MatchEntry) -> VerifiedEntry:
    sides = [_keypoints(task.workspace.features(i)) for i in (task.image_id0, entry.image_id1)]
    verdict = apply_chain(task.chain, candidates(entry.matches, *sides), pair.geometry, pair.seed)
    kept = select(entry.matches, verdict.keep)
    errors = None if verdict.errors_px is None else verdict.errors_px[verdict.keep]
    verdict = replace(verdict, keep=np.ones(len(kept.indices), dtype=bool), errors_px=errors)
    if entry.matches.remark:
        verdict = replace(verdict, reason=entry.matches.remark)
    return VerifiedEntry(entry.image_id1, pair.fingerprint, len(entry.matches.indices), kept, verdict, pair.features)


def candidates(matches: Matches, side0: Side, side1: Side) -> Candidates:
    """Return matches as filters see them. side0, side1: keypoints (K, 2) of an image, and colours (K, 3) or None."""
    points = match_points(matches, side0[0], side1[0])
    if side0[1] is None or side1[1] is None or (matches.indices < 0).any():
        return Candidates(*points)
    return Candidates(*points, side0[1][matches.indices[:, 0]], side1[1][matches.indices[:, 1]])


@read_once(256)
def _keypoints(path: Path) -> Side:
    keypoints_px, _, colours = read_keypoints(path)
    return keypoints_px, colours


def run(context: Context) -> StageReport:
    """Write verified/<id0>.npz for every row of the shard, then sum up what the block now is."""
    report = StageReport("filter")
    tasks, missing = make_tasks(context)
    store = context.store
    run_rows(context, report, run_task, tasks, store.verdicts, store.made_verdicts)
    report.failures.extend(unexplained(context, missing, "match"))
    ids = sorted(image.image_id for image in context.block.images)
    report.fingerprint = fingerprint(sorted(pair.fingerprint for task in tasks for pair in task.pairs), ids)
    report.result = _result_on_file(context, report) or connection(context)
    return report.write(context.workspace, context.scope.shard, context.block.names)


def _result_on_file(context: Context, report: StageReport) -> FilterResult | None:
    """Return the result of the last run, where nothing was made now and the verdicts are the same ones; else None."""
    last = context.workspace.stage_report(report.stage, context.scope.shard.label if context.scope.shard else "")
    if report.done or report.failures or context.scope.overwrite:
        return None
    record = read_record(last, StageRecord)
    if record is None or record.fingerprint != report.fingerprint or record.failed:
        return None
    return FilterResult.of_json(record.result)


def connection(context: Context, judged: Iterable[tuple[str, str, str, int]] | None = None) -> FilterResult:
    """States of the pairs, verified matches, sizes of the groups of images that verified pairs connect, and images
    that are weakly tied, not at all, or could not be read.

    judged: ids of both images, state and number of matches of every judged pair; by default those of this stage.
    """
    if judged is None:
        judged = (
            (pair.image_id0, pair.image_id1, known.state, known.matches)
            for pair, known in BlockState.of(context).known_verdicts()
        )
    states: Counter[str] = Counter()
    ties: Counter[str] = Counter()
    links: list[tuple[str, str]] = []
    matches = 0
    for id0, id1, state, count in judged:
        states[state] += 1
        if state == "verified":
            matches += count
            ties.update({id0: count, id1: count})
            links.append((id0, id1))
    failed = {item for stage, item, _ in gather_failures(context.workspace) if stage == "extract"} - set(ties)
    ids = [image.image_id for image in context.block.images if image.image_id not in failed]
    return FilterResult(
        pairs=dict(sorted(states.items())),
        verified_matches=matches,
        components=sorted(Counter(labels_by_name(ids, links).values()).values(), reverse=True),
        weakly_tied=sorted(image_id for image_id in ids if ties[image_id] < WEAK_MATCHES),
        unconnected=sorted(image_id for image_id in ids if not ties[image_id]),
        unread=sorted(image.image_id for image in context.block.images if image.image_id in failed),
    )
