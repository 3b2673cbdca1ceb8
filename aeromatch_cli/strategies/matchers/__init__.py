"""Matchers: strategy(features0, features1, geometry) -> Matches, once per pair."""

from __future__ import annotations

from aeromatch_cli.strategies.matchers.lightglue import LightGlue
from aeromatch_cli.strategies.matchers.nearest import Nearest

MATCHERS: dict[str, type[Nearest] | type[LightGlue]] = {"nearest": Nearest, "lightglue": LightGlue}
