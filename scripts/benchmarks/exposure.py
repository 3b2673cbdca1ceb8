"""Pictures as they would be had less light reached the camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.lab.synthetic.sensor import Development, tone

_LEVELS = np.linspace(0.0, 1.0, 4097)


def under_exposed(pixels: NDArray[np.uint8], light: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """(H, W, 3) as the renderer's camera stores a share of the light, by its noise and tone curve, in 8 bits: dark
    parts keep a few levels, and less contrast than noise. The picture's own noise is small against this."""
    camera = Development(light)
    linear = camera.exposure * np.interp(np.arange(256) / 255.0, tone(_LEVELS), _LEVELS)[pixels]
    sigma = np.sqrt(camera.read_noise**2 + camera.shot_noise**2 * linear)
    return np.rint(255.0 * tone(linear + sigma * rng.standard_normal(linear.shape))).astype(np.uint8)


def write_under_exposed(source: Path, target: Path, light: float, rng: np.random.Generator) -> None:
    """A stored picture with a share of the light, as a JPEG; both may be one file."""
    import cv2

    pixels = under_exposed(read_pixels(source, colour=True), light, rng)
    cv2.imwrite(str(target), pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
