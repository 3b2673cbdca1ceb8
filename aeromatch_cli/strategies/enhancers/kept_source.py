"""What enhancers have in common: whether the picture as it was taken stays in use."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from aeromatch_cli.strategies import Strategy


class KeepsSource(Strategy):
    """An enhancer whose picture is used instead of the one that was taken, or beside it."""

    changes: ClassVar[bool] = True
    keep_source: bool = Field(
        False,
        description="Find features in the picture as it was taken too, as many again; a pair uses what suits it.",
    )
    same_illumination_minutes: float = Field(
        20.0,
        ge=0.0,
        description="With beside: an image whose partners were all taken within so many minutes of it is left as it "
        "is (the sun moves by 5 degrees in 20 minutes, so their shadows are alike); 0, or an unknown time: never. "
        "Without beside it has no effect: every image is enhanced.",
    )
