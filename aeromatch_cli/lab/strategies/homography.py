"""Direct RANSAC: one homography for the whole pair, the baseline of the clustered one."""

from __future__ import annotations

from functools import partial
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import Candidates, FloatArray, PairGeometry, Verdict
from aeromatch_cli.geometry.planes import plane_distances_px
from aeromatch_cli.geometry.two_view import H_SAMPLE, Sampling, undistorted
from aeromatch_cli.strategies.filters.gate import Gated


class Homography(Gated):
    """One plane for all matches, estimated by PoseLib's LO-RANSAC.

    The plane's relative rotation is ambiguous, and not given.
    """

    version: ClassVar[int] = 1
    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    name: Literal["homography"] = "homography"
    threshold_px: float = Field(
        3.0,
        gt=0.0,
        description="Largest distance from the plane (larger of both directions), undistorted pixels. Larger: more "
        "matches, less accurate ones.",
    )

    def __call__(self, candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict:
        """The Verdict has H on undistorted pixels and distances to it."""
        import poselib

        points0, points1, usable = undistorted(candidates.points0_px, candidates.points1_px, geometry)
        refused = self.too_few(usable)
        if refused is not None:
            return refused
        options = Sampling(self.threshold_px).options(seed, "max_reproj_error")
        matrix = np.asarray(poselib.estimate_homography(points0, points1, options, {})[0])
        distance = partial(_distance_px, matrix)
        errors = distance(points0, points1)
        inliers = errors <= self.threshold_px
        doubt = partial(self.refusal, distance, points0, points1, self.threshold_px, H_SAMPLE)
        return self.verdict(usable, inliers, doubt, "H", matrix, errors)


def _distance_px(matrix: FloatArray, points0_px: FloatArray, points1_px: FloatArray) -> FloatArray:
    distances: FloatArray = plane_distances_px(matrix[None], points0_px, points1_px)[0]
    return distances
