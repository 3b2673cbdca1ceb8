"""From light to a stored picture: lens fall-off, exposure, white balance, blur, noise, tone curve, 8 bits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray

# Linear levels that the metering brings the scene's mean to, and its 97th percentile not above.
_MEAN_LEVEL, _BRIGHT_LEVEL = 0.25, 0.80


@dataclass(frozen=True)
class Development:
    """How one picture is taken.

    exposure: factor on the light. white_balance: (r, g, b) factors. vignetting: share lost in the corners.
    blur_px: sigma of the lens and motion blur. read_noise, shot_noise: standard deviation in linear light without
    light, and of full scale's photon noise (grows with the root of the light). jpeg_quality: 1-100.
    """

    exposure: float
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    vignetting: float = 0.16
    blur_px: float = 0.45
    read_noise: float = 0.0012
    shot_noise: float = 0.011
    jpeg_quality: int = 95


def develop(
    linear: NDArray[np.float32], radius2: NDArray[np.float32], settings: Development, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Stored RGB (H, W, 3) uint8 of linear light (H, W, 3), which is used up.

    radius2: (H, W) squared distance from the optical axis, any unit.
    """
    import cv2

    fall_off = 1.0 - settings.vignetting * radius2 / radius2.max(initial=1e-9)
    linear *= (np.float32(settings.exposure) * fall_off.astype(np.float32))[..., None]
    linear *= np.array(settings.white_balance, dtype=np.float32)
    if settings.blur_px > 0.0:
        cv2.GaussianBlur(linear, (0, 0), settings.blur_px, dst=linear, borderType=cv2.BORDER_REPLICATE)
    pixels = np.empty(linear.shape, dtype=np.uint8)
    for row in range(len(linear)):  # a row at a time: a 12-megapixel picture needs no second copy in float
        line = linear[row]
        sigma = np.sqrt(settings.read_noise**2 + settings.shot_noise**2 * np.clip(line, 0.0, 1.0))
        line = line + sigma * rng.standard_normal(line.shape, dtype=np.float32)
        pixels[row] = np.rint(255.0 * tone(line))
    return pixels


def tone(linear: FloatArray) -> FloatArray:
    """The tone curve of sRGB (IEC 61966-2-1), values 0-1."""
    level = np.clip(linear, 0.0, 1.0)
    toned: FloatArray = np.where(
        level <= 0.0031308, 12.92 * level, 1.055 * np.power(level, np.float32(1.0 / 2.4)) - 0.055
    )
    return toned


def meter(linear: FloatArray) -> float:
    """Exposure that a camera would choose for light (N, 3): a medium gray on average, highlights unclipped."""
    bright, mean = float(np.percentile(linear.max(axis=1), 97.0)), float(linear.mean())
    return min(_BRIGHT_LEVEL / max(bright, 1e-6), _MEAN_LEVEL / max(mean, 1e-6))
