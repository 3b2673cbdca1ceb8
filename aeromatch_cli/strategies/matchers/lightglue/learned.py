"""LightGlue for learned features, which knows where the poses expect each keypoint on the ground."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from aeromatch_cli.data import BoolArray
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Found
from aeromatch_cli.strategies.matchers.descriptors.evidence import most_evident
from aeromatch_cli.strategies.matchers.descriptors.search import Steps
from aeromatch_cli.strategies.matchers.lightglue.inference import NetworkInput, with_expected_places
from aeromatch_cli.strategies.matchers.lightglue.matcher import EveryPair, width_field

# With places half a picture off, or turned by 90 degrees, 13 and 93 matches of a pair of ochota agree with one pose;
# with right places 805. A hard pair has few with right places, too, and more than without the network.
_FEW = 100


class LearnedLightGlue(EveryPair):
    """LightGlue, a network that matches by attention between both images, for the features of `extract=learned`.

    The weights that ship turn the attention between both images by the places where poses and ground expect the
    keypoints (`nets.lightglue.Side.ground`), where both are known.
    """

    version: ClassVar[int] = 3
    reads_descriptors: ClassVar[str] = "GeoDesc"
    shipped: ClassVar[str] = "lightglue-learned"
    name: Literal["lightglue-learned"] = "lightglue-learned"
    # Twelve real pairs of 2,048 descriptors: 240 correct matches a pair with 0.99, 239 with 0.95 in two fifths of the
    # network's seconds.
    width_confidence: float = width_field(0.95)
    expect_places: bool = Field(
        True, description="Tell the network where poses and ground expect each keypoint, where they are known."
    )

    def reads(self) -> frozenset[str]:
        """All of the geometry where places are expected."""
        return self.needs if self.expect_places else super().reads()

    def by_network(
        self, comparison: Comparison, shown: tuple[BoolArray, BoolArray] | None = None, known: int = 0
    ) -> Steps[Found]:
        """Once more without expected places where few agree with them, and no more than are known without the network:
        wrong ones hide all matches of a pair."""
        found = yield from super().by_network(comparison, shown, known)
        if not self.expect_places or len(found.rows) >= _FEW or len(found.rows) > known:
            return found
        anyhow = yield from self.model_copy(update={"expect_places": False}).by_network(comparison, shown)
        return most_evident(comparison, [found, anyhow])

    def inputs(
        self, comparison: Comparison, view0: int, view1: int, shown: tuple[BoolArray, BoolArray]
    ) -> tuple[NetworkInput, NetworkInput]:
        """With the expected places."""
        side0, side1 = super().inputs(comparison, view0, view1, shown)
        if not self.expect_places:
            return side0, side1
        return with_expected_places(side0, side1, (comparison.features0, comparison.features1), comparison.geometry)
