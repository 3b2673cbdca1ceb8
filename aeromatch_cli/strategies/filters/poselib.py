"""Robust two-view geometry by PoseLib: the relative pose of known cameras, else a fundamental matrix."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from aeromatch_cli.data import Candidates, PairGeometry, Verdict
from aeromatch_cli.geometry.two_view import Sampling, estimate, undistorted
from aeromatch_cli.strategies.filters.gate import TwoViewGated


class Poselib(TwoViewGated):
    """One two-view geometry by PoseLib's LO-RANSAC.

    The gates on the number of inliers come after the estimator, which calls 7 of 7 random matches inliers.
    """

    version: ClassVar[int] = 2
    name: Literal["poselib"] = "poselib"
    confidence: float = Field(
        0.999,
        gt=0.0,
        lt=1.0,
        description="Sampling stops when the chance of having drawn an uncontaminated sample reaches this (0-1). "
        "Larger: more samples, more time.",
    )
    min_iterations: int = Field(50, ge=1, description="Smallest number of random samples.")
    max_iterations: int = Field(
        3000, ge=1, description="Largest number of random samples. Larger: more time on pairs with few inliers."
    )

    def __call__(self, candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict:
        """The Verdict has E (or F), Sampson errors and cam1_from_cam0's rotation."""
        points0, points1, usable = undistorted(candidates.points0_px, candidates.points1_px, geometry)
        refused = self.too_few(usable)
        if refused is not None:
            return refused
        sampling = Sampling(self.threshold_px, self.confidence, self.min_iterations, self.max_iterations)
        found = estimate(points0, points1, geometry, self.model, sampling, seed)
        return self.epipolar_verdict(found, points0, points1, usable, self.threshold_px)
