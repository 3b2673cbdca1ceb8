"""Verified matches that contradict the adjusted block, on file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from aeromatch_cli.data import IntArray
from aeromatch_cli.formats.archives import load_arrays, save_arrays

# image_id0, image_id1 -> fingerprint of the verified entry, and rows of its matches.
Dropped = Mapping[tuple[str, str], tuple[str, IntArray]]
_ARRAYS = ("images", "fingerprints", "counts", "rows", "least")


def write_dropped(stream: BinaryIO, dropped: Dropped, least: int) -> None:
    """An .npz without pickles. least: a pair that keeps fewer matches is rejected."""
    keys = sorted(dropped)
    save_arrays(
        stream,
        images=np.array(keys, dtype=np.str_).reshape(-1, 2),
        fingerprints=np.array([dropped[key][0] for key in keys], dtype=np.str_),
        counts=np.array([len(dropped[key][1]) for key in keys], dtype=np.int64),
        rows=np.concatenate([np.zeros(0, np.int32), *(dropped[key][1] for key in keys)]).astype(np.int32),
        least=np.array(least),
    )


def read_dropped(path: Path) -> tuple[Dropped, int]:
    """What was written, nothing where there is no file. Raises BrokenFileError where it is broken."""
    if not path.exists():
        return {}, 0
    arrays = load_arrays(path, _ARRAYS)
    rows = np.split(arrays["rows"], np.cumsum(arrays["counts"])[:-1]) if len(arrays["counts"]) else []
    found = {
        (str(id0), str(id1)): (str(made_of), own)
        for (id0, id1), made_of, own in zip(arrays["images"], arrays["fingerprints"], rows, strict=True)
    }
    return found, int(arrays["least"])
