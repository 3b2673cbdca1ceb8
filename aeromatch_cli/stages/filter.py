"""filter: which matches of every pair hold, whether it is verified, and whose attitude contradicts the pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray, Matches, Pair, PairGeometry
from aeromatch_cli.errors import WorkspaceError
from aeromatch_cli.formats import (
    MatchEntry,
    VerifiedEntry,
    read_keypoints,
    read_match_row,
    read_verified_row,
    row_fingerprints,
    write_verified_row,
)
from aeromatch_cli.stages.common import Context, StageReport, distrust_fingerprint, run_stage
from aeromatch_cli.stages.rotations import contradicting_images
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.filters import apply_chain
from aeromatch_cli.workspace import Workspace, fingerprint, stable_hash, write_atomically, write_json

# An image with fewer verified matches than this over all its pairs is called weakly tied.
WEAK_MATCHES = 50


@dataclass(frozen=True, eq=False)
class PairTask:
    """One pair of a row; seed depends on the two names only."""

    geometry: PairGeometry
    fingerprint: str
    seed: int


@dataclass(frozen=True, eq=False)
class FilterTask:
    """All matched pairs of one image."""

    image_id0: str
    pairs: tuple[PairTask, ...]
    chain: tuple[Strategy, ...]
    workspace: Workspace
    overwrite: bool


def make_tasks(context: Context) -> list[FilterTask]:
    """One task per row of the shard; only pairs that have been matched."""
    chain = context.settings.filter
    needs = frozenset[str]().union(*(strategy.needs for strategy in chain))
    tasks = []
    for image_id0, pairs in context.rows().items():
        matched = row_fingerprints(context.workspace.matches(image_id0))
        row = []
        for pair in pairs:
            if pair.image_id1 not in matched:
                continue
            seed = stable_hash(f"{context.settings.seed} {pair.image_id0} {pair.image_id1}") % (1 << 31)
            sides = [context.geometry_fingerprint(i, needs) for i in (pair.image_id0, pair.image_id1)]
            own = fingerprint(chain, matched[pair.image_id1], sides, seed)
            row.append(PairTask(context.geometry(pair), own, seed))
        if row:
            tasks.append(FilterTask(image_id0, tuple(row), chain, context.workspace, context.overwrite))
    return sorted(tasks, key=lambda task: (-len(task.pairs), task.image_id0))


def run_task(task: FilterTask) -> int:
    """Judge what is not up to date in one row; returns the pairs judged."""
    path = task.workspace.verified(task.image_id0)
    old = {} if task.overwrite else _usable_row(path)
    row = read_match_row(task.workspace.matches(task.image_id0))
    entries, judged = [], 0
    for pair in task.pairs:
        image_id1 = pair.geometry.pair.image_id1
        entry = old.get(image_id1)
        if entry is None or entry.fingerprint != pair.fingerprint:
            entry = _judge(task, pair, row[image_id1])
            judged += 1
        entries.append(entry)
    write_atomically(path, lambda stream: write_verified_row(stream, entries))
    return judged


def _judge(task: FilterTask, pair: PairTask, entry: MatchEntry) -> VerifiedEntry:
    keypoints = [_keypoints(task.workspace.features(i)) for i in (task.image_id0, entry.image_id1)]
    points0, points1 = match_points(entry.matches, *keypoints)
    verdict = apply_chain(task.chain, points0, points1, pair.geometry, pair.seed)
    kept = select(entry.matches, verdict.keep)
    errors = None if verdict.errors_px is None else verdict.errors_px[verdict.keep]
    verdict = replace(verdict, keep=np.ones(len(kept.indices), dtype=bool), errors_px=errors)
    return VerifiedEntry(entry.image_id1, pair.fingerprint, len(entry.matches.indices), kept, verdict)


def match_points(matches: Matches, keypoints0: FloatArray, keypoints1: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Stored-pixel points (M, 2) float64 of both sides: keypoints, or the measured place where there is none."""
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


