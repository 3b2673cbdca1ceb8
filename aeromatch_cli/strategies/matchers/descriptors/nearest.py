"""Mutual nearest neighbours with the ratio test over views of like direction: the classical matcher."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from aeromatch_cli.strategies.matchers.descriptors.comparison import RATIO, Comparison, Found, ratio_test
from aeromatch_cli.strategies.matchers.descriptors.search import Search


class Nearest(Search):
    """Mutual nearest neighbours with Lowe's ratio test, between views of similar direction. Scores are 1 - d1/d2."""

    version: ClassVar[int] = 3
    name: Literal["nearest"] = "nearest"
    ratio: float = Field(
        RATIO,
        gt=0.0,
        le=1.0,
        description="Largest ratio of the distances to the nearest and the second nearest descriptor. Larger: more "
        "matches, more of them wrong.",
    )

    def scan(self, comparison: Comparison) -> Found:
        """Matches of all view pairs that are comparable, costs d1/d2."""
        return ratio_test(comparison, self.ratio)
