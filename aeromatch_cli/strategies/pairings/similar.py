"""Pairs that look alike, for blocks without positions."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from aeromatch_cli.data import Block, Pair
from aeromatch_cli.geometry.footprints import block_footprints
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.pairings.measure import measured_pairs


class Similar(Strategy):
    """Images that look alike, by image retrieval from the descriptors of the first pass; whatever the poses say.

    Each image brings its most similar images that are no pair yet, so that there are `candidates` pairs per image.
    Pairs that the first pass has matched stay. Small blocks take all pairs. Needs a first pass (orient, not `none`).
    """

    name: Literal["similar"] = "similar"
    candidates: int = Field(
        20, ge=1, description="Number of pairs per image. Larger: fewer overlapping pairs are missed, more time."
    )

    def __call__(self, block: Block) -> list[Pair]:
        """Pairs of a block; see the family's table for the contract."""
        reasons = dict.fromkeys(block.tied, "first pass") | dict.fromkeys(block.similar, self.name)
        return measured_pairs(block, reasons, block_footprints(block))
