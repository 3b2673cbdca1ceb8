"""Main direction of a patch by the histogram of its gradients.

Source: Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004, section 5.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray

_BINS = 36
# Standard deviation of the Gaussian that weighs gradients, as a share of the patch's side.
_SPREAD = 0.25
# Binomial, over neighbouring bins.
_SMOOTH = (1.0, 4.0, 6.0, 4.0, 1.0)


def gradient_angles(patches: NDArray[Any]) -> FloatArray:
    """Degrees (N,), x towards y, of the direction in which gray patches (N, S, S) become brighter, the most of them.

    A patch cut anew along that direction looks the same however its place was turned.
    """
    histograms = _histograms(patches.astype(np.float32))
    smooth = np.sum([weight * np.roll(histograms, k - 2, axis=1) for k, weight in enumerate(_SMOOTH)], axis=0)
    best, rows = smooth.argmax(axis=1), np.arange(len(smooth))
    # The top of the parabola through the highest bin and its neighbours.
    left, middle, right = (smooth[rows, (best + k) % _BINS] for k in (-1, 0, 1))
    curve = np.minimum(left - 2.0 * middle + right, -1e-12)
    return np.asarray((best + 0.5 * (left - right) / curve) * (360.0 / _BINS), np.float64)


def _histograms(gray: NDArray[np.float32]) -> FloatArray:
    """(N, 36) weighted lengths of the gradients by their directions, each shared by the two nearest bins."""
    across = gray[:, 1:-1, 2:] - gray[:, 1:-1, :-2]
    down = gray[:, 2:, 1:-1] - gray[:, :-2, 1:-1]
    side = gray.shape[1]
    from_middle = np.arange(1, side - 1) - (side - 1) / 2.0
    near = np.exp(-0.5 * (from_middle / (_SPREAD * side)) ** 2).astype(np.float32)
    lengths = np.hypot(across, down) * near[:, None] * near
    places = np.arctan2(down, across) * np.float32(_BINS / (2.0 * np.pi))
    low = np.floor(places)
    rows = np.arange(len(gray))[:, None, None] * _BINS
    total = np.zeros(len(gray) * _BINS)
    for step, weights in ((0, lengths * (1.0 - (places - low))), (1, lengths * (places - low))):
        bins = rows + (low.astype(np.int64) + step) % _BINS
        total += np.bincount(bins.ravel(), weights.ravel(), len(total))
    return total.reshape(-1, _BINS)
