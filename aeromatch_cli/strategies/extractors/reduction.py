"""Views reduced by powers of two where they have many pixels for the keypoints that are wanted of them.

The fewer keypoints of a picture are kept, the larger are their blobs: those that only the full size shows cost three
quarters of the time and are hardly ever among them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aeromatch_cli.data import IntArray
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.detection import Raw

# Smaller pictures take no time.
_LEAST_PX = 400_000


def factor_for(views: Sequence[ViewPixels], keypoints: int, most_px: float) -> int:
    """The power of two by which views are reduced that share a number of keypoints, so that at most most_px visible
    pixels are left for each, and _LEAST_PX together; 1 where most_px is 0."""
    shown = sum(view.gray.size if view.valid is None else int(np.count_nonzero(view.valid)) for view in views)
    factor = 1
    while 0.0 < most_px * keypoints * factor**2 < shown and shown >= _LEAST_PX * (2 * factor) ** 2:
        factor *= 2
    return factor


def reduced(view: ViewPixels, factor: int) -> ViewPixels:
    """The same with a smaller picture, means of factor x factor pixels; its `view` still tells of the whole one. Valid
    is what has valid pixels alone; up to factor - 1 rows and columns at the end are left out."""
    import cv2

    height, width = (side // factor for side in view.gray.shape)
    if factor == 1 or not height or not width:
        return view
    parts = view.gray[: height * factor, : width * factor]
    gray = cv2.resize(parts, (width, height), interpolation=cv2.INTER_AREA)
    valid = view.valid
    if valid is not None:
        whole = valid[: height * factor, : width * factor].reshape(height, factor, width, factor)
        valid = np.logical_and.reduce(whole, axis=(1, 3))
    return replace(view, gray=gray, valid=valid)


def in_whole_views(raw: Raw, factors: IntArray) -> Raw:
    """Features (N,) of reduced views in the frames of the whole ones. factors: (N,)."""
    places = (raw.points_px.astype(np.float64) + 0.5) * factors[:, None] - 0.5
    sizes = (raw.sizes_px * factors).astype(np.float32)
    moved = {"source_px": places, "source_sizes_px": sizes, "points_px": places.astype(np.float32), "sizes_px": sizes}
    return Raw(**(vars(raw) | moved))


def in_reduced_views(raw: Raw, factors: IntArray) -> Raw:
    """Features (N,) of whole views in the frames of the reduced ones. factors: (N,)."""
    places = (raw.points_px.astype(np.float64) + 0.5) / factors[:, None] - 0.5
    moved = {"points_px": places.astype(np.float32), "sizes_px": (raw.sizes_px / factors).astype(np.float32)}
    return Raw(**(vars(raw) | moved))
