"""From stored values to light: gains are factors on light, and stored values are bent by a tone curve."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray

# IEC 61966-2-1 (sRGB): a straight toe, then ((v + offset) / (1 + offset)) ** power.
_TOE, _SLOPE, _OFFSET, _POWER = 0.04045, 12.92, 0.055, 2.4
# Deeper pictures have no fixed white: what this share of their values stays below counts as white.
_WHITE_PERCENTILE = 99.8
# Stored level from which raised values are bent, so that none is clipped.
_KNEE = 0.88


@dataclass(frozen=True)
class Tone:
    """How a picture's stored values stand for light.

    white: the stored value of level 1. linear: stored values are proportional to light (16-bit single bands, as
    multispectral cameras write them); all others are taken to follow sRGB's curve.
    """

    white: float
    linear: bool

    def light(self, levels: FloatArray) -> FloatArray:
        """Linear light of levels (stored value / white), same shape, float32."""
        levels = levels.astype(np.float32, copy=False)
        if self.linear:
            return levels
        curved = np.power((levels + np.float32(_OFFSET)) / np.float32(1.0 + _OFFSET), np.float32(_POWER))
        return np.where(levels <= _TOE, levels / np.float32(_SLOPE), curved)

    def factor(self, level: FloatArray, log_gain: FloatArray) -> FloatArray:
        """Factor (H, W) on stored values that multiplies light by exp(log_gain) >= 1, without clipping.

        level: (H, W) float32, stored value of the pixel's brightest band / white; one factor for all bands keeps hue.
        The raised level is straight up to the knee and then bent so that white stays white: monotone, so no edge is
        made or turned.
        """
        safe = np.maximum(level, np.float32(1e-4))
        if self.linear:
            raised, top = safe * np.exp(log_gain), np.exp(log_gain)
        else:
            gain = np.exp(log_gain / np.float32(_POWER))
            raised = gain * (safe + np.float32(_OFFSET)) - np.float32(_OFFSET)
            # In the straight toe the factor on stored values is the gain itself.
            raised = np.minimum(raised, safe * np.exp(log_gain))
            top = gain * np.float32(1.0 + _OFFSET) - np.float32(_OFFSET)
        bent = _KNEE + (raised - _KNEE) * ((1.0 - _KNEE) / np.maximum(top - _KNEE, 1.0 - _KNEE))
        raised = np.where(raised > _KNEE, np.minimum(raised, bent), raised)
        return np.maximum(raised / safe, np.float32(1.0))


def white_of(values: NDArray[Any], valid: BoolArray | None) -> float:
    """The stored value that counts as white in values (H, W) or (H, W, C), of what is valid (H, W; None = all)."""
    if values.dtype == np.uint8:
        return 255.0
    known = values if valid is None or not valid.any() else values[valid]
    return max(1.0, float(np.percentile(known, _WHITE_PERCENTILE)))


def tone_of(pixels: NDArray[Any], overview: NDArray[Any], valid: BoolArray | None) -> Tone:
    """The tone of a picture (H, W) or (H, W, C); overview: the same picture reduced, with its stored values, and where
    that is valid."""
    return Tone(white_of(overview, valid), linear=pixels.dtype != np.uint8 and pixels.ndim == 2)
