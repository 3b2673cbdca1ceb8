"""orient: cameras, poses and terrain of the block, found once from a first pass, before the images are matched.

Where the given poses explain the matches of the first pass they are used as they are; else the block is oriented from
the pictures. Later stages read the result from the workspace's orientation folder and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray, Ground
from aeromatch_cli.files import read_record, translated_os_errors, write_bytes, write_json, write_text
from aeromatch_cli.fingerprints import fingerprint, mask_fingerprint
from aeromatch_cli.formats.tables import cameras_text, poses_text, read_cameras, read_poses
from aeromatch_cli.formats.terrain import read_terrain, terrain_bytes
from aeromatch_cli.images.masks import mask_path
from aeromatch_cli.results.record import Record
from aeromatch_cli.results.stages import FurtherFirstPass, OrientResult
from aeromatch_cli.sfm.dem import Terrain, continued
from aeromatch_cli.sfm.earlier_datum import Before
from aeromatch_cli.sfm.focal import better_cameras
from aeromatch_cli.sfm.mapping import Group, own_frames
from aeromatch_cli.sfm.solution import (
    FirstPassMatches,
    Solution,
    from_given,
    from_models,
    judged,
    suffices,
    unoriented_remark,
)
from aeromatch_cli.stages import first_pass
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.ground import judged_altitudes, judged_ground
from aeromatch_cli.stages.messages import frame_remarks
from aeromatch_cli.stages.models import best_mapped, evidence_of
from aeromatch_cli.stages.stage_report import StageReport, gather_failures
from aeromatch_cli.stages.swapped_axes import fitting_reading
from aeromatch_cli.stages.versions import library_version
from aeromatch_cli.strategies.orienters import FirstPass

# The second is that of what is done with blocks that are large (`first_pass.is_large`) alone.
VERSION, _LARGE_BLOCK_VERSION = 30, 1
_DATA = "orientation/orientation.json"
# What failures.csv calls the mapper's process.
_MAPPING = "mapping"


class OrientedGroup(Record):
    """Images that one orientation holds. kind: "given", or how they were put into the world."""

    kind: str
    images: tuple[str, ...]


class OrientationRecord(Record):
    """What was found, of what, and which pairs the first pass has verified: the contents of orientation.json.

    settings, images: fingerprints of the settings, and by image_id of what was given. tied: pairs with verified
    matches. similar: pairs that look alike. failed: images that could not be read, and the mapper where it stopped,
    which the next run tries again. terrains: files beside it, the largest flight's first.
    """

    settings: str
    images: dict[str, str]
    tied: list[tuple[str, str]]
    similar: list[tuple[str, str]]
    failed: list[str]
    result: OrientResult
    groups: list[OrientedGroup]
    terrains: list[str]


def run(
    context: Context, altitudes: tuple[Ground, str] | None = None, *, dry: bool = False
) -> tuple[Context, StageReport]:
    """Orient the block; return the context with oriented cameras, poses and terrain.

    altitudes: the ground below relative altitudes and its source, which is judged. dry: only what is on file, nothing
    is made or written.
    """
    report = StageReport("orient", items=len(context.block.images))
    recipe = context.settings.first_pass
    if recipe is None:
        report.items = 0
        return context, report
    images, settings = _prints(context)
    # A block that grows large is oriented anew, but where its images were.
    report.fingerprint = fingerprint(images, settings, first_pass.is_large(context.block))
    before, made_of = _on_file(context)
    record = before if made_of == report.fingerprint else None
    if record is None and dry:
        return context, report
    recipe = first_pass.fitted(recipe, context.block)
    if record is not None and not dry and record.failed and first_pass.mended(context, recipe, record.failed):
        # What is made without some of its images is no beginning to go on from.
        record = before = None
    if record is None:
        known = before.images if before is not None and before.settings == settings else {}
        kept = {image_id for image_id, made_of in images.items() if known.get(image_id) == made_of}
        solution, seen = _solution(context, recipe, before if kept else None, kept)
        record = _write(context, solution, settings=settings, images=images, **seen)
        report.done = report.items
    else:
        report.skipped = report.items
    report.record_files(context, _files(context, record))
    folder = context.workspace.orientation
    found = record.result
    poses = read_poses(folder / "poses.csv")
    ground, source, ground_remarks = judged_ground(context, _terrains(context, record), found, poses)
    remarks = [*found.remarks, *frame_remarks(found, _groups(record)), *ground_remarks]
    remarks += judged_altitudes(ground, context.block, found, altitudes)
    report.result = found.model_copy(update={"remarks": remarks})
    if found.frame == "own":
        # Given positions are in another frame, and nothing ties this one to a CRS.
        context = replace(
            context,
            block=replace(context.block, crs="local", origin_m=(0.0, 0.0, 0.0), metric=False),
            given=replace(context.given, block=replace(context.given.block, poses={})),
        )
    block = replace(
        context.block,
        cameras=read_cameras(folder / "cameras.csv"),
        poses=poses,
        ground=ground,
        ground_source=source,
        tied=tuple(record.tied),
        similar=tuple(record.similar),
        outside=frozenset(found.outside),
        calibrated=frozenset(found.calibrated),
        frames=own_frames(_groups(record)),
    )
    report.failures = _failed_images(context, record.failed)
    # Every image counts once.
    report.done, report.skipped = (max(count - len(report.failures), 0) for count in (report.done, report.skipped))
    if found.stopped:
        report.failures.append((_MAPPING, found.stopped))
    context = replace(context, block=block)
    return context, report if dry else report.write(context.workspace)


def _failed_images(context: Context, failed: Sequence[str]) -> list[tuple[str, str]]:
    """Images that the first pass could not use, and why."""
    images = context.image_by_id.keys() & set(failed)
    if not images:
        return []
    rows = gather_failures(context.workspace.first_pass)
    return sorted({(item, reason) for _, item, reason in rows if item in images})


def groups(context: Context) -> list[Group]:
    """Return images that the orientation on file holds, the largest group first; none without an orientation."""
    record, _ = _on_file(context.with_scope(overwrite=False))
    return [] if record is None else _groups(record)


def _groups(record: OrientationRecord) -> list[Group]:
    return [Group(one.kind, one.images) for one in record.groups if one.images]


def _solution(
    context: Context, recipe: FirstPass, before: OrientationRecord | None, kept: set[str]
) -> tuple[Solution, dict[str, Any]]:
    """Find the orientation from the first pass; return it with the pairs of that pass, those that look alike, and what
    failed.

    before: what an earlier run has found, None where no image is as it was. kept: images that are, whose poses and
    terrain stay as they were where the new ones agree with them.
    """
    block = context.block
    given = sum(pose.world_rotation is not None for pose in block.poses.values())
    # Pairs that look alike are chosen once, for all passes.
    looks = given == len(block.images) and context.settings.similar is None
    first, evidence = evidence_of(context, first_pass.look(recipe, block) if looks else recipe, look=looks)
    if recipe.replaces:
        context, first, evidence = _with_better_cameras(context, first, evidence)
    good = evidence.explained()
    tried: list[FurtherFirstPass] = []
    stopped = ""
    if looks and recipe.replaces and not suffices(evidence, good):
        first, evidence = evidence_of(context, recipe)
        good = evidence.explained()
    if not evidence.pairs or suffices(evidence, good):
        solution = from_given(evidence, good, correct=recipe.replaces)
        if not evidence.pairs and not given:
            solution.result.remarks.append(unoriented_remark(evidence))
    else:
        mapped, tried = best_mapped(context, recipe, first, evidence)
        models, first, evidence, stopped = mapped.models, mapped.first, mapped.evidence, mapped.stopped
        reading = fitting_reading(block, models[0]) if models and mapped.contradicted else ""
        solution = from_models(evidence, models, _before(context, before, kept), context.given.angles, reading)
        if not models and not stopped:
            solution.result.remarks.append(unoriented_remark(evidence))
        if not recipe.replaces:
            solution = judged(from_given(evidence, good, correct=False), solution)
    counts = {
        "images_matched": len(evidence.matched),
        "positions_given": len(block.poses),
        "given_poses_explained": len(good),
    }
    result = solution.result.model_copy(update={**counts, "further_first_passes": tried, "stopped": stopped})
    seen = {
        "tied": [(pair.image_id0, pair.image_id1) for pair in evidence.pairs],
        "similar": list(first.block.similar),
        "failed": [*evidence.failed, *([_MAPPING] if stopped else [])],  # is tried again by the next run
    }
    terrains = solution.terrains
    old = () if before is None else _terrains(context, before)
    if len(old) == len(terrains):
        centers_m = np.array([pose.center_m for pose in solution.poses.values()])
        terrains = tuple(continued(one, new, centers_m) for one, new in zip(old, terrains, strict=True))
    return replace(solution, terrains=terrains, result=result), seen


def _with_better_cameras(
    context: Context, first: Context, evidence: FirstPassMatches
) -> tuple[Context, Context, FirstPassMatches]:
    """Return both contexts and the matches of the first pass with other focal lengths, where those given cannot be
    right."""
    block = evidence.block
    camera_ids = {image.image_id: image.camera_id for image in block.images}
    seen = evidence.pairs, block.poses, block.cameras, camera_ids, evidence.thresholds_px
    cameras = {**block.cameras, **better_cameras(*seen, context.given.likely_focals)}
    return (
        replace(context, block=replace(context.block, cameras=cameras)),
        replace(first, block=replace(first.block, cameras=cameras)),
        replace(evidence, block=replace(block, cameras=cameras)),
    )


def _before(context: Context, record: OrientationRecord | None, kept: set[str]) -> Before:
    if record is None:
        return Before()
    folder = context.workspace.orientation
    poses = read_poses(folder / "poses.csv")
    held = {i: pose for i, pose in poses.items() if i in kept and pose.world_rotation is not None}
    placing = [one.images for one in record.groups if one.kind != "level"]
    return Before(held, read_cameras(folder / "cameras.csv"), {i for images in placing for i in images})


def _prints(context: Context) -> tuple[dict[str, str], str]:
    """Fingerprints of what was given of every image, and of the settings: what the orientation depends on."""
    block, settings = context.block, context.settings
    images = {}
    for image in block.images:
        pose = block.poses.get(image.image_id)
        place = None
        if pose is not None:
            place = pose.center_m, pose.world_rotation, pose.sigma_position_m, pose.sigma_angle_deg
        mask = mask_path(settings.block.masks, image.name)
        taken = context.given.image_fingerprints[image.image_id], image.time, mask_fingerprint(mask) if mask else ""
        images[image.image_id] = fingerprint(
            taken, image.camera_id, block.camera(image), place, context.given.angles.get(image.image_id),
            context.given.likely_focals.get(image.camera_id),
        )  # fmt: skip
    how: list[Any] = [settings.orient, _limit_px(context), _LARGE_BLOCK_VERSION]
    if settings.similar is not None:
        how.append(settings.similar)
    return images, fingerprint(VERSION, library_version("pycolmap"), how, block.crs, block.origin_m)


def _limit_px(context: Context) -> int:
    """The size to which the settings reduce images, where the first pass takes them no smaller; else 0."""
    recipe, limit_px = context.settings.first_pass, context.settings.block.max_size_px
    return limit_px if recipe is not None and limit_px < recipe.size_px else 0


def _on_file(context: Context) -> tuple[OrientationRecord | None, str]:
    """Return what an earlier run has found, and the fingerprint of what it was made of, where its files are as they
    were written; else nothing."""
    report = context.recorded("orient")
    if report is None or _DATA not in report.files:
        return None, ""
    return read_record(context.workspace.root / _DATA, OrientationRecord), report.fingerprint


def _write(context: Context, solution: Solution, **seen: Any) -> OrientationRecord:
    """Write what was found; return the record. seen: the other fields of it."""
    workspace = context.workspace
    folder = workspace.orientation
    context.workspace.forget("orient")
    write_text(folder / "cameras.csv", cameras_text(solution.cameras))
    write_text(folder / "poses.csv", poses_text(solution.poses))
    names = []
    for number, terrain in enumerate(solution.terrains, start=1):
        place = terrain.west_m, terrain.north_m, terrain.cell_m
        data = terrain_bytes(terrain.heights_m, *place, *_frame(context, solution.result))
        names.append("terrain.tif" if number == 1 else f"terrain-{number}.tif")
        write_bytes(folder / names[-1], data)
    with translated_os_errors(folder):
        for old in set(folder.glob("terrain*.tif")) - {folder / name for name in names}:
            old.unlink(missing_ok=True)
    held = [OrientedGroup(kind=group.kind, images=group.images) for group in solution.groups]
    record = OrientationRecord(**seen, result=solution.result, groups=held, terrains=names)
    write_json(workspace.root / _DATA, record.as_json())
    return record


def _files(context: Context, record: OrientationRecord) -> list[Path]:
    """Return the files of an orientation."""
    workspace = context.workspace
    names = ("cameras.csv", "poses.csv", *record.terrains)
    return [workspace.root / _DATA, *(workspace.orientation / name for name in names)]


def _terrains(context: Context, record: OrientationRecord) -> tuple[Terrain, ...]:
    """Read the terrains on file, the largest flight's first."""
    origin_m, _ = _frame(context, record.result)
    folder = context.workspace.orientation
    return tuple(Terrain(*read_terrain(folder / name, origin_m)) for name in record.terrains)


def _frame(context: Context, found: OrientResult) -> tuple[FloatArray, str]:
    """Origin and CRS of what the orientation has found."""
    own = found.frame == "own"
    return (np.zeros(3), "local") if own else (np.array(context.block.origin_m), context.block.crs)
