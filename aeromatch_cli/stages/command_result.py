"""What a command says when it ends: lines for people, JSON for programs, failures and the verdict for the exit code."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from aeromatch_cli import graph
from aeromatch_cli.config import Settings
from aeromatch_cli.results.stages import ExportResult, PairsResult
from aeromatch_cli.sfm.quality.finding import Level
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.lost import Lost, lost_images, lost_lines, write_lost
from aeromatch_cli.stages.messages import stage_lines
from aeromatch_cli.stages.quality import quality_of, results_of
from aeromatch_cli.stages.result_summary import closing_lines, verdict_lines
from aeromatch_cli.stages.stage_report import StageReport, gather_failures, once, owner
from aeromatch_cli.store.naming import item_named, names_on_file, with_names
from aeromatch_cli.words import form
from aeromatch_cli.workspace import Workspace

# Commands that end with a verdict on the block.
JUDGED = ("run", "adjust")


@dataclass(frozen=True)
class Result:
    """Holds what a command says: lines for people, facts for machines; failures, and the verdict on the block where
    there is one, for the exit code. urgent: those of the lines that are said even where quiet is asked for. reports: of
    the stages."""

    lines: tuple[str, ...]
    facts: dict[str, Any] = field(default_factory=dict)
    failures: tuple[tuple[str, str, str], ...] = ()
    verdict: Level | None = None
    urgent: tuple[str, ...] = ()
    reports: tuple[StageReport, ...] = ()


class Said:
    """Lines that were said already, each once; all of them wait for the result where nobody listens."""

    def __init__(self, say: Callable[[str], None] | None) -> None:
        self._say, self._said = say, set[str]()

    def __call__(self, line: str) -> None:
        if self._say is not None and line not in self._said:
            self._say(line)
            self._said.add(line)

    def rest(self, lines: Iterable[str]) -> list[str]:
        return [line for line in lines if line not in self._said]


def named(result: Result, root: Path) -> Result:
    """Return the result as people and other programs get it: with names of files in place of image ids."""
    names = names_on_file(Workspace(root))
    failures = tuple((stage, item_named(item, names), reason) for stage, item, reason in result.failures)
    return replace(result, facts=with_names(result.facts, names), failures=failures)


def command_result(
    command: str,
    settings: Settings,
    workspace: Workspace,
    names: Mapping[str, str],
    reports: list[StageReport],
    failures: tuple[tuple[str, str, str], ...],
    said: Said,
    *,
    part: bool = False,
    old_page: bool = False,
    unjudged: int = 0,
) -> Result:
    """What a command has come to. names: of the files, by image_id. part: of a shard. old_page: whether there is a
    report page that does not tell of this state. unjudged: pairs whose matches the command has made, and that are not
    verified with these."""
    first = next(report for report in reports if report.stage == "pairs")
    lines = said.rest(block_of(reports).summary)
    for stage in reports:
        lines += stage_lines(stage, names, part=part)
    results = results_of(workspace, reports)
    quality = quality_of(results, names) if command in JUDGED and not part else None
    lost, urgent = list[Lost](), list[str]()
    if quality is not None:
        left_out = [*first.failures, *block_of(reports).unread.items()]
        lost = lost_images(results, left_out, names)
        write_lost(workspace, lost)
        told_lost = lost_lines(workspace, lost, len(names) + len(left_out))
        lines += [*closing_lines(quality, results, names), *told_lost]
        urgent = [*([] if quality.verdict == "good" else verdict_lines(quality)), *told_lost]
    if unjudged:
        pairs = form(unjudged, "pair is", "pairs are")
        lines.append(f"next      {unjudged} {pairs} not verified with these matches: `aeromatch filter` does that")
    lines.append(f"workspace {workspace.root}")
    if reports[-1].stage == "report":
        lines.append(f"report    {workspace.report}")
    elif old_page:
        lines.append(f"report    {workspace.report} is of an earlier run: `aeromatch report` makes it anew")
    if command not in ("run", "export") and workspace.export_is_older:
        lines += [
            f"export    {folder} is of an earlier adjustment: `aeromatch export` makes it anew"
            for folder in workspace.exported()
        ]
    if command in ("run", "export") and not part:
        written = next((r.result.exporters for r in reports if isinstance(r.result, ExportResult)), {})
        lines += [f"export    {workspace.export(e.name)}" for e in settings.export if e.name in written]
        lines += [f"export    {folder} is of earlier results, not made anew" for folder in _left(workspace, settings)]
    if failures:
        lines.append(f"{len(failures)} failed, listed in {workspace.failures}")
        urgent.append(lines[-1])
    facts = {
        "workspace": str(workspace.root),
        "stages": _stage_facts(reports),
        "failures": len(failures),
    }
    if quality is not None:
        facts["quality"] = quality.as_facts()
        facts["lost"] = {name: reason for name, _, reason in lost}
    verdict = None if quality is None else quality.verdict
    return Result(tuple(lines), facts, failures, verdict, tuple(urgent), tuple(reports))


def block_of(reports: Sequence[StageReport]) -> PairsResult:
    """Return the result of the stage pairs; every command runs it."""
    return next(report.result for report in reports if isinstance(report.result, PairsResult))


def _left(workspace: Workspace, settings: Settings) -> list[Path]:
    """Folders of exporters that the settings no longer name, and that are not of the present results."""
    wanted = {exporter.name for exporter in settings.export}
    return [one for one in workspace.exported() if one.name not in wanted and workspace.is_older_export(one)]


def _stage_facts(reports: Sequence[StageReport]) -> dict[str, Any]:
    """Return the facts of the stages by name; those of the steps of a shard's cascade are below the key `steps`, by
    step."""
    found: dict[str, Any] = {}
    for r in reports:
        step = r.part.removeprefix("step ").removesuffix(": ")
        stages = found.setdefault("steps", {}).setdefault(step, {}) if step else found
        stages[r.stage] = {
            "items": r.items,
            "done": r.done,
            "skipped": r.skipped,
            "failed": len(r.failures),
            "seconds": r.seconds,
            "result": None if r.result is None else r.result.as_json(),
        }
    return found


def all_failures(command: str, context: Context, reports: list[StageReport]) -> tuple[tuple[str, str, str], ...]:
    """Return what failed now, and what failed in the stages before this command and still stands."""
    failures = {(r.stage, item, reason) for r in reports for item, reason in r.failures}
    before = graph.RUN if command == "run" else graph.RUN[: graph.RUN.index(command)] if command in graph.RUN else ()
    for stage, item, reason in gather_failures(context.workspace):
        if stage in before and context.owns(owner(item)):
            failures.add((stage, item, reason))
    return tuple(sorted(once(failures)))
