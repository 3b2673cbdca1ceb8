"""LightGlue for the features of ALIKED, with the weights that its authors have published."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from aeromatch_cli.strategies.matchers.lightglue.matcher import EveryPair


class AlikedLightGlue(EveryPair):
    """LightGlue, a network that matches by attention between both images, for the features of `extract=aliked`.

    Its weights are found in an installed package or in the weights folder (`aeromatch weights list`).
    Source: Lindenberger et al., LightGlue, ICCV 2023.
    """

    version: ClassVar[int] = 1
    reads_descriptors: ClassVar[str] = "ALIKED"
    name: Literal["lightglue-aliked"] = "lightglue-aliked"

    def usual_path(self) -> Path:
        """The published file. Raises ConfigError where it is not there."""
        from aeromatch_cli.nets.published import published_path

        return published_path("aliked_lightglue")
