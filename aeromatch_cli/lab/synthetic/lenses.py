"""Lenses like those of real cameras: BROWN, with all that a calibration has to find."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.blocks.cameras import FULL_FRAME_DIAGONAL_MM
from aeromatch_cli.data import Camera
from aeromatch_cli.geometry.cameras import BROWN, MODELS, focal_px

# In the place of a lens model's name.
REAL = "REAL"
# Another copy of a lens has another focal length, by up to this share.
_FOCAL_SPREAD = 0.03
# Principal point: standard deviation and largest distance from the middle in each axis, as shares of the width.
_CENTRE_SIGMA, _CENTRE_MOST = 0.007, 0.02
# Distortion in the corner, as a share of the radius: usual lenses, of which most are barrel-shaped, and those that
# show nearly none, as of cameras that correct their pictures themselves.
_DISTORTION, _BARREL_SHARE = (0.01, 0.05), 0.7
_STRAIGHT_SHARE, _STRAIGHT = 0.2, 0.001
_DECENTRING_SIGMA, _DECENTRING_MOST = 4e-4, 1e-3
_AFFINITY_MOST = 3e-4


def real_lens(rng: np.random.Generator, width_px: int, height_px: int, focal_share: float = 0.9) -> Camera:
    """A lens of about focal_share picture widths, drawn at random; one-to-one over the picture and beyond.

    The ranges are set by hand to cover lenses of drones; they are no statistics of real ones.
    """
    focal = focal_share * width_px * (1.0 + rng.uniform(-_FOCAL_SPREAD, _FOCAL_SPREAD))
    off_px = width_px * np.clip(_CENTRE_SIGMA * rng.standard_normal(2), -_CENTRE_MOST, _CENTRE_MOST)
    corner2 = (width_px**2 + height_px**2) / (4.0 * focal**2)
    k1, k2, k3 = _radial(rng) / corner2 ** np.arange(1, 4)
    p1, p2 = np.clip(_DECENTRING_SIGMA * rng.standard_normal(2), -_DECENTRING_MOST, _DECENTRING_MOST)
    b1, b2 = focal * rng.uniform(-_AFFINITY_MOST, _AFFINITY_MOST, 2)
    values = {
        "f": focal, "cx": 0.5 * (width_px - 1) + off_px[0], "cy": 0.5 * (height_px - 1) + off_px[1],
        "k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2, "b1": b1, "b2": b2,
    }  # fmt: skip
    return Camera(BROWN, width_px, height_px, tuple(float(values[name]) for name in MODELS[BROWN]))


def focal_35mm(camera: Camera) -> int:
    """The 35-mm equivalent as EXIF states it: in whole millimetres, over the diagonal."""
    return round(focal_px(camera) / float(np.hypot(camera.width_px, camera.height_px)) * FULL_FRAME_DIAGONAL_MM)


def _radial(rng: np.random.Generator) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """(3,) shares of the corner's radius that k1, k2, k3 move the corner by: the later ones take some of it back."""
    straight = rng.random() < _STRAIGHT_SHARE
    total = _STRAIGHT * rng.standard_normal() if straight else rng.uniform(*_DISTORTION)
    if not straight and rng.random() < _BARREL_SHARE:
        total = -total
    first, third = rng.uniform(1.2, 1.9), rng.uniform(-0.3, 0.3)
    return np.asarray(total * np.array([first, 1.0 - first - third, third]))
