"""Which pairs of images to match.

Call: `strategy(block) -> list[Pair]`, sorted by (image_id0, image_id1) with image_id0 < image_id1, each pair once.
Every strategy fills overlap and view angle where both images have a footprint (pose with attitude, and a ground),
and NaN elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.pairings.exhaustive import Exhaustive
from aeromatch_cli.strategies.pairings.file import PairFile
from aeromatch_cli.strategies.pairings.overlap import Overlap
from aeromatch_cli.strategies.pairings.sequential import Sequential
from aeromatch_cli.strategies.pairings.similar import Similar

PAIRINGS: Mapping[str, type[Strategy]] = {
    "overlap": Overlap,
    "exhaustive": Exhaustive,
    "sequential": Sequential,
    "file": PairFile,
    "similar": Similar,
}
