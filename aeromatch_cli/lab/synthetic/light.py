"""Sun, sky and air: what arrives at a surface, and what the air between it and the camera adds.

Linear RGB; the figures are relative, since every flight's exposure is metered.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from aeromatch_cli.data import FloatArray

SUN_RADIUS_DEG = 0.2665
_SUN_ABOVE_AIR = np.array([2.75, 2.72, 2.66], dtype=np.float32)
# Optical depth of clear air at 610, 550 and 460 nm (Iqbal, An Introduction to Solar Radiation, 1983, ch. 6, rounded).
_OPTICAL_DEPTH = np.array([0.16, 0.21, 0.33], dtype=np.float32)
_SKY = np.array([0.33, 0.385, 0.47], dtype=np.float32)
_BOUNCED = np.array([0.14, 0.13, 0.11], dtype=np.float32)
HORIZON = np.array([0.60, 0.70, 0.83], dtype=np.float32)
# Blue light is scattered more.
_HAZE_COLOUR = np.array([0.75, 0.95, 1.30], dtype=np.float32)


@dataclass(frozen=True)
class Light:
    """One moment's light.

    sun_azimuth_deg: clockwise from north (y). sun_elevation_deg: above the horizon. haze_per_km: share of contrast that
    a kilometre of air takes, as an extinction coefficient. sky: brightness of the sky against a clear one.
    season: 0 fresh green to 1 dry; vegetation changes its colour and brightness with it.
    """

    sun_azimuth_deg: float
    sun_elevation_deg: float
    haze_per_km: float = 0.08
    sky: float = 1.0
    season: float = 0.0

    @cached_property
    def to_sun(self) -> FloatArray:
        """Unit vector (3,) towards the middle of the sun."""
        return sun_direction(self.sun_azimuth_deg, self.sun_elevation_deg)

    @cached_property
    def sun(self) -> FloatArray:
        """Linear RGB (3,) of full sun on a surface that faces it (Kasten and Young 1989 for the air mass)."""
        elevation = max(self.sun_elevation_deg, 1.0)
        air_mass = 1.0 / (np.sin(np.deg2rad(elevation)) + 0.50572 * (elevation + 6.07995) ** -1.6364)
        return np.asarray(_SUN_ABOVE_AIR * np.exp(-_OPTICAL_DEPTH * np.float32(air_mass)))

    def indirect(self, open_sky: FloatArray) -> FloatArray:
        """Linear RGB (N, 3) from the sky and the surroundings, for the share (N, 1) of the sky that is in view."""
        # What is bounced off the surroundings grows with the sun that they get.
        bounced = _BOUNCED * np.float32(0.35 + 0.9 * self.to_sun[2])
        arriving: FloatArray = open_sky * (_SKY * np.float32(self.sky)) + (1.0 - open_sky) * bounced
        return arriving

    def through_air(self, light: FloatArray, distances_m: FloatArray) -> FloatArray:
        """Linear RGB (N, 3) that is left of `light` after distances (N,), and what the air adds."""
        left = np.exp(-(distances_m * np.float32(1e-3 * self.haze_per_km))[:, None] * _HAZE_COLOUR)
        seen: FloatArray = light * left + HORIZON * np.float32(0.65) * (1.0 - left)
        return seen

    def disc(self, turns: int) -> FloatArray:
        """Unit vectors (turns, 3) to points spread evenly over the sun's disc (a sunflower pattern)."""
        k = np.arange(turns) + 0.5
        radius, angle = np.tan(np.deg2rad(SUN_RADIUS_DEG)) * np.sqrt(k / turns), 2.399963229728653 * k
        across = np.cross(self.to_sun, [0.0, 0.0, 1.0] if self.to_sun[2] < 0.9 else [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        up = np.cross(across, self.to_sun)
        rays = self.to_sun + radius[:, None] * (np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * up)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def sun_direction(azimuth_deg: float, elevation_deg: float) -> FloatArray:
    """Unit vector (3,) towards the sun; azimuth clockwise from north (y), elevation above the horizon."""
    azimuth, elevation = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    return np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])


def seasonal(albedo: FloatArray, season: float) -> FloatArray:
    """Albedo (N, 3) with its vegetation turned from fresh (season 0) to dry (1); the rest stays as it is."""
    if season == 0.0:
        return albedo
    red, green, blue = albedo.T
    leafy = np.clip((green - np.maximum(red, blue)) / np.maximum(green, 1e-3) * 4.0, 0.0, 1.0) * np.float32(season)
    dry = albedo.mean(axis=1, keepdims=True) * np.array([1.75, 1.45, 0.80], dtype=np.float32)
    turned: FloatArray = albedo + leafy[:, None] * (dry - albedo)
    return turned
