"""Matchers: strategy(features0, features1, geometry) -> Matches, once per pair."""

from __future__ import annotations

from aeromatch_cli.strategies.matchers.nearest import Nearest

MATCHERS = {"nearest": Nearest}
