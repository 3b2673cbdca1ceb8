"""The workspace's files of keypoints: features of an image, joined keypoints of a cascade, and refined places."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import (
    BoolArray,
    Features,
    FloatArray,
    JoinedKeypoints,
)
from aeromatch_cli.errors import BrokenFileError
from aeromatch_cli.formats.archives import load_arrays, load_checked, save_arrays
from aeromatch_cli.formats.reading import say_damaged

_FEATURE_ARRAYS = tuple(field.name for field in fields(Features) if field.name != "colours")


def write_features(stream: BinaryIO, features: Features, fingerprint: str) -> None:
    arrays: dict[str, Any] = {name: getattr(features, name) for name in _FEATURE_ARRAYS}
    if features.colours is not None:
        arrays["colours"] = features.colours
    save_arrays(stream, fingerprint=np.array(fingerprint), **arrays)


def read_features(path: Path) -> Features:
    """All arrays. Raises BrokenFileError when the file is missing or broken."""
    return Features(**load_arrays(path, _FEATURE_ARRAYS, ("colours",)))


def write_joined(stream: BinaryIO, joined: JoinedKeypoints, fingerprint: str) -> None:
    """Of a cascade: keypoints of all its steps; descriptors stay in the steps' own files."""
    arrays: dict[str, Any] = {name: getattr(joined, name) for name in ("keypoints_px", "sizes_px", "responses")}
    arrays |= {f"numbers_{name}": numbers for name, numbers in joined.numbers.items()}
    if joined.colours is not None:
        arrays["colours"] = joined.colours
    kinds = np.array(joined.kinds, dtype=np.str_)
    save_arrays(stream, fingerprint=np.array(fingerprint), kinds=kinds, kind_idx=joined.kind_idx, **arrays)


def read_joined(path: Path) -> JoinedKeypoints:
    """Raises BrokenFileError when the file is missing or broken."""
    kinds = tuple(str(name) for name in load_arrays(path, ("kinds",))["kinds"])
    numbers = load_arrays(path, [f"numbers_{name}" for name in kinds])
    arrays: dict[str, Any] = load_arrays(path, ("keypoints_px", "sizes_px", "responses", "kind_idx"), ("colours",))
    return JoinedKeypoints(kinds=kinds, numbers={name: numbers[f"numbers_{name}"] for name in kinds}, **arrays)


def read_keypoints(path: Path) -> tuple[FloatArray, FloatArray, NDArray[np.uint8] | None]:
    """keypoints_px (K, 2), sizes_px (K,) and colours (K, 3) or None; the rest stays on disk."""
    arrays = load_arrays(path, ("keypoints_px", "sizes_px"), ("colours",))
    return arrays["keypoints_px"], arrays["sizes_px"], arrays.get("colours")


def checked_features(path: Path) -> tuple[str, int]:
    """Return the fingerprint and the number of keypoints of a feature file, after all its contents were compared with
    their checksums. Raises BrokenFileError when the file is missing or broken."""
    arrays = load_checked(path, ("fingerprint", "keypoints_px"))
    return str(arrays["fingerprint"]), len(arrays["keypoints_px"])


def checked_keypoints(path: Path) -> tuple[str, FloatArray | None]:
    """Return fingerprint and keypoints (K, 2) from one reading; "" and None, with a warning, where the file is broken,
    without one where it is absent."""
    try:
        arrays = load_checked(path, ("fingerprint", "keypoints_px"))
    except BrokenFileError as error:
        say_damaged(path, error)
        return "", None
    return str(arrays["fingerprint"]), arrays["keypoints_px"]


def features_fingerprint(path: Path) -> str:
    """Return the fingerprint that a feature file states; nothing else of it is read. Raises BrokenFileError."""
    return str(load_arrays(path, ("fingerprint",))["fingerprint"])


def write_refined(stream: BinaryIO, keypoints_px: FloatArray, measured: BoolArray, features_fingerprint: str) -> None:
    """Write the refined places of the keypoints of an image.

    keypoints_px: (K, 2) of all keypoints. measured: (K,) which of them stand for their points or were measured by those
    that do. features_fingerprint: of the features whose keypoints these are.
    """
    places = keypoints_px.astype(np.float32)
    save_arrays(stream, fingerprint=np.array(features_fingerprint), keypoints_px=places, measured=measured)


def read_final_keypoints(features: Path, refined: Path) -> FloatArray:
    """Return (K, 2) stored pixels of an image's keypoints: where they were measured, else where the detector put them;
    none of an image without features. Raises BrokenFileError where a file is broken."""
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
    """Return the measured places (K, 2), None where there are none of the features with this fingerprint."""
    if not refined.is_file():
        return None
    found = load_arrays(refined, ("keypoints_px", "fingerprint"))
    return found["keypoints_px"] if str(found["fingerprint"]) == fingerprint else None
