"""Pictures of virtual views."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, View
from aeromatch_cli.errors import ItemError
from aeromatch_cli.geometry.cameras import distort
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.geometry.warps import area_scale, ground_beyond
from aeromatch_cli.images.scaling import shrink

_GRID_STEP_PX = 8

_GRID_ERROR_PX = 0.015

# Where distant ground begins is known to so many pixels.
_FAR_STEP_PX = 8

# Shrinking below this scale needs an area filter first, or the view aliases.
_ALIASING_SCALE = 0.75

# OpenCV's remap reads and makes no longer pictures.
_LONGEST_PX = 32_766


def render_view(
    pixels: NDArray[Any], valid: BoolArray | None, camera: Camera, view: View
) -> tuple[NDArray[Any], BoolArray | None]:
    """Picture (H, W) or (H, W, C) of a view and where it saw something (None = everywhere).

    pixels, valid: the source raster of `camera` and its mask. Minified views are filtered against aliasing. Raises
    ItemError where the source is too long to be read.
    """
    import cv2

    if view.is_source:
        return pixels, valid
    map_x, map_y = view_maps(camera, view)
    inside = (map_x >= 0) & (map_x <= camera.width_px - 1) & (map_y >= 0) & (map_y <= camera.height_px - 1)
    scale = _typical_scale(camera, view, inside)
    if scale < _ALIASING_SCALE:
        pixels = shrink(pixels, scale)
        map_x, map_y = (map_x + 0.5) * scale - 0.5, (map_y + 0.5) * scale - 0.5
    longest = max(pixels.shape[:2])
    if longest > _LONGEST_PX:
        raise ItemError(
            f"an image {longest:,} px long is too long to be seen from elsewhere: "
            f"reduce it with --max-size {_LONGEST_PX}"
        )
    kernel = _smoothing_kernel(view, inside, scale if scale < _ALIASING_SCALE else 1.0)
    if kernel is not None:
        pixels = cv2.filter2D(pixels, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    map_x, map_y = map_x.astype(np.float32), map_y.astype(np.float32)
    picture = cv2.remap(pixels, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    picture[~inside] = 0
    if valid is not None:
        seen = shrink(valid.astype(np.uint8) * 255, scale) if scale < _ALIASING_SCALE else valid.astype(np.uint8) * 255
        inside &= cv2.remap(seen, map_x, map_y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 127
    if view.beyond is not None:
        inside &= _beyond(view, view.beyond)
    return picture, inside


def _beyond(view: View, near: View) -> BoolArray:
    """Where a view (H, W) shows ground that a nearer one leaves out, to a few pixels."""
    columns, rows = -(-view.width_px // _FAR_STEP_PX), -(-view.height_px // _FAR_STEP_PX)
    middles = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2) + 0.5
    places = apply_homography(view.undistorted_from_view, middles * _FAR_STEP_PX - 0.5)
    coarse = ground_beyond(near, places).reshape(rows, columns)
    return coarse.repeat(_FAR_STEP_PX, axis=0).repeat(_FAR_STEP_PX, axis=1)[: view.height_px, : view.width_px]


def view_maps(camera: Camera, view: View) -> tuple[FloatArray, FloatArray]:
    """Source x and y (H, W) float32 of every view pixel, far outside the raster where nothing is seen.

    Evaluated exactly on a grid and interpolated, within 0.02 px: the grid of 8 px is refined where the view bends more.
    """
    import cv2

    step = 2 * _GRID_STEP_PX
    error = np.inf
    while error > _GRID_ERROR_PX and step > 1:
        step //= 2
        columns, rows = -(-view.width_px // step) + 2, -(-view.height_px // step) + 2
        # cv2.resize puts node k of the small grid at (k + 0.5) step - 0.5: start one node outside the view.
        xs = (np.arange(columns) - 0.5) * step - 0.5
        ys = (np.arange(rows) - 0.5) * step - 0.5
        nodes = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
        grid = distort(camera, apply_homography(view.undistorted_from_view, nodes)).reshape(rows, columns, 2)
        error = _interpolation_error_px(grid, camera)
    full = cv2.resize(grid.astype(np.float32), (columns * step, rows * step), interpolation=cv2.INTER_LINEAR)
    part: FloatArray = np.asarray(full[step : step + view.height_px, step : step + view.width_px], dtype=np.float32)
    part[np.isnan(part)] = -1e6
    return part[..., 0], part[..., 1]


def _interpolation_error_px(grid: FloatArray, camera: Camera) -> float:
    """Largest error of linear interpolation between nodes (R, C, 2) inside the raster: second differences / 8."""
    with np.errstate(invalid="ignore"):
        inside = ((grid >= -1.0) & (grid <= (camera.width_px, camera.height_px))).all(axis=2)
    bend = np.zeros(grid.shape)
    bend[:, 1:-1] += np.abs(grid[:, 2:] - 2.0 * grid[:, 1:-1] + grid[:, :-2])
    bend[1:-1] += np.abs(grid[2:] - 2.0 * grid[1:-1] + grid[:-2])
    return float(np.nan_to_num(bend[inside]).max(initial=0.0)) / 8.0


def _smoothing_kernel(view: View, inside: BoolArray, scale: float) -> FloatArray | None:
    """Gaussian (K, K) on a source reduced by `scale` for what the view still shrinks along one axis; None if little.

    A shrink by t needs a blur of 0.8 sqrt(t^2 - 1) source pixels along its axis (Morel and Yu 2009, section 3.2).
    """
    ys, xs = np.nonzero(inside[::_GRID_STEP_PX, ::_GRID_STEP_PX])
    if not len(xs):
        return None
    at = np.array([xs.mean(), ys.mean()]) * _GRID_STEP_PX
    warp = view.undistorted_from_view
    depth = float(warp[2, :2] @ at + warp[2, 2])
    place = (warp[:2, :2] @ at + warp[:2, 2]) / depth
    jacobian = scale * (warp[:2, :2] - np.outer(place, warp[2, :2])) / depth
    axes, shrinks, _ = np.linalg.svd(jacobian)
    if shrinks[0] * _ALIASING_SCALE <= 1.0:
        return None
    # A variance of 0.01 leaves an axis as it is and keeps the matrix invertible.
    variances = np.maximum(0.64 * (shrinks**2 - 1.0), 0.01)
    reach = int(np.ceil(3.0 * np.sqrt(variances[0])))
    grid = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1.0)] * 2), axis=-1)
    weights = np.exp(-0.5 * (((grid @ axes) ** 2) / variances).sum(axis=-1))
    return np.asarray(weights / weights.sum())


def _typical_scale(camera: Camera, view: View, inside: BoolArray) -> float:
    """Median view px per source px over what the view shows: below 1 the view is a reduction."""
    ys, xs = np.nonzero(inside[::_GRID_STEP_PX, ::_GRID_STEP_PX])
    if not len(xs):
        return 1.0
    points = np.stack([xs, ys], axis=1)[:: max(1, len(xs) // 2000)] * float(_GRID_STEP_PX)
    return float(1.0 / np.median(area_scale(view.undistorted_from_view, points)))
