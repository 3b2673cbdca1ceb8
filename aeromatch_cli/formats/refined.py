"""The workspace's files of measured places of keypoints."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.errors import BrokenFileError
from aeromatch_cli.formats.archives import load_arrays, save_arrays
from aeromatch_cli.formats.features import checked_keypoints, features_fingerprint, read_keypoints
from aeromatch_cli.formats.reading import say_damaged


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
    places = _measured(refined, features_fingerprint(features)) if refined.is_file() else None
    return read_keypoints(features)[0] if places is None else places


def checked_final_keypoints(features: Path, refined: Path) -> tuple[str, FloatArray | None]:
    """Fingerprint of the features and the same places; "" and None, with a warning, where the features are broken.
    Where the other file is broken, a warning and the places where the detector put the keypoints."""
    fingerprint, detected = checked_keypoints(features)
    try:
        places = None if detected is None else _measured(refined, fingerprint)
    except BrokenFileError as error:
        say_damaged(refined, error)
        return fingerprint, detected
    return fingerprint, detected if places is None else places


def _measured(refined: Path, fingerprint: str) -> FloatArray | None:
    """None where none are there of the features with this fingerprint."""
    if not refined.is_file():
        return None
    found = load_arrays(refined, ("keypoints_px", "fingerprint"))
    return found["keypoints_px"] if str(found["fingerprint"]) == fingerprint else None
