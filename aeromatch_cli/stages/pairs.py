"""pairs: what the block is, and which images to compare. Every command begins here."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from aeromatch_cli.blocks.summary import summarise
from aeromatch_cli.config import Settings, dump
from aeromatch_cli.data import Block, Pair, PictureQuality
from aeromatch_cli.errors import ConfigError, InputError
from aeromatch_cli.executor import Executor
from aeromatch_cli.files import read_record, write_json, write_text
from aeromatch_cli.fingerprints import file_digest, fingerprint
from aeromatch_cli.formats.tables import cameras_text, images_text, pairs_text, poses_text, read_pairs
from aeromatch_cli.nets.files import ships
from aeromatch_cli.results.record import StageRecord
from aeromatch_cli.results.stages import OrientResult, PairsResult
from aeromatch_cli.stages import orient, picture_quality
from aeromatch_cli.stages.block import BlockRead, block_record, read_block, with_gsd
from aeromatch_cli.stages.cascade import strategies_of
from aeromatch_cli.stages.context import Context, Scope
from aeromatch_cli.stages.memory import budget_mb, jobs_within, runs_network
from aeromatch_cli.stages.messages import orientation_lines
from aeromatch_cli.stages.shard import Shard
from aeromatch_cli.stages.stage_report import StageReport, forget_absent, result_on_file
from aeromatch_cli.store.index import Index
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.matchers.lightglue.learned import LearnedLightGlue
from aeromatch_cli.workspace import Workspace

log = logging.getLogger("aeromatch")


def prepare(
    settings: Settings,
    executor: Executor,
    say: Callable[[str], None] = lambda _line: None,
    *,
    index: Index | None = None,
    shard: Shard | None = None,
    overwrite: bool = False,
    dry: bool = False,
    exports: bool = False,
    again: bool = False,
) -> tuple[Context, StageReport, StageReport]:
    """Read the block, orient it, choose the pairs and, unless `dry`, write what the block is.

    say: gets the lines of the summary as soon as each is known. index: what is known of the workspace's files. exports:
    whether the command ends with an export, whose refusals come at once, and not after hours. again: with other
    settings in the same command, which warns of nothing twice. Returns the context and the reports of orient and pairs.

    Raises ConfigError for wrong input lists, InputError when no image or no pair is left, WorkspaceError when the
    workspace cannot be written.
    """
    report = StageReport("pairs")
    workspace = _opened(settings, dry=dry)
    index = index or Index()
    found = read_block(settings, workspace, executor, index)
    as_given = summarise(found.given.block)
    given_lines = [*([f"poses            {found.recognised}"] if found.recognised else []), *as_given.given_lines()]
    for line in given_lines:
        say(line)
    known = [*found.warnings, *as_given.warnings, *_within_memory(settings, executor, found.given.block)]
    tell = (lambda _warnings, _urgent=(): None) if again else warn
    tell(known, found.urgent)
    _check_images(found.given.block)
    for exporter in settings.export if exports else ():
        exporter.check_images(found.given.block.images)
    given = _context(settings, workspace, executor, index, found, shard, overwrite)
    quality = picture_quality.measured(given, dry=dry)
    looks = picture_quality.remarks(given, quality)
    tell(looks)
    known += looks
    context, oriented = orient.run(given, found.ground_hint, dry=dry)
    report.started += oriented.seconds  # has its own report
    context = _with_ground(context, found)
    report.fingerprint = _fingerprint(context)
    pairs = _listed(context, report, anew=overwrite or dry)
    summary, pairs_csv = summarise(context.block, pairs), pairs_text(pairs)
    as_oriented = oriented.result if isinstance(oriented.result, OrientResult) else None
    oriented_lines = (
        []
        if as_oriented is None
        else orientation_lines(as_oriented, found.given.block, context.block, found.given.guessed_cameras)
    )
    remarks = [] if as_oriented is None else as_oriented.remarks
    said_later = [*remarks, *(w for w in summary.warnings if w not in known)]
    before = result_on_file(workspace, PairsResult)
    result = PairsResult(
        summary=[*given_lines, *oriented_lines, *summary.lines(as_given), *_remarks(settings)],
        block=summary.figures(),
        warnings=[*known, *said_later],
        urgent=sorted(found.urgent),
        unread=dict(found.unread),
        images=len(found.given.block.images),
        left_out=[] if before is None else before.left_out,  # until a whole run says otherwise
    )
    report.result = result
    report.failures = list(found.failures)
    context = replace(context, pairs=tuple(pairs))
    for line in result.summary:
        say(line)
    tell(said_later)
    _check_pairs(context)
    if not dry:
        report.record_files(context, _write(context, pairs_csv, quality))
        forget_absent(context)
        report.write(workspace)
    return context, oriented, report


def warn(warnings: Iterable[str], urgent: Collection[str] = ()) -> None:
    """Say each; those that are urgent even where quiet is asked for, as errors are."""
    for warning in warnings:
        log.log(logging.ERROR if warning in urgent else logging.WARNING, "warning: %s", warning)


def _opened(settings: Settings, *, dry: bool) -> Workspace:
    workspace = Workspace(Path(settings.workspace).absolute())
    _check_settings(settings)
    if dry:
        workspace.check_version()
    else:
        workspace.create()
    return workspace


def _listed(context: Context, report: StageReport, *, anew: bool) -> Sequence[Pair]:
    """The pairs on file where they are those of the report's fingerprint, else chosen now; counted in the report."""
    pairs = None if anew else _stored_pairs(context.workspace, report.fingerprint)
    if pairs is not None:
        report.items = report.skipped = len(pairs)
        return pairs
    with context.executor.step("pairs"):
        chosen = context.settings.pairs(context.block)
    report.items = report.done = len(chosen)
    return chosen


