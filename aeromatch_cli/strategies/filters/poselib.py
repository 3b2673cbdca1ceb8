"""Robust two-view geometry by PoseLib: the relative pose of known cameras, else a fundamental matrix.

Source: PoseLib (Larsson, https://github.com/PoseLib/PoseLib), LO-RANSAC with non-linear refinement; five points,
Nister, PAMI 2004.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import BoolArray, Camera, Candidates, FloatArray, PairGeometry, Verdict
from aeromatch_cli.geometry.cameras import parameters, undistort
from aeromatch_cli.geometry.epipolar import essential, fundamental, sampson_distance_px
from aeromatch_cli.strategies import Strategy


class Poselib(Strategy):
    """Keeps the matches that one two-view geometry explains.

    The gate on the number of inliers comes after the estimator, which calls 7 of 7 random matches inliers.
    """

    version: ClassVar[int] = 1
    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    name: Literal["poselib"] = "poselib"
    model: Literal["relative_pose", "fundamental"] = Field(
        "relative_pose", description="Relative pose with the known cameras, or fundamental matrix without."
    )
    threshold_px: float = Field(4.0, gt=0.0, description="Largest Sampson error, undistorted pixels.")
    min_inliers: int = Field(15, ge=8, description="Fewer matches are not verifiable, fewer inliers reject the pair.")
    confidence: float = Field(0.999, gt=0.0, lt=1.0, description="Sampling stops at this chance of a clean sample.")
    min_iterations: int = Field(50, ge=1, description="Samples drawn at least.")
    max_iterations: int = Field(3000, ge=1, description="Samples drawn at most.")

    def __call__(self, candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict:
        """The Verdict has E (or F), Sampson errors and cam1_from_cam0's rotation."""
        nothing = np.zeros(len(candidates), dtype=bool)
        points0 = undistort(geometry.camera0, candidates.points0_px)
        points1 = undistort(geometry.camera1, candidates.points1_px)
        usable = np.isfinite(points0).all(axis=1) & np.isfinite(points1).all(axis=1)
        if usable.sum() < self.min_inliers:
            reason = f"{int(usable.sum())} matches, {self.min_inliers} needed"
            return Verdict(keep=nothing, state="not verifiable", reason=reason)
        kind, model, pixel_model, rotation, inliers = self._estimate(points0[usable], points1[usable], geometry, seed)
        keep: BoolArray = nothing.copy()
        keep[usable] = inliers
        errors = np.full(len(points0), np.nan, dtype=np.float32)
        errors[usable] = sampson_distance_px(pixel_model, points0[usable], points1[usable])
        if keep.sum() < self.min_inliers:
            reason = f"{int(keep.sum())} inliers of {len(keep)} matches, {self.min_inliers} needed"
            return Verdict(keep=nothing, state="rejected", reason=reason)
        return Verdict(
            keep=keep,
            state="verified",
            model_kind=kind,
            model=model,
            errors_px=errors,
            relative_rotation=rotation,
        )

    def _estimate(
        self, points0: FloatArray, points1: FloatArray, geometry: PairGeometry, seed: int
    ) -> tuple[Literal["E", "F"], FloatArray, FloatArray, FloatArray | None, BoolArray]:
        """Kind, model, the same on undistorted pixels, rotation and inliers (N,) from undistorted pixels (N, 2)."""
        import poselib

        ransac = {
            "max_epipolar_error": self.threshold_px,
            "success_prob": self.confidence,
            "min_iterations": self.min_iterations,
            "max_iterations": self.max_iterations,
            "seed": seed,
        }
        if self.model == "fundamental":
            matrix, info = poselib.estimate_fundamental(points0, points1, ransac, {})
            matrix = np.asarray(matrix)
            return "F", matrix, matrix, None, np.asarray(info["inliers"], dtype=bool)
        cameras = [_pinhole(camera) for camera in (geometry.camera0, geometry.camera1)]
        pose, info = poselib.estimate_relative_pose(points0, points1, *cameras, ransac, {})
        rotation = np.asarray(pose.R)
        matrix = essential(rotation, np.asarray(pose.t))
        pixel_matrix = fundamental(matrix, geometry.camera0, geometry.camera1)
        return "E", matrix, pixel_matrix, rotation, np.asarray(info["inliers"], dtype=bool)


def _pinhole(camera: Camera) -> dict[str, Any]:
    """The camera of undistorted pixels, in PoseLib's words."""
    p = parameters(camera)
    size = {"width": camera.width_px, "height": camera.height_px}
    return {"model": "PINHOLE", "params": [p["fx"], p["fy"], p["cx"], p["cy"]], **size}
