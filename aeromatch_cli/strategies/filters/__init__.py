"""Filters: strategy(candidates, geometry, seed) -> Verdict, stored pixels; `apply_chain` composes them."""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.filters.chain import apply_chain as apply_chain
from aeromatch_cli.strategies.filters.pose import PoseBand
from aeromatch_cli.strategies.filters.poselib import Poselib

FILTERS: Mapping[str, type[Strategy]] = {"poselib": Poselib, "pose": PoseBand}
