"""How cameras, poses and terrain are found before the images are matched: recipes, which `stages.orient` follows.

A first pass matches reduced source images. Where the given poses explain its matches they are used as they are; else
a mapper orients the block from the matches, with the given positions as observations.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from aeromatch_cli.strategies import Strategy


class FirstPass(Strategy):
    """What recipes with a first pass have in common."""

    mapper: ClassVar[Literal["global", "incremental"]] = "global"
    first_pass: ClassVar[bool] = True
    replaces: ClassVar[bool] = True
    size_px: int = Field(
        1600, ge=200, description="Longer side of the images of the first pass, pixels. Larger: more time, more exact."
    )
    keypoints: int = Field(
        2000,
        ge=100,
        description="Largest number of keypoints per image of the first pass; small images in blocks of more than "
        "100 take one per 200 pixels, blocks that fall into parts three times as many in a second try. Larger: more "
        "time, more ties.",
    )
    pixels_per_keypoint: float = Field(
        600.0,
        ge=0.0,
        description="Images are halved while they have more pixels per keypoint than this; where that leaves images "
        "out, all are looked at once more as they are. 0: never halved. Smaller: less time.",
    )
    neighbours: int = Field(
        20,
        ge=2,
        description="Number of nearest images by position that an image is compared with, at most 12 in a block of "
        "more than 100. Larger: more time.",
    )


class GlobalMapping(FirstPass):
    """Orients by pycolmap's global mapper (GLOMAP) where the given poses do not explain the matches."""

    name: Literal["global"] = "global"


class IncrementalMapping(FirstPass):
    """Orients by pycolmap's incremental mapper where the given poses do not explain the matches."""

    mapper: ClassVar[Literal["global", "incremental"]] = "incremental"
    name: Literal["incremental"] = "incremental"


class GivenPoses(FirstPass):
    """Keeps given poses and cameras as they are, and finds only the terrain; wrong ones are named all the same."""

    replaces: ClassVar[bool] = False
    name: Literal["given"] = "given"


class NoOrientation(Strategy):
    """No first pass: poses and cameras as given, ground only where it is stated."""

    first_pass: ClassVar[bool] = False
    name: Literal["none"] = "none"


ORIENTERS: Mapping[str, type[Strategy]] = {
    "global": GlobalMapping,
    "incremental": IncrementalMapping,
    "given": GivenPoses,
    "none": NoOrientation,
}
