"""Where the pictures are taken: nadir strips, flown to and fro, with the wobble of a real flight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.geometry.cameras import focal_px, from_colmap
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa

HEIGHT_M = 85.0
FORWARD_OVERLAP, SIDE_OVERLAP = 0.70, 0.60
_HEIGHT_SIGMA, _POSITION_SIGMA, _TILT_SIGMA_DEG, _HEADING_SIGMA_DEG = 0.03, 0.01, 2.0, 2.5
# Pose noise of the benchmark: 5 % of the height on every coordinate, 3 degrees on every angle.
NOISE_SHARE_OF_HEIGHT, NOISE_ANGLE_DEG = 0.05, 3.0


@dataclass(frozen=True)
class Exterior:
    """A pose as it is written: projection centre in metres and photogrammetric angles in degrees."""

    x_m: float
    y_m: float
    z_m: float
    omega_deg: float
    phi_deg: float
    kappa_deg: float

    def pose(self) -> Pose:
        center_m = np.array([self.x_m, self.y_m, self.z_m])
        return Pose(center_m, from_omega_phi_kappa(self.omega_deg, self.phi_deg, self.kappa_deg), 0.0, 0.0)


def make_camera(width_px: int, height_px: int) -> Camera:
    """SIMPLE_RADIAL, 58 degrees wide, 1.4 % of barrel distortion in the corners, centre slightly off the middle."""
    params = (0.9 * width_px, 0.504 * width_px, 0.4965 * height_px, -0.03)
    return from_colmap("SIMPLE_RADIAL", width_px, height_px, params)


def plan_flight(camera: Camera, images: int, rng: np.random.Generator) -> tuple[Exterior, ...]:
    """Exact exterior orientations, rounded first (0.1 mm, 1e-6 degrees), so that their text is exact, too.

    Strips run north and south in turn, 3:2 longer than the block is wide, centred on the origin.
    """
    ground_m = HEIGHT_M / focal_px(camera)
    forward_m = (1.0 - FORWARD_OVERLAP) * camera.height_px * ground_m
    side_m = (1.0 - SIDE_OVERLAP) * camera.width_px * ground_m
    strips = max(1, round(float(np.sqrt(images / 1.5))))
    longest = -(-images // strips)
    flown = []
    for k in range(images):
        strip, step = divmod(k, longest)
        north = 1.0 if strip % 2 == 0 else -1.0
        x = (strip - 0.5 * (strips - 1)) * side_m
        y = north * (step - 0.5 * (longest - 1)) * forward_m
        wobble = rng.standard_normal(6)
        position = np.array([x, y, HEIGHT_M]) + HEIGHT_M * wobble[:3] * [
            _POSITION_SIGMA,
            _POSITION_SIGMA,
            _HEIGHT_SIGMA,
        ]
        angles = wobble[3:] * [_TILT_SIGMA_DEG, _TILT_SIGMA_DEG, _HEADING_SIGMA_DEG]
        angles[2] += 0.0 if north > 0 else 180.0
        flown.append(_rounded(position, angles))
    return tuple(flown)


def noisy(exterior: Exterior, rng: np.random.Generator) -> Exterior:
    """The exterior orientation as a cheap receiver and gyro would give it (Gaussian, independent)."""
    exact = np.array([exterior.x_m, exterior.y_m, exterior.z_m])
    position = exact + NOISE_SHARE_OF_HEIGHT * HEIGHT_M * rng.standard_normal(3)
    angles = np.array([exterior.omega_deg, exterior.phi_deg, exterior.kappa_deg])
    return _rounded(position, angles + NOISE_ANGLE_DEG * rng.standard_normal(3))


def _rounded(position_m: FloatArray, angles_deg: FloatArray) -> Exterior:
    wrapped = (np.asarray(angles_deg) + 180.0) % 360.0 - 180.0
    return Exterior(*(round(float(v), 4) for v in position_m), *(round(float(v), 6) for v in wrapped))


def reach_m(camera: Camera, flown: tuple[Exterior, ...]) -> float:
    """Distance from the origin, along x or y, up to which the pictures show ground, with room for tilt
    and for what throws its shadow in from outside."""
    farthest = max(max(abs(e.x_m), abs(e.y_m)) for e in flown)
    half_diagonal_m = 0.5 * HEIGHT_M * float(np.hypot(camera.width_px, camera.height_px)) / focal_px(camera)
    return float(np.ceil(farthest + 1.3 * half_diagonal_m + 20.0))
