"""adjust: the bundle adjustment of the verified matches, from the orientation that the first pass gave.

Poses, cameras and points go to the workspace's orientation folder, for the exporters and for people.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from aeromatch_cli.data import AdjustedBlock, Pair, PoseResidual
from aeromatch_cli.errors import InputError
from aeromatch_cli.files import write_atomically, write_text
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.formats.adjusted import orientation_text, read_adjusted, residuals_text, write_adjusted
from aeromatch_cli.geometry.cameras import BROWN, MODELS, focal_px
from aeromatch_cli.images.scaling import scale_within
from aeromatch_cli.results.adjustment import Control, GroupResult
from aeromatch_cli.results.stages import AdjustResult
from aeromatch_cli.sfm.block_figures import block_figures, residual_figures, residuals_of
from aeromatch_cli.sfm.calibration import held_by
from aeromatch_cli.sfm.mapping import Group, adjust_block, own_frames
from aeromatch_cli.sfm.mapping_process import LARGE_BLOCK
from aeromatch_cli.sfm.model_validation import FEWEST_IMAGES
from aeromatch_cli.stages import orient
from aeromatch_cli.stages.contents import contents_of
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.messages import single_pair_words
from aeromatch_cli.stages.models import remapped
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.stages.state import BlockState
from aeromatch_cli.stages.surveyed import control_of_block, control_remarks, counted_from_below, height_remarks
from aeromatch_cli.stages.unregistered import unregistered_reasons
from aeromatch_cli.stages.versions import library_version

VERSION = 31
# A focal length that the adjustment changed by more than this share is said.
_FOCAL_SHARE = 0.01
_NOTHING = "not done: no image is oriented; exports have poses only where some are given"


def run(context: Context) -> StageReport:
    """Write adjusted.npz, orientation.csv and residuals.csv where they are not up to date."""
    report = StageReport("adjust", items=len(context.block.images))
    groups = _groups(context)
    if context.settings.first_pass is None:
        report.items = 0
        report.result = AdjustResult(images=0)
        context.workspace.withdraw("adjust", _files(context))
        return report.write(context.workspace)
    context, without_results = BlockState.of(context).with_current_pairs()
    report.fingerprint = _fingerprint(context)
    if report.take_if_up_to_date(context):
        return report.write(context.workspace)
    _remove(context)
    context, groups, words = _with_more_images(context, groups)
    if not groups:
        report.result = AdjustResult(images=0, remarks=[_NOTHING], outside=_none_adjusted(context, without_results))
        return report.write(context.workspace)
    try:
        with context.executor.step("adjust"):
            contents, fixed = contents_of(context, raw=False), context.settings.keeps_poses
            adjusted, found = adjust_block(contents, context.observed, groups, fixed=fixed)
    except InputError as error:  # matches and export stand without it
        report.failures.append(("all images", str(error)))
        stopped, outside = str(error), _none_adjusted(context, without_results, str(error))
        # Not that of an earlier adjustment.
        report.result = AdjustResult(images=0, remarks=[f"not done: {stopped}"], stopped=stopped, outside=outside)
        return report.write(context.workspace)
    residuals = _residuals(context, adjusted)
    result = _result(context, adjusted, found, residuals, without_results)
    report.result = result.model_copy(update={"remarks": [*words, *result.remarks]})
    report.done = report.items
    report.record_files(context, _write(context, adjusted, residuals))
    return report.write(context.workspace)


def _none_adjusted(context: Context, without_results: Sequence[Pair], stopped: str = "") -> dict[str, str]:
    """Return why no image is adjusted, by image_id; nothing of two images, which have no adjustment."""
    if len(context.block.images) < FEWEST_IMAGES:
        return {}
    return unregistered_reasons(context, AdjustedBlock.empty(), without_results, stopped)


def _with_more_images(context: Context, groups: Sequence[Group]) -> tuple[Context, Sequence[Group], list[str]]:
    """Return the context and the groups of images with the orientation from the verified matches, where the first pass
    has left out images that these tie, and that has more of them; and remarks on it.

    A block that needs it: every 4th image of lewis, with positions from GPS.
    """
    oriented = _images(groups)
    tied = {i for pair, known in BlockState.of(context).known_verdicts() if known.state == "verified" for i in pair.ids}
    if tied <= oriented or len(tied) < FEWEST_IMAGES or len(context.block.images) > LARGE_BLOCK:
        return context, groups, []
    found = remapped(context)
    images = set() if found is None else _images(found.groups)
    if found is None or len(images) <= len(oriented):
        return context, groups, []
    block = replace(context.block, cameras=found.cameras, poses=found.poses, frames=own_frames(found.groups))
    words = f"oriented from the verified matches: {len(images)} images, {len(oriented)} from the first pass"
    names = context.block.names
    return replace(context, block=block), found.groups, [words, *single_pair_words(found.result, names)]


def _images(groups: Sequence[Group]) -> set[str]:
    return {image_id for group in groups for image_id in group.images}


def adjusted_block(context: Context) -> AdjustedBlock | None:
    """Read the adjusted block of the present results; None without orientation, or where no image could be adjusted."""
    if not context.workspace.adjusted.is_file() or not _is_current(context):
        return None
    found = read_adjusted(context.workspace.adjusted)
    return found if found.poses else None


def is_current(context: Context) -> bool:
    """Whether the adjustment on file is of the pairs whose results are up to date; also where there is none of these,
    False."""
    if not context.workspace.adjusted.is_file():
        return False
    try:
        return _is_current(BlockState.of(context).with_current_pairs()[0])
    except InputError:  # no pair has results
        return False


def _groups(context: Context) -> Sequence[Group]:
    return [] if context.settings.first_pass is None else orient.groups(context)


def _is_current(context: Context) -> bool:
    made_now = context.with_scope(overwrite=False)
    return StageReport("adjust", fingerprint=_fingerprint(context)).take_if_up_to_date(made_now)


def _fingerprint(context: Context) -> str:
    """Return the fingerprint of what the adjustment reads, and of what was given."""
    observed = context.observed
    poses = {i: (pose.center_m, pose.axis_sigmas_m, pose.sigma_angle_deg) for i, pose in observed.poses.items()}
    control = [
        (p.name, p.position_m, p.sigmas_m, p.check, p.sigma_px, sorted(p.pixels.items())) for p in observed.control
    ]
    known = [
        sorted(part.items())
        for part in (observed.focal_sigmas, observed.cameras, observed.angles, observed.flights, observed.velocities)
    ]
    how = VERSION, library_version("pycolmap"), context.settings.orient, context.settings.adjust.model_dump()
    return fingerprint(how, BlockState.of(context).inputs_fingerprint("adjust"), sorted(poses.items()), known, control)


def _files(context: Context) -> list[Path]:
    return [context.workspace.orientation / name for name in ("adjusted.npz", "orientation.csv", "residuals.csv")]


def _remove(context: Context) -> None:
    context.workspace.forget("adjust", _files(context))
    context.workspace.forget("consistency", [context.workspace.final])  # which is of this adjustment


def _residuals(context: Context, adjusted: AdjustedBlock) -> dict[str, PoseResidual]:
    keypoints_px = contents_of(context, adjusted).keypoints_px
    return residuals_of(adjusted, context.observed.poses, context.block.images, keypoints_px)


def _write(context: Context, adjusted: AdjustedBlock, residuals: Mapping[str, PoseResidual]) -> list[Path]:
    """Write what was found; return the files."""
    workspace = context.workspace
    table = workspace.orientation / "orientation.csv"
    write_atomically(workspace.adjusted, lambda stream: write_adjusted(stream, adjusted))
    write_text(table, orientation_text(adjusted, context.block))
    write_text(workspace.residuals, residuals_text(residuals, context.block.images))
    return [workspace.adjusted, table, workspace.residuals]


def _result(
    context: Context,
    adjusted: AdjustedBlock,
    groups: Sequence[GroupResult],
    residuals: Mapping[str, PoseResidual],
    without_results: Sequence[Pair],
) -> AdjustResult:
    """Figures of the whole and of every group, and why images are not oriented. without_results: pairs that are not
    matched and verified by the present settings."""
    control = control_of_block(context, adjusted, groups)
    return AdjustResult(
        **block_figures(adjusted, context.block.images, groups),
        positions_given=len(context.given.block.poses),
        reduced=_reduced(context),
        outside=unregistered_reasons(context, adjusted, without_results),
        held_by=_held_by(context),
        guessed_cameras=sorted(context.given.guessed_cameras & adjusted.cameras.keys()),
        readout_not_tried=readout_not_tried(context, adjusted.poses),
        control=control,
        remarks=_remarks(context, adjusted, groups, control),
        residuals=residual_figures(residuals, context.block.names),
    )


def _held_by(context: Context) -> dict[str, str]:
    """Parameters of cameras that a setting holds -> that setting."""
    if context.settings.keeps_poses:
        return dict.fromkeys(MODELS[BROWN], "orient=given")
    return held_by(context.observed.calibration, context.observed.switches)


def readout_not_tried(context: Context, oriented: Collection[str]) -> str | None:
    """Say why the read-out time of a rolling shutter was no unknown, None where it was tried. oriented: image_ids."""
    if context.settings.keeps_poses:
        return "orient=given"
    if not context.settings.adjust.rolling_shutter:
        return "adjust.rolling_shutter=false"
    if any(np.any(velocity) for i, velocity in context.observed.velocities.items() if i in oriented):
        return None
    return "the velocity of the aircraft is not known; capture times of images with positions tell it, or DJI's XMP"


def _reduced(context: Context) -> float:
    """Stored pixels in a pixel of the pictures that keypoints are found in (--max-size), median."""
    limit = context.settings.block.max_size_px
    scales = [scale_within(limit, image.width_px, image.height_px) for image in context.block.images]
    return round(1.0 / float(np.median(scales)), 4)


def _remarks(
    context: Context,
    adjusted: AdjustedBlock,
    groups: Sequence[GroupResult],
    control: Control | None,
) -> list[str]:
    """Say what a person should know of the adjusted block, one sentence each."""
    if not adjusted.poses:
        words = "no image could be oriented from the verified matches: export/colmap/sparse has no points"
        kept = context.settings.keeps_poses
        return [f"{words}. They do not fit the given poses; use orient=global instead of given" if kept else words]
    remarks = []
    before, used = context.block.cameras, {i.camera_id for i in context.block.images if i.image_id in adjusted.poses}
    for camera_id in sorted(used):
        old_px, new_px = focal_px(before[camera_id]), focal_px(adjusted.cameras[camera_id])
        if abs(new_px / old_px - 1.0) > _FOCAL_SHARE:
            remarks.append(
                f"focal length of camera {camera_id}: {new_px:.0f} px after the adjustment, {old_px:.0f} px before"
            )
    remarks += height_remarks(groups)
    if control is None:
        return remarks
    return remarks + (counted_from_below(context, adjusted, control) or control_remarks(context, control.offset_m))
