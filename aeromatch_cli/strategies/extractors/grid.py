"""An even grid of places to measure, chosen from the image alone: for matchers that compare pixels.

In every cell of a square grid the place where a window can be matched best in all directions: the largest smaller
eigenvalue of the structure tensor. No descriptors.

Source: Foerstner and Guelch, ISPRS Intercommission Workshop 1987; Shi and Tomasi, CVPR 1994.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import BoolArray, Camera, Features, FloatArray
from aeromatch_cli.geometry.frames import apply_homography, resize_matrix
from aeromatch_cli.geometry.warps import source_from_view
from aeromatch_cli.strategies import Strategy, ViewPixels

# Texture is judged on pictures of this longer side at most: what only stored pixels show, noise shows too.
_JUDGED_PX = 1840
_WINDOW = 7
_BLUR_PX = 0.8
# Gray levels per pixel, squared: what a slope needs to be more than rounding.
_LEAST_TEXTURE = 0.02
# Of a cell, left free along its sides: points of neighbouring cells do not meet.
_RIM = 0.15
_LEAST_CELL_PX = 3


class Grid(Strategy):
    """Points on an even grid, one per cell where the image has texture; no descriptors."""

    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    descriptor_length: ClassVar[int] = 0
    north_up_only: ClassVar[bool] = False
    colours: ClassVar[bool] = False
    name: Literal["grid"] = "grid"
    points: int = Field(
        1200,
        ge=1,
        description="Approximate number of grid cells, and so the largest number of points. Larger: denser tie "
        "points, more time.",
    )

    def with_extra_views(self, views: int) -> Grid:
        """The same: a grid is of the source alone."""
        del views
        return self

    def __call__(self, camera: Camera, views: Sequence[ViewPixels]) -> Features:
        """Features of the first view of near ground (the source, with simulate=none), without descriptors."""
        shown = next(view for view in views if view.view.beyond is None)
        height, width = shown.gray.shape
        scale = min(1.0, _JUDGED_PX / max(height, width))
        texture = _texture(shown.gray, shown.valid, scale)
        places, values, cell = _chosen(texture, self.points)
        points = apply_homography(np.linalg.inv(resize_matrix(scale)), places)
        if not shown.view.is_source:
            points = source_from_view(camera, shown.view.undistorted_from_view, points)
        return _features(np.rint(points), np.full(len(points), cell / scale), values, shown)


def _texture(gray: NDArray[Any], valid: BoolArray | None, scale: float) -> NDArray[np.float32]:
    """Smaller eigenvalue of the structure tensor of the reduced picture; 0 where a window is not all valid."""
    import cv2

    reduced = gray.astype(np.float32)
    if scale < 1.0:
        reduced = np.asarray(cv2.resize(reduced, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.float32)
    picture = np.asarray(cv2.GaussianBlur(reduced, (0, 0), _BLUR_PX))
    found = np.asarray(cv2.cornerMinEigenVal(picture, _WINDOW, ksize=3)) * _WINDOW**2
    rim = 2 * _WINDOW
    if valid is not None:
        known = cv2.resize(valid.astype(np.uint8), picture.shape[::-1], interpolation=cv2.INTER_NEAREST)
        found[cv2.erode(known, np.ones((rim + 1, rim + 1), np.uint8)) == 0] = 0.0
    found[: rim // 2], found[-(rim // 2) :], found[:, : rim // 2], found[:, -(rim // 2) :] = 0.0, 0.0, 0.0, 0.0
    return np.asarray(found, np.float32)


def _chosen(texture: NDArray[np.float32], points: int) -> tuple[FloatArray, FloatArray, float]:
    """Places (K, 2), their texture (K,) and the side of a cell, px."""
    height, width = texture.shape
    side = float(np.sqrt(height * width / points))
    rows, columns = (max(1, min(round(length / side), length // _LEAST_CELL_PX)) for length in (height, width))
    tops, lefts = (np.linspace(0, length, count + 1) for length, count in ((height, rows), (width, columns)))
    places, values = [], []
    for row in range(rows):
        for column in range(columns):
            top, bottom = _inner(tops[row], tops[row + 1])
            left, right = _inner(lefts[column], lefts[column + 1])
            cell = texture[top:bottom, left:right]
            y, x = divmod(int(cell.argmax()), cell.shape[1])
            if cell[y, x] > _LEAST_TEXTURE:
                places.append((left + x, top + y))
                values.append(float(cell[y, x]))
    return np.array(places, float).reshape(-1, 2), np.array(values), side


def _inner(low: float, high: float) -> tuple[int, int]:
    rim = _RIM * (high - low)
    first = int(np.ceil(low + rim))
    return first, max(first + 1, int(high - rim))


def _features(points: FloatArray, sizes: FloatArray, values: FloatArray, shown: ViewPixels) -> Features:
    view = shown.view
    nothing = np.zeros(0, np.float32)
    return Features(
        keypoints_px=points.astype(np.float32),
        sizes_px=sizes.astype(np.float32),
        responses=values.astype(np.float32),
        descriptors=np.zeros((0, 0), np.uint8),
        descriptor_keypoint_idx=np.zeros(0, np.int32),
        view_idx=np.zeros(0, np.int32),
        view_keypoints_px=np.zeros((0, 2), np.float32),
        view_size_px=nothing,
        view_orientation_deg=nothing,
        view_sizes_px=np.array([(view.width_px, view.height_px)], np.int32),
        view_angles_deg=np.array([view.angle_deg], np.float32),
        view_directions=np.full((1, 3), np.nan, np.float32),
        view_gsd_m=np.full(1, np.nan, np.float32),
        view_enhanced=np.zeros(1, bool),
    )