def _check_images(block: Block) -> None:
    """Raise InputError where there is nothing to match."""
    if len(block.images) == 1:
        raise InputError(f"only one image can be used ({block.images[0].name}): one image makes no pair")


def _check_pairs(context: Context) -> None:
    """Raise InputError where there is nothing to match."""
    if not context.pairs:
        raise InputError(
            f"no pairs: {len(context.block.images)} images, none of which overlap; check poses, cameras and ground "
            "(the warnings above), or use --set pairs=exhaustive"
        )


def _with_ground(context: Context, found: BlockRead) -> Context:
    """Return the context with the ground below relative altitudes, where the images show no terrain, and the ground
    sampling distance."""
    block = context.block
    if block.ground is None and found.ground_hint is not None:
        block = replace(block, ground=found.ground_hint[0], ground_source=found.ground_hint[1])
    return replace(context, block=with_gsd(block, found.gsd_before_m, context.settings.block.max_size_px))


def _within_memory(settings: Settings, executor: Executor, block: Block) -> list[str]:
    """Fewer workers where the memory budget asks for that, and what is said of it."""
    budget = budget_mb(settings.run.memory)
    if budget is None or executor.kind == "serial":
        return []
    network = runs_network(settings)
    size_px = settings.block.max_size_px
    jobs, remark = jobs_within(budget, executor.jobs, block.images, network=network, max_size_px=size_px)
    executor.limit(jobs)
    return [remark] if remark else []


def _context(
    settings: Settings,
    workspace: Workspace,
    executor: Executor,
    index: Index,
    found: BlockRead,
    shard: Shard | None,
    overwrite: bool,
) -> Context:
    """The context without pairs, of the block as it is given."""
    return Context(
        settings=settings,
        workspace=workspace,
        executor=executor,
        given=found.given,
        block=found.given.block,
        scope=Scope(shard=shard, overwrite=overwrite),
        index=index,
    )


def _check_settings(settings: Settings) -> None:
    """Raise ConfigError for strategies that do not go together, and for files that they need (weights, pair lists):
    now, and not after hours of extraction.
    """
    budget_mb(settings.run.memory)
    if settings.similar is not None and settings.first_pass is None:
        raise ConfigError(
            "pairs=similar compares the descriptors of the first pass, and orient=none makes none: choose another "
            "orient, or pairs=exhaustive"
        )
    for strategy in chosen_strategies(settings):
        strategy.check_files(settings.extract.descriptor_length)
    _check_descriptors(settings)


def _check_descriptors(settings: Settings) -> None:
    """Raise ConfigError where LightGlue does not know the user's own descriptors."""
    match = settings.match
    if not isinstance(match, LearnedLightGlue) or match.weights is not None:
        return
    described = [path for path in settings.extract.own_weights() if Path(path).stem in ("geodesc", "context")]
    if own := [path for path in described if not ships(Path(path))]:
        raise ConfigError(
            f"match={match.name} was trained on the descriptors that ship, not on those of {own[0]}: give "
            "match.weights that were trained on these, or set match=bidirectional"
        )


def chosen_strategies(settings: Settings) -> Iterator[Strategy]:
    """All that the settings name, and those that their steps take instead."""
    yield from (settings.orient, settings.pairs, settings.enhance, settings.simulate, settings.extract, settings.match)
    for step in settings.cascade:
        yield step
        yield from strategies_of(step, settings).values()
    yield from settings.filter
    yield from settings.export


def _remarks(settings: Settings) -> list[str]:
    """Say what the settings bring that their user may not expect."""
    own = dict.fromkeys(path for strategy in chosen_strategies(settings) for path in strategy.own_weights())
    return [f"own weights      {path}" for path in own]


def _fingerprint(context: Context) -> str:
    block: Block = context.block
    needs = frozenset({"camera", "pose", "ground"})
    images = [(i.image_id, i.name, i.time, context.geometry_fingerprint(i.image_id, needs)) for i in block.images]
    return fingerprint(context.settings.pairs, images, block.tied, block.similar)


def _stored_pairs(workspace: Workspace, wanted: str) -> list[Pair] | None:
    """The pairs on file, if the report that vouches for them is about exactly this file."""
    record = read_record(workspace.stage_report("pairs"), StageRecord)
    if record is None or record.fingerprint != wanted or not workspace.pairs.is_file():
        return None
    same = file_digest(workspace.pairs) == record.files.get(workspace.pairs.name)
    return read_pairs(workspace.pairs) if same else None


def _write(context: Context, pairs_csv: str, quality: Mapping[str, PictureQuality]) -> list[Path]:
    """Write settings and tables of the block; return the tables."""
    workspace, block = context.workspace, context.block
    texts = {
        workspace.images: images_text(block.images, context.given.image_fingerprints, quality),
        workspace.cameras: cameras_text(block.cameras),
        workspace.poses: poses_text(block.poses),
        workspace.pairs: pairs_csv,
    }
    write_text(workspace.config, dump(context.settings))
    for path, text in texts.items():
        write_text(path, text)
    write_json(workspace.block, block_record(block, context.given.block, context.settings))
    return [workspace.block, *texts]
