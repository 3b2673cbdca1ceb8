"""Refiners: how exactly the places of tie points are measured once it is known which ones correspond."""

from __future__ import annotations

from collections.abc import Mapping

from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.refiners.least_squares import LeastSquares, NoRefinement

REFINERS: Mapping[str, type[Strategy]] = {"least-squares": LeastSquares, "none": NoRefinement}
