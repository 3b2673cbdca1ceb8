"""Further steps of a cascade: recipes for pairs that the cheaper steps before leave with too few matches, or that may
have many more.

The first step is what the settings say of enhance, simulate, extract and match. `stages.cascade` follows the recipes;
the matches of all steps of a pair are verified together.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import Field

from aeromatch_cli.nets.precision import DEVICE, Device, Precision
from aeromatch_cli.strategies import Strategy

_KEYPOINTS: int | None = Field(
    None,
    ge=1,
    description="Largest number of descriptors per image of this step; null: as many as extract.keypoints. "
    "Larger: more matches, more time and memory.",
)


def _below_matches(default: int) -> Any:
    """The setting of one step: cheap ones are for more pairs."""
    return Field(
        default,
        ge=1,
        description="The step is taken by pairs with fewer verified matches than this times the share of the image "
        "that overlaps; fewer are enough where that is less than 40 %, and in proportion where an image has fewer "
        "than 2000 keypoints. Larger: more pairs take it, more time.",
    )


class Step(Strategy):
    """What all steps have in common: which pairs take them.

    own_features: it finds keypoints of its own, else it uses those of the first step, and what it finds replaces that
    step's matches. cheap_to_match: pairs take the step, too, whose images are both looked at for other pairs.
    expectation_weights: by which `stages.pair_statistics` expects how many matches a pair has after the step, as
    `scripts/train evidence` has found them; None: nothing is expected.
    """

    own_features: ClassVar[bool] = True
    cheap_to_match: ClassVar[bool] = False
    expectation_weights: ClassVar[tuple[float, ...] | None] = None
    name: str
    below_matches: int = _below_matches(600)
    below_coverage: float = Field(
        0.7,
        ge=0.0,
        le=1.0,
        description="And by pairs with an overlap of 40 % or more whose verified matches lie in less than this share "
        "of its cells (8 x 8 in the image). Larger: more pairs take it, more time.",
    )


class GuidedSearch(Step):
    """The first step's keypoints matched once more, within the windows that the poses predict and around the places
    that verified matches predict."""

    version: ClassVar[int] = 2
    own_features: ClassVar[bool] = False
    expectation_weights: ClassVar[tuple[float, ...] | None] = (-0.046, 0.734, 0.37, -0.105, -0.112)
    name: Literal["guided"] = "guided"
    # Two rendered nadir blocks (hills, suburb): 28,543 correct matches with 1000, 30,869 with 1500, 33,635 with 2000,
    # where `fusion` has 30,058.
    below_matches: int = _below_matches(1500)


_PRECISION: Precision = Field(
    "auto",
    description="Number type of the networks' layers; auto is bfloat16 where the processor has it. Results depend on "
    "it: set it explicitly for shards on different processors.",
)


class LearnedFeatures(Step):
    """Learned keypoints and descriptors on ground views, the ratio test from both images, LightGlue, guided search.

    Views are halved as by `extract=learned` itself, but never where `extract.pixels_per_keypoint` is 0.
    """

    version: ClassVar[int] = 4
    cheap_to_match: ClassVar[bool] = True
    expectation_weights: ClassVar[tuple[float, ...] | None] = (0.989, 0.852, -0.348, -0.018, 0.449)
    name: Literal["learned"] = "learned"
    # Two rendered nadir blocks (city, farmland): 16,664 correct matches with 600, 35,677 with 1000, 37,216 for every
    # pair; on easy ground (hills, suburb, sheffield, seneca) no pair has fewer.
    below_matches: int = _below_matches(1000)
    large_gain: float = Field(
        0.7,
        ge=0.0,
        description="Also taken by pairs with enough matches, but less than twice as many, and an overlap of 40 % or "
        "more, where an image has less than three quarters of the keypoints that were looked for and the step is "
        "expected to bring this share more matches (0.7: 70 %). Larger: fewer pairs take it, less time; 100: none.",
    )
    keypoints: int | None = _KEYPOINTS
    features: Literal["own", "aliked"] = Field(
        "own",
        description="Features of the package's own networks, or of ALIKED, which others have published "
        "(`aeromatch weights list` says whether its weights are there), on the processor in 32 bits.",
    )
    lightglue: bool = Field(
        True,
        description="Match the step's features not only by nearest neighbours, but also by the LightGlue that belongs "
        "to them; that of own features gets each keypoint's place on the ground by the poses. It compares the 1024 "
        "strongest descriptors of a view. false: fewer matches of difficult pairs, a little less time.",
    )
    precision: Precision = _PRECISION
    device: Device = DEVICE


STEPS: Mapping[str, type[Step]] = {"guided": GuidedSearch, "learned": LearnedFeatures}
