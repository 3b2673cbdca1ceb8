"""Each image with those taken shortly before and after it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from aeromatch_cli.data import Block, Pair
from aeromatch_cli.geometry.footprints import block_footprints
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.pairings.measure import measured_pairs
from aeromatch_cli.strategies.pairings.neighbours import name_order, order_neighbours, time_order


class Sequential(Strategy):
    """Pairs of images at most `window` places apart in the order of their names or capture times.

    order "time" sorts by capture time; images without one come last, in name order, and join the last timed ones.
    """

    name: Literal["sequential"] = "sequential"
    window: int = Field(
        default=10,
        ge=1,
        description="Number of images before and after each image that it is paired with. Larger: more pairs.",
    )
    order: Literal["name", "time"] = Field(
        default="name", description="Order of the images: by name or by capture time."
    )

    def __call__(self, block: Block) -> list[Pair]:
        """Pairs of a block; see the family's table for the contract."""
        ids = name_order(block)
        if self.order == "time":
            timed = time_order(block)
            known = set(timed)
            ids = timed + [image_id for image_id in ids if image_id not in known]
        keys = order_neighbours(ids, set(ids), self.window)
        return measured_pairs(block, dict.fromkeys(keys, self.name), block_footprints(block))
