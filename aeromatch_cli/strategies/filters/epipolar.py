"""Verification by one epipolar geometry, with a band as narrow as the matches are accurate."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import Candidates, FloatArray, PairGeometry, Verdict
from aeromatch_cli.geometry.epipolar import sampson_distance_px
from aeromatch_cli.geometry.two_view import Sampling, estimate, undistorted
from aeromatch_cli.strategies.filters.gate import TwoViewGated

# Median of |x| of a normal variable is its standard deviation over this.
_SIGMA_OF_MEDIAN = 1.4826


class Epipolar(TwoViewGated):
    """One two-view geometry with a band that follows the accuracy of the matches.

    The geometry is found with `threshold_px`. The standard deviation of its inliers is estimated robustly, and the band
    narrowed to `sigmas` of it: what is locally consistent but globally impossible goes, and so do near misses.
    """

    version: ClassVar[int] = 2
    name: Literal["epipolar"] = "epipolar"
    sigmas: float = Field(
        6.0,
        gt=0.0,
        description="Half-width of the band around the epipolar line in standard deviations of the inliers, at most "
        "threshold_px. Larger: more matches are kept.",
    )
    min_band_px: float = Field(
        1.5, gt=0.0, description="Smallest half-width of the band, undistorted pixels. Larger: more matches are kept."
    )

    def __call__(self, candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict:
        """The Verdict has E (or F), Sampson errors and cam1_from_cam0's rotation."""
        points0, points1, usable = undistorted(candidates.points0_px, candidates.points1_px, geometry)
        refused = self.too_few(usable)
        if refused is not None:
            return refused
        found = estimate(points0, points1, geometry, self.model, Sampling(self.threshold_px), seed)
        errors = sampson_distance_px(found.pixel_model, points0, points1)
        band_px = self._band_px(errors[found.inliers])
        found = replace(found, inliers=found.inliers & (errors <= band_px))
        return self.epipolar_verdict(found, points0, points1, usable, band_px)

    def _band_px(self, errors_px: FloatArray) -> float:
        """From the errors (n,) of the inliers; wide enough for min_inliers of them."""
        if len(errors_px) < self.min_inliers:
            return self.threshold_px
        sigma = _SIGMA_OF_MEDIAN * float(np.median(errors_px))
        enough = float(np.partition(errors_px, self.min_inliers - 1)[self.min_inliers - 1])
        return min(max(self.sigmas * sigma, self.min_band_px, enough), self.threshold_px)
