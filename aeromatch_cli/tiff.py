"""TIFFs of any number of bands and any depth, as rasterio reads them. The only file that knows its band order."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.errors import ItemError

SUFFIXES = frozenset({".tif", ".tiff"})


def tiff_size(path: Path) -> tuple[int, int]:
    """Width and height of the stored raster, from the header alone. Raises ItemError."""
    with _opened(path) as source:
        return int(source.width), int(source.height)


def read_tiff(path: Path) -> NDArray[Any]:
    """(H, W) or (H, W, 3) of whole or floating numbers as stored; the first three bands of four or more.

    Raises ItemError.
    """
    with _opened(path) as source:
        bands = source.read(list(range(1, 4)) if source.count >= 3 else [1])
    if bands.dtype.kind not in "iuf":
        raise ItemError(f"image {path} holds {bands.dtype} numbers: write their magnitudes, as uint16 or float32")
    return np.ascontiguousarray(np.moveaxis(bands, 0, 2)) if len(bands) == 3 else np.asarray(bands[0])


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """rasterio's dataset; what it raises within becomes an ItemError."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as source:
                yield source
    except (RasterioError, OSError) as error:
        raise ItemError(f"cannot decode image {path}: {error}") from None
