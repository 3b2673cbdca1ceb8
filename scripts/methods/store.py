"""What methods answered, on disk: matching takes an hour and judging seconds, so a new judge needs no new matches."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from aeromatch_cli.workspace import write_atomically
from methods.base import Found
from methods.worker import Measured

_ARRAYS = ("points0_px", "points1_px", "scores", "keypoints0_px", "keypoints1_px")


def write_measured(path: Path, measured: Measured) -> None:
    """One pair of one method, whole or not at all."""
    found = measured.found
    buffer = io.BytesIO()
    numbers = np.array([found.descriptors, measured.seconds, measured.peak_mb])
    np.savez_compressed(buffer, numbers=numbers, **{name: getattr(found, name) for name in _ARRAYS})
    write_atomically(path, lambda stream: stream.write(buffer.getvalue()))


def read_measured(path: Path) -> Measured:
    with np.load(path, allow_pickle=False) as arrays:
        descriptors, seconds, peak_mb = arrays["numbers"].tolist()
        found = Found(**{name: arrays[name] for name in _ARRAYS}, descriptors=descriptors)
    return Measured(found, seconds, peak_mb)
