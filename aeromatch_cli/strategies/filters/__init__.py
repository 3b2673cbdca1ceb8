"""Filters: strategy(candidates, geometry, seed) -> Verdict, stored pixels; `apply_chain` composes them."""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.filters.chain import apply_chain as apply_chain
from aeromatch_cli.strategies.filters.clustered_ransac import ClusteredRansac
from aeromatch_cli.strategies.filters.colour import Colour
from aeromatch_cli.strategies.filters.epipolar import Epipolar
from aeromatch_cli.strategies.filters.graph import Graph
from aeromatch_cli.strategies.filters.pose import PoseBand
from aeromatch_cli.strategies.filters.poselib import Poselib

FILTERS: Mapping[str, type[Strategy]] = {
    "poselib": Poselib,
    "pose": PoseBand,
    "colour": Colour,
    "graph": Graph,
    "clustered-ransac": ClusteredRansac,
    "epipolar": Epipolar,
}
