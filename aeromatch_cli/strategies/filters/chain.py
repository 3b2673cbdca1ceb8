"""How a list of filters composes into one verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from aeromatch_cli.data import BoolArray, Candidates, IntArray, PairGeometry, Verdict


class Filter(Protocol):
    name: str

    def __call__(self, candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict: ...


def apply_chain(filters: Sequence[Filter], candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict:
    """One verdict on the matches: each filter sees what those before it left.

    A refusal ends the chain and drops everything. Otherwise the last model wins, with its errors, and the pair is
    verified as long as the filters after it leave matches; without a model it is not verifiable, and what the filters
    left is kept. Reject counts are summed by filter name.
    """
    alive = np.arange(len(candidates))
    rejected: dict[str, int] = {}
    found, judged = Verdict(keep=_mask(len(alive), alive), state="not verifiable", reason="no filter was given"), alive
    for one in filters:
        verdict, given = one(candidates.take(alive), geometry, seed), alive
        alive = given[verdict.keep]
        rejected[one.name] = rejected.get(one.name, 0) + len(given) - len(alive)
        if verdict.state == "rejected" or len(alive) == 0:
            return _refusal(len(candidates), found, verdict, one.name, rejected)
        if verdict.state == "verified" or found.state != "verified":
            found, judged = verdict, given
    errors = np.full(len(candidates), np.nan, dtype=np.float32)
    if found.errors_px is not None:
        errors[judged] = found.errors_px
    return replace(found, keep=_mask(len(candidates), alive), errors_px=errors, rejected=rejected)


def _refusal(count: int, found: Verdict, last: Verdict, name: str, rejected: dict[str, int]) -> Verdict:
    """Nothing is kept: a filter refused the pair, or none of its matches is left."""
    nothing = np.zeros(count, dtype=bool)
    if last.state == "not verifiable" and found.state == "verified":
        return Verdict(keep=nothing, state="rejected", reason=f"{name} left no match", rejected=rejected)
    return Verdict(keep=nothing, state=last.state, reason=last.reason, rejected=rejected)


def _mask(count: int, which: IntArray) -> BoolArray:
    mask = np.zeros(count, dtype=bool)
    mask[which] = True
    return mask
