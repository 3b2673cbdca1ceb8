"""filter: which matches of every pair hold, and whether the pair is verified."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Candidates, FloatArray, Matches, Pair
from aeromatch_cli.files import read_json, write_atomically
from aeromatch_cli.fingerprints import fingerprint, stable_hash
from aeromatch_cli.formats.features import read_keypoints
from aeromatch_cli.formats.rows import (
    MatchEntry,
    VerifiedEntry,
    read_match_row,
    read_verified_row,
    row_fingerprints,
    write_verified_row,
)
from aeromatch_cli.geometry.components import labels_by_name
from aeromatch_cli.recent import read_once
from aeromatch_cli.results.stages import FilterResult
from aeromatch_cli.stages import extract, match, rows
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.rows import PairTask
from aeromatch_cli.stages.stage_report import StageReport, run_stage, unexplained
from aeromatch_cli.stages.versions import library_version
from aeromatch_cli.strategies.filters import apply_chain
from aeromatch_cli.strategies.filters.chain import VERSION as CHAIN_VERSION
from aeromatch_cli.strategies.filters.chain import Filter
from aeromatch_cli.workspace import Workspace

# Keypoints (K, 2) of an image, stored pixels, and their colours (K, 3) where the extractor kept them.
Side = tuple[FloatArray, NDArray[np.uint8] | None]
# Pairs and their verdicts, in the order of pairs.csv.
Judged = Iterator[tuple[Pair, VerifiedEntry]]
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


@dataclass(frozen=True)
class RowResult:
    """done: pairs judged now. failures: ("id0 id1", reason)."""

    done: int
    failures: tuple[tuple[str, str], ...]


def pair_seed(context: Context, pair: Pair) -> int:
    """Return the random seed of a pair, which is the same whatever else is in the block."""
    return stable_hash(f"{context.settings.seed} {pair.image_id0} {pair.image_id1}") % (1 << 31)


def pair_fingerprint(context: Context, pair: Pair) -> str:
    """Return the fingerprint that the verdict on a pair must carry: of the chain, the matches, the geometry that the
    chain reads, and the seed."""
    return context.once_per_pair("filter", pair, lambda: _pair_fingerprint(context, pair))


def _pair_fingerprint(context: Context, pair: Pair) -> str:
    chain = context.settings.filter
    needs = frozenset[str]().union(*(strategy.needs for strategy in chain))
    sides = [context.geometry_fingerprint(i, needs) for i in (pair.image_id0, pair.image_id1)]
    matches = match.pair_fingerprint(context, pair)
    return fingerprint(CHAIN_VERSION, chain, library_version("poselib"), matches, sides, pair_seed(context, pair))


def make_tasks(context: Context) -> tuple[list[FilterTask], list[Pair]]:
    """Return one task per row of the shard, and the pairs whose matches or features are not up to date: those have
    none.

    Larger rows first, so that none runs last.
    """
    rows = context.rows()
    features = extract.current(context, {i for r in rows.values() for p in r for i in (p.image_id0, p.image_id1)})
    tasks, missing = [], []
    for image_id0, pairs in rows.items():
        matched = row_fingerprints(context.workspace.matches(image_id0))
        row = []
        for pair in pairs:
            known = {pair.image_id0, pair.image_id1} <= features
            if known and matched.get(pair.image_id1) == match.pair_fingerprint(context, pair):
                own = pair_fingerprint(context, pair)
                row.append(PairTask(context.geometry(pair), own, pair_seed(context, pair)))
            else:
                missing.append(pair)
        tasks.append(FilterTask(image_id0, tuple(row), context.settings.filter, context.workspace, context.overwrite))
    return sorted(tasks, key=lambda task: (-len(task.pairs), task.image_id0)), missing


def run_task(task: FilterTask) -> RowResult:
    """Judge what is not up to date in one row."""
    path = task.workspace.verified(task.image_id0)
    old = rows.readable(read_verified_row, path, task.overwrite)
    matched = read_match_row(task.workspace.matches(task.image_id0))
    row = rows.redo(task.image_id0, task.pairs, old, lambda pair: _judge(task, pair, matched[pair.image_id1]))
    write_atomically(path, lambda stream: write_verified_row(stream, row.entries))
    return RowResult(len(row.made), row.failures)


def _judge(task: FilterTask, pair: PairTask, entry: MatchEntry) -> VerifiedEntry:
    sides = [_keypoints(task.workspace.features(i)) for i in (task.image_id0, entry.image_id1)]
    verdict = apply_chain(task.chain, candidates(entry.matches, *sides), pair.geometry, pair.seed)
    kept = select(entry.matches, verdict.keep)
    errors = None if verdict.errors_px is None else verdict.errors_px[verdict.keep]
    verdict = replace(verdict, keep=np.ones(len(kept.indices), dtype=bool), errors_px=errors)
    if entry.matches.remark:
        verdict = replace(verdict, reason=entry.matches.remark)
    features = rows.features_of(task.workspace, task.image_id0, entry.image_id1)
    return VerifiedEntry(entry.image_id1, pair.fingerprint, len(entry.matches.indices), kept, verdict, features)


def match_points(matches: Matches, keypoints0: FloatArray, keypoints1: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return stored-pixel points (M, 2) float64 of both sides: keypoints, or the measured place where there is none."""
    sides = []
    for side, (keypoints, measured) in enumerate(((keypoints0, matches.points0_px), (keypoints1, matches.points1_px))):
        indices = matches.indices[:, side]
        if measured is None:
            sides.append(keypoints[indices].astype(np.float64))
        else:
            points = np.array(measured, dtype=np.float64)
            found = indices >= 0
            points[found] = keypoints[indices[found]]
            sides.append(points)
    return sides[0], sides[1]


