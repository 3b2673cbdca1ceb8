"""Colour as evidence: matches whose places have clearly different colours are dropped."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import Candidates, FloatArray, PairGeometry, Verdict
from aeromatch_cli.strategies import Strategy

# Added to every 8-bit channel before the logarithm: in the dark a level or two of noise is no other colour.
_DARK_LEVELS = 16.0
# How much more the light of sun and sky may differ than the colour of a thing.
_DAYLIGHT = 2.0
_FEWEST = 8  # matches that tell the gain between two images


class Colour(Strategy):
    """Drops matches whose chromaticity clearly differs.

    Colours are those of the enhanced images around both keypoints. One gain per channel, the median ratio over the
    pair, takes exposure and white balance away; taking the mean of the log channels away leaves chromaticity. Sunlight
    and the blue light of the sky, which is all that shadow gets, differ along blue against red: differences along that
    axis count half. Colour limits matches and is no evidence for them, so the verdict is "not verifiable" with
    the others kept. Without colours, and in gray images, everything passes.
    """

    version: ClassVar[int] = 1
    needs: ClassVar[frozenset[str]] = frozenset({"colour"})
    verifies: ClassVar[bool] = False
    name: Literal["colour"] = "colour"
    max_distance: float = Field(
        0.15,
        gt=0.0,
        description="Largest distance in log chromaticity; 0.15 is green stronger by a fifth. Larger: fewer matches "
        "are dropped.",
    )
    max_distance_medians: float = Field(
        4.0,
        ge=0.0,
        description="The limit is at least this many times the pair's median distance, for noisy colours. Larger: "
        "fewer matches are dropped.",
    )

    def __call__(self, candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict:
        """errors_px stay unknown: colours have no pixels."""
        everything = np.ones(len(candidates), dtype=bool)
        if candidates.colours0 is None or candidates.colours1 is None:
            return Verdict(keep=everything, state="not verifiable", reason="no colours to compare")
        if len(candidates) < _FEWEST:
            return Verdict(keep=everything, state="not verifiable", reason="too few matches to compare exposures")
        distances = chromaticity_distances(candidates.colours0, candidates.colours1)
        keep = distances <= max(self.max_distance, self.max_distance_medians * float(np.median(distances)))
        return Verdict(keep=keep, state="not verifiable", reason="colours limit the matches but do not verify them")


def chromaticity_distances(colours0: NDArray[Any], colours1: NDArray[Any]) -> FloatArray:
    """Distance (M,) of log chromaticities of RGB (M, 3), 0-255, after one gain per channel for the whole pair.

    The gain is the median log ratio: matches that are wrong on either side alike leave it where it is. Differences
    along blue against red count half, those along green against both in full.
    """
    ratio = np.log(colours1 + _DARK_LEVELS) - np.log(colours0 + _DARK_LEVELS)
    ratio -= np.median(ratio, axis=0)
    red, green, blue = ratio.T
    daylight, other = (blue - red) / np.sqrt(2.0), (2.0 * green - red - blue) / np.sqrt(6.0)
    return np.asarray(np.hypot(daylight / _DAYLIGHT, other))
