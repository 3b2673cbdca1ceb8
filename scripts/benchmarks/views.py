"""Views of images: where their pixels lie in the stored raster, and what they have not seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, View
from aeromatch_cli.geometry.warps import source_from_view, view_from_source


@dataclass(frozen=True, eq=False)
class ImageView:
    """A view of an image that `camera` took; None, or a view with is_source, is the stored raster itself."""

    image: str
    camera: Camera
    view: View | None

    def stored_px(self, points_px: FloatArray) -> FloatArray:
        """Stored pixels (N, 2) of points (N, 2) of this view; NaN where the image does not see them."""
        points = np.asarray(points_px, np.float64).reshape(-1, 2)
        if self.view is None or self.view.is_source or len(points) == 0:
            return points
        return source_from_view(self.camera, self.view.undistorted_from_view, points)

    def from_stored(self, stored_px: FloatArray) -> FloatArray:
        """Points (N, 2) of this view at stored pixels (N, 2)."""
        points = np.asarray(stored_px, np.float64).reshape(-1, 2)
        if self.view is None or self.view.is_source or len(points) == 0:
            return points
        return view_from_source(self.camera, self.view.undistorted_from_view, points)


def inside(points_px: FloatArray, frame: Camera | View) -> BoolArray:
    """Which points (N, 2) lie on a raster of this width and height; NaN do not."""
    last = np.array([frame.width_px, frame.height_px]) - 0.5
    with np.errstate(invalid="ignore"):
        return np.asarray(((points_px >= -0.5) & (points_px <= last)).all(axis=1))


def filled(picture: NDArray[np.uint8], seen: BoolArray) -> NDArray[np.uint8]:
    """The picture (H, W, 3) with the nearest seen pixel in the place of each that is not."""
    import cv2

    if seen.all() or not seen.any():
        return picture
    unseen = (~seen).astype(np.uint8)
    found: Any = cv2.distanceTransformWithLabels(unseen, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL)
    labels = found[1]
    at = np.zeros(int(labels.max()) + 1, np.int64)
    at[labels[seen]] = np.flatnonzero(seen)
    out: Any = picture.reshape(-1, 3)[at[labels.ravel()]].reshape(picture.shape)
    return np.asarray(out)


def away_from_unseen(points_px: FloatArray, seen: BoolArray, margin_px: float | FloatArray) -> BoolArray:
    """Which points (N, 2) of a view lie farther than the margin, one or (N,), from what it has not seen (H, W)."""
    import cv2

    distance = cv2.distanceTransform(seen.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    last = np.array(seen.shape[::-1]) - 1
    x, y = np.clip(np.rint(np.asarray(points_px).reshape(-1, 2)), 0, last).astype(np.int64).T
    return np.asarray(seen.all() | (distance[y, x] > margin_px))
