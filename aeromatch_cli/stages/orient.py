"""orient: cameras, poses and terrain of the block, found once from a first pass, before the images are matched.

Where the given poses explain the matches of the first pass they are used as they are; else the block is oriented from
the pictures. Later stages read the result from the workspace's orientation folder and nothing else.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray, Ground
from aeromatch_cli.errors import InputError
from aeromatch_cli.files import read_json, translated_os_errors, whole_record, write_bytes, write_record, write_text
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.formats.tables import cameras_text, poses_text, read_cameras, read_poses
from aeromatch_cli.formats.terrain import read_terrain, terrain_bytes
from aeromatch_cli.orientation.dem import Terrain, continued
from aeromatch_cli.orientation.focal import better_cameras
from aeromatch_cli.orientation.growth import grown
from aeromatch_cli.orientation.mapping import MAPPERS, Group, Mapper, Model, map_block
from aeromatch_cli.orientation.solution import (
    Before,
    Evidence,
    Solution,
    from_given,
    from_models,
    judged,
    suffices,
    unoriented_remark,
)
from aeromatch_cli.orientation.soundness import FEWEST_IMAGES, only, sound_part
from aeromatch_cli.stages import first_pass
from aeromatch_cli.stages.contents import contents_of
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.exchanged import exchanged_columns
from aeromatch_cli.stages.ground import judged_altitudes, judged_ground
from aeromatch_cli.stages.lines import frame_remarks
from aeromatch_cli.stages.stage_report import StageReport, gather_failures
from aeromatch_cli.stages.versions import library_version
from aeromatch_cli.strategies.orienters import FirstPass
from aeromatch_cli.strategies.pairings.similar import Similar

log = logging.getLogger("aeromatch")

# The second counts for blocks that are large (`first_pass.is_large`) alone.
VERSION, _LARGE_BLOCK_VERSION = 18, 1
# Images that no model holds are mapped again by themselves so often.
_MAX_ROUNDS = 4
# A block falls into parts where the largest model holds fewer than this share of its images though so many are matched.
_WHOLE = 0.8
# An exact match of the first pass lies this near its epipolar line, in pixels of its own reduced image.
_EXACT_PX = 3.0
# Standard deviation of a focal length that the pictures gave, as a share of it.
_FOUND_FOCAL = 0.01


def run(
    context: Context, altitudes: tuple[Ground, str] | None = None, *, dry: bool = False
) -> tuple[Context, StageReport]:
    """The context with oriented cameras, poses and terrain.

    altitudes: the ground below relative altitudes and its source, which is judged. dry: only what is on file, nothing
    is made or written.
    """
    report = StageReport("orient", items=len(context.block.images))
    recipe = context.settings.orient
    if not isinstance(recipe, FirstPass):
        report.items = 0
        return context, report
    images, settings = _prints(context)
    report.fingerprint = fingerprint(images, settings)
    before = _on_file(context)
    record = before if before.get("fingerprint") == report.fingerprint else None
    if record is None and dry:
        return context, report
    recipe = first_pass.fitted(recipe, context.block)
    if record is not None and not dry and record["failed"] and first_pass.mended(context, recipe, record["failed"]):
        # What is made without some of its images is no beginning to go on from.
        record, before = None, {}
    if record is None:
        same = before.get("settings") == settings
        kept = {i for i, value in images.items() if same and before.get("images", {}).get(i) == value}
        solution = _solution(context, recipe, kept, before)
        head = {"fingerprint": report.fingerprint, "settings": settings, "images": images}
        record = _write(context, solution, head)
        report.done = report.items
    else:
        report.skipped = report.items
    folder = context.workspace.orientation
    ground, source, ground_remarks = judged_ground(context, _terrains(context, record), record["facts"])
    remarks = [*frame_remarks(record), *ground_remarks]
    remarks += judged_altitudes(ground, context.block, record["facts"], altitudes)
    report.facts = record["facts"] | {"remarks": [*record["facts"]["remarks"], *remarks]}
    if record["facts"]["frame"] == "own":
        # Given positions are in another frame, and nothing ties this one to a CRS.
        context = replace(
            context,
            block=replace(context.block, crs="local", origin_m=(0.0, 0.0, 0.0)),
            given=replace(context.given, poses={}),
        )
    block = replace(
        context.block,
        cameras=read_cameras(folder / "cameras.csv"),
        poses=read_poses(folder / "poses.csv"),
        ground=ground,
        ground_source=source,
        tied=tuple((id0, id1) for id0, id1 in record["tied"]),
        similar=tuple((id0, id1) for id0, id1 in record["similar"]),
        outside=frozenset(record["facts"]["outside"]),
    )
    report.failures = _failed_images(context, record["failed"])
    found = dict.fromkeys(report.facts.get("calibrated", ()), _FOUND_FOCAL)
    context = replace(context, block=block, focal_sigmas={**context.focal_sigmas, **found})
    return context, report if dry else report.write(context.workspace)


def _failed_images(context: Context, failed: Sequence[str]) -> list[tuple[str, str]]:
    """Images that the first pass could not use, and why."""
    images = context.image_by_id.keys() & set(failed)
    if not images:
        return []
    rows = gather_failures(context.workspace.first_pass)
    return sorted({(item, reason) for _, item, reason in rows if item in images})


def groups(context: Context) -> list[Group]:
    """Images that the orientation on file holds, the largest group first; none without an orientation."""
    record = _on_file(replace(context, overwrite=False))
    return [Group(str(one["kind"]), tuple(one["images"])) for one in record.get("groups", ()) if one["images"]]


def _solution(context: Context, recipe: FirstPass, kept: set[str], before: Mapping[str, Any]) -> Solution:
    """What the first pass says. kept: images that have not changed since an earlier run, whose poses and terrain stay
    as they were where the new ones agree with them. before: the record of that run."""
    block = context.block
    given = sum(pose.world_rotation is not None for pose in block.poses.values())
    # Pairs that look alike are chosen once, for all passes.
    looks = given == len(block.images) and not isinstance(context.settings.pairs, Similar)
    first, evidence = _evidence(context, first_pass.look(recipe, block) if looks else recipe)
    if recipe.replaces:
        context, first, evidence = _with_better_cameras(context, first, evidence)
    good = evidence.explained()
    if looks and recipe.replaces and not suffices(evidence, good):
        first, evidence = _evidence(context, recipe)
        good = evidence.explained()
    if not evidence.pairs or suffices(evidence, good):
        solution = from_given(evidence, good, correct=recipe.replaces)
        if not evidence.pairs and not given:
            solution.facts["remarks"].append(unoriented_remark(evidence))
    else:
        models, first, evidence = _mapped(context, recipe, first, evidence)
        contradicted = bool(models) and bool(models[0].figures["contradiction"])
        exchanged = exchanged_columns(block, models[0]) if contradicted else ""
        solution = from_models(evidence, models, _before(context, kept), context.angles, exchanged)
        if not models:
            solution.facts["remarks"].append(unoriented_remark(evidence))
        if not recipe.replaces:
            solution = judged(from_given(evidence, good, correct=False), solution)
    facts = {"images_matched": len(evidence.matched), "given_poses_explained": len(good), **solution.facts}
    facts["tied"] = [(pair.image_id0, pair.image_id1) for pair in evidence.pairs]
    facts["similar"] = list(first.block.similar)
    facts["failed"] = list(evidence.failed)
    terrains = solution.terrains
    old = _terrains(context, before) if kept else ()
    if len(old) == len(terrains):
        centers_m = np.array([pose.center_m for pose in solution.poses.values()])
        terrains = tuple(continued(one, new, centers_m) for one, new in zip(old, terrains, strict=True))
    return replace(solution, terrains=terrains, facts=facts)


def _with_better_cameras(context: Context, first: Context, evidence: Evidence) -> tuple[Context, Context, Evidence]:
    """All three with other focal lengths, where those given cannot be right."""
    block = evidence.block
    camera_ids = {image.image_id: image.camera_id for image in block.images}
    seen = evidence.pairs, block.poses, block.cameras, camera_ids, evidence.thresholds_px
    cameras = {**block.cameras, **better_cameras(*seen, context.likely_focals)}
    return (
        replace(context, block=replace(context.block, cameras=cameras)),
        replace(first, block=replace(first.block, cameras=cameras)),
        replace(evidence, block=replace(block, cameras=cameras)),
    )


def _mapped(
    context: Context, recipe: FirstPass, first: Context, evidence: Evidence
) -> tuple[tuple[Model, ...], Context, Evidence]:
    """Models of a first pass, and it; of one with more keypoints, where the block falls into parts, and of one whose
    pairs do not lean on positions, where these do not fit."""
    models = _sound_models(context, recipe, first, evidence)
    falls_apart = _oriented(models) < _WHOLE * len(context.block.images) <= len(evidence.matched)
    if falls_apart and recipe.replaces and (dearer := first_pass.thorough(recipe, first)) is not None:
        other, more = _evidence(context, dearer)
        again = _sound_models(context, dearer, other, more)
        if _oriented(again) > _oriented(models) and _images(again) >= _images(models):
            recipe, models, first, evidence = dearer, again, other, more
    if not context.block.poses or (models and not models[0].figures["contradiction"]):
        return models, first, evidence
    other, more = _evidence(context, recipe, by_position=False)
    if {(p.image_id0, p.image_id1) for p in other.pairs} <= {(p.image_id0, p.image_id1) for p in first.pairs}:
        return models, first, evidence
    again = _sound_models(context, recipe, other, more)
    better = _oriented(again) > _oriented(models)
    return (again, other, more) if better else (models, first, evidence)


def _sound_models(context: Context, recipe: FirstPass, first: Context, evidence: Evidence) -> tuple[Model, ...]:
    """Models that explain their matches, the largest first. What is left after one is mapped again by itself."""
    models: list[Model] = []
    left = evidence.matched
    for _ in range(_MAX_ROUNDS):
        found = _one_round(context, recipe, first, evidence, left)
        models += found
        left = left - {i for model in found for i in model.rotations}
        if not found or len(left) < FEWEST_IMAGES:
            break
    block = context.block
    camera_ids = {image.image_id: image.camera_id for image in block.images}
    return grown(models, evidence.pairs, camera_ids, block.cameras, evidence.thresholds_px, block.poses)


def _one_round(
    context: Context, recipe: FirstPass, first: Context, evidence: Evidence, image_ids: set[str]
) -> list[Model]:
    """Sound models of some images; by the other mapper where that finds more of them."""
    best: list[Model] = []
    for mapper in (recipe.mapper, *(name for name in MAPPERS if name != recipe.mapper)):
        mapped = _mapped_images(context, first, mapper, image_ids)
        found = _sound_parts(context, evidence, mapped)
        whole = _images(found) == _images(mapped)
        if not whole:  # what was cut off has bent the rest
            again = [_mapped_images(context, first, mapper, set(part.rotations))[:1] for part in found]
            found = _sound_parts(context, evidence, [model for models in again for model in models])
        best = found if _images(found) > _images(best) else best
        if found and whole:
            break
    return best


def _sound_parts(context: Context, evidence: Evidence, models: Sequence[Model]) -> list[Model]:
    """The models as far as they explain their matches, each image in the largest that has it."""
    found: list[Model] = []
    taken: set[str] = set()
    for model in sorted(models, key=lambda model: -len(model.rotations)):
        part = _sound(context, evidence, only(model, model.rotations.keys() - taken))
        if part is not None:
            found.append(part)
            taken |= part.rotations.keys()
    return found


def _sound(context: Context, evidence: Evidence, model: Model) -> Model | None:
    cameras = {**context.block.cameras, **model.cameras}
    of_images = {image.image_id: cameras[image.camera_id] for image in context.block.images}
    return sound_part(model, evidence.pairs, of_images, evidence.thresholds_px, context.block.poses)


def _mapped_images(context: Context, first: Context, mapper: Mapper, image_ids: set[str]) -> tuple[Model, ...]:
    """Models of the pairs of the first pass between some images."""
    pairs = tuple(pair for pair in first.pairs if {pair.image_id0, pair.image_id1} <= image_ids)
    with context.executor.step(f"first pass: {mapper} mapping of {len(image_ids)} images"):
        try:
            return map_block(contents_of(replace(first, pairs=pairs)), context.observed, mapper)
        except InputError as error:  # the other mapper may do, and matches are found without orientation, too
            log.warning("warning: %s", error)
            return ()


def _images(models: Sequence[Model]) -> int:
    """Images of all models."""
    return sum(len(model.rotations) for model in models)


def _oriented(models: Sequence[Model]) -> int:
    """Images of the largest model."""
    return max((len(model.rotations) for model in models), default=0)


def _evidence(context: Context, recipe: FirstPass, *, by_position: bool = True) -> tuple[Context, Evidence]:
    """The context of a first pass that has been run, and its verified matches."""
    first, failed = first_pass.run(first_pass.prepared(context, recipe), recipe, by_position=by_position)
    limit = first.settings.block.max_size_px
    sizes = {image.image_id: max(image.width_px, image.height_px) for image in context.block.images}
    pairs = list(first_pass.verified_points(first)) if first.pairs else []
    thresholds_px = {i: _EXACT_PX * max(1.0, size / limit) for i, size in sizes.items()}
    return first, Evidence(context.block, pairs, thresholds_px, context.given.cameras, failed)


def _before(context: Context, kept: set[str]) -> Before:
    if not kept:
        return Before({}, {})
    folder = context.workspace.orientation
    poses = read_poses(folder / "poses.csv")
    held = {i: pose for i, pose in poses.items() if i in kept and pose.world_rotation is not None}
    return Before(held, read_cameras(folder / "cameras.csv"))


def _prints(context: Context) -> tuple[dict[str, str], str]:
    """Fingerprints of what was given of every image, and of the settings: what the orientation depends on."""
    block, settings = context.block, context.settings
    images = {}
    for image in block.images:
        pose = block.poses.get(image.image_id)
        place = None if pose is None else (pose.center_m, pose.world_rotation, pose.sigma_position_m)
        taken = context.image_fingerprints[image.image_id], image.time
        images[image.image_id] = fingerprint(
            taken, image.camera_id, block.camera(image), place, context.angles.get(image.image_id),
            context.likely_focals.get(image.camera_id),
        )  # fmt: skip
    how: list[Any] = [settings.orient, settings.block.max_size_px, settings.block.masks]
    if isinstance(settings.pairs, Similar):
        how.append(settings.pairs)
    if first_pass.is_large(block):
        how.append(_LARGE_BLOCK_VERSION)
    return images, fingerprint(VERSION, library_version("pycolmap"), how, block.crs, block.origin_m)


def _on_file(context: Context) -> Mapping[str, Any]:
    """The record of an earlier run whose files are as they were written, else nothing."""
    return {} if context.overwrite else whole_record(context.workspace.orientation / "orientation.json", say=True)


def _write(context: Context, solution: Solution, head: Mapping[str, Any]) -> dict[str, Any]:
    folder = context.workspace.orientation
    path = folder / "orientation.json"
    with translated_os_errors(path):  # the record comes last: it vouches for the others
        path.unlink(missing_ok=True)
    write_text(folder / "cameras.csv", cameras_text(solution.cameras))
    write_text(folder / "poses.csv", poses_text(solution.poses))
    names = ["cameras.csv", "poses.csv"]
    for number, terrain in enumerate(solution.terrains, start=1):
        place = terrain.west_m, terrain.north_m, terrain.cell_m
        data = terrain_bytes(terrain.heights_m, *place, *_frame(context, solution.facts))
        names.append("terrain.tif" if number == 1 else f"terrain-{number}.tif")
        write_bytes(folder / names[-1], data)
    with translated_os_errors(folder):
        for old in set(folder.glob("terrain*.tif")) - {folder / name for name in names}:
            old.unlink(missing_ok=True)
    large = {key: solution.facts[key] for key in ("tied", "similar", "groups", "failed")}
    facts = {key: value for key, value in solution.facts.items() if key not in large}
    write_record(path, {**head, "facts": facts, **large}, names)
    return read_json(path)


def _terrains(context: Context, record: Mapping[str, Any]) -> tuple[Terrain, ...]:
    """Those on file, the largest flight's first. record: orientation.json."""
    names = sorted(
        (name for name in record.get("files", ()) if name.endswith(".tif")), key=lambda name: (len(name), name)
    )
    if not names:
        return ()
    origin_m, _ = _frame(context, record["facts"])
    return tuple(Terrain(*read_terrain(context.workspace.orientation / name, origin_m)) for name in names)


def _frame(context: Context, facts: Mapping[str, Any]) -> tuple[FloatArray, str]:
    """Origin and CRS of what the orientation has found."""
    own = facts["frame"] == "own"
    return (np.zeros(3), "local") if own else (np.array(context.block.origin_m), context.block.crs)
