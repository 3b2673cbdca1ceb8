"""How the networks' descriptors are stored: as bytes, like SIFT's."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray

# Descriptors of unit length as bytes: 128 and so many steps a unit. Their distances stay what they are, to 1 %.
BYTE_ZERO, _BYTES_PER_UNIT = 128, 256.0


def as_bytes(descriptors: FloatArray) -> NDArray[np.uint8]:
    """Descriptors (N, C) of unit length as bytes: 128 + 256 times the value, clipped."""
    return np.clip(np.rint(BYTE_ZERO + _BYTES_PER_UNIT * descriptors), 0, 255).astype(np.uint8)


def from_bytes(descriptors: NDArray[np.uint8]) -> FloatArray:
    """What `as_bytes` was given, float32, up to rounding."""
    return np.asarray((descriptors.astype(np.float32) - np.float32(BYTE_ZERO)) / np.float32(_BYTES_PER_UNIT))
