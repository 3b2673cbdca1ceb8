"""export: verified matches in the files of other programs, one folder per exporter."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from aeromatch_cli.data import AdjustedBlock
from aeromatch_cli.executor import Executor
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.results.stages import Exported, ExportResult
from aeromatch_cli.stages.consistency import final_block, final_pairs
from aeromatch_cli.stages.contents import contents_of, residuals_of_points
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.driver import run_stage
from aeromatch_cli.stages.stage_report import StageReport, unexplained
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.strategies import Strategy

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
    context, outdated = BlockState.of(context).with_current_pairs()
    adjusted = final_block(context)
    given = sorted(context.given.block.poses.items()), sorted(context.guessed_cameras)
    wanted = fingerprint(
        context.settings.export, BlockState.of(context).inputs_fingerprint("export"), given, adjusted is None
    )
    report.items, report.fingerprint = len(context.settings.export), wanted
    folders = [context.workspace.export(exporter.name) for exporter in context.settings.export]
    record = context.recorded("export")
    before = None if record is None or record.fingerprint != wanted else ExportResult.of_json(record.result)
    # None has failed where all have a result; of pairs that are missing the report may tell failures all the same.
    if record and before and before.exporters.keys() == {path.name for path in folders}:
        if context.workspace.export_is_older:  # by its time alone: what was made since is the same
            context.workspace.stage_report("export").touch()
        report.skipped, report.result, report.files = report.items, before, record.files
        report.failures = unexplained(context, outdated, "filter")
        return report.write(context.workspace)
    context.workspace.forget("export")
    tasks = [ExportTask(e, context, f, adjusted) for e, f in zip(context.settings.export, folders, strict=True)]
    names = [exporter.name for exporter in context.settings.export]
    # In this process, one after the other: a task holds the whole context.
    alone = replace(context, executor=Executor("serial", 1, context.executor.progress))
    done = run_stage(alone, report, _run_task, tasks, names)
    report.result = ExportResult(exporters={one.name: one for one in done})
    report.record_files(context, (context.workspace.export(one.name) / n for one in done for n in one.files))
    report.failures += unexplained(context, outdated, "filter")
    return report.write(context.workspace)


def _run_task(task: ExportTask) -> Exported:
    contents = contents_of(task.context, task.adjusted, final_pairs)
    contents = replace(contents, residuals=residuals_of_points(contents))
    summary = task.exporter(contents, task.folder)  # type: ignore[operator]
    for remark in summary.remarks:
        log.warning("warning: export %s: %s", task.folder.name, remark)
    files = [path.relative_to(task.folder).as_posix() for path in summary.files]
    return Exported(name=task.folder.name, **{**asdict(summary), "files": files})
