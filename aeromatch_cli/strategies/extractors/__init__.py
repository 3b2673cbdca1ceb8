"""Extractors: strategy(camera, views) -> Features, once per image."""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.extractors.aliked import Aliked
from aeromatch_cli.strategies.extractors.grid import Grid
from aeromatch_cli.strategies.extractors.learned import Learned
from aeromatch_cli.strategies.extractors.sift import Sift

EXTRACTORS: Mapping[str, type[Strategy]] = {"sift": Sift, "grid": Grid, "learned": Learned, "aliked": Aliked}
