"""Gains applied to the full picture, strip by strip: feathered, noise calmed, highlights kept, coloured as if lit.

Skylight is bluer than the sun's, and the hue of what is nearly black is noise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.strategies.enhancers.brightness import brightness, multiplied
from aeromatch_cli.strategies.enhancers.shadow_mask import SoftMask, guide_of
from aeromatch_cli.strategies.enhancers.tone import Tone

_STRIP_PX = 2**20  # pixels worked on at a time: bounds the memory whatever the size
_LEAST_LOG_GAIN = 0.02  # a smaller gain is less than rounding
_NOISE_ROWS = 64
_DETAIL_POWER, _DETAIL_REACH_PX = 0.61, 3
# Level of the brightest band, as stored, from which the hue of a shadow is believed.
_KNOWN_LEVEL = 0.16
# Stored values follow light by about this power (sRGB as a whole).
_POWER = 2.2
# Largest change of a band against green: a pair of materials may be taken for one.
_LARGEST_LOG = 0.7


def relit(
    pixels: NDArray[Any],
    valid: BoolArray | None,
    soft: SoftMask,
    inside: BoolArray,
    log_gain: FloatArray,
    tone: Tone,
    tint: FloatArray,
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """Pixels with their shadow lifted, and the mask (H, W) uint8, 255 = shadow.

    inside: (h, w) bool, the regions treated; log_gain: (h, w) float32; both, like `soft`, at the overview's size.
    tint: (2,) see `Regions`.
    """
    import cv2

    height, width = pixels.shape[:2]
    # A border that falls between two pixels of the overview lies within one pixel of its region.
    reach = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    small = np.dstack([soft.slope, soft.offset, log_gain, reach])
    lifted = pixels.copy()
    mask = np.zeros((height, width), dtype=np.uint8)
    rows = max(1, _STRIP_PX // width)
    noise = _noise_level(pixels, inside, tone)
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        slope, offset, gain, near = cv2.split(_enlarged(small, top, bottom, height, width))
        first, source = max(0, top - _DETAIL_REACH_PX), pixels[top:bottom]
        around = guide_of(pixels[first : bottom + _DETAIL_REACH_PX]).astype(np.float32) / np.float32(tone.white)
        level = around[top - first :][: bottom - top]
        share = np.clip(slope * level + offset, 0.0, 1.0) * np.minimum(near, 1.0)
        if valid is not None:
            share[~valid[top:bottom]] = 0.0
        mask[top:bottom] = np.where(share >= 0.5, np.uint8(255), np.uint8(0))
        log = gain * share
        changed = log > _LEAST_LOG_GAIN
        if not changed.any():
            continue
        calm = _calmed(around, noise)[top - first :][: bottom - top]
        factor = np.where(changed, tone.factor(level, log) * calm, np.float32(1.0))
        brighter = multiplied(source, np.maximum(factor, np.float32(1.0)))
        if brighter.ndim == 3 and brighter.shape[2] == 3:
            brighter = as_sunlit(brighter, level, np.where(changed, share, np.float32(0.0)), tint, linear=tone.linear)
        lifted[top:bottom] = brighter
    return lifted, mask


def _noise_level(pixels: NDArray[Any], inside: BoolArray, tone: Tone) -> float:
    """Standard deviation of the noise in shadow, as a level, from second differences along some rows.

    Texture makes most differences larger than noise does, so the lowest fifth of them says it; never below rounding.
    """
    height, width = pixels.shape[:2]
    rows = np.arange(0, height, max(1, height // _NOISE_ROWS))
    level = guide_of(pixels[rows]).astype(np.float32) / np.float32(tone.white)
    down, across = inside.shape[0] / height, inside.shape[1] / width
    row_idx = np.minimum((rows * down).astype(np.int64), inside.shape[0] - 1)
    column_idx = np.minimum((np.arange(width) * across).astype(np.int64), inside.shape[1] - 1)
    dark = inside[row_idx][:, column_idx][:, 1:-1]
    rounding = np.sqrt(1.0 / 12.0) / tone.white
    if not dark.any():
        return float(rounding)
    differences = np.abs(level[:, :-2] - 2.0 * level[:, 1:-1] + level[:, 2:])[dark]
    # A fifth of normal values lie within 0.2533 standard deviations; second differences have sqrt(6) times the noise.
    return max(float(np.quantile(differences, 0.2)) / (0.2533 * np.sqrt(6.0)), float(rounding))


def _calmed(level: FloatArray, noise: float) -> FloatArray:
    """Factor (H, W) that takes from the finest detail of level (H, W) what noise explains (Wiener's rule)."""
    import cv2

    detail = level - cv2.GaussianBlur(level, (3, 3), 0.8)
    power = cv2.blur(detail * detail, (5, 5))
    # Of white noise, this detail keeps the share of power that the difference from the blur lets through.
    expected = np.float32(_DETAIL_POWER * noise * noise)
    taken = detail * np.minimum(expected / np.maximum(power, expected), 1.0)
    return 1.0 - taken / np.maximum(level, np.float32(1e-3))


def _enlarged(small: FloatArray, top: int, bottom: int, height: int, width: int) -> FloatArray:
    """Rows top to bottom of `small` (h, w, C) enlarged to (height, width) bilinearly, pixel centres aligned."""
    import cv2

    down, across = small.shape[0] / height, small.shape[1] / width
    # Places of the strip's pixel centres in `small`.
    matrix = np.array([[across, 0.0, 0.5 * across - 0.5], [0.0, down, (top + 0.5) * down - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(small, matrix, (width, bottom - top), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    )


def as_sunlit(
    lifted: NDArray[Any], level: FloatArray, share: FloatArray, tint: FloatArray, *, linear: bool
) -> NDArray[Any]:
    """Lifted pixels (H, W, 3) in the colour that the sun would give them, their gray level unchanged up to rounding.

    level: (H, W) of the brightest band before, 0-1. share: (H, W) of shadow, 0-1; pixels without
    any stay as they are. tint: (2,) logarithms of by how much red over green, and blue over green, of light are larger
    where it is lit.
    """
    power = 1.0 if linear else _POWER
    change = np.clip(np.array([tint[0], 0.0, tint[1]]), -_LARGEST_LOG, _LARGEST_LOG) / power
    before = brightness(lifted).astype(np.float32)
    bands = lifted.astype(np.float32) * np.exp(share[..., None] * change.astype(np.float32))
    bands *= (before / np.maximum(brightness(bands), np.float32(1.0)))[..., None]
    doubt = share * (1.0 - np.clip(level / np.float32(_KNOWN_LEVEL), 0.0, 1.0))
    bands += doubt[..., None] * (before[..., None] - bands)
    coloured = np.clip(np.rint(bands), 0, np.iinfo(lifted.dtype).max).astype(lifted.dtype)
    return np.where((share > 0)[..., None], coloured, lifted)
