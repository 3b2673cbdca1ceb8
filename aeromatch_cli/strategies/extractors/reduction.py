"""Views reduced by powers of two where they have many pixels for the keypoints that are wanted of them.

The fewer keypoints of a picture are kept, the larger are their blobs: those that only the full size shows cost three
quarters of the time and are hardly ever among them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aeromatch_cli.data import Camera, IntArray
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.detection import Raw

# Images of fewer pixels take hardly any time.
LEAST_PX = 400_000


def factor_for(camera: Camera, views: Sequence[ViewPixels], keypoints: int, most_px: float) -> int:
    """The power of two by which views are reduced that share a number of keypoints: the smallest that leaves the image
    at most most_px pixels for each keypoint, and at least LEAST_PX in all; 1 where most_px is 0.

    The pixels of the image count, not those of its views: images of one camera shall be reduced alike, however many
    views they have and whatever ground these show, because only then have they the same blobs.
    """
    pixels = camera.width_px * camera.height_px
    sides = [side for view in views for side in view.gray.shape]
    factor = 1
    while 0.0 < most_px * keypoints * factor**2 < pixels and pixels >= LEAST_PX * (2 * factor) ** 2:
        if min(sides) < 2 * factor:  # a sliver
            break
        factor *= 2
    return factor


def reduced(view: ViewPixels, factor: int) -> ViewPixels:
    """The same with a smaller picture, means of factor x factor pixels; its `view` still tells of the whole one. Valid
    is what has valid pixels alone; up to factor - 1 rows and columns at the end are left out."""
    import cv2

    height, width = (side // factor for side in view.gray.shape)
    if factor == 1:
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
