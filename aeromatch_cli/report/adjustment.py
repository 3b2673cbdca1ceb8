"""report: what the bundle adjustment found, as the page says it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from aeromatch_cli.data import AdjustedBlock, Block, Camera, Pose
from aeromatch_cli.formats.adjusted import read_adjusted
from aeromatch_cli.geometry.cameras import corner_params, from_colmap
from aeromatch_cli.report.rows import ImageRow
from aeromatch_cli.results.adjustment import Control
from aeromatch_cli.results.stages import AdjustResult, ConsistencyResult, OrientResult, with_final_points
from aeromatch_cli.sfm.control import offset_words
from aeromatch_cli.stages import adjust
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.messages import control_of, control_words
from aeromatch_cli.stages.stage_report import result_on_file
from aeromatch_cli.words import counted

# Where cx and cy of cameras count from, on the page and in files.
PRINCIPAL_POINT = "cx, cy from the corner of the first pixel, as in COLMAP"


@dataclass(frozen=True)
class Notice:
    """Something a person must see. level: "bad" or "warn". items: names, MAX_LISTED of them shown."""

    level: str
    title: str
    text: str
    items: tuple[str, ...] = ()


@dataclass(frozen=True)
class Adjustment:
    """What the stages adjust and consistency state of the present matches; nothing where they state it of earlier ones.
    in_world: else the frame is the pictures' own, and no length in it is a metre."""

    found: AdjustResult = field(default_factory=lambda: AdjustResult(images=0))
    judged: ConsistencyResult = field(default_factory=ConsistencyResult)
    outdated: bool = False
    in_world: bool = True


def read_adjustment(context: Context) -> Adjustment:
    found = result_on_file(context.workspace, AdjustResult) or AdjustResult(images=0)
    oriented = result_on_file(context.workspace, OrientResult)
    in_world = oriented is None or oriented.frame != "own"
    if found.points and not adjust.is_current(context):
        return Adjustment(outdated=True, in_world=in_world)
    judged = result_on_file(context.workspace, ConsistencyResult) or ConsistencyResult()
    return Adjustment(found, judged, in_world=in_world)


def final_points(context: Context, adjustment: Adjustment) -> AdjustedBlock | None:
    """The adjusted block with the points that final matches hold; None where the last adjustment found none."""
    path = context.workspace.final_or_adjusted
    return read_adjusted(path) if adjustment.found.points and path.is_file() else None


def adjusted_poses(adjusted: AdjustedBlock | None) -> dict[str, Pose]:
    """Poses of all adjusted images, by image_id, each in the frame of its group."""
    if adjusted is None:
        return {}
    # Standard deviations are shown elsewhere.
    return {i: Pose(pose.center_m, pose.rotation, math.nan, math.nan) for i, pose in adjusted.poses.items()}


def images_aside(block: Block, adjusted: AdjustedBlock | None, *, in_world: bool) -> frozenset[str]:
    """Images of groups whose place beside the first part is not known, as adjusted or, without adjustment, as
    oriented."""
    return (adjusted or block).aside(in_world=in_world)


def as_adjusted(block: Block, adjusted: AdjustedBlock | None, *, in_world: bool) -> Block:
    """The block with adjusted poses and cameras in place of those that the first pass found: so the page shows it.

    Groups of images that lie in frames of their own beside that of the first part have no place in it. Where the
    pictures' own frame is another one than that of the first pass, or the first pass may have had several, nothing of
    the first pass is left.
    """
    aside = images_aside(block, adjusted, in_world=in_world)
    if adjusted is None:
        return replace(block, poses={i: pose for i, pose in block.poses.items() if i not in aside})
    found = {i: pose for i, pose in adjusted_poses(adjusted).items() if i not in aside}
    held = in_world or found.keys() <= block.poses.keys()
    known = dict(block.poses) if in_world or (held and not aside) else {}
    # In the world images that lay in a frame of their own have a place only where the adjustment has given them one.
    loose = aside | (block.frames.keys() if in_world else set())
    known = {i: pose for i, pose in known.items() if i not in loose}
    return replace(
        block, poses={**known, **found}, cameras={**block.cameras, **adjusted.cameras},
        ground=block.ground if held else None,
    )  # fmt: skip


