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

from aeromatch_cli.blocks.auto_ground import auto_ground, choose_adjacent_pairs
from aeromatch_cli.blocks.crs import WorldFrame
from aeromatch_cli.blocks.exif import ExifFacts, exif_or_reason
from aeromatch_cli.blocks.ground import ConstantGround, open_dem
from aeromatch_cli.blocks.read import BlockInputs, read_block_inputs
from aeromatch_cli.config import Settings
from aeromatch_cli.data import Block, Camera, FloatArray, Ground, Image, Pair, PairGeometry, Pose
from aeromatch_cli.errors import ConfigError, ItemError
from aeromatch_cli.executor import Executor
from aeromatch_cli.geometry.footprints import block_footprints, common_gsd_m
from aeromatch_cli.geometry.frames import apply_homography, resize_matrix
from aeromatch_cli.images import mask_path, read_pixels, shrink
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.sift import Sift
from aeromatch_cli.strategies.matchers.nearest import Nearest
from aeromatch_cli.strategies.simulators.none import source_view
from aeromatch_cli.workspace import FORMAT_VERSION, Workspace, fingerprint, image_fingerprint, read_json

log = logging.getLogger("aeromatch")

# Automatic ground: this many seeds, images reduced to this longer side. Height needs far less than tie points do.
_GROUND_SEEDS = 5
_GROUND_SIZE_PX = 1200
_GROUND_KEYPOINTS = 2000
# A height that could not be found is not looked for again before the images, poses or settings change.
_UNKNOWN = "unknown"
# What was fixed holds until it is off by this share of the ground sampling distance, or of the flying height.
_GSD_TOLERANCE = 0.1
_GROUND_TOLERANCE = 0.05


@dataclass(frozen=True, eq=False)
class Assembled:
    """A block with what was learnt on the way. record: contents of block.json."""

    block: Block
    image_fingerprints: Mapping[str, str]
    guessed_cameras: frozenset[str]
    warnings: tuple[str, ...]
    failures: tuple[tuple[str, str], ...]
    record: Mapping[str, Any]


