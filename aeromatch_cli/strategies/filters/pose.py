"""Rejects matches outside the epipolar band that the poses and their stated accuracy predict."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import BoolArray, Camera, Candidates, FloatArray, PairGeometry, Pose, Verdict
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.epipolar import fundamental_from_poses, sampson_distance_px
from aeromatch_cli.geometry.prediction import homogeneous
from aeromatch_cli.strategies import Strategy

_SMALLEST_BASELINE_M = 1e-6


class PoseBand(Strategy):
    """Keeps the matches whose epipolar error the standard deviations of the poses can explain.

    The band is a limit, not evidence: it verifies nothing by itself, so its verdict is "not verifiable" with the
    surviving matches kept. Without both attitudes everything passes.
    """

    version: ClassVar[int] = 1
    needs: ClassVar[frozenset[str]] = frozenset({"camera", "pose", "sigma"})
    verifies: ClassVar[bool] = False
    name: Literal["pose"] = "pose"
    sigmas: float = Field(
        3.0,
        gt=0.0,
        description="Half-width of the band around the epipolar line in predicted standard deviations. Larger: more "
        "matches are kept.",
    )
    sigma_px: float = Field(1.5, gt=0.0, description="Standard deviation of a keypoint, pixels. Larger: a wider band.")

    def __call__(self, candidates: Candidates, geometry: PairGeometry, seed: int) -> Verdict:
        """errors_px are Sampson distances to the poses' own epipolar geometry."""
        pose0, pose1 = geometry.pose0, geometry.pose1
        if pose0 is None or pose1 is None or pose0.world_rotation is None or pose1.world_rotation is None:
            everything = np.ones(len(candidates), dtype=bool)
            return Verdict(keep=everything, state="not verifiable", reason="a pose is missing")
        points0 = undistort(geometry.camera0, candidates.points0_px)
        points1 = undistort(geometry.camera1, candidates.points1_px)
        matrix = fundamental_from_poses(geometry.camera0, pose0, geometry.camera1, pose1)
        errors = sampson_distance_px(matrix, points0, points1)
        sigma = predicted_sigma_px(points0, points1, geometry.camera0, pose0, geometry.camera1, pose1)
        with np.errstate(invalid="ignore"):
            keep: BoolArray = errors <= self.sigmas * np.hypot(sigma, self.sigma_px)
        reason = "poses limit the matches but do not verify them"
        return Verdict(keep=keep, state="not verifiable", reason=reason, errors_px=errors.astype(np.float32))


def predicted_sigma_px(
    points0_px: FloatArray, points1_px: FloatArray, camera0: Camera, pose0: Pose, camera1: Camera, pose1: Pose
) -> FloatArray:
    """Standard deviation (N,) of the Sampson distance of true matches (N, 2), undistorted pixels, due to pose errors.

    In the world frame the epipolar constraint is g = w1 . (b x w0), with rays w0, w1 and the direction b of the
    baseline of length B. Its first-order change under independent errors of each angle (which turn a ray: dw = a x w)
    and of each coordinate of the centres is
        dg = a0 . (w0 x (w1 x b)) + a1 . (w1 x (b x w0)) + db . (w0 x w1),
    so var g = s_a0^2 |w0 x (w1 x b)|^2 + s_a1^2 |w1 x (b x w0)|^2 + (s_p0^2 + s_p1^2) / B^2 |w0 x w1|^2. The Sampson
    distance is |g| over the length of its gradient by the four pixel coordinates; the same division scales sigma.
    Infinite without a baseline, where the poses predict no epipolar line. Both poses need an attitude.
    """
    baseline = pose0.center_m - pose1.center_m
    length = float(np.linalg.norm(baseline))
    if length < _SMALLEST_BASELINE_M:
        return np.full(len(points0_px), np.inf)
    direction = baseline / length
    rays0, rays1 = _rays(camera0, pose0, points0_px), _rays(camera1, pose1, points1_px)
    turned0 = np.cross(rays0, np.cross(rays1, direction))
    turned1 = np.cross(rays1, np.cross(direction, rays0))
    angle0, angle1 = np.deg2rad(pose0.sigma_angle_deg), np.deg2rad(pose1.sigma_angle_deg)
    variance = angle0**2 * (turned0**2).sum(axis=1) + angle1**2 * (turned1**2).sum(axis=1)
    position = (pose0.sigma_position_m**2 + pose1.sigma_position_m**2) / length**2
    variance += position * (np.cross(rays0, rays1) ** 2).sum(axis=1)
    matrix = fundamental_from_poses(camera0, pose0, camera1, pose1)
    lines1 = points0_px @ matrix[:, :2].T + matrix[:, 2]
    lines0 = points1_px @ matrix[:2, :] + matrix[2, :]
    gradient = np.sqrt((lines1[:, :2] ** 2).sum(axis=1) + (lines0[:, :2] ** 2).sum(axis=1))
    # At both epipoles at once every direction is on the line: the gradient vanishes and nothing is predicted.
    return np.divide(np.sqrt(variance), gradient, out=np.full(len(variance), np.inf), where=gradient > 0)


def _rays(camera: Camera, pose: Pose, undistorted_px: FloatArray) -> FloatArray:
    """World directions (N, 3) of undistorted pixels (N, 2), of depth 1 in the camera."""
    return np.asarray(homogeneous(camera, undistorted_px) @ np.asarray(pose.world_rotation))
