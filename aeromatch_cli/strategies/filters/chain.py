"""How a list of filters composes into one verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from aeromatch_cli.data import BoolArray, Candidates, IntArray, PairGeometry, Verdict

# Part of the fingerprint of every verdict; raised when composing changes results.
VERSION = 2


class Filter(Protocol):
    name: str

    def __call__(self, candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict: ...


def apply_chain(filters: Sequence[Filter], candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict:
    """One verdict on the matches: each filter sees what those before it left.

    A refusal ends the chain and drops everything. Otherwise the last model wins, with its errors, and the pair is
    verified if what the filters after it leave would verify it too, as many inliers and beyond chance; without a model
    it is not verifiable, and what the filters left is kept. Reject counts are summed by filter name.
    """
    alive = np.arange(len(candidates))
    rejected: dict[str, int] = {}
    found, judged = Verdict(keep=_mask(len(alive), alive), state="not verifiable", reason="no filter was given"), alive
    judge = ""
    for one in filters:
        verdict, given = one(candidates.take(alive), geometry, seed), alive
        alive = given[verdict.keep]
        rejected[one.name] = rejected.get(one.name, 0) + len(given) - len(alive)
        if verdict.state == "rejected" or len(alive) == 0:
            if verdict.state == "not verifiable" and found.state == "verified":
                reason = _doubt(found, _mask(len(candidates), given)[judged]) or f"{one.name} left no match"
                verdict = replace(verdict, state="rejected", reason=reason)
            return _refusal(len(candidates), verdict, rejected)
        if verdict.state == "verified" or found.state != "verified":
            found, judged, judge = verdict, given, one.name
    if reason := _doubt(found, _mask(len(candidates), alive)[judged]):
        rejected[judge] += len(alive)
        return _refusal(len(candidates), replace(found, state="rejected", reason=reason), rejected)
    errors = np.full(len(candidates), np.nan, dtype=np.float32)
    if found.errors_px is not None:
        errors[judged] = found.errors_px
    return replace(found, keep=_mask(len(candidates), alive), errors_px=errors, rejected=rejected, doubt=None)


def _doubt(found: Verdict, left: BoolArray) -> str:
    """Why what is left (M,) of the matches given to the filter that verified the pair does not verify it."""
    if found.state != "verified" or found.doubt is None or bool((left == found.keep).all()):
        return ""
    return found.doubt(left)


def _refusal(count: int, verdict: Verdict, rejected: dict[str, int]) -> Verdict:
    """Nothing is kept, no model told."""
    nothing = np.zeros(count, dtype=bool)
    return Verdict(keep=nothing, state=verdict.state, reason=verdict.reason, rejected=rejected)


def _mask(count: int, which: IntArray) -> BoolArray:
    mask = np.zeros(count, dtype=bool)
    mask[which] = True
    return mask
