"""The network that tells shadow from dark ground: a small U-Net over a reduced picture, evaluated in NumPy.

Ronneberger et al. 2015, "U-Net", in small: five scales, one skip connection each. Its weights were trained on rendered
scenes with exact shadow truth by scripts/train shadow, which documents the recipe. NumPy, because a picture of one
megapixel costs a fraction of a second and workers need not load a deep-learning library for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.nets.files import shipped_path

SCALES = 5
MULTIPLE_PX = 2**SCALES  # the first scale works on 2 x 2 pixels at once

_STRIP_ROWS = 48
Array = NDArray[np.float32]


@lru_cache(maxsize=1)
def network_weights() -> Mapping[str, Array]:
    """The shipped weights, once per process: NAME.weight (9 * C_in, C_out) and NAME.bias (C_out,), float32.

    Raises ConfigError where the file is missing.
    """
    from safetensors.numpy import load_file

    return {name: array.astype(np.float32) for name, array in load_file(shipped_path("shadow")).items()}


def shadow_logits(inputs: Array, weights: Mapping[str, Array]) -> Array:
    """Logits (H, W) of shadow for inputs (H, W, 3); H and W are multiples of MULTIPLE_PX."""
    height, width, bands = inputs.shape
    if height % MULTIPLE_PX or width % MULTIPLE_PX:
        raise ValueError(f"inputs are {width}x{height}, sides must be multiples of {MULTIPLE_PX}")
    blocks = inputs.reshape(height // 2, 2, width // 2, 2, bands)
    # Band-major order of the 2 x 2 neighbours, as torch's pixel_unshuffle.
    x = np.ascontiguousarray(blocks.transpose(0, 2, 4, 1, 3)).reshape(height // 2, width // 2, 4 * bands)
    skipped: list[Array] = []
    for scale in range(SCALES):
        if scale:
            x = _halved(x)
        x = _convolved(_convolved(x, weights, f"down{scale}.0"), weights, f"down{scale}.1")
        skipped.append(x)
    for scale in reversed(range(SCALES - 1)):
        coarse = x.repeat(2, axis=0).repeat(2, axis=1)
        x = _convolved(np.concatenate([skipped[scale], coarse], axis=2), weights, f"up{scale}")
    four = x @ weights["out.weight"] + weights["out.bias"]
    return four.reshape(height // 2, width // 2, 2, 2).transpose(0, 2, 1, 3).reshape(height, width)


def _halved(x: Array) -> Array:
    """Maximum of 2 x 2 blocks of (H, W, C)."""
    rows = np.maximum(x[0::2], x[1::2])
    return np.maximum(rows[:, 0::2], rows[:, 1::2])


def _convolved(x: Array, weights: Mapping[str, Array], name: str) -> Array:
    """3 x 3 convolution of (H, W, C_in) with zeros around it, bias and rectifier: (H, W, C_out).

    Rows of weights are ordered (dy, dx, c_in). Worked on in strips: nine copies of a whole layer would not fit a cache.
    """
    weight, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
    height, width, bands = x.shape
    padded = np.zeros((height + 2, width + 2, bands), dtype=np.float32)
    padded[1:-1, 1:-1] = x
    out = np.empty((height, width, weight.shape[1]), dtype=np.float32)
    columns = np.empty((min(_STRIP_ROWS, height), width, 9, bands), dtype=np.float32)
    for top in range(0, height, _STRIP_ROWS):
        rows = min(_STRIP_ROWS, height - top)
        for tap in range(9):
            dy, dx = divmod(tap, 3)
            columns[:rows, :, tap] = padded[top + dy : top + dy + rows, dx : dx + width]
        strip = columns[:rows].reshape(rows * width, 9 * bands) @ weight
        strip += bias
        out[top : top + rows] = np.maximum(strip, 0.0, out=strip).reshape(rows, width, -1)
    return out
