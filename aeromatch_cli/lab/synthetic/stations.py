"""One picture to take: its exterior orientation and its camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.cameras import FISHEYE, MODELS, from_colmap
from aeromatch_cli.geometry.frames import CAM_FROM_PHOTO
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa, to_omega_phi_kappa


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


@dataclass(frozen=True)
class Station:
    """One picture to take.

    sortie: which flight of the day (0 or 1): light and season come from it. height_m: flying height above the datum
    (z = 0) that was planned for this camera; the picture's own differs by the wobble. heading_deg: where the aircraft
    flies, clockwise from grid north.
    """

    exterior: Exterior
    camera_id: str
    sortie: int
    height_m: float
    heading_deg: float

    def velocity_m_s(self, speed_m_s: float) -> FloatArray:
        """(3,) of level flight."""
        heading = np.deg2rad(self.heading_deg)
        return speed_m_s * np.array([np.sin(heading), np.cos(heading), 0.0])


# Between two strips, and between two sorties, seconds.
_TURN_S, _PAUSE_S = 15.0, 3600.0
# A strip ends where the next picture lies further off its line than this, degrees.
_ALONG_DEG = 30.0


def taken_s(stations: Sequence[Station], speed_m_s: float) -> list[float]:
    """(N,) seconds from the first picture to each, at one speed along strips; cameras of a rig take theirs at once."""
    times_s = [0.0]
    for before, now in pairwise(stations):
        way_m = np.array([now.exterior.x_m - before.exterior.x_m, now.exterior.y_m - before.exterior.y_m])
        length_m = float(np.hypot(*way_m))
        ahead = way_m @ before.velocity_m_s(1.0)[:2] >= np.cos(np.deg2rad(_ALONG_DEG)) * length_m
        turned = now.heading_deg != before.heading_deg or not ahead
        pause_s = _PAUSE_S if now.sortie != before.sortie else _TURN_S * turned
        times_s.append(times_s[-1] + length_m / speed_m_s + pause_s)
    return times_s


# Angle from the axis of a fisheye's corners at most.
_WIDEST_RAD = 1.3


def make_camera(lens: str, width_px: int, height_px: int, focal_share: float) -> Camera:
    """Camera of a lens model whose focal length is focal_share picture widths.

    The principal point lies 0.4 % off the middle; 1.5 % of barrel distortion in the corners and a tenth of that
    decentred, where the model has them; one-to-one over the picture. A fisheye's focal length is longer where corners
    would be further than 74 degrees from the axis. Raises ConfigError on an unknown lens.
    """
    if lens not in MODELS:
        raise ConfigError(f"lens {lens!r} is not known; use one of {', '.join(MODELS)}, or real")
    focal = focal_share * width_px
    if lens == FISHEYE:  # it projects by angles: those of the corners stay below a right angle
        focal = max(focal, 0.5 * float(np.hypot(width_px, height_px)) / _WIDEST_RAD)
    r2 = (width_px**2 + height_px**2) / (4.0 * focal**2)
    k2_share = 0.006 if "k2" in MODELS[lens] else 0.0
    values = {
        "f": focal,
        "fx": focal,
        "fy": 1.001 * focal,
        "cx": 0.504 * width_px,
        "cy": 0.4965 * height_px,
        "k1": -(0.015 + k2_share) / r2,
        "k2": k2_share / r2**2,
        "k3": 0.0006 / r2**3,
        "k4": -0.0003 / r2**4,
        "p1": 0.0004 / float(np.sqrt(r2)),
        "p2": -0.0003 / float(np.sqrt(r2)),
        "b1": -0.0008 * focal,
        "b2": 0.0005 * focal,
    }
    return from_colmap(lens, width_px, height_px, tuple(values[name] for name in MODELS[lens]))


def rounded(position_m: FloatArray, angles_deg: FloatArray) -> Exterior:
    wrapped = (np.asarray(angles_deg) + 180.0) % 360.0 - 180.0
    return Exterior(*(round(float(v), 4) for v in position_m), *(round(float(v), 6) for v in wrapped))


def exterior_of(position_m: FloatArray, world_from_photo: FloatArray) -> Exterior:
    return rounded(position_m, np.array(to_omega_phi_kappa(CAM_FROM_PHOTO @ world_from_photo.T)))
