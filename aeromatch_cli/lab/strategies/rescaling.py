"""Putting a changed brightness back into a picture, without a change of hue below white."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.strategies.enhancers.brightness import multiplied

_STRIP_ROWS = 256


def with_brightness(pixels: NDArray[Any], before: NDArray[Any], after: NDArray[Any]) -> NDArray[Any]:
    """Pixels (H, W) or (H, W, C) scaled, all bands alike, so that their brightness `before` becomes `after`."""
    if pixels.ndim == 2:
        return after.astype(pixels.dtype)
    out = np.empty_like(pixels)
    for top in range(0, len(pixels), _STRIP_ROWS):
        rows = slice(top, top + _STRIP_ROWS)
        factor = after[rows].astype(np.float32) / np.maximum(before[rows].astype(np.float32), np.float32(1.0))
        out[rows] = multiplied(pixels[rows], factor)
    return out