def select(matches: Matches, keep: Any) -> Matches:
    """The matches where `keep` (M,) is true."""
    return Matches(
        matches.indices[keep],
        matches.scores[keep],
        matches.view_pairs[keep],
        None if matches.points0_px is None else matches.points0_px[keep],
        None if matches.points1_px is None else matches.points1_px[keep],
    )


@lru_cache(maxsize=256)
def _cached_keypoints(path: Path, stamp: int) -> FloatArray:
    del stamp  # only tells rewritten files apart
    return read_keypoints(path)[0]


def _keypoints(path: Path) -> FloatArray:
    return _cached_keypoints(path, path.stat().st_mtime_ns)


def _usable_row(path: Path) -> dict[str, VerifiedEntry]:
    try:
        return read_verified_row(path)
    except WorkspaceError:
        return {}


def run(context: Context) -> StageReport:
    """Write verified/<id0>.npz for every row of the shard, then sum up what the block now is."""
    report = StageReport("filter")
    tasks = make_tasks(context)
    todo = [task for task in tasks if context.overwrite or not _is_done(task)]
    report.items = sum(len(task.pairs) for task in tasks)
    run_stage(context, report, run_task, todo, [task.image_id0 for task in todo])
    report.skipped = report.items - sum(len(task.pairs) for task in todo)
    report.done = report.items - report.skipped - len(report.failures)
    report.fingerprint = fingerprint(sorted(pair.fingerprint for task in tasks for pair in task.pairs))
    report.facts = summarise(context)
    if context.shard is None:
        contradicting = contradicting_images(context.given_poses, _rotations(context))
        report.facts["rotation_contradicts_pose"] = contradicting
        write_json(
            context.workspace.distrusted,
            {"fingerprint": distrust_fingerprint(context), "angles_deg": contradicting},
        )
    return report.write(context.workspace, context.shard)


def _is_done(task: FilterTask) -> bool:
    wanted = {pair.geometry.pair.image_id1: pair.fingerprint for pair in task.pairs}
    return row_fingerprints(task.workspace.verified(task.image_id0)) == wanted


def verified_pairs(context: Context) -> Iterator[tuple[Pair, VerifiedEntry]]:
    """Judged pairs in the order of pairs.csv: stale rows of older pair lists cannot leak."""
    row_id, row = "", dict[str, VerifiedEntry]()
    for pair in context.pairs:
        if pair.image_id0 != row_id:
            row_id, row = pair.image_id0, read_verified_row(context.workspace.verified(pair.image_id0))
        entry = row.get(pair.image_id1)
        if entry is not None:
            yield pair, entry


def _rotations(context: Context) -> list[tuple[str, str, FloatArray, int]]:
    return [
        (pair.image_id0, pair.image_id1, entry.verdict.relative_rotation, len(entry.matches.indices))
        for pair, entry in verified_pairs(context)
        if entry.verdict.state == "verified" and entry.verdict.relative_rotation is not None
    ]


def summarise(context: Context) -> dict[str, Any]:
    """States of the pairs, verified matches, connected components and weakly tied images."""
    states: Counter[str] = Counter()
    ties: Counter[str] = Counter()
    matches, parent = 0, {image.image_id: image.image_id for image in context.block.images}

    def root(image_id: str) -> str:
        while parent[image_id] != image_id:
            parent[image_id] = parent[parent[image_id]]
            image_id = parent[image_id]
        return image_id

    for pair, entry in verified_pairs(context):
        states[entry.verdict.state] += 1
        if entry.verdict.state == "verified":
            count = len(entry.matches.indices)
            matches += count
            ties.update({pair.image_id0: count, pair.image_id1: count})
            parent[root(pair.image_id0)] = root(pair.image_id1)
    sizes = Counter(root(image_id) for image_id in parent)
    weak = sorted(image_id for image_id in parent if ties[image_id] < WEAK_MATCHES)
    return {
        "pairs": dict(sorted(states.items())),
        "verified_matches": matches,
        "components": sorted(sizes.values(), reverse=True),
        "weakly_tied": weak,
    }
