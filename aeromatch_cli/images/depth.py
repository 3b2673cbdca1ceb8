"""Depth of pixels: other number types to 16 bits, 16 bits to 8, colours around points."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray

# 16-bit pictures are stretched between these percentiles: a cast would leave a 12-bit sensor black.
_STRETCH_PERCENTILES = (0.5, 99.5)

# The range of float pictures, and of whole numbers that are no uint16: a few outliers are not to make the rest flat.
_RANGE_PERCENTILES = (0.1, 99.9)

_TOP_16_BIT = 65535

# Pixels that are decoded or stretched at once.
STRIP_PIXELS = 4_000_000

_COLOUR_LEVELS = 7  # squares of 1, 2, 4 ... 64 px


def in_16_bits(pixels: NDArray[Any], valid: BoolArray | None = None) -> NDArray[Any]:
    """A picture of whole or floating numbers as uint16; uint8 and uint16 as they are. NaN and infinity become 0.

    Whole numbers that all lie within 0-65535 keep their values. Others are scaled, all bands alike so that hue stays:
    the 99.9th percentile becomes 65535, and 0 stays 0, so that values stay proportional to light; where the 0.1th
    percentile is negative (temperatures, say), that becomes 0. Only what is valid (H, W; None = all) counts, and no
    zeros, for they may be a frame.
    """
    if pixels.dtype in (np.uint8, np.uint16):
        return pixels
    there = np.isfinite(pixels)
    if valid is not None:
        there &= valid if pixels.ndim == 2 else valid[..., None]
    seen = pixels[there & (pixels != 0)]
    if not seen.size:
        return np.zeros(pixels.shape, np.uint16)
    known = np.where(there, pixels, 0)
    if pixels.dtype.kind in "iu" and seen.min() >= 0 and seen.max() <= _TOP_16_BIT:
        return known.astype(np.uint16)
    exact = np.result_type(pixels.dtype, np.float32)
    low, high = (float(value) for value in np.percentile(seen.astype(exact), _RANGE_PERCENTILES))
    low = min(low, 0.0)
    with np.errstate(over="ignore"):  # an outlier may be beyond float32 once it is scaled
        scaled = np.rint((known.astype(exact) - low) * (_TOP_16_BIT / ((high - low) or 1.0)))
    # What is not 0 stays above it, however dark or cold: zeros may be a frame.
    return np.where(there, np.clip(scaled, known != 0, _TOP_16_BIT), 0).astype(np.uint16)


def to_gray8(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """(H, W) uint8 of a uint8 or uint16 picture; 16 bits are stretched between percentiles of their own values."""
    import cv2

    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) if pixels.ndim == 3 else pixels
    return np.asarray(gray) if gray.dtype == np.uint8 else _stretched(gray, gray)


def sample_colours(pixels: NDArray[Any], points_px: FloatArray, sizes_px: FloatArray) -> NDArray[np.uint8]:
    """(N, 3) uint8 RGB around points (N, 2) of a picture, averaged over a square of half to all of each size (N,).

    Gray pictures give it thrice; 16 bits are stretched as in `to_gray8`, all bands alike so that hue stays.
    """
    import cv2

    levels = min(_COLOUR_LEVELS, int(np.log2(min(pixels.shape[:2]))) + 1)
    level = np.clip(np.floor(np.log2(np.maximum(sizes_px, 1.0))), 0, levels - 1).astype(np.int64)
    found = np.zeros((len(points_px), 3), np.float32)
    reduced, scale = pixels, 1.0
    for step in range(levels):
        height, width = reduced.shape[:2]
        of_level = np.flatnonzero(level == step)
        places = np.rint((points_px[of_level].astype(np.float64) + 0.5) * scale - 0.5).astype(np.int64)
        values = reduced[np.clip(places[:, 1], 0, height - 1), np.clip(places[:, 0], 0, width - 1)]
        found[of_level] = values if values.ndim == 2 else values[:, None]
        if not (level > step).any():
            break
        reduced, scale = cv2.resize(reduced, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), scale * 0.5
    return _stretched(found, pixels)


def _stretched(values: NDArray[Any], pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Values of a picture in 8 bits: as they are where it has 8, else between percentiles of the picture."""
    if pixels.dtype == np.uint8:
        return np.clip(np.rint(values), 0, 255).astype(np.uint8)
    low, high = _percentiles(pixels)

    def in_8_bits(numbers: NDArray[Any]) -> NDArray[np.uint8]:
        stretched = (numbers.astype(np.float32) - low) * (255.0 / max(float(high - low), 1e-6))
        return np.clip(np.rint(stretched), 0, 255).astype(np.uint8)

    if values.dtype != np.uint16:
        return in_8_bits(values)
    # By a table, in strips: in floating numbers a large picture would take ten times its own memory.
    table = in_8_bits(np.arange(_TOP_16_BIT + 1))
    found = np.empty(values.shape, np.uint8)
    for rows in strips(*values.shape[:2]):
        found[rows] = table[values[rows]]
    return found


def _percentiles(pixels: NDArray[np.uint16]) -> tuple[np.float64, np.float64]:
    """_STRETCH_PERCENTILES of the values other than 0, (0, 1) where there are none: as np.percentile has them."""
    counts = np.zeros(_TOP_16_BIT + 1, np.int64)
    for rows in strips(*pixels.shape[:2]):
        counts += np.bincount(pixels[rows].ravel(), minlength=len(counts))
    counts[0] = 0
    until = np.cumsum(counts)
    if not until[-1]:
        return np.float64(0.0), np.float64(1.0)
    places = np.array(_STRETCH_PERCENTILES) / 100.0 * (until[-1] - 1)
    below = np.floor(places).astype(np.int64)
    first, second = (np.searchsorted(until, at, side="right") for at in (below, np.minimum(below + 1, until[-1] - 1)))
    share = places - below
    # From the nearer one, as numpy does.
    between = np.where(share < 0.5, first + (second - first) * share, second - (second - first) * (1.0 - share))
    return between[0], between[1]


def strips(height_px: int, width_px: int) -> Iterator[slice]:
    """Rows of a picture, some megapixels at a time."""
    rows = max(1, STRIP_PIXELS // width_px)
    return (slice(top, top + rows) for top in range(0, height_px, rows))
