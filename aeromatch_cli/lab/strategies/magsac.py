"""MAGSAC++ on the fundamental matrix, as users of OpenCV call it.

Source: Barath et al., MAGSAC++, CVPR 2020; OpenCV's USAC framework, whose generator starts from a fixed state.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import Candidates, PairGeometry, Verdict
from aeromatch_cli.geometry.two_view import TwoView, undistorted
from aeromatch_cli.strategies.filters.gate import Gated


class Magsac(Gated):
    """Fundamental matrix by MAGSAC++ (OpenCV), which holds no relative rotation."""

    version: ClassVar[int] = 1
    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    name: Literal["magsac"] = "magsac"
    threshold_px: float = Field(
        3.0,
        gt=0.0,
        description="Largest error of an inlier, undistorted pixels. Larger: more matches, less accurate ones.",
    )
    confidence: float = Field(
        0.9999,
        gt=0.0,
        lt=1.0,
        description="Sampling stops when the chance of having drawn an uncontaminated sample reaches this (0-1). "
        "Larger: more time.",
    )
    max_iterations: int = Field(
        10000, ge=1, description="Largest number of random samples. Larger: more time on pairs with few inliers."
    )

    def __call__(self, candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict:
        """The Verdict has F on undistorted pixels and Sampson errors; OpenCV takes no seed and needs none."""
        import cv2

        points0, points1, usable = undistorted(candidates.points0_px, candidates.points1_px, geometry)
        refused = self.too_few(usable)
        if refused is not None:
            return refused
        options = (cv2.USAC_MAGSAC, self.threshold_px, self.confidence, self.max_iterations)
        try:
            matrix, mask = cv2.findFundamentalMat(points0, points1, *options)
        except cv2.error:  # raised where no sample gives a model
            matrix, mask = None, None
        if matrix is None or mask is None or matrix.shape != (3, 3):
            nothing = np.zeros(len(usable), dtype=bool)
            return Verdict(keep=nothing, state="rejected", reason=f"no model among {len(points0)} matches")
        model = np.asarray(matrix, dtype=np.float64)
        found = TwoView("F", model, model, None, mask.ravel() > 0)
        return self.epipolar_verdict(found, points0, points1, usable, self.threshold_px)
