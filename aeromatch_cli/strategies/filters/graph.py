"""Neighbourhood consistency: a match needs neighbours that move with it."""

from __future__ import annotations

from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from aeromatch_cli.data import BoolArray, Candidates, FloatArray, IntArray, PairGeometry, Verdict
from aeromatch_cli.geometry.affinities import joint_places, local_support, nearest_matches
from aeromatch_cli.geometry.two_view import undistorted
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.words import form

# The first round only clears the field, so that the second one's neighbours are true ones: it takes this many times the
# threshold and asks for the least support alone.
_COARSE = 5 / 3


class Graph(Strategy):
    """Neighbourhood consistency: keeps the matches whose neighbours in both images move with them.

    Matches are the nodes of a graph, joined with those nearest by where they lie in both images. A match is supported
    by the neighbours that one affinity through it explains, from either image alike: some of them, for at a depth step
    the others lie on another surface. How many it needs follows from how many those half of its neighbours have that
    have least: sparse parts and strips are not held to the support of open ground, a wrong match among true ones is.
    Two rounds: the first drops what next to nothing supports, the second compares what is left. Where they would leave
    fewer than min_matches there is too little to compare by, and everything passes. The graph limits matches and is no
    evidence for them: the verdict is "not verifiable" with the others kept.

    Source: the graph constraint of J. Geo-inf. Sci. 2021(10), 1823-1837; neighbours as evidence after Aguilar et al.,
    GTM, Image and Vision Computing 27(7), 2009, and Bian et al., GMS, CVPR 2017.
    """

    version: ClassVar[int] = 2
    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    verifies: ClassVar[bool] = False
    name: Literal["graph"] = "graph"
    neighbours: int = Field(
        12,
        ge=4,
        le=32,
        description="Number of nearest matches that each match is compared with; time grows with its cube.",
    )
    threshold_px: float = Field(
        3.0,
        gt=0.0,
        description="Largest distance of a neighbour from the place predicted by a local affinity, undistorted pixels "
        "of either image. Larger: fewer matches are dropped.",
    )
    min_support: float = Field(
        0.9,
        ge=0.0,
        description="Smallest weighted number of neighbours that must move with a match, besides the two that define "
        "its affinity. Larger: more matches are dropped.",
    )
    min_support_share: float = Field(
        0.6,
        ge=0.0,
        le=1.0,
        description="Smallest support of a match, as a share (0-1) of the mean support of the less supported half of "
        "its neighbours. Larger: more matches are dropped.",
    )
    min_matches: int = Field(20, ge=8, description="With fewer matches, before or after, the filter keeps all of them.")

    @model_validator(mode="after")
    def _can_be_had(self) -> Self:
        if self.min_support >= self.neighbours - 2:
            raise ValueError(
                f"min_support {self.min_support:g} is never reached: {self.neighbours} neighbours support by at most "
                f"{self.neighbours - 2}; lower min_support"
            )
        return self

    def __call__(self, candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict:
        """errors_px stay unknown: support has no pixels. Nothing is drawn at random."""
        points0, points1, usable = undistorted(candidates.points0_px, candidates.points1_px, geometry)
        if len(points0) < self.min_matches:
            few = form(len(points0), "match is", "matches are")
            return _passed(len(usable), f"{len(points0)} {few} too few to compare with their neighbours")
        alive = np.arange(len(points0))
        for fine in (False, True):
            alive = alive[self._supported(points0[alive], points1[alive], fine)]
            if len(alive) < self.min_matches:
                return _passed(len(usable), f"only {len(alive)} of {len(points0)} matches move with their neighbours")
        keep = np.zeros(len(usable), dtype=bool)
        keep[np.flatnonzero(usable)[alive]] = True
        return Verdict(keep=keep, state="not verifiable", reason="neighbours limit the matches but do not verify them")

    def _supported(self, points0: FloatArray, points1: FloatArray, fine: bool) -> BoolArray:
        """Which of the matches (M, 2) have support enough."""
        around: IntArray = nearest_matches(joint_places(points0, points1), self.neighbours)
        threshold_px = self.threshold_px if fine else _COARSE * self.threshold_px
        # One way alone, whatever falls together on one spot of image 1 would move with its neighbours.
        ways = ((points0, points1), (points1, points0))
        support = np.minimum(*(local_support(*way, around, threshold_px)[0] for way in ways))
        least = np.sort(support[around], axis=1)[:, : around.shape[1] // 2].mean(axis=1)
        return np.asarray(support >= np.maximum(self.min_support_share * least if fine else 0.0, self.min_support))


def _passed(count: int, reason: str) -> Verdict:
    return Verdict(keep=np.ones(count, dtype=bool), state="not verifiable", reason=reason)