def assemble(settings: Settings, workspace: Workspace, executor: Executor) -> Assembled:
    """Read the inputs and resolve the ground. Raises ConfigError or InputError where nothing can be started."""
    if not settings.block.images:
        raise ConfigError("no images: give --images DIR, or block.images in the configuration")
    _check_folders(settings, workspace)
    before = read_json(workspace.block) if workspace.block.is_file() else {}
    inputs, prints = _read_inputs(settings, workspace, executor, before)
    basis = {i.image_id: _basis_print(inputs, i, prints[i.image_id]) for i in inputs.images}
    wanted = fingerprint(_ground_print(settings), settings.block.crs, inputs.crs, inputs.ground_hint_z_m)
    kept = before.get("ground_fingerprint") == wanted
    same = all(basis.get(image_id) == value for image_id, value in before.get("basis", {}).items())
    warnings = [*inputs.warnings, *_mask_warnings(settings, inputs.images)]
    ground, source = _stored_ground(before) if kept and same else (None, "")
    if ground is None and not source.startswith(_UNKNOWN):
        ground, source, remarks = _resolve_ground(settings, inputs, executor)
        warnings += remarks
    if source.startswith(_UNKNOWN) and inputs.poses:
        warnings.append(f"the ground height is {source}; no ground views, no overlap; give --ground METRES or a DEM")
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
    return Assembled(
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
    prints: dict[Path, str] = {}
    given = settings.block

    def read_facts(paths: Sequence[Path]) -> list[ExifFacts | str]:
        outcomes = executor.run(_read_header, paths, "read")
        facts: list[ExifFacts | str] = []
        for path, outcome in zip(paths, outcomes, strict=True):
            if outcome.value is None:
                facts.append(outcome.error)
            else:
                fact, prints[path] = outcome.value
                facts.append(fact)
        return facts

    # The origin of an earlier run is kept, unless the user now asks for another CRS.
    same_crs = before and given.crs in ("auto", before["crs"])
    frame = WorldFrame(before["crs"], tuple(before["origin_m"])) if same_crs else None
    inputs = read_block_inputs(
        Path(given.images),
        None if given.poses == "none" else given.poses,
        given.cameras,
        given.crs,
        given.angles,
        sigma_position_m=given.sigma_position_m,
        sigma_angle_deg=given.sigma_angle_deg,
        known_frame=frame,
        read_facts=read_facts,
        exclude=[workspace.root, *([Path(given.masks)] if given.masks else [])],
    )
    return inputs, {image.image_id: prints[Path(given.images) / image.name] for image in inputs.images}


def _read_header(path: Path) -> tuple[ExifFacts | str, str]:
    try:
        return exif_or_reason(path), image_fingerprint(path)
    except OSError as error:
        raise ItemError(f"cannot be read ({error.strerror or error}): was it moved or deleted?") from None


def _ground_print(settings: Settings) -> str:
    """The ground setting; of a DEM also its content, since it may be replaced in place."""
    text = settings.block.ground
    return f"{text} {image_fingerprint(Path(text))}" if Path(text).is_file() else text


def _basis_print(inputs: BlockInputs, image: Image, image_print: str) -> str:
    pose = inputs.poses.get(image.image_id)
    place = None if pose is None else (pose.center_m, pose.world_rotation)
    return fingerprint(image_print, inputs.cameras[image.camera_id], place)


def _stored_ground(record: Mapping[str, Any]) -> tuple[Ground | None, str]:
    z_m = record["ground_z_m"]
    return (None if z_m is None else ConstantGround(float(z_m))), str(record["ground_source"])


def _resolve_ground(
    settings: Settings, inputs: BlockInputs, executor: Executor
) -> tuple[Ground | None, str, tuple[str, ...]]:
    """The ground, where it comes from in words, and remarks."""
    text = settings.block.ground
    try:
        return ConstantGround(float(text) - inputs.origin_m[2]), f"given: {float(text):g} m", ()
    except ValueError:
        pass
    if text != "auto":
        positions = np.array([pose.center_m for pose in inputs.poses.values()]).reshape(-1, 3)
        dem, remarks = open_dem(Path(text), inputs.crs, inputs.origin_m, positions)
        return dem, f"DEM {text}", remarks
    if inputs.ground_hint_z_m is not None and inputs.ground_is_stated:
        return ConstantGround(inputs.ground_hint_z_m), inputs.ground_hint_source, ()
    estimate_z_m, reason = _triangulated(settings, inputs, executor)
    if estimate_z_m is not None:
        return ConstantGround(estimate_z_m), reason, ()
    if inputs.ground_hint_z_m is not None:
        return ConstantGround(inputs.ground_hint_z_m), inputs.ground_hint_source, ()
    return None, f"{_UNKNOWN}: {reason if inputs.poses else 'no poses'}", ()


@dataclass(frozen=True, eq=False)
class _GroundTask:
    """One adjacent pair to match at reduced size; mapped back to stored pixels."""

    paths: tuple[Path, Path]
    cameras: tuple[Camera, Camera]


def _triangulated(settings: Settings, inputs: BlockInputs, executor: Executor) -> tuple[float | None, str]:
    posed: dict[str, Pose] = {i: p for i, p in inputs.poses.items() if p.world_rotation is not None}
    pairs = choose_adjacent_pairs(posed, _GROUND_SEEDS)
    if not pairs:
        return None, "no two images with attitude"
    by_id = {image.image_id: image for image in inputs.images}
    root = Path(settings.block.images)
    cameras = {image_id: inputs.cameras[by_id[image_id].camera_id] for image_id in posed}
    tasks = [_GroundTask((root / by_id[a].name, root / by_id[b].name), (cameras[a], cameras[b])) for a, b in pairs]
    outcomes = executor.run(_match_reduced, tasks, "ground")
    nothing = (np.zeros((0, 2)), np.zeros((0, 2)))
    matched = {p: nothing if o.value is None else o.value for p, o in zip(pairs, outcomes, strict=True)}
    estimate = auto_ground(pairs, posed, cameras, lambda id0, id1: matched[id0, id1])
    return estimate.z_m, estimate.reason


def _match_reduced(task: _GroundTask) -> tuple[FloatArray, FloatArray]:
    """Matched stored-pixel points (N, 2) of two images, at reduced size."""
    features, scales = [], []
    for path, camera in zip(task.paths, task.cameras, strict=True):
        gray = read_pixels(path, colour=False)
        scale = min(1.0, _GROUND_SIZE_PX / max(gray.shape))
        view = source_view(camera)
        features.append(Sift(keypoints=_GROUND_KEYPOINTS)(camera, [ViewPixels(view, shrink(gray, scale), None)]))
        scales.append(scale)
    pair = Pair("0", "1", float("nan"), float("nan"), "ground")
    geometry = PairGeometry(pair, task.cameras[0], task.cameras[1], None, None, None)
    matches = Nearest()(features[0], features[1], geometry)
    points = [
        apply_homography(np.linalg.inv(resize_matrix(scale)), f.keypoints_px[matches.indices[:, side]])
        for side, (f, scale) in enumerate(zip(features, scales, strict=True))
    ]
    return points[0], points[1]
