"""Colour of lifted shadow: skylight is bluer than the sun's, and the hue of what is nearly black is noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.strategies.enhancers.brightness import brightness

# Level of the brightest band, as stored, from which the hue of a shadow is believed.
_KNOWN_LEVEL = 0.16
# Stored values follow light by about this power (sRGB as a whole).
_POWER = 2.2
# Largest change of a band against green: a pair of materials may be taken for one.
_LARGEST_LOG = 0.7


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
