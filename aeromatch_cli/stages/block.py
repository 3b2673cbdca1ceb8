"""This module turns settings into a `Block` as it is given: inputs read in parallel, stated ground, what was fixed
before kept.

The world origin and the common ground sampling distance are fixed when a workspace is made, as image ids are: images
that come later must not change the views of all others. The latter is fixed anew when it would now come out clearly
different: one corrected pose must not re-do the block, a corrected pose list must.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from aeromatch_cli.blocks.control import read_control
from aeromatch_cli.blocks.control_files import opened_survey
from aeromatch_cli.blocks.crs import AUTO, WorldFrame, checked_crs, checked_heights, world_crs
from aeromatch_cli.blocks.doubles import doubles
from aeromatch_cli.blocks.exif import ExifFacts, exif_or_reason
from aeromatch_cli.blocks.ground import ConstantGround
from aeromatch_cli.blocks.other_files import MASK
from aeromatch_cli.blocks.read import BlockInputs, GivenHeights, block_inputs, read_lists
from aeromatch_cli.blocks.scan import scan_files, scan_images
from aeromatch_cli.config import Settings
from aeromatch_cli.data import Block, Ground, Image
from aeromatch_cli.errors import BrokenFileError, ConfigError, ItemError, WorkspaceError
from aeromatch_cli.executor import Executor, Outcome
from aeromatch_cli.files import read_json
from aeromatch_cli.fingerprints import contents_digest, picture_fingerprint, program_digest
from aeromatch_cli.formats.tables import read_picture_quality
from aeromatch_cli.geometry.footprints import block_footprints, common_gsd_m
from aeromatch_cli.images.masks import mask_path
from aeromatch_cli.images.remote import RemoteFile, is_remote, list_remote, on_disk
from aeromatch_cli.images.scaling import scale_within
from aeromatch_cli.stages.context import Given
from aeromatch_cli.stages.ground import check_ground, given_ground, ground_fingerprint
from aeromatch_cli.store.index import Index
from aeromatch_cli.workspace import FORMAT_VERSION, Workspace

log = logging.getLogger("aeromatch")

# What was fixed holds until it is off by this share.
_GSD_TOLERANCE = 0.1


@dataclass(frozen=True, eq=False)
class BlockRead:
    """A block as it is given, with what was learnt on the way.

    recognised, unread: as in `read.BlockInputs`. urgent: warnings that are said even where quiet
    is asked for: of pictures that are not read, and of control points none of which is used. gsd_before_m: gsd_m and
    reduced_gsd_m that the workspace had, or None.
    ground_hint: the ground below relative altitudes, and its source.
    """

    given: Given
    warnings: tuple[str, ...]
    failures: tuple[tuple[str, str], ...]
    unread: tuple[tuple[str, str], ...]
    urgent: frozenset[str]
    recognised: str
    gsd_before_m: tuple[float | None, float | None]
    ground_hint: tuple[Ground, str] | None


def read_block(settings: Settings, workspace: Workspace, executor: Executor, index: Index) -> BlockRead:
    """Read the inputs and the stated ground. index: what is known of pictures that have not changed. Raises ConfigError
    or InputError where nothing can be started."""
    if not settings.block.images:
        raise ConfigError("no images: give --images DIR, or block.images in the configuration")
    _check_given(settings, workspace)
    before = read_json(workspace.block) if workspace.block.is_file() else {}
    inputs, prints, touched, remote = _read_inputs(settings, workspace, executor, index, before)
    ground, source, remarks = given_ground(settings, inputs)
    control, absent = read_control(
        settings.block.gcp,
        inputs.images,
        inputs.crs,
        inputs.origin_m,
        marks=settings.block.gcp_marks,
        poses=inputs.poses,
        use=settings.block.gcp_use,
        heights=inputs.heights,
        usual_crs=settings.block.crs,
    )
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
    return BlockRead(
        given=Given(
            block=block,
            image_fingerprints=prints,
            touched=touched,
            focal_sigmas=inputs.focal_sigmas,
            likely_focals=inputs.likely_focals,
            angles=inputs.angles,
            flights=inputs.flights,
            velocities=inputs.velocities,
            control=control,
            remote=remote,
        ),
        warnings=(*inputs.warnings, *_mask_warnings(settings, inputs.images), *remarks, *absent),
        failures=tuple((failure.name, failure.reason) for failure in inputs.failures),
        unread=tuple((one.name, one.reason) for one in inputs.unread),
        urgent=frozenset(
            [
                *(line for line in inputs.warnings if any(line.endswith(one.reason) for one in inputs.unread)),
                *(absent if not control else ()),
            ]
        ),
        recognised=inputs.recognised,
        gsd_before_m=(before.get("gsd_m"), before.get("reduced_gsd_m"))
        if before.get("ground_fingerprint") == ground_fingerprint(settings)
        else (None, None),
        ground_hint=None
        if inputs.ground_hint_z_m is None or inputs.ground_is_stated
        else (ConstantGround(inputs.ground_hint_z_m), inputs.ground_hint_source),
    )


def with_gsd(block: Block, before_m: tuple[float | None, float | None], max_size_px: int) -> Block:
    """Return the block with its common ground sampling distances: those that the workspace had, while they still fit.

    before_m: of the images, and of reduced ones. max_size_px: longer side to which images are reduced, 0 for never.
    """
    footprints = block_footprints(block)
    scales = {i.image_id: scale_within(max_size_px, i.width_px, i.height_px) for i in block.images}
    gsd_m = _while_it_fits(common_gsd_m(footprints), before_m[0])
    reduced = any(scales[image_id] < 1.0 for image_id in footprints)
    reduced_gsd_m = _while_it_fits(common_gsd_m(footprints, scales), before_m[1]) if reduced else None
    return replace(block, gsd_m=gsd_m, reduced_gsd_m=reduced_gsd_m)


def _while_it_fits(gsd_m: float | None, before_m: float | None) -> float | None:
    fits = gsd_m and before_m and abs(gsd_m / before_m - 1.0) < _GSD_TOLERANCE
    return before_m if fits else gsd_m


def block_record(block: Block, given: Block, settings: Settings) -> dict[str, Any]:
    """Return the contents of block.json. given: the block before it was oriented."""
    return {
        "format_version": FORMAT_VERSION,
        "crs": block.crs,
        "origin_m": list(block.origin_m),
        "metric": block.metric,
        "frames": dict(sorted(block.frames.items())),
        "given_crs": given.crs,
        "given_origin_m": list(given.origin_m),
        "ground_source": block.ground_source,
        "ground_z_m": block.ground.z_m if isinstance(block.ground, ConstantGround) else None,
        "gsd_m": block.gsd_m,
        "reduced_gsd_m": block.reduced_gsd_m,
        "ground_fingerprint": ground_fingerprint(settings),
    }


def _check_given(settings: Settings, workspace: Workspace) -> None:
    """Raise ConfigError for what is wrong whatever the images are: before thousands of them are read."""
    given = settings.block
    if not _is_auto(given.crs):
        checked_crs(world_crs(given.crs))
    if not _is_auto(given.heights):
        checked_heights(given.heights)
    check_ground(given.ground)
    if given.gcp:
        opened_survey(Path(given.gcp))
    if given.gcp_marks:
        opened_survey(Path(given.gcp_marks), marks=True)
    if given.masks and not (Path(given.masks).is_dir() or Path(given.masks).is_file()):
        what = "are neither a folder nor a file" if Path(given.masks).exists() else "do not exist"
        raise ConfigError(f"masks {given.masks} {what}: give a folder of masks, or one mask, with --masks")
    if Path(given.images).resolve() == workspace.root.resolve():
        raise ConfigError(
            f"the workspace is the images folder {given.images}: its pictures would be taken for images; "
            "choose another --workspace"
        )


def _mask_warnings(settings: Settings, images: Sequence[Image]) -> list[str]:
    """Say what is wrong with the masks. Raises as `mask_path`."""
    masks = settings.block.masks
    found = [mask_path(masks, image.name) for image in images]
    if not masks or any(found):
        return []
    name = images[0].name
    return [f"no mask in {masks} belongs to an image: the mask of {name} would be {name}.png"]


def _read_inputs(
    settings: Settings, workspace: Workspace, executor: Executor, index: Index, before: Mapping[str, Any]
) -> tuple[BlockInputs, dict[str, str], dict[str, str], dict[str, RemoteFile]]:
    """Inputs; by image_id the fingerprint of every image, and the present one of those that were only touched; by name
    those that lie elsewhere."""
    given, root = settings.block, Path(settings.block.images)
    poses = "" if given.poses == "none" else given.poses
    lists = read_lists(poses, given.cameras, given.angles, given.pose_format, given.crs)
    remote: dict[str, RemoteFile] = {}
    if is_remote(given.images):
        with executor.step("list"):
            remote = list_remote(given.images)
        names, passed_over = scan_files({name: file.size_bytes for name, file in remote.items()})
    else:
        masks = [Path(given.masks)] if given.masks else []
        names, passed_over = scan_images(root, [workspace.root, *masks])
    if given.masks and Path(given.masks).resolve() == root.resolve():
        passed_over = [one for one in passed_over if one.reason != MASK]
    pictures = [remote.get(name) or root / name for name in names]
    outcomes = dict(zip(names, _headers(pictures, executor, index), strict=True))
    for name, outcome in outcomes.items():
        if outcome.lost:  # without the image it would be another block, whose origin later runs would keep
            raise WorkspaceError(f"the header of {name} could not be read: {outcome.error}; run the same command again")
    # The origin of an earlier run is kept, unless the user now asks for another CRS.
    frame = WorldFrame(before["given_crs"], tuple(before["given_origin_m"])) if "given_crs" in before else None
    read = partial(
        block_inputs,
        given.images,
        lists,
        {name: outcome.value[0] if outcome.value else outcome.error for name, outcome in outcomes.items()},
        passed_over,
        crs=world_crs(given.crs),
        sigma_position_m=given.sigma_position_m,
        sigma_angle_deg=given.sigma_angle_deg,
        known_frame=frame if frame is not None and _same_crs(given.crs, frame.crs) else None,
        exclude=given.exclude,
        drop_ground_shots=given.ground_shots == "drop",
        given_heights=GivenHeights(given.heights, given.height_shift_m),
    )
    inputs = read()
    # Of copies the one that has a pose is kept: a pose file may name only one of them.
    posed_first = sorted(inputs.images, key=lambda image: image.image_id not in inputs.poses)
    if copies := doubles({one.name: on_disk(remote.get(one.name) or root / one.name) for one in posed_first}):
        inputs = read(copies=copies)
    prints = {name: outcome.value[1] for name, outcome in outcomes.items() if outcome.value}
    found = {image.image_id: prints[image.name] for image in inputs.images}
    places = {image.image_id: remote.get(image.name) or root / image.name for image in inputs.images}
    before_touched = _of_touched(workspace, found, places, executor)
    return inputs, found | before_touched, {i: found[i] for i in before_touched}, remote


def _of_touched(
    workspace: Workspace, found: Mapping[str, str], places: Mapping[str, Path | RemoteFile], executor: Executor
) -> dict[str, str]:
    """The fingerprints that pictures had before, where nothing but the time of their file has changed. found: those of
    now, by image_id."""
    try:
        before = read_picture_quality(workspace.images) if workspace.images.is_file() else {}
    except BrokenFileError:
        return {}
    known = {i: (mark, quality.sha256) for (i, mark), quality in before.items() if i in found and quality.sha256}
    changed = [i for i, (mark, _) in known.items() if mark != found[i]]
    digests = executor.run(_digest, [places[i] for i in changed], "compare") if changed else []
    return {i: known[i][0] for i, one in zip(changed, digests, strict=True) if one.value == known[i][1]}


def _digest(picture: Path | RemoteFile) -> str:
    path = on_disk(picture)
    try:
        return contents_digest(path)
    except OSError as error:
        raise ItemError(f"cannot be read ({error.strerror or error})") from None


def _same_crs(given: str, known: str) -> bool:
    """Whether the user asks for no other CRS than the one of an earlier run."""
    return _is_auto(given) or checked_crs(world_crs(given)) == known


def _is_auto(given: str) -> bool:
    return given.strip().lower() in ("", AUTO)


_Header = tuple[ExifFacts | str, str]


def _headers(pictures: Sequence[Path | RemoteFile], executor: Executor, index: Index) -> list[Outcome[_Header]]:
    """Read what the headers of pictures say, of those that have changed since the index was told."""
    what, kind = f"header {program_digest()}", TypeAdapter(_Header)
    found: dict[int, Outcome[_Header]] = {}
    for place, picture in enumerate(pictures):
        if isinstance(picture, Path):
            with suppress(OSError):  # is told of by those who read it
                known = index.get(what, picture.absolute())
                if known is not None:
                    found[place] = Outcome(kind.validate_python(known))
    todo = [place for place in range(len(pictures)) if place not in found]
    for place, outcome in zip(todo, executor.run(_read_header, [pictures[i] for i in todo], "read"), strict=True):
        found[place], picture = outcome, pictures[place]
        if outcome.value is not None and isinstance(picture, Path):
            with suppress(OSError):
                index.put(what, picture.absolute(), kind.dump_python(outcome.value))
    return [found[place] for place in range(len(pictures))]


def _read_header(picture: Path | RemoteFile) -> _Header:
    """Return what an image's header says, or why it is unusable, and the fingerprint of the file."""
    path = on_disk(picture)
    try:
        return exif_or_reason(path), picture_fingerprint(path)
    except OSError as error:
        raise ItemError(f"cannot be read ({error.strerror or error}): was it moved or deleted?") from None
