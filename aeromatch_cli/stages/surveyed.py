"""Surveyed points beside the adjusted block: errors at them, and what is probably wrong with their list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aeromatch_cli.blocks.crs import LOCAL
from aeromatch_cli.data import AdjustedBlock, ControlPoint
from aeromatch_cli.results.adjustment import Control, GroupResult
from aeromatch_cli.sfm.control import control_figures
from aeromatch_cli.sfm.heights import shift_to_control_m, zeros_words
from aeromatch_cli.stages.context import Context

# Control points are said to lie elsewhere beyond this, metres, and so many standard deviations of a given position.
_FAR_CONTROL_M, _FAR_CONTROL_SIGMAS = 10.0, 5.0
# Image points of surveyed points count from below where their rays meet so many times better then; and beyond so many
# pixels.
_FROM_BELOW, _FROM_BELOW_PX = 5.0, 20.0


def height_remarks(groups: Sequence[GroupResult]) -> list[str]:
    """Say which heights of positions lie above or below those of the control points, all by as much."""
    shifts_m = [up_m for group in groups if (up_m := shift_to_control_m(group)) is not None]
    return [
        f"heights of the given positions lie {abs(up_m):.1f} m {'above' if up_m > 0 else 'below'} those of the control "
        f"points, everywhere by about as much: {zeros_words(up_m)}; the block has the heights of the control points"
        for up_m in shifts_m
    ]


def control_remarks(context: Context, offset_m: Sequence[float] | None) -> list[str]:
    """Say which control points lie far from where the given positions of the images put them."""
    if offset_m is None or context.block.crs == LOCAL:
        return []
    east_m, north_m, up_m = offset_m
    across_m = float(np.hypot(east_m, north_m))
    sigmas_m = [pose.sigma_position_m for pose in context.given.block.poses.values()]
    sigma_m = float(np.median(sigmas_m)) if sigmas_m else 0.0
    limit_m = max(_FAR_CONTROL_M, _FAR_CONTROL_SIGMAS * sigma_m)
    if across_m > limit_m:
        return [
            f"the control points lie {across_m:,.0f} m beside where the given positions of the images put them: is the "
            "CRS in the first line of their file right, or are x and y exchanged?"
        ]
    if abs(up_m) > limit_m:
        return [
            f"the control points lie {abs(up_m):.1f} m {'above' if up_m > 0 else 'below'} the heights at which the "
            "given positions of the images put them: do both count from the same zero (ellipsoid, sea level)?"
        ]
    return []


def control_of_block(context: Context, adjusted: AdjustedBlock, groups: Sequence[GroupResult]) -> Control | None:
    """The block beside surveyed points, without those that the adjustment has found wrong or exchanged."""
    if not context.given.control:
        return None
    found = [group.control for group in groups if group.control is not None]
    left_out = {name for one in found for name in (*one.wrong, *one.exchanged)}
    return _control_figures(context, adjusted, [point for point in context.given.control if point.name not in left_out])


def _control_figures(context: Context, adjusted: AdjustedBlock, points: Sequence[ControlPoint]) -> Control:
    cameras = {image.image_id: adjusted.cameras[image.camera_id] for image in context.block.images}
    # Images that no position has placed lie beside the others: their rays meet those at no surveyed point.
    placed = {i: pose for i, pose in adjusted.poses.items() if i not in adjusted.frames} or adjusted.poses
    return control_figures(replace(adjusted, poses=placed), cameras, points, metric=context.block.metric)


def counted_from_below(context: Context, adjusted: AdjustedBlock, control: Control) -> list[str]:
    """Say that the y of image points of surveyed points counts from the lower edge of the picture, where it does."""
    images = context.image_by_id
    turned = [
        replace(point, pixels={i: np.array([x, images[i].height_px - 1.0 - y]) for i, (x, y) in point.pixels.items()})
        for point in context.given.control
    ]
    as_given_px, turned_px = (
        control.reprojection_error_px,
        _control_figures(context, adjusted, turned).reprojection_error_px,
    )
    if as_given_px is None or turned_px is None or as_given_px < max(_FROM_BELOW * turned_px, _FROM_BELOW_PX):
        return []
    return [
        f"rays of surveyed points meet to {as_given_px:.0f} px, and to {turned_px:.1f} px if y in their list counts "
        "from the lower edge of the pictures: it has to count from the upper edge, correct the list"
    ]
