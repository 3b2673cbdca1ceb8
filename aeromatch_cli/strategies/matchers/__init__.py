"""Matchers: strategy(features0, features1, geometry[, rasters]) -> Matches, once per pair."""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.matchers.descriptors.bidirectional import Bidirectional
from aeromatch_cli.strategies.matchers.descriptors.nearest import Nearest
from aeromatch_cli.strategies.matchers.lightglue.aliked import AlikedLightGlue
from aeromatch_cli.strategies.matchers.lightglue.learned import LearnedLightGlue
from aeromatch_cli.strategies.matchers.lightglue.matcher import LightGlue
from aeromatch_cli.strategies.matchers.polar import Polar

MATCHERS: Mapping[str, type[Strategy]] = {
    "nearest": Nearest,
    "bidirectional": Bidirectional,
    "lightglue": LightGlue,
    "lightglue-learned": LearnedLightGlue,
    "lightglue-aliked": AlikedLightGlue,
    "polar": Polar,
}