def adjustment_notices(images: Sequence[ImageRow], adjustment: Adjustment) -> list[Notice]:
    """Images that the bundle adjustment does not hold, images whose adjusted poses their matches contradict, and what
    else it found."""
    if adjustment.outdated:
        text = "Run aeromatch adjust, or aeromatch run: what they tell is of earlier matches, and is left out here."
        return [Notice("warn", "Adjustment and points are older than the matches", text)]
    names, adjusted = {row.image_id: row.name for row in images}, adjustment.found
    found = [Notice("warn", "Note on the adjustment", remark) for remark in adjusted.remarks]
    control = adjusted.control
    if control and (not control.residuals or control.rays_do_not_meet):
        # What the section below cannot show.
        found.append(Notice("warn", "Note on the control points", ". ".join(control_words(control))))
    outside = tuple(f"{names.get(i, i)}: {reason}" for i, reason in adjusted.outside.items())
    doubtful = adjustment.judged.doubtful
    if outside:
        text = "Their matches are exported, but they have no adjusted pose and see no point."
        found.insert(0, Notice("bad", counted(len(outside), "image", "images") + " not oriented", text, outside))
    if doubtful:
        title = counted(len(doubtful), "adjusted pose is doubtful", "adjusted poses are doubtful")
        text = "Too many verified matches of these images contradict their adjusted poses."
        found.insert(0, Notice("bad", title, text, tuple(names.get(i, i) for i in doubtful)))
    return found


def adjustment_rows(adjustment: Adjustment) -> list[tuple[str, str]]:
    """Figures of the adjusted block with its final points, and of the control points."""
    adjusted = with_final_points(adjustment.found, adjustment.judged)
    if not adjusted.points:
        return []
    found = [
        ("Oriented images", f"{adjusted.images:,}"),
        ("Points", f"{adjusted.points:,} in {adjusted.track_length:.1f} images each"),
    ]
    if adjusted.reprojection_error_px is not None:
        found.append(("Reprojection error", f"{adjusted.reprojection_error_px:.2f} px, mean"))
    stated = (adjusted.sigma_position_m, "m"), (adjusted.sigma_angle_deg, "degrees")
    sigmas = [f"{value:.3g} {unit}" for value, unit in stated if value is not None]
    if sigmas:
        found.append(("Standard deviations of the poses", f"{', '.join(sigmas)}, median"))
    cameras = {
        camera_id: from_colmap(one.model, one.width_px, one.height_px, tuple(one.parameters))
        for camera_id, one in adjusted.cameras.items()
    }
    if cameras:
        found.append((f"Cameras after the adjustment ({PRINCIPAL_POINT})", camera_words(cameras)))
    control = adjusted.control
    if control and control.control_rmse_m:
        found.append(("Control points", f"{control.control}; {offset_words(control)}"))
        found.append(("Control points after a similarity", f"RMSE {_metres(control.control_rmse_m)}"))
        if control.check_rmse_m:
            kind = f"{control.check} check points" if control.check else "Control points, each left out once"
            found.append((f"{kind}, after it", f"RMSE {_metres(control.check_rmse_m)}"))
        if control.doubtful:
            found.append(("Control points that the others contradict", ", ".join(control.doubtful)))
    elif control and control.residuals:
        counts, *words = control_words(control, control_of(adjusted.groups))
        found.append((counts.capitalize(), "; ".join(words)))
    return found


def surveyed_rows(control: Control | None) -> list[tuple[str, ...]]:
    """Of every surveyed point (name, part, x, y, z in metres, its length in ground pixels, the largest of the three in
    standard deviations, images, root mean square of its residuals there in pixels)."""
    rows: list[tuple[str, ...]] = []
    if control is None or control.ground_pixel_m is None:
        return rows
    for name, error_m in control.residuals.items():
        metres = [f"{value:+.3f}" for value in error_m]
        pixels = f"{math.hypot(*error_m) / control.ground_pixel_m:.1f}"
        sigmas = f"{max(abs(e) / s for e, s in zip(error_m, control.point_sigmas_m[name], strict=True)):.1f}"
        lengths_px = [math.hypot(*off_px) for off_px in control.image_residuals_px[name].values()]
        in_images = f"{math.hypot(*lengths_px) / math.sqrt(len(lengths_px)):.2f}" if lengths_px else ""
        part = "check" if name in control.checks else "control"
        rows.append((name, part, *metres, pixels, sigmas, f"{len(lengths_px)}", in_images))
    return rows


def _metres(errors_m: Sequence[float]) -> str:
    return " / ".join(f"{error:.3f}" for error in errors_m) + " m (x / y / z)"


def camera_words(cameras: Mapping[str, Camera]) -> str:
    """One camera a line: its model, size and parameters, as a camera file has them."""
    words = []
    for camera_id, camera in sorted(cameras.items()):
        params = ", ".join(f"{value:g}" for value in corner_params(camera))
        words.append(f"{camera_id}: {camera.model}, {camera.width_px} x {camera.height_px} px, {params}")
    more = [f"and {len(words) - 10} more"] if len(words) > 10 else []
    return "\n".join(words[:10] + more)
