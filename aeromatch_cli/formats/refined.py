"""The workspace's files of measured places of keypoints."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.formats.archives import load_arrays, save_arrays
from aeromatch_cli.formats.features import known_fingerprint, read_keypoints


def write_refined(stream: BinaryIO, keypoints_px: FloatArray, measured: BoolArray, fingerprint: str) -> None:
    """keypoints_px: (K, 2) of all keypoints of an image. measured: (K,) which of them stand for their points or were
    measured by those that do. fingerprint: of the features whose keypoints these are."""
    places = keypoints_px.astype(np.float32)
    save_arrays(stream, fingerprint=np.array(fingerprint), keypoints_px=places, measured=measured)


def read_final_keypoints(features: Path, refined: Path) -> FloatArray:
    """(K, 2) stored pixels of an image's keypoints: where they were measured, else where the detector put them; none of
    an image without features. Raises BrokenFileError where a file is broken."""
    if not features.is_file():
        return np.zeros((0, 2), np.float32)
    if refined.is_file():
        found = load_arrays(refined, ("keypoints_px", "fingerprint"))
        if str(found["fingerprint"]) == known_fingerprint(features):
            return found["keypoints_px"]
    return read_keypoints(features)[0]
