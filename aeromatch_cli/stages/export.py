"""export: verified matches in the files of other programs, one folder per exporter."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from aeromatch_cli.data import AdjustedBlock
from aeromatch_cli.executor import Executor
from aeromatch_cli.files import changed_files, read_json, translated_os_errors, write_record
from aeromatch_cli.fingerprints import file_digest, fingerprint
from aeromatch_cli.results.stages import Exported, ExportResult
from aeromatch_cli.stages import refine
from aeromatch_cli.stages.consistency import final_block, final_pairs
from aeromatch_cli.stages.contents import contents_of, with_current_pairs
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.filter import pair_fingerprint
from aeromatch_cli.stages.stage_report import StageReport, run_stage, unexplained
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.workspace import Workspace

log = logging.getLogger("aeromatch")


@dataclass(frozen=True, eq=False)
class ExportTask:
    """One exporter, where it writes, and the adjusted block that it writes."""

    exporter: Strategy
    context: Context
    folder: Path
    adjusted: AdjustedBlock | None


def run(context: Context) -> StageReport:
    """Write export/<name>/ for every exporter whose folder is not up to date."""
    report = StageReport("export")
    block = context.block
    context, outdated = with_current_pairs(context)
    adjusted = final_block(context)
    contents: list[Any] = [
        block.images,
        sorted(block.cameras.items()),
        sorted(block.poses.items()),
        sorted(context.given.poses.items()),
        block.crs,
        block.origin_m,
        sorted(context.guessed_cameras),
        [(pair.image_id0, pair.image_id1, pair_fingerprint(context, pair)) for pair in context.pairs],
        refine.made_fingerprint(context),
        None if adjusted is None else file_digest(context.workspace.final_or_adjusted),
        file_digest(context.workspace.dropped) if context.workspace.dropped.is_file() else None,
    ]
    wanted = fingerprint(context.settings.export, contents)
    report.items, report.fingerprint = len(context.settings.export), wanted
    folders = [context.workspace.export(exporter.name) for exporter in context.settings.export]
    last = context.workspace.stage_report("export")
    if (
        not context.overwrite
        and last.is_file()
        and (found := read_json(last)).get("fingerprint") == wanted
        and (result := ExportResult.of_json(found.get("result")))
        and result.exporters.keys() == {exporter.name for exporter in context.settings.export}  # none failed
        and _complete(context.workspace)
    ):
        if context.workspace.export_is_older:  # by its time alone: what was made since is the same
            last.touch()
        report.skipped = report.items
        report.result = result
        report.failures = unexplained(context, outdated, "filter")
        return report.write(context.workspace)
    # A killed export must not be vouched for by the report of an earlier one.
    with translated_os_errors(last):
        last.unlink(missing_ok=True)
    tasks = [ExportTask(e, context, f, adjusted) for e, f in zip(context.settings.export, folders, strict=True)]
    names = [exporter.name for exporter in context.settings.export]
    # In this process, one after the other: a task holds the whole context.
    alone = replace(context, executor=Executor("serial", 1, context.executor.progress))
    done = run_stage(alone, report, _run_task, tasks, names)
    report.result = ExportResult(exporters={one.name: one for one in done})
    written = [f"{one.name}/{name}" for one in done for name in one.files]
    write_record(context.workspace.exports, {}, written)
    report.failures += unexplained(context, outdated, "filter")
    return report.write(context.workspace)


def _complete(workspace: Workspace) -> bool:
    """Whether every file that the exporters wrote is as they wrote it; says which one is not."""
    record = workspace.exports
    if not record.is_file():
        return False
    changed = changed_files(record.parent, read_json(record))
    if changed:
        more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
        log.warning(
            "warning: %s%s was changed or deleted since it was written: the export is made again",
            record.parent / changed[0],
            more,
        )
    return not changed


def _run_task(task: ExportTask) -> Exported:
    contents = contents_of(task.context, task.adjusted, final_pairs)
    summary = task.exporter(contents, task.folder)  # type: ignore[operator]
    for remark in summary.remarks:
        log.warning("warning: export %s: %s", task.folder.name, remark)
    files = [path.relative_to(task.folder).as_posix() for path in summary.files]
    return Exported(name=task.folder.name, **{**asdict(summary), "files": files})
