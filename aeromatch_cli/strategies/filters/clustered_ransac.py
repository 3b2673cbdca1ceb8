"""K-means clustered RANSAC: matches are clustered, and each cluster explained by planes of its own.

Source: J. Geo-inf. Sci. 2025(6), 1401-1419; the mathematics stands in geometry.planes.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import BoolArray, Candidates, PairGeometry, Verdict
from aeromatch_cli.geometry.planes import Planes, fit_planes
from aeromatch_cli.geometry.two_view import undistorted
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.filters.gate import shortage

# Without colours: matches for each cluster.
_MATCHES_PER_CLUSTER = 64
# Dominant colours: cells of 64 levels a channel that hold at least one in 32 places.
_LEVELS_PER_CELL, _DOMINANT_SHARE = 64, 1 / 32


class ClusteredRansac(Strategy):
    """K-means clusters of matches, each explained by planes of its own; matches on no plane need neighbours that move
    with them.

    The number of clusters follows the colour content: dominant colours of the matched places in image 0 (see
    `dominant_colours`), or one per 64 matches where the extractor keeps no colours; never so many that they
    hold less than 24 matches on average. Small structures, trees and facades that make no plane are kept by local
    support; the more of a pair's matches are explained, the less of it is asked, for where few are wrong, being alone
    is no sign of being wrong. Where planes and support do not explain min_inliers matches there is too little to judge
    by: everything is left to the filters after this one, and the verdict is "not verifiable".
    """

    version: ClassVar[int] = 3
    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    name: Literal["clustered-ransac"] = "clustered-ransac"
    clusters: int = Field(
        0,
        ge=0,
        description="Largest number of clusters; 0 = the number of dominant colours. Larger: smaller planes are "
        "found, more time.",
    )
    planes: int = Field(
        3,
        ge=1,
        description="Largest number of planes per cluster, found one after the other. Larger: more matches are kept, "
        "more time.",
    )
    threshold_px: float = Field(
        3.0,
        gt=0.0,
        description="Largest distance from a plane (larger of both directions), undistorted pixels. Larger: more "
        "matches, less accurate ones.",
    )
    min_support: float = Field(
        3.0,
        gt=0.0,
        description="Smallest weighted number of neighbours (0-6) that must move with a match on no plane; fewer in "
        "pairs where more than half of the matches are explained. Larger: more matches are dropped.",
    )
    min_inliers: int = Field(
        15,
        ge=8,
        description="Smallest number of matches, and of explained matches, of a verified pair. Larger: fewer pairs, "
        "fewer of them wrong.",
    )

    def __call__(self, candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict:
        """The Verdict has the homography of the plane with most matches, and distances to each match's own plane."""
        found, usable = self.find_planes(candidates, geometry, seed)
        explained = self._explained(found)
        if not len(found.homographies) or explained.sum() < self.min_inliers:
            reason = f"{int(explained.sum())} of {len(usable)} matches lie on planes, {self.min_inliers} needed"
            return Verdict(keep=usable, state="not verifiable", reason=reason)
        keep = np.zeros(len(usable), dtype=bool)
        keep[usable] = explained
        errors = np.full(len(usable), np.nan, dtype=np.float32)
        errors[usable] = np.where(np.isfinite(found.residuals_px), found.residuals_px, np.nan)
        largest = np.bincount(found.labels[found.labels >= 0], minlength=1).argmax()
        return Verdict(
            keep=keep,
            state="verified",
            model_kind="H",
            model=found.homographies[largest],
            errors_px=errors,
            doubt=lambda left: shortage(int((keep & left).sum()), len(keep), self.min_inliers),
        )

    def _explained(self, found: Planes) -> BoolArray:
        """Which matches (N,) lie on planes or have support enough."""
        strictly = (found.labels >= 0) | (found.support >= self.min_support)
        wrong = 1.0 - strictly.mean() if len(strictly) else 1.0
        needed = self.min_support * min(1.0, 2.0 * wrong)
        return np.asarray((found.labels >= 0) | ((found.support > 0.0) & (found.support >= needed)))

    def find_planes(self, candidates: Candidates, geometry: PairGeometry, seed: int) -> tuple[Planes, BoolArray]:
        """The planes among the matches that have undistorted pixels, and which of those given (M,) these are."""
        points0, points1, usable = undistorted(candidates.points0_px, candidates.points1_px, geometry)
        found = fit_planes(
            points0,
            points1,
            clusters=self.clusters or self._clusters_by_content(candidates),
            planes_per_cluster=self.planes,
            threshold_px=self.threshold_px,
            seed=seed,
        )
        return found, usable

    def _clusters_by_content(self, candidates: Candidates) -> int:
        if candidates.colours0 is None:
            return max(1, len(candidates) // _MATCHES_PER_CLUSTER)
        return dominant_colours(candidates.colours0)


def dominant_colours(colours: NDArray[Any]) -> int:
    """How many coarse colours, of 64 levels a channel, hold one in 32 of the places (N, 3) or more each; 1 at least."""
    cells = np.asarray(colours, np.int64) // _LEVELS_PER_CELL
    _, counts = np.unique(cells @ np.array([64, 8, 1]), return_counts=True)
    return max(1, int((counts >= _DOMINANT_SHARE * max(len(cells), 1)).sum()))
