"""Every image with every other."""

from __future__ import annotations

from itertools import combinations
from typing import Literal

from aeromatch_cli.data import Block, Pair
from aeromatch_cli.geometry.footprints import block_footprints
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.pairings.measure import measured_pairs


class Exhaustive(Strategy):
    """All N (N - 1) / 2 pairs: for small blocks, and for unreliable poses."""

    name: Literal["exhaustive"] = "exhaustive"

    def __call__(self, block: Block) -> list[Pair]:
        """Pairs of a block; see the family's table for the contract."""
        ids = sorted(image.image_id for image in block.images)
        return measured_pairs(block, dict.fromkeys(combinations(ids, 2), self.name), block_footprints(block))
