"""pairs: what the block is, and which images to compare. Every command begins here."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from aeromatch_cli.blocks.summary import summarise
from aeromatch_cli.config import Settings, dump
from aeromatch_cli.data import Block, Pair, Pose
from aeromatch_cli.errors import InputError
from aeromatch_cli.executor import Executor
from aeromatch_cli.formats import cameras_text, images_text, pairs_text, poses_text, read_pairs
from aeromatch_cli.stages.assemble import Assembled, assemble
from aeromatch_cli.stages.common import Context, Shard, StageReport, distrust_fingerprint
from aeromatch_cli.workspace import Workspace, fingerprint, read_json, write_json, write_text

log = logging.getLogger("aeromatch")


def prepare(
    settings: Settings,
    executor: Executor,
    *,
    shard: Shard | None = None,
    overwrite: bool = False,
    dry: bool = False,
) -> tuple[Context, StageReport]:
    """Read the block, choose the pairs and, unless `dry`, write what the block is.

    Raises ConfigError for wrong input lists, InputError when no image or no pair is left, WorkspaceError when the
    workspace cannot be written.
    """
    report = StageReport("pairs")
    workspace = Workspace(Path(settings.workspace).absolute())
    if not dry:
        workspace.create()
    assembled = assemble(settings, workspace, executor)
    context = Context(
        settings=settings,
        workspace=workspace,
        executor=executor,
        block=assembled.block,
        pairs=(),
        image_fingerprints=assembled.image_fingerprints,
        given_poses=assembled.block.poses,
        guessed_cameras=assembled.guessed_cameras,
        shard=shard,
        overwrite=overwrite,
    )
    context = without_distrusted(context)
    wanted = _fingerprint(context)
    pairs = None if overwrite or dry else _stored_pairs(workspace, wanted)
    report.items = report.done = len(pairs or ())
    report.skipped = len(pairs or ())
    if pairs is None:
        pairs = settings.pairs(context.block)
        report.items = report.done = len(pairs)
        report.skipped = 0
    summary = summarise(assembled.block, pairs)
    report.facts = {
        "summary": list(summary.lines()),
        "warnings": [*assembled.warnings, *summary.warnings],
        "images": len(assembled.block.images),
        "distrusted": sorted(_turned(context)),
    }
    report.failures = list(assembled.failures)
    report.fingerprint = wanted
    context = replace(context, pairs=tuple(pairs))
    if not dry:
        _write(context, assembled, pairs)
        report.write(workspace)
    for warning in report.facts["warnings"]:
        log.warning("warning: %s", warning)
    if not pairs:
        raise InputError(
            f"no pairs: {len(context.block.images)} image(s), none of which overlap; check poses, cameras and ground "
            "(the warnings above), or use --set pairs=exhaustive"
        )
    return context, report


def without_distrusted(context: Context) -> Context:
    """The context in which images whose attitude contradicts the pictures keep only their position.

    The list was made by the filter stage; it holds as long as nothing that it depends on has changed.
    """
    path = context.workspace.distrusted
    if context.overwrite or not path.is_file():
        return context
    found = read_json(path)
    if found.get("fingerprint") != distrust_fingerprint(context):
        return context
    wrong = found["angles_deg"]
    poses: dict[str, Pose] = {
        i: replace(pose, world_rotation=None) if i in wrong else pose for i, pose in context.given_poses.items()
    }
    return replace(context, block=replace(context.block, poses=poses))


def _turned(context: Context) -> set[str]:
    """Images whose given attitude is not used."""
    return {
        i
        for i, pose in context.given_poses.items()
        if pose.world_rotation is not None and context.block.poses[i].world_rotation is None
    }


def _fingerprint(context: Context) -> str:
    block: Block = context.block
    needs = frozenset({"camera", "pose", "ground"})
    images = [(i.image_id, i.name, i.time, context.geometry_fingerprint(i.image_id, needs)) for i in block.images]
    return fingerprint(context.settings.pairs, images)


def _stored_pairs(workspace: Workspace, wanted: str) -> list[Pair] | None:
    report = workspace.stage_report("pairs")
    if not (report.is_file() and workspace.pairs.is_file()) or read_json(report).get("fingerprint") != wanted:
        return None
    return read_pairs(workspace.pairs)


def _write(context: Context, assembled: Assembled, pairs: list[Pair]) -> None:
    workspace, block = context.workspace, assembled.block
    write_text(workspace.config, dump(context.settings))
    write_json(workspace.block, dict(assembled.record))
    write_text(workspace.images, images_text(block.images, context.image_fingerprints))
    write_text(workspace.cameras, cameras_text(block.cameras))
    write_text(workspace.poses, poses_text(block.poses))
    write_text(workspace.pairs, pairs_text(pairs))
