"""What enhancers have in common: whether the source image is used as well."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from aeromatch_cli.strategies import Strategy


class KeepsSource(Strategy):
    """An enhancer whose picture replaces the source image, or is used in addition to it."""

    changes: ClassVar[bool] = True
    keep_source: bool = Field(
        False,
        description="Also find features in the source image, with the same budget again; each pair uses the pictures "
        "that give more matches.",
    )
    same_illumination_minutes: float = Field(
        20.0,
        ge=0.0,
        description="With keep_source: an image is not enhanced if all images that it is paired with were taken "
        "within this many minutes (their shadows are alike: the sun moves by 5 degrees in 20 minutes). "
        "Larger: fewer images are enhanced; 0, or an unknown capture time: every image is.",
    )
