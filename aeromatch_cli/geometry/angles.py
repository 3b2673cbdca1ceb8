"""Attitudes as they are written down, before they are rotations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, from_quaternion, from_yaw_pitch_roll, rotation_z

AnglesKind = Literal["omega_phi_kappa", "yaw_pitch_roll", "quaternion"]


@dataclass(frozen=True)
class Angles:
    """One attitude.

    kind, values: omega, phi, kappa or yaw, pitch, roll in degrees, or a quaternion (w, x, y, z) cam_from_world.
    forward: for yaw, pitch, roll: the optical axis is body x (gimbal), else down (nadir). convergence_deg: meridian
    convergence that yaw is reduced by, 0 where it counts from grid north. true_north: the other kinds count from true
    north, too, and are turned by the convergence.
    """

    kind: AnglesKind
    values: tuple[float, ...]
    forward: bool = True
    convergence_deg: float = 0.0
    true_north: bool = False

    @property
    def rotation(self) -> FloatArray:
        """(3, 3) cam_from_world."""
        if self.kind != "yaw_pitch_roll":
            read = from_quaternion if self.kind == "quaternion" else from_omega_phi_kappa
            # A direction of true azimuth a has the grid azimuth a - convergence.
            return read(*self.values) @ rotation_z(self.convergence_deg).T if self.true_north else read(*self.values)
        yaw_deg, pitch_deg, roll_deg = self.values
        return from_yaw_pitch_roll(yaw_deg - self.convergence_deg, pitch_deg, roll_deg, forward=self.forward)
