"""LightGlue for learned features, which knows where the poses expect each keypoint on the ground."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from aeromatch_cli.data import BoolArray
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison
from aeromatch_cli.strategies.matchers.lightglue.inference import NetworkInput, with_expected_places
from aeromatch_cli.strategies.matchers.lightglue.matcher import Attention


class LearnedLightGlue(Attention):
    """LightGlue, a network that matches by attention between both images, for the features of `extract=learned`.

    The weights that ship turn the attention between both images by the places where poses and ground expect the
    keypoints (`nets.lightglue.Side.ground`), where both are known.
    """

    version: ClassVar[int] = 1
    reads_descriptors: ClassVar[str] = "GeoDesc"
    shipped: ClassVar[str] = "lightglue-learned"
    signed: ClassVar[bool] = True
    name: Literal["lightglue-learned"] = "lightglue-learned"
    expect_places: bool = Field(
        True, description="Tell the network where poses and ground expect each keypoint, where they are known."
    )

    def reads(self) -> frozenset[str]:
        """All of the geometry where places are expected."""
        return self.needs if self.expect_places else super().reads()

    def inputs(
        self, comparison: Comparison, view0: int, view1: int, shown: tuple[BoolArray, BoolArray]
    ) -> tuple[NetworkInput, NetworkInput]:
        """With the expected places."""
        side0, side1 = super().inputs(comparison, view0, view1, shown)
        if not self.expect_places:
            return side0, side1
        return with_expected_places(side0, side1, (comparison.features0, comparison.features1), comparison.geometry)
