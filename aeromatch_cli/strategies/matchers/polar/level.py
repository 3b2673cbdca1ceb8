"""A picture at one scale, with gradients and where it is known, read at places between its pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray

# A slight blur takes the noise's highest frequencies, which linear interpolation would treat unevenly.
_BLUR_PX = 0.8
_EVEN_PX = 5.0
_NOISE = 0.02  # of a picture's deviation: contrast below is none
_BORDER_PX = 2.0  # of the picture that blur and gradients have spoilt
_FAR_PX = 1e6
# OpenCV's remap takes pictures of places, not lists, and of fewer than 32,767 rows: the windows of 11,506 grid points
# have more.
_ROW, _ROWS = 256, 16_384


@dataclass(frozen=True, eq=False)
class Level:
    """scale: level px per frame px. planes: (H, W, 3) float32 value, d/dx, d/dy. known: (H, W) float32, 1 where the
    value is one of the picture's, less where the blur mixed it with something else; None = everywhere.
    """

    scale: float
    planes: NDArray[np.float32]
    known: NDArray[np.float32] | None

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.planes.shape[1], self.planes.shape[0]

    @property
    def values(self) -> NDArray[np.float32]:
        return self.planes[..., 0]

    def sample(self, places_px: FloatArray) -> tuple[NDArray[np.float32], BoolArray]:
        """Planes (N, 3) at places (N, 2) in level px, bilinear, and which places are known (N,)."""
        return bilinear_at(self.planes, places_px), self.knows(places_px)

    def knows(self, places_px: FloatArray) -> BoolArray:
        """Which places (N, 2) are known (N,); NaN is not."""
        width, height = self.size_px
        x, y = places_px.T
        low = _BORDER_PX
        inside = (x >= low) & (x <= width - 1.0 - low) & (y >= low) & (y <= height - 1.0 - low)
        if self.known is not None:
            inside &= bilinear_at(self.known, places_px) > 0.99
        return inside


def level_of(pixels: FloatArray, valid: BoolArray | None, scale: float, *, even: bool) -> Level:
    """Of a picture (H, W) float32 that stands at `scale` and where it is valid (None = everywhere). even: locally
    normalised, so that a road counts no more than a furrow, and vignetting nothing.
    """
    import cv2

    known = np.ones(pixels.shape, np.float32) if valid is None else valid.astype(np.float32)
    values = normalised(pixels, known, _EVEN_PX) if even else _filled(pixels, valid)
    border: NDArray[np.float32] | None = None
    if valid is not None and not valid.all():
        narrowed = cv2.erode(known, np.ones((5, 5), np.uint8))
        border = np.asarray(cv2.GaussianBlur(narrowed, (3, 3), 0.8), np.float32)
    smooth = cv2.GaussianBlur(values, (0, 0), _BLUR_PX)
    dx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    dy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    return Level(scale, np.asarray(cv2.merge([smooth, dx, dy])), border)


def normalised(picture: FloatArray, known: NDArray[np.float32], spread_px: float) -> NDArray[np.float32]:
    """(H, W) float32 less its mean within about spread_px, over its deviation there, where it is known, else 0.

    known: (H, W), 1 or 0.
    """
    import cv2

    def mean(values: NDArray[np.float32], width_px: float) -> NDArray[np.float32]:
        weight = np.maximum(cv2.GaussianBlur(known, (0, 0), width_px), 1e-3)
        return np.asarray(cv2.GaussianBlur(values * known, (0, 0), width_px) / weight)

    values = np.asarray(picture, np.float32)
    values = (values - mean(values, spread_px)) * known
    noise = _NOISE * float(np.sqrt((values**2).sum() / max(float(known.sum()), 1.0))) + 1e-6
    return np.asarray(values / np.sqrt(mean(values**2, 1.5 * spread_px) + noise**2), np.float32)


def _filled(picture: FloatArray, valid: BoolArray | None) -> NDArray[np.float32]:
    """With the mean where it is not valid: blurring carries little across the border then."""
    values = np.asarray(picture, np.float32)
    if valid is None or valid.all():
        return values
    return np.where(valid, values, values[valid].mean() if valid.any() else 0.0).astype(np.float32)


def bilinear_at(picture: NDArray[Any], places_px: FloatArray) -> NDArray[np.float32]:
    """Values (N,) or (N, C) of a picture at places (N, 2), bilinear; 0 outside."""
    import cv2

    count = len(places_px)
    rows = -(-count // _ROW)
    places = np.zeros((rows * _ROW, 2), np.float32)
    with np.errstate(invalid="ignore"):
        np.clip(places_px, -_FAR_PX, _FAR_PX, out=places[:count], casting="unsafe")
    places[~np.isfinite(places)] = -_FAR_PX
    maps = places.reshape(rows, _ROW, 2)
    found = np.empty((rows, _ROW, *picture.shape[2:]), np.float32)
    for first in range(0, rows, _ROWS):
        part = maps[first : first + _ROWS]
        cv2.remap(picture, part[..., 0], part[..., 1], cv2.INTER_LINEAR, dst=found[first : first + _ROWS])
    return found.reshape(-1, *found.shape[2:])[:count]
