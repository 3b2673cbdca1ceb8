"""export: verified matches in the files of other programs, one folder per exporter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import InputError
from aeromatch_cli.formats import MatchEntry, read_keypoints, read_match_row
from aeromatch_cli.stages.common import Context, StageReport, run_stage
from aeromatch_cli.stages.filter import verified_pairs
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters import ExportContents, PairContents
from aeromatch_cli.workspace import fingerprint, read_json


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
    pairs = [(p.image_id0, p.image_id1, e.fingerprint) for p, e in verified_pairs(context)]
    if not pairs:
        raise InputError(
            "nothing to export: no pair has been matched and filtered; see failures.csv and `aeromatch check`"
        )
    contents = [
        block.images,
        sorted(block.cameras.items()),
        sorted(block.poses.items()),
        block.crs,
        block.origin_m,
        pairs,
    ]
    wanted = fingerprint(context.settings.export, contents)
    report.items, report.fingerprint = len(context.settings.export), wanted
    folders = [context.workspace.export(exporter.name) for exporter in context.settings.export]
    last = context.workspace.stage_report("export")
    if (
        not context.overwrite
        and all(folder.is_dir() for folder in folders)
        and last.is_file()
        and (found := read_json(last)).get("fingerprint") == wanted
        and not found.get("failures")
    ):
        report.skipped = report.items
        report.facts = found["facts"]
        return report.write(context.workspace)
    tasks = [ExportTask(e, context, f) for e, f in zip(context.settings.export, folders, strict=True)]
    names = [exporter.name for exporter in context.settings.export]
    report.facts = dict(zip(names, run_stage(context, report, _run_task, tasks, names), strict=False))
    return report.write(context.workspace)


def _run_task(task: ExportTask) -> dict[str, object]:
    contents = _contents(task.context)
    summary = task.exporter(contents, task.folder)  # type: ignore[operator]
    return {key: str(value) if key == "folder" else value for key, value in asdict(summary).items() if key != "files"}


def _contents(context: Context) -> ExportContents:
    """Read lazily: one row and one image's keypoints at a time."""

    def keypoints_px(image_id: str) -> FloatArray:
        path = context.workspace.features(image_id)
        # An image whose extraction failed is exported without keypoints, so that ids stay complete.
        return read_keypoints(path)[0] if path.exists() else np.zeros((0, 2), np.float32)

    return ExportContents(context.block, keypoints_px, _pairs(context), context.guessed_cameras)


def _pairs(context: Context) -> Iterator[PairContents]:
    row_id, row = "", dict[str, MatchEntry]()
    for pair, entry in verified_pairs(context):
        if pair.image_id0 != row_id:
            row_id, row = pair.image_id0, read_match_row(context.workspace.matches(pair.image_id0))
        raw = row[pair.image_id1].matches
        yield PairContents(pair, raw.indices, entry.matches.indices, entry.verdict.model_kind, entry.verdict.model)
