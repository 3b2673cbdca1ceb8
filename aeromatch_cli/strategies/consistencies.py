"""What is done about verified matches that contradict the adjusted block; `stages.consistency` follows it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from aeromatch_cli.strategies import Strategy


class BlockConsistency(Strategy):
    """Drops verified matches that contradict the adjusted block: its epipolar lines, and places in third images."""

    drops: ClassVar[bool] = True
    name: Literal["block"] = "block"
    epipolar_px: float = Field(
        1.5,
        gt=0.0,
        description="Largest distance of a match from the epipolar lines of the adjusted block, undistorted pixels; "
        "more in pairs that the block holds less exactly. Larger: more matches, less accurate ones.",
    )
    third_image_px: float = Field(
        4.0,
        gt=0.0,
        description="Largest distance of a keypoint of a third image from the place of the point there, pixels. "
        "Larger: fewer matches are dropped.",
    )
    min_matches: int = Field(
        15, ge=1, description="A pair that keeps fewer matches is rejected. Larger: fewer pairs, fewer of them wrong."
    )


class NoConsistency(Strategy):
    """Verified matches stay as the two images alone verify them."""

    drops: ClassVar[bool] = False
    name: Literal["none"] = "none"


CONSISTENCIES: Mapping[str, type[Strategy]] = {"block": BlockConsistency, "none": NoConsistency}
