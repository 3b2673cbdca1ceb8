"""Contrast-limited adaptive histogram equalisation of the brightness (Zuiderveld, Graphics Gems IV, 1994, VIII.5)."""

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


class ClaheEnhancement(KeepsSource):
    """Contrast-limited adaptive histogram equalisation of the brightness."""

    needs_colour: ClassVar[bool] = False
    name: Literal["clahe"] = "clahe"
    clip_limit: float = Field(
        2.0,
        gt=0.0,
        le=100.0,
        description="Contrast limit of a tile's histogram, in OpenCV's unit. Larger: more contrast and more noise.",
    )
    tiles: int = Field(
        8, ge=1, le=256, description="Number of tiles along each side of the image. Larger: more local contrast."
    )

    def __call__(self, pixels: NDArray[Any], valid: BoolArray | None) -> Enhanced:
        """pixels (H, W) or (H, W, C) uint8 or uint16; no mask. What is not valid counts like the rest."""
        import cv2

        source = np.ascontiguousarray(brightness(pixels))
        equalised = cv2.createCLAHE(self.clip_limit, (self.tiles, self.tiles)).apply(source)
        return Enhanced(with_brightness(pixels, source, equalised))
