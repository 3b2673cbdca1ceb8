"""Brightness of gray and colour pictures, and pictures times a factor."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray


def brightness(pixels: NDArray[Any]) -> NDArray[Any]:
    """(H, W) of (H, W) or (H, W, C), same dtype: the gray level, or the only band."""
    import cv2

    if pixels.ndim == 2:
        return pixels
    if pixels.shape[2] != 3:
        return np.asarray(np.rint(pixels.mean(axis=2)).astype(pixels.dtype))
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))


def multiplied(source: NDArray[Any], factor: FloatArray) -> NDArray[Any]:
    """source (H, W) or (H, W, C) times factor (H, W), rounded and bounded to its type."""
    import cv2

    bands = 1 if source.ndim == 2 else source.shape[2]
    wide = factor if source.ndim == 2 else cv2.merge([factor] * bands)
    code = cv2.CV_8U if source.dtype == np.uint8 else cv2.CV_16U
    return np.asarray(cv2.multiply(source, wide, dtype=code)).reshape(source.shape)
