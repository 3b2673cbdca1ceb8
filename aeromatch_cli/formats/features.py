"""The workspace's feature files."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import (
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
