"""Reduced pictures and their cameras."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Camera
from aeromatch_cli.geometry.cameras import resized

_WHOLE_ERROR = 1e-6

_STRIP_PX = 4_000_000  # that are held as float32 at once while a large picture is reduced


def shrink(pixels: NDArray[Any], scale: float) -> NDArray[Any]:
    """The picture reduced by `scale` <= 1 with an area filter: source pixel x lies at (x + 0.5) scale - 0.5.

    The size is rounded, the scale is not: a picture stretched to whole pixels would be off by up to a pixel.
    """
    import cv2

    if scale >= 1.0:
        return pixels
    if round(min(pixels.shape[:2]) * scale) < 1:
        size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
        return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
    return np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def shrink_in_strips(
    read: Callable[[int, int], NDArray[Any]], size_px: tuple[int, int], scale: float
) -> NDArray[np.float32]:
    """What `shrink` makes of float32, of a picture that is read by rows: read(top, count) gives (count, W).

    size_px: width, height. Rows and columns that are left over at the far edges may be left out.
    """
    import cv2

    width, height = size_px
    # A whole factor first. Where another follows that is to reduce to half at least: of pixels hardly smaller than its
    # own, an area filter makes averages of two.
    factor = 1.0 / scale
    whole = round(factor) if abs(factor - round(factor)) < _WHOLE_ERROR else int(factor / 2.0)
    whole = max(1, min(whole, width, height))
    count = max(1, _STRIP_PX // (width * whole)) * whole
    strips = []
    for top in range(0, height // whole * whole, count):
        rows = min(count, height // whole * whole - top)
        strip = np.ascontiguousarray(read(top, rows)[:, : width // whole * whole], np.float32)
        size = width // whole, rows // whole
        strips.append(strip if whole == 1 else cv2.resize(strip, size, interpolation=cv2.INTER_AREA))
    return np.asarray(shrink(np.concatenate(strips), min(1.0, scale * whole)), np.float32)


def scale_within(max_size_px: int, width_px: int, height_px: int) -> float:
    """What reduces a picture to a longer side of max_size_px, 0 for any: at most 1."""
    return min(1.0, max_size_px / max(width_px, height_px)) if max_size_px else 1.0


def shrink_camera(camera: Camera, scale: float) -> Camera:
    """The camera of the picture that `shrink` makes."""
    if scale >= 1.0:
        return camera
    return resized(camera, scale, max(1, round(camera.width_px * scale)), max(1, round(camera.height_px * scale)))