def candidates(matches: Matches, side0: Side, side1: Side) -> Candidates:
    """Return matches as filters see them. side0, side1: keypoints (K, 2) of an image, and colours (K, 3) or None."""
    points = match_points(matches, side0[0], side1[0])
    if side0[1] is None or side1[1] is None or (matches.indices < 0).any():
        return Candidates(*points)
    return Candidates(*points, side0[1][matches.indices[:, 0]], side1[1][matches.indices[:, 1]])


def select(matches: Matches, keep: Any) -> Matches:
    """Return the matches where `keep` (M,) is true."""
    return Matches(
        matches.indices[keep],
        matches.scores[keep],
        matches.view_pairs[keep],
        None if matches.points0_px is None else matches.points0_px[keep],
        None if matches.points1_px is None else matches.points1_px[keep],
        None if matches.sigmas_px is None else matches.sigmas_px[keep],
    )


@read_once(256)
def _keypoints(path: Path) -> Side:
    keypoints_px, _, colours = read_keypoints(path)
    return keypoints_px, colours


def run(context: Context) -> StageReport:
    """Write verified/<id0>.npz for every row of the shard, then sum up what the block now is."""
    report = StageReport("filter")
    tasks, missing = make_tasks(context)
    on_file = {task.image_id0: row_fingerprints(context.workspace.verified(task.image_id0)) for task in tasks}
    todo = [task for task in tasks if context.overwrite or not rows.is_done(task.pairs, on_file[task.image_id0])]
    report.items = sum(len(task.pairs) for task in tasks)
    results = run_stage(
        context, report, run_task, todo, [task.image_id0 for task in todo], [len(task.pairs) for task in todo]
    )
    report.failures.extend(failure for result in results for failure in result.failures)
    report.failures.extend(unexplained(context, missing, "match"))
    report.done = sum(result.done for result in results)
    report.skipped = 0 if context.overwrite else sum(rows.kept(task.pairs, on_file[task.image_id0]) for task in tasks)
    ids = sorted(image.image_id for image in context.block.images)
    report.fingerprint = fingerprint(sorted(pair.fingerprint for task in tasks for pair in task.pairs), ids)
    report.result = _result_on_file(context, report) or connection(context)
    return report.write(context.workspace, context.shard)


def _result_on_file(context: Context, report: StageReport) -> FilterResult | None:
    """Return the result of the last run, where nothing was made now and the verdicts are the same ones; else None."""
    last = context.workspace.stage_report(report.stage, context.shard.label if context.shard else "")
    if report.done or report.failures or context.overwrite or not last.is_file():
        return None
    found = read_json(last)
    same = found.get("fingerprint") == report.fingerprint and not found["failed"]
    return FilterResult.of_json(found.get("result")) if same else None


def outdated_pairs(context: Context) -> list[Pair]:
    """Return pairs whose verdict, or the features that it points into, is not what present settings and inputs give."""
    features = extract.current(context, {i for p in context.pairs for i in (p.image_id0, p.image_id1)})
    outdated = []
    for image_id0, pairs in context.rows().items():
        judged = row_fingerprints(context.workspace.verified(image_id0))
        for pair in pairs:
            known = {pair.image_id0, pair.image_id1} <= features
            if not known or judged.get(pair.image_id1) != pair_fingerprint(context, pair):
                outdated.append(pair)
    return outdated


def verified_pairs(context: Context, features: Callable[[str], str] | None = None) -> Judged:
    """Return judged pairs in the order of pairs.csv: stale rows, of older pair lists or features that were made again
    since, cannot leak. features: fingerprint of an image's features, "" of none; by default from its file."""
    row_id, row = "", dict[str, VerifiedEntry]()
    features = features or cache(partial(rows.features_on_file, context.workspace))
    for pair in context.pairs:
        if pair.image_id0 != row_id:
            row_id, row = pair.image_id0, read_verified_row(context.workspace.verified(pair.image_id0))
        entry = row.get(pair.image_id1)
        if entry is not None and not rows.stale_image(pair.image_id0, entry, features):
            yield pair, entry


def connection(context: Context, judged: Iterable[tuple[str, str, str, int]] | None = None) -> FilterResult:
    """States of the pairs, verified matches, sizes of the groups of images that verified pairs connect, and images
    that are weakly tied or not at all.

    judged: ids of both images, state and number of matches of every judged pair; by default those of this stage.
    """
    if judged is None:
        judged = (
            (pair.image_id0, pair.image_id1, entry.verdict.state, len(entry.matches.indices))
            for pair, entry in verified_pairs(context)
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
    ids = [image.image_id for image in context.block.images]
    return FilterResult(
        pairs=dict(sorted(states.items())),
        verified_matches=matches,
        components=sorted(Counter(labels_by_name(ids, links).values()).values(), reverse=True),
        weakly_tied=sorted(image_id for image_id in ids if ties[image_id] < WEAK_MATCHES),
        unconnected=sorted(image_id for image_id in ids if not ties[image_id]),
    )
