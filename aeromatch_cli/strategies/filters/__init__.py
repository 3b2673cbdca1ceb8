"""Filters: strategy(points0_px, points1_px, geometry, seed) -> Verdict, and how several make a chain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from aeromatch_cli.data import FloatArray, PairGeometry, Verdict
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.filters.poselib import Poselib

FILTERS: dict[str, type[Strategy]] = {"poselib": Poselib}


class Filter(Protocol):
    name: str

    def __call__(
        self, points0_px: FloatArray, points1_px: FloatArray, geometry: PairGeometry, seed: int
    ) -> Verdict: ...


def apply_chain(
    filters: Sequence[Filter], points0_px: FloatArray, points1_px: FloatArray, geometry: PairGeometry, seed: int
) -> Verdict:
    """Each filter judges what the ones before it kept; the first that does not verify ends the chain."""
    keep = np.ones(len(points0_px), dtype=bool)
    verdict = Verdict(keep, "not verifiable", "the chain holds no filter")
    rejected: dict[str, int] = {}
    for strategy in filters:
        verdict = strategy(points0_px[keep], points1_px[keep], geometry, seed)
        before = int(keep.sum())
        keep[keep] = verdict.keep
        rejected[strategy.name] = before - int(keep.sum())
        if verdict.state != "verified":
            break
    from dataclasses import replace

    errors = verdict.errors_px
    if errors is not None:
        full = np.full(len(keep), np.nan, np.float32)
        full[keep] = errors[verdict.keep]
        errors = full
    return replace(verdict, keep=keep, rejected=rejected, errors_px=errors)
