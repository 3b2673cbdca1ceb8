"""From settings to a `Block`: inputs read in parallel, ground resolved, what was fixed before kept.

The world origin, the ground height and the common ground sampling distance are fixed when a workspace is made, as
image ids are: images that come later must not change the views of all others. They are fixed anew when the settings
that they come from change, or when images that they were computed from have changed or gone and they would now come
out clearly different: one corrected pose must not re-do the block, a corrected pose list must.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.blocks.crs import WorldFrame
from aeromatch_cli.blocks.exif import ExifFacts, exif_or_reason
from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.blocks.read import BlockInputs, block_inputs, read_lists
from aeromatch_cli.blocks.scan import scan_images
from aeromatch_cli.config import Settings
from aeromatch_cli.data import Block, Ground, Image
from aeromatch_cli.errors import ConfigError, ItemError
from aeromatch_cli.executor import Executor
from aeromatch_cli.geometry.footprints import block_footprints, common_gsd_m
from aeromatch_cli.images.masks import mask_path
from aeromatch_cli.stages.ground import UNKNOWN, find_ground, ground_fingerprint
from aeromatch_cli.workspace import FORMAT_VERSION, Workspace, fingerprint, image_fingerprint, read_json

log = logging.getLogger("aeromatch")

# What was fixed holds until it is off by this share of the ground sampling distance, or of the flying height.
_GSD_TOLERANCE = 0.1
_GROUND_TOLERANCE = 0.05


@dataclass(frozen=True, eq=False)
class BlockRead:
    """A block with what was learnt on the way. record: contents of block.json."""

    block: Block
    image_fingerprints: Mapping[str, str]
    guessed_cameras: frozenset[str]
    warnings: tuple[str, ...]
    failures: tuple[tuple[str, str], ...]
    record: Mapping[str, Any]


def read_block(settings: Settings, workspace: Workspace, executor: Executor) -> BlockRead:
    """Read the inputs and resolve the ground. Raises ConfigError or InputError where nothing can be started."""
    if not settings.block.images:
        raise ConfigError("no images: give --images DIR, or block.images in the configuration")
    _check_folders(settings, workspace)
    before = read_json(workspace.block) if workspace.block.is_file() else {}
    inputs, prints = _read_inputs(settings, workspace, executor, before)
    basis = {i.image_id: _basis_print(inputs, i, prints[i.image_id]) for i in inputs.images}
    wanted = fingerprint(ground_fingerprint(settings), settings.block.crs, inputs.crs, inputs.ground_hint_z_m)
    kept = before.get("ground_fingerprint") == wanted
    same = all(basis.get(image_id) == value for image_id, value in before.get("basis", {}).items())
    warnings = [*inputs.warnings, *_mask_warnings(settings, inputs.images)]
    ground, source = _stored_ground(before) if kept and same else (None, "")
    if ground is None and not source.startswith(UNKNOWN):
        ground, source, remarks = find_ground(settings, inputs, executor)
        warnings += remarks
    if source.startswith(UNKNOWN) and inputs.poses:
        attitudes = any(pose.world_rotation is not None for pose in inputs.poses.values())
        remedy = "give --ground METRES or a DEM" if attitudes else "give attitudes with --poses"
        warnings.append(f"the ground height is {source}; no ground views, no overlap; {remedy}")
    if kept and not same:
        ground, source = _nearly_stored(before, ground, source, inputs)
    block = Block(
        images=inputs.images,
        cameras=inputs.cameras,
        poses=inputs.poses,
        crs=inputs.crs,
        origin_m=inputs.origin_m,
        ground=ground,
        ground_source=source,
        gsd_m=None,
    )
    gsd_m = before["gsd_m"] if kept and same else common_gsd_m(block_footprints(block))
    if kept and not same and gsd_m and before["gsd_m"] and abs(gsd_m / before["gsd_m"] - 1.0) < _GSD_TOLERANCE:
        gsd_m = before["gsd_m"]
    record = {
        "format_version": FORMAT_VERSION,
        "crs": inputs.crs,
        "origin_m": list(inputs.origin_m),
        "ground_source": source,
        "ground_z_m": ground.z_m if isinstance(ground, ConstantGround) else None,
        "gsd_m": gsd_m,
        "ground_fingerprint": wanted,
        "basis": before["basis"] if kept and same else basis,
    }
    return BlockRead(
        block=replace(block, gsd_m=gsd_m),
        image_fingerprints=prints,
        guessed_cameras=inputs.guessed_cameras,
        warnings=tuple(warnings),
        failures=tuple((failure.name, failure.reason) for failure in inputs.failures),
        record=record,
    )


def _check_folders(settings: Settings, workspace: Workspace) -> None:
    given = settings.block
    if given.masks and not Path(given.masks).exists():
        raise ConfigError(f"masks {given.masks} do not exist: give a folder of masks, or one mask, with --masks")
    if Path(given.images).resolve() == workspace.root.resolve():
        raise ConfigError(
            f"the workspace is the images folder {given.images}: its pictures would be taken for images; "
            "choose another --workspace"
        )


def _mask_warnings(settings: Settings, images: Sequence[Image]) -> list[str]:
    masks = settings.block.masks
    if not masks or any(mask_path(masks, image.name) for image in images):
        return []
    name = images[0].name
    return [f"no mask in {masks} belongs to an image: the mask of {name} would be {name}.png"]


def _nearly_stored(
    before: Mapping[str, Any], ground: Ground | None, source: str, inputs: BlockInputs
) -> tuple[Ground | None, str]:
    """The stored height where the new one is the same up to a small share of the flying height."""
    stored, stored_source = _stored_ground(before)
    if not isinstance(ground, ConstantGround) or not isinstance(stored, ConstantGround) or not inputs.poses:
        return ground, source
    height_m = float(np.median([pose.center_m[2] for pose in inputs.poses.values()])) - stored.z_m
    if abs(ground.z_m - stored.z_m) > _GROUND_TOLERANCE * abs(height_m):
        return ground, source
    return stored, stored_source


def _read_inputs(
    settings: Settings, workspace: Workspace, executor: Executor, before: Mapping[str, Any]
) -> tuple[BlockInputs, dict[str, str]]:
    """Inputs, and the fingerprint of every image by image_id."""
    given, root = settings.block, Path(settings.block.images)
    lists = read_lists("" if given.poses == "none" else given.poses, given.cameras, given.angles)
    names, passed_over = scan_images(root, [workspace.root, *([Path(given.masks)] if given.masks else [])])
    outcomes = dict(zip(names, executor.run(_read_header, [root / name for name in names], "read"), strict=True))
    # The origin of an earlier run is kept, unless the user now asks for another CRS.
    same_crs = before and given.crs in ("auto", before["crs"])
    inputs = block_inputs(
        root,
        lists,
        {name: outcome.value[0] if outcome.value else outcome.error for name, outcome in outcomes.items()},
        passed_over,
        crs=given.crs,
        sigma_position_m=given.sigma_position_m,
        sigma_angle_deg=given.sigma_angle_deg,
        known_frame=WorldFrame(before["crs"], tuple(before["origin_m"])) if same_crs else None,
    )
    prints = {name: outcome.value[1] for name, outcome in outcomes.items() if outcome.value}
    return inputs, {image.image_id: prints[image.name] for image in inputs.images}


def _read_header(path: Path) -> tuple[ExifFacts | str, str]:
    """What a picture's header says, or why it is unusable, and the fingerprint of the file."""
    try:
        return exif_or_reason(path), image_fingerprint(path)
    except OSError as error:
        raise ItemError(f"cannot be read ({error.strerror or error}): was it moved or deleted?") from None


def _basis_print(inputs: BlockInputs, image: Image, image_print: str) -> str:
    pose = inputs.poses.get(image.image_id)
    place = None if pose is None else (pose.center_m, pose.world_rotation)
    return fingerprint(image_print, inputs.cameras[image.camera_id], place)


def _stored_ground(record: Mapping[str, Any]) -> tuple[Ground | None, str]:
    z_m = record["ground_z_m"]
    return (None if z_m is None else ConstantGround(float(z_m))), str(record["ground_source"])
