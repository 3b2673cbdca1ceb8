"""run: one command from its settings to its result; the whole chain, or one stage of it."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from aeromatch_cli import graph, report
from aeromatch_cli.config import Settings
from aeromatch_cli.errors import BrokenFileError, ConfigError, InputError, WorkspaceError
from aeromatch_cli.executor import Executor, Progress
from aeromatch_cli.files import remove_stale_temporaries, translated_os_errors
from aeromatch_cli.formats.features import read_keypoints
from aeromatch_cli.formats.tables import read_images
from aeromatch_cli.images.remote import is_remote
from aeromatch_cli.results.stages import FilterResult, PairsResult
from aeromatch_cli.stages import (
    adjust,
    cascade,
    check,
    consistency,
    enhance,
    export,
    extract,
    filter,  # noqa: A004
    joined_steps,
    match,
    pairs,
    picture_quality,
    refine,
    simulate,
    up_to_date,
)
from aeromatch_cli.stages.command_result import (
    JUDGED,
    Result,
    Said,
    all_failures,
    block_of,
    command_result,
    named,
)
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.settings_diff import changed_words
from aeromatch_cli.stages.shard import Shard
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.stages.within import (
    Deadline,
    fitting,
    keep_asked,
    measured_in_time,
    page_in_time,
    steps_in_time,
    without_steps,
)
from aeromatch_cli.store.index import Index
from aeromatch_cli.words import of_images
from aeromatch_cli.workspace import Workspace, locked

log = logging.getLogger("aeromatch")

FUNCTIONS: dict[str, Callable[[Context], StageReport]] = {
    "enhance": enhance.run, "simulate": simulate.run, "extract": extract.run, "match": match.run, "filter": filter.run,
    "refine": refine.run, "adjust": adjust.run, "consistency": consistency.run, "export": export.run,
    "report": report.run,
}  # fmt: skip
"""What brings each stage up to date but orient and pairs, with which every command begins."""

# Of a cascade these work on what its steps have found together.
_AFTER_CASCADE = ("match", "filter", "adjust", "export", "report")
# Commands that export, and the one that says what they would do.
_EXPORTING = ("run", "export", "check")


def execute(
    command: str,
    settings: Settings,
    *,
    shard: str | None = None,
    within: str | None = None,
    started: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> Result:
    """Run one command. Raises AeromatchError where nothing can be done, KeyboardInterrupt where it was stopped.

    within: how long a whole run may take, such as 20m. started: when that time began, on the clock of time.monotonic();
    now, unless it is given. say: gets the summary of the block before the long stages;
    without it the summary stands in the result's lines.
    """
    part = Shard.parse(shard) if shard else None
    if part and not graph.sharded(command):
        raise ConfigError(f"--shard does not work with {command}: run it without, after all shards are done")
    if within is not None and (part or command != "run"):
        raise ConfigError("--within is for a whole `aeromatch run`: leave out --within, or --shard")
    now = time.monotonic() if started is None else started
    deadline = None if within is None else Deadline(within, started=now)
    root = Path(settings.workspace)
    if settings.block.images and command in graph.NEED_RESULTS and not root.exists():
        raise ConfigError(f"the workspace {root} does not exist: run `aeromatch run`, which makes it, or name another")
    with ExitStack() as stack:
        stack.enter_context(_nothing_left_of_a_failed_start(Workspace(root), shared=part is not None))
        if command != "check" and (not settings.block.images or _there(settings)):
            stack.enter_context(locked(Workspace(Path(settings.workspace)), command, shared=part is not None))
        try:
            whole = command == "run" and part is None
            inputs = up_to_date.state_of_inputs(settings) if whole else ""
            before = None if overwrite else up_to_date.unchanged_reports(Workspace(root), inputs)
            if before is not None:
                return named(_timed(_unchanged(settings, before, Said(say)), deadline), root)
            run = settings.run
            with (
                Executor(run.executor, run.jobs, progress, run.scheduler) as executor,
                _index(Workspace(root.absolute()), command, part) as index,
            ):
                asked = _Asked(command, settings, executor, index, part, deadline, overwrite, Said(say))
                result = _timed(_repairing(asked), deadline)
                if inputs and not result.failures and not (deadline and deadline.left_out):
                    up_to_date.remember(Workspace(root), index, inputs, result.reports)
            return named(result, root)
        except BaseException as error:
            # Workers are stopped in the middle of what they write.
            if command != "check":
                remove_stale_temporaries(Path(settings.workspace))
            if isinstance(error, PermissionError):  # even looking into a folder may fail
                words = f"cannot read {error.filename} ({error.strerror}): check its permissions"
                raise WorkspaceError(words) from error
            raise


def _unchanged(settings: Settings, reports: list[StageReport], said: Said) -> Result:
    """Return the result of a whole run that has nothing to do."""
    workspace = Workspace(Path(settings.workspace).absolute())
    names = {image.image_id: image.name for image in read_images(workspace.images)}
    block = block_of(reports)
    for line in block.summary:
        said(line)
    pairs.warn(block.warnings, block.urgent)
    return command_result("run", settings, workspace, names, reports, (), said)


@contextmanager
def _nothing_left_of_a_failed_start(workspace: Workspace, *, shared: bool) -> Iterator[None]:
    """Leave no folder but those that were there before, where nothing could be started. shared: other shards may be at
    work in the workspace."""
    root = workspace.root
    absent = [folder for folder in (root, *root.absolute().parents) if not folder.exists()]
    try:
        yield
    except BaseException as error:
        # The block is on file once it has images and pairs: what an interrupted command has made before that stays.
        refused = isinstance(error, ConfigError | InputError) and not workspace.block.exists() and not shared
        if absent and root.is_dir() and (refused or set(root.iterdir()) <= {workspace.lock}):
            shutil.rmtree(root, ignore_errors=True)
            for folder in absent[1:]:
                with suppress(OSError):  # something else lies in it by now
                    folder.rmdir()
        raise


@contextmanager
def _index(workspace: Workspace, command: str, part: Shard | None) -> Iterator[Index]:
    """What is known of the files of a workspace; what the command learns is kept. Of shards each keeps an index of its
    own, which the command for the whole block takes over."""
    if command == "check":
        yield Index(workspace.index, read_only=True)
        return
    index = Index(workspace.index if part is None else workspace.shard_index(part.label))
    if part is None:
        index.merge(workspace.shard_indexes())
    with closing(index):
        yield index


@dataclass(frozen=True, eq=False)
class _Asked:
    """One command with what it is run with. part: of a sharded run. overwrite: results are made anew though they are up
    to date."""

    command: str
    settings: Settings
    executor: Executor
    index: Index
    part: Shard | None
    deadline: Deadline | None
    overwrite: bool
    said: Said


def _repairing(asked: _Asked) -> Result:
    """Repeat the command until it meets no damaged file; each one is deleted, so that it is made again."""
    repaired: set[str] = set()
    while True:
        try:
            return _attempt(asked)
        except BrokenFileError as error:
            if asked.command == "check" or error.path in repaired:
                raise
            if not _makes(asked.command, Workspace(Path(asked.settings.workspace)), Path(error.path)):
                words = f"{error.path} is damaged ({error.reason}): run `aeromatch run`, which makes it again"
                raise WorkspaceError(words) from None
            repaired.add(error.path)
            asked = replace(asked, overwrite=False)  # what this command has done already is up to date
            log.warning("warning: %s was damaged (%s): it is made again", error.path, error.reason)
            with translated_os_errors(Path(error.path)):
                Path(error.path).unlink(missing_ok=True)


def _makes(command: str, workspace: Workspace, path: Path) -> bool:
    """Whether a command makes a file of the workspace."""
    below = path.absolute().relative_to(workspace.root.absolute())
    return graph.makes(command, PurePosixPath(below.as_posix()))


def _attempt(asked: _Asked) -> Result:
    command, settings, deadline, said = asked.command, asked.settings, asked.deadline, asked.said
    dry = command == "check"
    workspace = Workspace(Path(settings.workspace))
    if _there(settings) and not dry:
        for name in workspace.changed_tables():
            log.warning("warning: %s is not as it was written: it is made again", workspace.root / name)
    if _there(settings) and (words := changed_words(workspace.config, settings)):
        said(f"changed          {words}")
    exports = command in _EXPORTING
    context, *reports = pairs.prepare(
        settings, asked.executor, said,
        index=asked.index, shard=asked.part, overwrite=asked.overwrite, dry=dry, exports=exports,
    )  # fmt: skip
    if dry:
        return _check(context, reports[0], reports[-1], said)
    if command == "run":  # config.yaml has by now what was asked for
        with translated_os_errors(workspace.asked):
            workspace.asked.unlink(missing_ok=True)
    if deadline is not None:
        deadline.left_out.clear()  # of an attempt that met a damaged file
        if smaller := fitting(context, deadline):
            said(deadline.plan())
            keep_asked(context)
            context, _, reports[-1] = pairs.prepare(
                smaller, asked.executor, index=asked.index, exports=exports, again=True
            )
            context = context.with_scope(overwrite=asked.overwrite)
    if command == "run":
        reports += _run_all(context, reports[-1], deadline)
    elif context.settings.cascade and command in _AFTER_CASCADE:
        context, made = _cascaded(context) if command == "match" else (_joined(context), [])
        if command == "match" and context.scope.shard is None:
            _tell_left_out(context, reports[-1], without_steps(block_of(reports).left_out))
        reports += made
        if command != "match":
            reports += _stages_of(command, context)
    elif command == "match":
        features = extract.run(context.with_scope(overwrite=False), match.images_of_rows(context))
        reports += [features, match.run(context)]
    elif command not in ("orient", "pairs"):
        reports += _stages_of(command, context)
    if command == "filter" and not reports[-1].items and reports[-1].failures:
        raise InputError(
            "no pair has matches made with the present settings and inputs: run `aeromatch match` first "
            "(`aeromatch run` does everything)"
        )
    failures = all_failures(command, context, reports)
    unjudged = _unjudged(context) if command == "match" else 0
    old_page = command in JUDGED and report.is_of_earlier_results(context.workspace)
    return command_result(
        command, context.settings, context.workspace, context.block.names, reports, failures, said,
        part=context.scope.shard is not None, old_page=old_page, unjudged=unjudged,
    )  # fmt: skip


def _unjudged(context: Context) -> int:
    """Count the pairs with matches that are not verified with these; of a shard nothing is said."""
    if context.scope.shard is not None:
        return 0
    state = BlockState.of(context)
    return sum(state.are_matched(pair) for pair in state.outdated_pairs())


def _timed(result: Result, deadline: Deadline | None) -> Result:
    """The result with what `--within` has left out."""
    if deadline is None:
        return result
    facts, line = {**result.facts, "left_out": deadline.left_out}, deadline.line()
    urgent = result.urgent if deadline.is_kept else (*result.urgent, line)
    return replace(result, lines=(*result.lines, line), facts=facts, urgent=urgent)


def _there(settings: Settings) -> bool:
    """Whether there may be images: without any nothing is made at all."""
    images = settings.block.images
    return bool(images) and (is_remote(images) or Path(images).is_dir())


def _stages_of(command: str, context: Context) -> list[StageReport]:
    """Bring the stages of a command up to date; where results are to be made anew, only its own stage is, and of
    `adjust` what belongs to it."""
    kept = context.with_scope(overwrite=False) if command == "export" else context
    return [FUNCTIONS[name](context if name == command else kept) for name in graph.COMMANDS[command]]


def _cascaded(context: Context, deadline: Deadline | None = None) -> tuple[Context, list[StageReport]]:
    """Run all steps of a cascade that fit in time and, unless it is a shard, merge what they have found."""
    steps = cascade.run(context) if deadline is None else steps_in_time(context, deadline)
    if context.scope.shard is not None:
        return context, [report for step in steps for report in step.reports]
    joined = joined_steps.joined_context(context, steps)
    return joined, joined_steps.run(joined, steps)


def _joined(context: Context) -> Context:
    """The context of the stages after a cascade, whose steps are on file."""
    return joined_steps.joined_context(context, cascade.steps_on_file(context))


def _run_all(context: Context, read: StageReport, deadline: Deadline | None) -> list[StageReport]:
    """extract, match, filter; then adjust, consistency, export and report. read: the report of the stage pairs."""
    context, reports = _to_filter(context, deadline)
    if context.scope.shard is None:
        judged = reports[-1].result
        if not isinstance(judged, FilterResult) or not judged.verified_matches:
            report.run(context)  # in any case: nothing else says why
            raise InputError(
                f"no pair could be verified: the table of pairs in {context.workspace.report} says why"
                + _without_keypoints(context)
                + (f"; this run was reduced: {'; '.join(deadline.left_out)}" if deadline and deadline.left_out else "")
            )
        if deadline is not None:
            context = measured_in_time(context, deadline)
        _tell_left_out(context, read, [] if deadline is None else deadline.left_out)
        after = graph.RUN[graph.RUN.index("filter") + 1 :]
        reports += [FUNCTIONS[name](context) for name in after if name != "report"]
        if context.settings.run.report:
            page = report.page_if_up_to_date(context)
            if page is None and (deadline is None or page_in_time(context, deadline)):
                with context.executor.step("report"):
                    page = report.run(context)
            reports += [] if page is None else [page]
    return reports


def _tell_left_out(context: Context, read: StageReport, left_out: list[str]) -> None:
    """Note in the report of the stage pairs what is left out, for the page."""
    assert isinstance(read.result, PairsResult)
    if left_out != read.result.left_out:
        read.result = read.result.model_copy(update={"left_out": list(left_out)})
        read.started = time.perf_counter() - read.seconds
        read.write(context.workspace)


def _without_keypoints(context: Context) -> str:
    """Say of a block none of whose pairs is verified how many images show nothing to match, and what may hide it."""
    made = {image.name: context.workspace.features(image.image_id) for image in context.block.images}
    empty = [name for name, path in made.items() if path.is_file() and not len(read_keypoints(path)[0])]
    if not empty:
        return ""
    masks = context.settings.block.masks
    hidden = f"; do the masks {masks} hide them? white is used, black is ignored" if masks else ""
    return f"; {of_images(empty, made, 'has', 'have')} no keypoints{hidden}"


def _to_filter(context: Context, deadline: Deadline | None) -> tuple[Context, list[StageReport]]:
    if context.settings.cascade:
        context, reports = _cascaded(context, deadline)
        return context, reports if context.scope.shard is not None else [*reports, filter.run(context)]
    features = extract.run_own_first(context, match.images_of_rows(context))
    return context, [features, match.run(context), filter.run(context)]


def _check(context: Context, oriented: StageReport, first: StageReport, said: Said) -> Result:
    settled = oriented.result is not None or context.settings.first_pass is None
    read, quality = block_of([first]), picture_quality.measured(context)
    looks = picture_quality.remarks(context, quality)
    pairs.warn(warning for warning in looks if warning not in read.warnings)
    found = check.run(context, time.perf_counter() - first.started, len(first.failures), oriented=settled)
    lines = (*said.rest(read.summary), *found.lines)
    failures = tuple(("check", item, reason) for item, reason in [*first.failures, *found.failures])
    for _, item, reason in failures:
        log.warning("failed: %s: %s", item, reason)  # quiet has its own way
    facts = {
        "warnings": [*dict.fromkeys([*read.warnings, *looks])],
        "estimate": found.estimate,
        "failures": len(failures),
    }
    return Result(tuple(lines), facts, failures)
