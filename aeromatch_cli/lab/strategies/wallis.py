"""Wallis filter: local mean and standard deviation of the brightness are brought towards targets.

Wallis 1976, "An approach to the space variant restoration and enhancement of images".
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import BoolArray
from aeromatch_cli.lab.strategies.rescaling import with_brightness
from aeromatch_cli.strategies import Enhanced
from aeromatch_cli.strategies.enhancers.brightness import brightness
from aeromatch_cli.strategies.enhancers.kept_source import KeepsSource
from aeromatch_cli.strategies.enhancers.tone import white_of

_STRIP_ROWS = 256


class WallisEnhancement(KeepsSource):
    """Wallis filter: local mean and contrast are brought to targets; hue is kept, except where a band saturates."""

    needs_colour: ClassVar[bool] = False
    name: Literal["wallis"] = "wallis"
    window_share: float = Field(
        0.04,
        gt=0.0,
        le=1.0,
        description="Side of the window as a share (0-1) of the longer image side. Larger: less local.",
    )
    mean: float = Field(0.5, ge=0.0, le=1.0, description="Target mean of the brightness, as a share (0-1) of white.")
    standard_deviation: float = Field(
        0.2,
        gt=0.0,
        le=0.5,
        description="Target standard deviation of the brightness, as a share (0-1) of white. Larger: more contrast.",
    )
    contrast: float = Field(
        0.8,
        ge=0.0,
        le=1.0,
        description="Weight (0-1) of the target standard deviation: 0 = all local contrast taken away, 1 = reached "
        "everywhere.",
    )
    brightness: float = Field(
        0.9, ge=0.0, le=1.0, description="Weight (0-1) of the target mean: 0 = unchanged, 1 = reached everywhere."
    )

    def __call__(self, pixels: NDArray[Any], valid: BoolArray | None) -> Enhanced:
        """pixels (H, W) or (H, W, C) uint8 or uint16; no mask. What is not valid counts in no neighbourhood."""
        source = brightness(pixels)
        filtered = self._filtered(source, valid, white_of(source, valid))
        return Enhanced(with_brightness(pixels, source, filtered))

    def _filtered(self, source: NDArray[Any], valid: BoolArray | None, white: float) -> NDArray[Any]:
        """g = (f - m) c S / (c s + (1 - c) S) + b M + (1 - b) m, m and s the local mean and spread, M and S wanted."""
        import cv2

        half = max(1, round(0.5 * self.window_share * max(source.shape)))
        side, top_value = 2 * half + 1, float(np.iinfo(source.dtype).max)
        wanted = self.standard_deviation * white
        out = np.empty_like(source)
        for top in range(0, len(source), _STRIP_ROWS):
            first, last = max(0, top - half), min(len(source), top + _STRIP_ROWS + half)
            values = source[first:last].astype(np.float32)
            counted = values
            if valid is not None:
                seen = valid[first:last].astype(np.float32)
                counted = values * seen
                share = np.maximum(cv2.blur(seen, (side, side), borderType=cv2.BORDER_REFLECT), np.float32(1e-6))
            mean = cv2.blur(counted, (side, side), borderType=cv2.BORDER_REFLECT)
            square = cv2.sqrBoxFilter(counted, cv2.CV_64F, (side, side), borderType=cv2.BORDER_REFLECT)
            if valid is not None:
                mean, square = mean / share, square / share
            spread = np.sqrt(np.maximum(square - mean.astype(np.float64) ** 2, 0.0)).astype(np.float32)
            slope = self.contrast * wanted / (self.contrast * spread + (1.0 - self.contrast) * wanted + 1e-3 * white)
            level = self.brightness * self.mean * white + (1.0 - self.brightness) * mean
            rows = slice(top - first, min(top + _STRIP_ROWS, len(source)) - first)
            bounded = np.clip(np.rint((values - mean) * slope + level), 0.0, top_value)[rows]
            out[top : top + _STRIP_ROWS] = bounded.astype(source.dtype)
        return out
