"""No enhancement: pixels pass as they are."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray
from aeromatch_cli.strategies import Enhanced, Strategy


class NoEnhancement(Strategy):
    """The source image, unchanged."""

    needs_colour: ClassVar[bool] = False
    changes: ClassVar[bool] = False
    keep_source: ClassVar[bool] = False
    same_illumination_minutes: ClassVar[float] = 0.0
    name: Literal["none"] = "none"

    def __call__(self, pixels: NDArray[Any], valid: BoolArray | None) -> Enhanced:
        """The very same array, no mask."""
        return Enhanced(pixels)
