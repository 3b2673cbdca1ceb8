"""export: verified matches in the files of other programs, one folder per exporter."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import BrokenFileError, InputError
from aeromatch_cli.executor import Executor
from aeromatch_cli.formats.features import read_keypoints
from aeromatch_cli.formats.rows import MatchEntry, read_match_row
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.filter import outdated_pairs, pair_fingerprint, verified_pairs
from aeromatch_cli.stages.stage_report import StageReport, run_stage, unexplained
from aeromatch_cli.stages.tracks import MatchedPair, Tracks, tracks_of
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters import ExportContents, PairContents
from aeromatch_cli.workspace import fingerprint, read_json, translated_os_errors


@dataclass(frozen=True, eq=False)
class ExportTask:
    """One exporter and where it writes."""

    exporter: Strategy
    context: Context
    folder: Path


def run(context: Context) -> StageReport:
    """Write export/<name>/ for every exporter whose folder is not up to date."""
    report = StageReport("export")
    block = context.block
    outdated = outdated_pairs(context)
    absent = {(pair.image_id0, pair.image_id1) for pair in outdated}
    pairs = [p for p in context.pairs if (p.image_id0, p.image_id1) not in absent]
    if not pairs:
        raise InputError(
            "nothing to export: no pair is matched and filtered with the present settings and inputs; "
            "run `aeromatch filter` first (`aeromatch run` does everything), and see failures.csv"
        )
    context = replace(context, pairs=tuple(pairs))
    contents = [
        block.images,
        sorted(block.cameras.items()),
        sorted(block.poses.items()),
        block.crs,
        block.origin_m,
        sorted(context.guessed_cameras),
        [(pair.image_id0, pair.image_id1, pair_fingerprint(context, pair)) for pair in pairs],
    ]
    wanted = fingerprint(context.settings.export, contents)
    report.items, report.fingerprint = len(context.settings.export), wanted
    folders = [context.workspace.export(exporter.name) for exporter in context.settings.export]
    last = context.workspace.stage_report("export")
    if (
        not context.overwrite
        and last.is_file()
        and (found := read_json(last)).get("fingerprint") == wanted
        and _complete(folders, found["facts"])
    ):
        report.skipped = report.items
        report.facts = found["facts"]
        report.failures = unexplained(context, outdated, "filter")
        return report.write(context.workspace)
    # A killed export must not be vouched for by the report of an earlier one.
    with translated_os_errors(last):
        last.unlink(missing_ok=True)
    tasks = [ExportTask(e, context, f) for e, f in zip(context.settings.export, folders, strict=True)]
    names = [exporter.name for exporter in context.settings.export]
    # In this process, one after the other: a task holds the whole context.
    alone = replace(context, executor=Executor("serial", 1, context.executor.progress))
    done = run_stage(alone, report, _run_task, tasks, names)
    report.facts = {str(facts["name"]): facts for facts in done}
    report.failures += unexplained(context, outdated, "filter")
    return report.write(context.workspace)


def _complete(folders: list[Path], facts: Mapping[str, Any]) -> bool:
    """Whether every file that the exporters wrote is still there."""
    return all(
        folder.name in facts and all((folder / name).is_file() for name in facts[folder.name]["files"])
        for folder in folders
    )


def _run_task(task: ExportTask) -> dict[str, Any]:
    contents = contents_of(task.context)
    summary = task.exporter(contents, task.folder)  # type: ignore[operator]
    files = [path.relative_to(task.folder).as_posix() for path in summary.files]
    return {"name": task.folder.name, **asdict(summary), "files": files}


def contents_of(context: Context) -> ExportContents:
    """What exporters and mappers get. Read lazily: one row and one image's keypoints at a time."""

    def keypoints_px(image_id: str) -> FloatArray:
        path = context.workspace.features(image_id)
        # An image whose extraction failed is exported without keypoints, so that ids stay complete.
        return read_keypoints(path)[0] if path.exists() else np.zeros((0, 2), np.float32)

    if not context.settings.match.reads_pixels:
        return ExportContents(context.block, keypoints_px, _pairs(context), context.guessed_cameras)
    matched = list(_matched(context))
    tracks = tracks_of(matched, keypoints_px, lambda image_id: context.block.camera(context.image_by_id[image_id]))

    def with_measured_px(image_id: str) -> FloatArray:
        return tracks.keypoints_px[image_id] if image_id in tracks.keypoints_px else keypoints_px(image_id)

    return ExportContents(context.block, with_measured_px, _joined(matched, tracks), context.guessed_cameras)


def _joined(matched: Iterable[MatchedPair], tracks: Tracks) -> Iterator[PairContents]:
    for item in matched:
        key, verdict = (item.pair.image_id0, item.pair.image_id1), item.verified.verdict
        yield PairContents(item.pair, tracks.raw[key], tracks.verified[key], verdict.model_kind, verdict.model)


def _pairs(context: Context) -> Iterator[PairContents]:
    for item in _matched(context):
        verdict, kept = item.verified.verdict, item.verified.matches.indices
        yield PairContents(item.pair, item.raw.indices, kept, verdict.model_kind, verdict.model)


def _matched(context: Context) -> Iterator[MatchedPair]:
    row_id, row = "", dict[str, MatchEntry]()
    for pair, entry in verified_pairs(context):
        if pair.image_id0 != row_id:
            row_id, row = pair.image_id0, read_match_row(context.workspace.matches(pair.image_id0))
        found = row.get(pair.image_id1)
        if found is None:  # the row was rewritten under another configuration while this one ran
            raise BrokenFileError(str(context.workspace.matches(pair.image_id0)), f"no entry {pair.image_id1}")
        yield MatchedPair(pair, found.matches, entry)
