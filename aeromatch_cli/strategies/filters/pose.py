"""Rejects matches outside the epipolar band that the poses and their stated accuracy predict."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import BoolArray, FloatArray, PairGeometry, Verdict
from aeromatch_cli.geometry.cameras import undistort, world_rays
from aeromatch_cli.geometry.epipolar import fundamental_from_poses, sampson_distance_px
from aeromatch_cli.strategies import Strategy


class PoseBand(Strategy):
    """Keeps the matches whose epipolar error the errors of the poses can explain.

    The band is a limit, not evidence: it verifies nothing by itself, so its verdict is "not verifiable" with the
    surviving matches kept. Without both attitudes everything passes.
    """

    version: ClassVar[int] = 1
    needs: ClassVar[frozenset[str]] = frozenset({"camera", "pose", "sigma"})
    name: Literal["pose"] = "pose"
    sigmas: float = Field(3.0, gt=0.0, description="Half-width of the band in predicted standard deviations.")
    sigma_px: float = Field(1.5, gt=0.0, description="Standard deviation of a keypoint, pixels.")

    def __call__(self, points0_px: FloatArray, points1_px: FloatArray, geometry: PairGeometry, seed: int) -> Verdict:
        """points (M, 2) in stored pixels. errors_px are Sampson distances to the poses' own epipolar geometry."""
        pose0, pose1 = geometry.pose0, geometry.pose1
        if pose0 is None or pose1 is None or pose0.world_rotation is None or pose1.world_rotation is None:
            everything = np.ones(len(points0_px), dtype=bool)
            return Verdict(keep=everything, state="not verifiable", reason="a pose is missing")
        matrix = fundamental_from_poses(geometry.camera0, pose0, geometry.camera1, pose1)
        points0, points1 = undistort(geometry.camera0, points0_px), undistort(geometry.camera1, points1_px)
        errors = sampson_distance_px(matrix, points0, points1)
        band = self.sigmas * np.hypot(predicted_sigma_px(points0_px, points1_px, geometry), self.sigma_px)
        with np.errstate(invalid="ignore"):
            keep: BoolArray = errors <= band
        reason = "poses limit the matches but do not verify them"
        return Verdict(keep=keep, state="not verifiable", reason=reason, errors_px=errors.astype(np.float32))


def predicted_sigma_px(points0_px: FloatArray, points1_px: FloatArray, geometry: PairGeometry) -> FloatArray:
    """Standard deviation (N,) of the Sampson distance of true matches (N, 2), stored pixels, due to pose errors alone.

    In the world frame the epipolar constraint is g = w1 . (b x w0) with rays w0, w1 and baseline b. Its first-order
    change under independent errors of each angle (turning a ray: dw = a x w) and of each coordinate of the centres is
        dg = a0 . (w0 x (w1 x b)) + a1 . (w1 x (b x w0)) + db . (w0 x w1),
    so var g = s_a0^2 |w0 x (w1 x b)|^2 + s_a1^2 |w1 x (b x w0)|^2 + (s_p0^2 + s_p1^2) |w0 x w1|^2. The Sampson
    distance is |g| over the length of its gradient by the four pixel coordinates; the same division scales sigma.
    Infinite where the poses say nothing (no baseline).
    """
    pose0, pose1 = geometry.pose0, geometry.pose1
    assert pose0 is not None and pose1 is not None  # the caller's check
    assert pose0.world_rotation is not None and pose1.world_rotation is not None
    rays0 = world_rays(geometry.camera0, pose0.world_rotation, points0_px)
    rays1 = world_rays(geometry.camera1, pose1.world_rotation, points1_px)
    baseline = pose1.center_m - pose0.center_m
    normals = np.cross(baseline, rays0)
    turned0 = np.cross(rays0, np.cross(rays1, baseline))
    turned1 = np.cross(rays1, normals)
    moved = np.cross(rays0, rays1)
    angle0, angle1 = np.deg2rad(pose0.sigma_angle_deg), np.deg2rad(pose1.sigma_angle_deg)
    variance = angle0**2 * (turned0**2).sum(axis=1) + angle1**2 * (turned1**2).sum(axis=1)
    variance += (pose0.sigma_position_m**2 + pose1.sigma_position_m**2) * (moved**2).sum(axis=1)
    gradient = _pixel_gradient(rays0, rays1, baseline, geometry)
    unknown = np.full(len(variance), np.inf)
    return np.divide(np.sqrt(variance), gradient, out=unknown, where=gradient > 0)
