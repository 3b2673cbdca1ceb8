"""match: correspondences of every pair, one task and one file per image row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from aeromatch_cli.data import Features, Matches, PairGeometry
from aeromatch_cli.errors import ItemError
from aeromatch_cli.files import write_atomically
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.formats.features import read_features
from aeromatch_cli.formats.rows import MatchEntry, read_match_row, write_match_row
from aeromatch_cli.images.source import Source
from aeromatch_cli.images.stored import StoredRaster
from aeromatch_cli.recent import read_once
from aeromatch_cli.results.stages import MatchResult
from aeromatch_cli.stages import driver, extract
from aeromatch_cli.stages.batches import matched_in_batches
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.driver import PairTask, RowResult, run_rows
from aeromatch_cli.stages.enhance import check_unchanged
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.store.block_store import KnownMatches, matches_of
from aeromatch_cli.strategies import Matcher
from aeromatch_cli.strategies.matchers.descriptors.scan import expect_comparisons
from aeromatch_cli.strategies.matchers.descriptors.search import Search
from aeromatch_cli.workspace import Workspace


@dataclass(frozen=True, eq=False)
class MatchTask:
    """Asks for the matches of all pairs of one image. matchers: by image_id1. share: of all pairs, how many a
    worker compares."""

    image_id0: str
    pairs: tuple[PairTask, ...]
    matchers: Mapping[str, Matcher]
    workspace: Workspace
    overwrite: bool
    # By image_id, for a matcher that reads pixels.
    sources: Mapping[str, Source] = field(default_factory=dict)
    share: int = 0


def paired_images(context: Context) -> set[str]:
    """Return every image whose features the rows of this shard need."""
    return {i for pairs in context.rows().values() for p in pairs for i in (p.image_id0, p.image_id1)}


def images_of_rows(context: Context) -> set[str]:
    """Return the images of all pairs of the shard, and the images of the shard itself."""
    return paired_images(context) | {image.image_id for image in context.images()}


def make_tasks(context: Context) -> list[MatchTask]:
    """Return one task per row of the shard, pairs without features left out. Larger rows first, so that none runs
    last."""
    state = BlockState.of(context)
    features, tasks = state.with_features(images_of_rows(context)), []
    share = sum(map(len, context.rows().values())) // context.executor.jobs
    for image_id0, pairs in context.rows().items():
        usable = [p for p in pairs if p.image_id0 in features and p.image_id1 in features]
        row = tuple(
            PairTask(
                context.geometry(p),
                state.wanted_matches(p),
                (state.wanted_features(p.image_id0), state.wanted_features(p.image_id1)),
            )
            for p in usable
        )
        if row:
            ids = (image_id0, *(pair.image_id1 for pair in row)) if context.settings.match.reads_pixels else ()
            sources = {image_id: extract.task_of(context, image_id).views.enhance.source for image_id in ids}
            matchers = {pair.image_id1: state.matcher(pair) for pair in usable}
            task = MatchTask(image_id0, row, matchers, context.workspace, context.scope.overwrite, sources, share)
            tasks.append(task)
    return sorted(tasks, key=lambda task: (-len(task.pairs), task.image_id0))


def run_task(task: MatchTask) -> RowResult[KnownMatches]:
    """Match what is not up to date in one row."""
    expect_comparisons(task.share)
    path = task.workspace.matches(task.image_id0)
    old = driver.readable(read_match_row, path, task.overwrite)
    features0 = _features(task.workspace.features(task.image_id0))
    ahead = matched_in_batches(
        task.matchers, driver.missing(task.pairs, old), lambda pair: _sides(task, pair, features0)
    )
    maker = task.workspace.features_of
    own = maker == task.workspace.step
    scanned = None if own else read_match_row(task.workspace.of_step(maker, maker).matches(task.image_id0))
    row = driver.redo(task.image_id0, task.pairs, old, lambda pair: _match_pair(task, pair, features0, ahead, scanned))
    write_atomically(path, lambda stream: write_match_row(stream, row.entries))
    found = sum(len(entry.matches.indices) for entry in row.made)
    return RowResult(task.image_id0, len(row.made), found, row.failures, matches_of(row.entries))


def _match_pair(
    task: MatchTask,
    pair: PairTask,
    features0: Features,
    ahead: dict[str, Matches],
    scanned: Mapping[str, MatchEntry] | None,
) -> MatchEntry:
    """ahead: matches of pairs that are there already, which are taken out. scanned: what the step before has found in
    the same features."""
    ids, matcher = (task.image_id0, pair.image_id1), task.matchers[pair.image_id1]
    matches = ahead.pop(pair.image_id1, None)
    if matches is None and scanned is not None and isinstance(matcher, Search) and not matcher.network:
        before = scanned.get(pair.image_id1)
        if before is None or before.features != pair.features:
            raise ItemError("the step before has no matches of these features: run the same command again")
        matches = matcher.again(*_sides(task, pair, features0), pair.geometry, before.matches)
    if matches is None:
        sources = (task.sources[ids[0]], task.sources[ids[1]]) if matcher.reads_pixels else None
        matches = compared(matcher, _sides(task, pair, features0), pair.geometry, sources)
        for source in sources or ():
            check_unchanged(source)
    _check(matcher, matches, _sides(task, pair, features0))
    return MatchEntry(pair.image_id1, pair.fingerprint, matcher.name, matches, pair.features)


def _check(matcher: Matcher, matches: Matches, sides: tuple[Features, Features]) -> None:
    """Raise ItemError where a matcher has returned what no later stage could use."""
    count, keypoints = len(matches.indices), [len(side.keypoints_px) for side in sides]
    lengths = {len(matches.scores), len(matches.view_pairs)}
    if lengths != {count}:
        words = f"{count} matches, but {len(matches.scores)} scores and {len(matches.view_pairs)} pairs of views"
        raise ItemError(f"match={matcher.name} returned {words}: the matcher has a fault")
    if count and not ((matches.indices >= -1) & (matches.indices < keypoints)).all():
        words = f"keypoints that are not there (of {keypoints[0]} and {keypoints[1]})"
        raise ItemError(f"match={matcher.name} returned {words}: the matcher has a fault")


def _sides(task: MatchTask, pair: PairTask, features0: Features) -> tuple[Features, Features]:
    path1 = task.workspace.features(pair.image_id1)
    return features0, _features(path1)


def compared(
    matcher: Matcher,
    features: tuple[Features, Features],
    geometry: PairGeometry,
    sources: tuple[Source, Source] | None,
) -> Matches:
    """Match one pair. sources: of both images, for a matcher that reads pixels."""
    if sources is None:
        return matcher(*features, geometry)
    return matcher(*features, geometry, (StoredRaster(sources[0]), StoredRaster(sources[1])))


@read_once(64)
def _features(path: Path) -> Features:
    """Features of the last images that this worker saw."""
    return read_features(path)


def run(context: Context) -> StageReport:
    """Write matches/<id0>.npz for every row of the shard, from the features that are up to date."""
    report = StageReport("match")
    tasks = make_tasks(context)
    network = any(matcher.network for task in tasks for matcher in task.matchers.values())
    store = context.store
    results = run_rows(context, report, run_task, tasks, store.matches, store.made_matches, network=network)
    if report.done:
        report.result = MatchResult(matches=sum(result.found for result in results))
    report.fingerprint = fingerprint(sorted(pair.fingerprint for task in tasks for pair in task.pairs))
    return report.write(context.workspace, context.scope.shard, context.block.names)
