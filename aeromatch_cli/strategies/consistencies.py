"""What is done about verified matches that contradict the adjusted block; `stages.consistency` follows it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from aeromatch_cli.strategies import Strategy


class BlockConsistency(Strategy):
    """Drops verified matches that contradict the adjusted block: its epipolar lines, and places in third images."""

    name: Literal["block"] = "block"
    epipolar_px: float = Field(
        1.5,
        gt=0.0,
        description="Largest distance of a match from the epipolar lines of the adjusted block, pixels. Larger: more "
        "matches, less accurate ones.",
    )
    medians: float = Field(
        4.0,
        ge=1.0,
        description="That distance is at least this many times the median of the pair: some images are held less "
        "exactly than others. Larger: more matches, less accurate ones.",
    )
    third_image_px: float = Field(
        4.0,
        gt=0.0,
        description="A keypoint of a third image speaks for the match up to this distance from the place of the point "
        "there, pixels, beyond it against. Larger: fewer matches are dropped.",
    )
    min_probability: float = Field(
        0.0,
        ge=0.0,
        lt=1.0,
        description="Matches that are less likely to be right are dropped, by their score, their distance from the "
        "epipolar line, third images, neighbouring matches, and how loose the whole pair is; pairs without which "
        "images would fall apart keep their best 30. 0 = none. Larger: fewer matches, fewer of them wrong.",
    )
    min_expected_right: float = Field(
        0.0,
        ge=0.0,
        lt=1.0,
        description="Where a smaller share of the matches left in the block is expected to be right, the least "
        "probable ones are dropped as well, until this share is reached. 0 = none. Larger: fewer matches, fewer of "
        "them wrong.",
    )
    most_given_up: float = Field(
        0.15,
        ge=0.0,
        le=1.0,
        description="No larger share of the matches is given up for min_expected_right: on photographs of bare earth "
        "or forest most of them would be right. Larger: where min_expected_right is not reached, fewer matches, fewer "
        "of them wrong.",
    )
    min_matches: int = Field(
        15,
        ge=1,
        description="A pair that has lost matches and keeps fewer than this is rejected. Larger: fewer pairs, fewer of "
        "them wrong.",
    )


class NoConsistency(Strategy):
    """Verified matches stay as the two images alone verify them."""

    name: Literal["none"] = "none"


CONSISTENCIES: Mapping[str, type[Strategy]] = {"block": BlockConsistency, "none": NoConsistency}
