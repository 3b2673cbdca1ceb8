"""orient: cameras, poses and terrain of the block, found once from a first pass, before the images are matched.

Where the given poses explain the matches of the first pass they are used as they are; else the block is oriented from
the pictures. Later stages read the result from the workspace's orientation folder and nothing else.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from aeromatch_cli.blocks.ground import DemGround
from aeromatch_cli.data import Block, Camera, FloatArray, Ground, Pose
from aeromatch_cli.formats.tables import cameras_text, poses_text, read_cameras, read_poses
from aeromatch_cli.formats.terrain import read_terrain, terrain_bytes
from aeromatch_cli.orientation.dem import Terrain, terrain_of
from aeromatch_cli.orientation.judgement import (
    PairPoints,
    attitude_errors_deg,
    explained_images,
    position_errors_m,
    triangulated,
)
from aeromatch_cli.orientation.mapping import Model, map_block
from aeromatch_cli.orientation.resection import resected
from aeromatch_cli.stages import first_pass
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.export import contents_of
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.stages.versions import library_version
from aeromatch_cli.strategies.orienters import FirstPass
from aeromatch_cli.workspace import (
    file_digest,
    fingerprint,
    read_json,
    write_atomically,
    write_json,
    write_text,
)

log = logging.getLogger("aeromatch")

VERSION = 1
# An exact match of the first pass lies this near its epipolar line, in pixels of its own reduced image.
_EXACT_PX = 3.0
# Standard deviations of poses from the pictures: of each angle, and of the position as a share of the flying height.
_SIGMA_ANGLE_DEG = 0.2
_SIGMA_POSITION_SHARE = 0.005
# Standard deviations of focal lengths, as a share: stated by EXIF or a file, and guessed.
_STATED_FOCAL, _GUESSED_FOCAL = 0.03, 0.4
# Beyond this a given attitude is wrong and not just inexact; and a position beyond so many standard deviations.
_WRONG_DEG = 30.0
_WRONG_SIGMAS = 5.0
# Given poses stay where they explain the matches of this share of the images: single others are corrected.
_MOST = 0.6


@dataclass(frozen=True, eq=False)
class Found:
    """What the first pass says: what differs from what was given, and facts for the report."""

    cameras: Mapping[str, Camera]
    poses: Mapping[str, Pose]
    terrain: Terrain | None
    facts: Mapping[str, Any]


def run(context: Context, *, dry: bool = False) -> tuple[Context, StageReport]:
    """The context with oriented cameras, poses and terrain. dry: only what is on file, nothing is made or written."""
    report = StageReport("orient", items=len(context.block.images))
    recipe = context.settings.orient
    if not isinstance(recipe, FirstPass):
        report.items = 0
        return context, report
    report.fingerprint = _fingerprint(context)
    folder = context.workspace.orientation
    record = _stored(context, report.fingerprint)
    if record is None and dry:
        return context, report
    if record is None:
        found = _found(context, recipe)
        record = _write(context, found, report.fingerprint)
        report.done = report.items
    else:
        report.skipped = report.items
    report.facts = record["facts"]
    poses = read_poses(folder / "poses.csv")
    ground, source = context.block.ground, context.block.ground_source
    if ground is None and (folder / "terrain.tif").is_file():
        ground, source = _terrain_ground(context), f"terrain from {record['facts']['points']} points of the first pass"
    block = replace(
        context.block,
        cameras=read_cameras(folder / "cameras.csv"),
        poses=poses,
        ground=ground,
        ground_source=source,
        tied=tuple((id0, id1) for id0, id1 in record["tied"]),
    )
    return replace(context, block=block), report if dry else report.write(context.workspace)


def _found(context: Context, recipe: FirstPass) -> Found:
    first = first_pass.prepared(context, recipe)
    if first.pairs:
        first_pass.run(first)
    block = context.block
    cameras = {image.image_id: block.camera(image) for image in block.images}
    pairs = list(first_pass.verified_points(first)) if first.pairs else []
    matched = {i for pair in pairs for i in (pair.image_id0, pair.image_id1)}
    good = explained_images(pairs, block.poses, cameras, _thresholds(first))
    facts: dict[str, Any] = {
        "images_matched": len(matched),
        "given_poses_explained": len(good),
        "tied": [(pair.image_id0, pair.image_id1) for pair in pairs],
    }
    if not matched or not recipe.replaces or len(good) >= _MOST * len(matched):
        return _kept(block, pairs, cameras, good, facts, _thresholds(first) if recipe.replaces else None)
    sigmas = {k: _GUESSED_FOCAL if k in context.guessed_cameras else _STATED_FOCAL for k in block.cameras}
    return _merged(block, map_block(contents_of(first), block.poses, sigmas, recipe.mapper), facts)


def _kept(
    block: Block,
    pairs: Sequence[PairPoints],
    cameras: Mapping[str, Camera],
    good: set[str],
    facts: dict[str, Any],
    thresholds_px: Mapping[str, float] | None,
) -> Found:
    """Given poses as they are, but for those that the matches contradict: these by resection (thresholds_px: not None).

    Images without matches keep what was given: nothing speaks against it.
    """
    poses = dict(block.poses)
    matched = {i for pair in pairs for i in (pair.image_id0, pair.image_id1)}
    found: dict[str, Pose] = {}
    if thresholds_px is not None:
        known = {i: poses[i] for i in sorted(good)}
        height_m = _height_m([pose.center_m for pose in known.values()], pairs, known, cameras)
        sigmas = (_SIGMA_POSITION_SHARE * height_m, _SIGMA_ANGLE_DEG)
        found = resected(pairs, known, cameras, thresholds_px, sigmas)
        for image_id in matched - good - found.keys():
            if image_id in poses:
                poses[image_id] = replace(poses[image_id], world_rotation=None)
        poses |= found
    points = np.concatenate([np.zeros((0, 3)), *triangulated(pairs, poses, cameras)])
    points = points[np.isfinite(points).all(axis=1)]
    judged = _judged(block.poses, found)
    facts |= {"method": "given", "corrected": sorted(found), "points": len(points), **judged}
    facts["outside"] = sorted(image.image_id for image in block.images if not _oriented(poses, image.image_id))
    return Found(block.cameras, poses, terrain_of(points, _area(poses)), facts)


def _height_m(
    centers_m: Sequence[FloatArray],
    pairs: Sequence[PairPoints],
    poses: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
) -> float:
    """Median flying height by the points of posed pairs, 1 where there are none."""
    points = np.concatenate([np.zeros((0, 3)), *triangulated(pairs, poses, cameras)])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points) or not centers_m:
        return 1.0
    return abs(float(np.median([center[2] for center in centers_m]) - np.median(points[:, 2])))


def _oriented(poses: Mapping[str, Pose], image_id: str) -> bool:
    return image_id in poses and poses[image_id].world_rotation is not None


def _judged(given: Mapping[str, Pose], found: Mapping[str, Pose]) -> dict[str, Any]:
    """Given attitudes and positions that those found contradict: image_id -> degrees, image_id -> metres."""
    angles = {i: round(error, 1) for i, error in attitude_errors_deg(given, found).items()}
    shifts = {i: round(error, 2) for i, error in position_errors_m(given, found).items()}
    far = {
        i: error
        for i, error in shifts.items()
        if error > _WRONG_SIGMAS * (given[i].sigma_position_m + found[i].sigma_position_m)
    }
    return {
        "wrong_attitudes": {i: error for i, error in sorted(angles.items()) if error > _WRONG_DEG},
        "wrong_positions": dict(sorted(far.items())),
    }


def _thresholds(first: Context) -> dict[str, float]:
    """image_id -> error of an exact match in stored pixels: reduced pictures are coarser."""
    limit = first.settings.block.max_size_px
    return {i.image_id: _EXACT_PX * max(1.0, max(i.width_px, i.height_px) / limit) for i in first.block.images}


def _merged(block: Block, models: Sequence[Model], facts: dict[str, Any]) -> Found:
    """Given poses and cameras, replaced by what the models say."""
    poses, cameras = dict(block.poses), dict(block.cameras)
    points = [np.zeros((0, 3))]
    found: dict[str, Pose] = {}
    offset = np.zeros(3)
    for model in reversed(models):  # the largest model's cameras count
        shift = np.zeros(3)
        if model.kind == "level":
            # Groups that nothing ties to the world or to each other lie side by side.
            xyz = np.array(list(model.centers_m.values()))
            shift = offset - [xyz[:, 0].min(), 0.0, 0.0]
            offset[0] += 2.0 * float(np.ptp(xyz[:, 0])) + 1000.0
        height = float(np.median([c[2] for c in model.centers_m.values()]) - np.median(model.points_m[:, 2]))
        sigma_m = _SIGMA_POSITION_SHARE * abs(height)
        for image_id, rotation in model.rotations.items():
            found[image_id] = Pose(model.centers_m[image_id] + shift, rotation, sigma_m, _SIGMA_ANGLE_DEG)
        cameras |= model.cameras
        points.append(model.points_m[model.track_lengths >= 3] + shift)
    for image_id in block.poses.keys() - found.keys():
        # An attitude that nothing confirms in a block where others were wrong is not relied on.
        poses[image_id] = replace(poses[image_id], world_rotation=None)
    poses |= found
    facts |= {
        "method": "pictures",
        "models": [dict(model.figures) | {"kind": model.kind} for model in models],
        "points": sum(len(p) for p in points),
        **_judged(block.poses, found),
        "outside": sorted(image.image_id for image in block.images if image.image_id not in found),
    }
    return Found(cameras, poses, terrain_of(np.concatenate(points), _area(poses)), facts)


def _area(poses: Mapping[str, Pose]) -> FloatArray:
    return np.array([pose.center_m[:2] for pose in poses.values()]).reshape(-1, 2)


def _fingerprint(context: Context) -> str:
    block = context.block
    images = [(i.image_id, context.image_fingerprints[i.image_id], i.camera_id, i.time) for i in block.images]
    poses = [(k, p.center_m, p.world_rotation, p.sigma_position_m) for k, p in sorted(block.poses.items())]
    settings = context.settings
    return fingerprint(
        VERSION,
        library_version("pycolmap"),
        settings.orient,
        settings.block.max_size_px,
        settings.block.masks,
        settings.seed,
        images,
        sorted(block.cameras.items()),
        poses,
        block.crs,
    )


def _stored(context: Context, wanted: str) -> dict[str, Any] | None:
    """The record on file, if it is of these inputs and its files are as they were written."""
    folder = context.workspace.orientation
    path = folder / "orientation.json"
    if context.overwrite or not path.is_file():
        return None
    record = read_json(path)
    if record.get("fingerprint") != wanted:
        return None
    whole = all((folder / n).is_file() and file_digest(folder / n) == d for n, d in record["files"].items())
    return record if whole else None


def _write(context: Context, found: Found, wanted: str) -> dict[str, Any]:
    folder = context.workspace.orientation
    (folder / "orientation.json").unlink(missing_ok=True)
    write_text(folder / "cameras.csv", cameras_text(found.cameras))
    write_text(folder / "poses.csv", poses_text(found.poses))
    names = ["cameras.csv", "poses.csv"]
    terrain = found.terrain
    if terrain is not None:
        origin_m = np.array(context.block.origin_m)
        place = terrain.west_m, terrain.north_m, terrain.cell_m
        data = terrain_bytes(terrain.heights_m, *place, origin_m, context.block.crs)
        write_atomically(folder / "terrain.tif", lambda stream: stream.write(data))
        names.append("terrain.tif")
    else:
        (folder / "terrain.tif").unlink(missing_ok=True)
    facts = {key: value for key, value in found.facts.items() if key != "tied"}
    files = {name: file_digest(folder / name) for name in names}
    record = {"fingerprint": wanted, "facts": facts, "tied": found.facts["tied"], "files": files}
    write_json(folder / "orientation.json", record)
    return read_json(folder / "orientation.json")


def _terrain_ground(context: Context) -> Ground:
    heights, west, north, cell = read_terrain(
        context.workspace.orientation / "terrain.tif", np.array(context.block.origin_m)
    )
    return DemGround(heights, west, north, (cell, cell), float(np.median(heights)))
