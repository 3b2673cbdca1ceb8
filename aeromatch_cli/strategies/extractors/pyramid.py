"""A picture at scales an octave or half an octave apart, and patches cut out of it at any place, size and turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.errors import ItemError

PATCH_PX = 32
# A patch shows this many keypoint sizes: a keypoint of 5 px has a patch of 32 stored pixels.
SUPPORT = 6.4
PER_OCTAVE = 2
STEP = 2.0 ** (-1.0 / PER_OCTAVE)
_SMALLEST_PX = 32
# cv2.remap addresses rows by 16 bits.
_PER_CALL, _LONGEST_PX = 512, 32_766


@dataclass(frozen=True, eq=False)
class Level:
    """gray: (h, w) uint8 or float32. scale: (2,) level pixels per picture pixel, x and y: 1 or less."""

    gray: NDArray[Any]
    scale: FloatArray

    def from_picture(self, points_px: FloatArray) -> FloatArray:
        """Points (N, 2) of the picture in the level's pixels."""
        return np.asarray((points_px + 0.5) * self.scale - 0.5)

    def to_picture(self, points_px: FloatArray) -> FloatArray:
        """Points (N, 2) of the level in the picture's pixels."""
        return np.asarray((points_px + 0.5) / self.scale - 0.5)


def levels_of(gray: NDArray[Any], most: int = 16, per_octave: int = PER_OCTAVE) -> list[Level]:
    """The picture (H, W) itself, then area averages of it at equal ratios, as long as a patch fits in."""
    import cv2

    height, width = gray.shape
    found = [Level(gray, np.ones(2))]
    while len(found) < most:
        scale = (2.0 ** (-1.0 / per_octave)) ** len(found)
        size = round(width * scale), round(height * scale)
        if min(size) < _SMALLEST_PX:
            break
        # From the level twice as large where there is one: exact halves, and far fewer pixels to read.
        larger = found[-min(per_octave, len(found))]
        small = cv2.resize(larger.gray, size, interpolation=cv2.INTER_AREA)
        found.append(Level(small, np.array(size) / np.array([width, height])))
    return found


def cut_patches(
    levels: Sequence[Level], points_px: FloatArray, sizes_px: FloatArray, angles_deg: FloatArray, side: int = PATCH_PX
) -> NDArray[Any]:
    """Patches (N, side, side) of the levels' type around points (N, 2) of the picture.

    sizes_px: (N,) diameters of the keypoints; a patch shows SUPPORT of them from its first pixel's edge to its last's.
    angles_deg: (N,) of the direction, x towards y, that lies along a patch's rows. Bilinear, of the coarsest level that
    is no coarser than the patch; beyond the picture its edge is repeated. Raises ItemError where that is too long.
    """
    import cv2

    out = np.empty((len(points_px), side, side), levels[0].gray.dtype)
    steps_px = SUPPORT * np.asarray(sizes_px, np.float64) / side
    grid = np.arange(side) - (side - 1) / 2.0
    across, down = np.meshgrid(grid, grid)
    angles = np.deg2rad(np.asarray(angles_deg, np.float64))
    which = _levels_for(levels, steps_px)
    for index in np.unique(which):
        level = levels[int(index)]
        if max(level.gray.shape) > _LONGEST_PX:
            raise ItemError(
                f"an image {max(level.gray.shape):,} px long is too long for patches around keypoints: "
                f"reduce it with --max-size {_LONGEST_PX}"
            )
        for chunk in _chunks(np.flatnonzero(which == index)):
            cosine, sine = (steps_px[chunk] * f(angles[chunk]) for f in (np.cos, np.sin))
            places = np.stack(
                [
                    points_px[chunk, 0, None, None] + cosine[:, None, None] * across - sine[:, None, None] * down,
                    points_px[chunk, 1, None, None] + sine[:, None, None] * across + cosine[:, None, None] * down,
                ],
                axis=-1,
            )
            there = level.from_picture(places).astype(np.float32).reshape(-1, side, 2)
            there_x, there_y = np.ascontiguousarray(there[..., 0]), np.ascontiguousarray(there[..., 1])
            cut = cv2.remap(level.gray, there_x, there_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            out[chunk] = cut.reshape(-1, side, side)
    return out


def _levels_for(levels: Sequence[Level], steps_px: FloatArray) -> IntArray:
    """(N,) the coarsest level whose pixels are no larger than a step, up to rounding."""
    octaves = np.log2(np.maximum(steps_px, 1.0)) / -np.log2(STEP)
    return np.asarray(np.clip(np.floor(octaves + 0.01), 0, len(levels) - 1), np.int64)


def _chunks(which: IntArray) -> list[IntArray]:
    return [which[start : start + _PER_CALL] for start in range(0, len(which), _PER_CALL)]
