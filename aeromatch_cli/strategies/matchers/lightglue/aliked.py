"""LightGlue for the features of ALIKED, with the weights that its authors have published."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Found, ratio_test_both_ways
from aeromatch_cli.strategies.matchers.descriptors.search import guide_below_field, guided_field
from aeromatch_cli.strategies.matchers.lightglue.matcher import EVERY, Attention, network_below_field

_RATIO = 0.9


class AlikedLightGlue(Attention):
    """LightGlue, a network that matches by attention between both images, for the features of `extract=aliked`.

    Its weights are found in an installed package or in the weights folder (`aeromatch weights list`).
    Source: Lindenberger et al., LightGlue, ICCV 2023.
    """

    version: ClassVar[int] = 1
    reads_descriptors: ClassVar[str] = "ALIKED"
    signed: ClassVar[bool] = True
    name: Literal["lightglue-aliked"] = "lightglue-aliked"
    guided: bool = guided_field(default=True)
    guide_below_matches: int = guide_below_field(EVERY)
    network_below_matches: int = network_below_field(EVERY)

    def usual_path(self) -> Path:
        """The published file. Raises ConfigError where it is not there."""
        from aeromatch_cli.nets.published import published_path

        return published_path("aliked_lightglue")

    def scan(self, comparison: Comparison) -> Found:
        """The ratio test from either image."""
        return ratio_test_both_ways(comparison, _RATIO)
