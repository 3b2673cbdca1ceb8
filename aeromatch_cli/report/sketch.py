"""A sketch of the ground below the block map: small pictures laid on the terrain, the one taken from nearest on top.

No orthophoto: seams are not blended, and what rises above the terrain leans.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.cameras import project
from aeromatch_cli.geometry.footprints import block_footprints
from aeromatch_cli.stages.context import Context

# Longer side of the sketch, pixels.
_SIDE_PX = 640
# Ground that is seen from farther than this many flying heights aside is left out.
_FARTHEST = 2.0
# In a block of more images each is a few pixels of the map: what one of them sees at most so far aside is not painted
# again.
_MANY_IMAGES, _NEAR = 2000, 0.5
# So much of its size is looked at around an image's footprint, whose border is found by a few rays.
_MARGIN = 0.2


def ground_sketch(
    context: Context, pictures: Mapping[str, NDArray[np.uint8]], low_m: FloatArray, high_m: FloatArray
) -> NDArray[np.uint8] | None:
    """RGBA (h, w, 4) of the world from low_m to high_m (2,), north up, clear where nothing is known; None without
    terrain or attitudes. pictures: image_id -> reduced picture as stored."""
    ground = context.block.ground
    if ground is None:
        return None
    step_m = float((high_m - low_m).max()) / _SIDE_PX
    width, height = (max(1, round(float(extent) / step_m)) for extent in high_m - low_m)
    x = low_m[0] + (np.arange(width) + 0.5) * step_m
    y = high_m[1] - (np.arange(height) + 0.5) * step_m
    places = np.stack([*np.meshgrid(x, y)], axis=2)
    heights = np.asarray(ground.height_m(places.reshape(-1, 2)), np.float64).reshape(height, width)
    points = np.dstack([places, heights])
    canvas, nearest = np.zeros((height, width, 4), np.uint8), np.full((height, width), _FARTHEST)
    lowest_m = float(np.nanmin(heights))
    footprints = block_footprints(context.block)
    ids, near, stride = list(pictures), 0.0, 1
    if len(ids) > _MANY_IMAGES:  # every third image paints most of what the others show
        near, stride = _NEAR, 3
    for image_id in (image_id for start in range(stride) for image_id in ids[start::stride]):
        pose, footprint = context.pose(image_id), footprints.get(image_id)
        if pose is not None and footprint is not None:
            window = _around(points, pose.center_m, lowest_m, footprint.polygon_m)
            _lay(context, image_id, pictures, points[window], canvas[window], nearest[window], near)
    return canvas if canvas[..., 3].any() else None


def _lay(
    context: Context,
    image_id: str,
    pictures: Mapping[str, NDArray[np.uint8]],
    points_m: FloatArray,
    canvas: NDArray[np.uint8],
    nearest: FloatArray,
    near: float,
) -> None:
    """Paint what an image with an attitude shows of points_m (h, w, 3) where it is nearer, in flying heights aside,
    than `nearest`, which is not `near` yet."""
    import cv2

    if not (nearest > near).any():
        return
    pose, image = context.block.poses[image_id], context.image_by_id[image_id]
    aside = np.hypot(points_m[..., 0] - pose.center_m[0], points_m[..., 1] - pose.center_m[1])
    above = pose.center_m[2] - points_m[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(above > 0.0, aside / above, np.inf)
    rows, columns = np.nonzero((distance < nearest) & (nearest > near))
    if not len(rows):
        return
    camera, picture = context.block.cameras[image.camera_id], pictures[image_id]
    seen = project(camera, np.asarray(pose.world_rotation), pose.center_m, points_m[rows, columns])
    scale = np.array([picture.shape[1] / image.width_px, picture.shape[0] / image.height_px])
    seen = (seen + 0.5) * scale - 0.5
    with np.errstate(invalid="ignore"):
        inside = ((seen >= 0.0) & (seen <= np.array(picture.shape[1::-1]) - 1.0)).all(axis=1)
    rows, columns, seen = rows[inside], columns[inside], seen[inside]
    if not len(rows):
        return
    colour = picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB)
    whole = np.rint(seen).astype(np.int64)
    canvas[rows, columns, :3] = colour[whole[:, 1], whole[:, 0], :3]
    canvas[rows, columns, 3] = 255
    nearest[rows, columns] = distance[rows, columns]


def _around(
    points_m: FloatArray, center_m: FloatArray, lowest_m: float, footprint_m: FloatArray
) -> tuple[slice, slice]:
    """Rows and columns of points_m (h, w, 3), x right and y up, that lie about the footprint (N, 2) and within
    _FARTHEST of a camera above them: an image shows a small part of a large block. lowest_m: of all their heights."""
    reach_m = _FARTHEST * max(0.0, float(center_m[2]) - lowest_m)
    low_m, high_m = footprint_m.min(axis=0), footprint_m.max(axis=0)
    margin_m = _MARGIN * (high_m - low_m)
    low_m = np.maximum(low_m - margin_m, center_m[:2] - reach_m)
    high_m = np.minimum(high_m + margin_m, center_m[:2] + reach_m)
    columns = np.searchsorted(points_m[0, :, 0], [low_m[0], high_m[0]])
    rows = np.searchsorted(-points_m[:, 0, 1], [-high_m[1], -low_m[1]])
    return slice(*rows.tolist()), slice(*columns.tolist())
