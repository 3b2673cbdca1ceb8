"""Small pictures of the images, for the pair viewer and the sketch of the ground; each image is read once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.errors import ItemError
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.images.scaling import shrink
from aeromatch_cli.report.previews import to_colour8
from aeromatch_cli.report.rows import PairRow
from aeromatch_cli.stages.context import Context

MAX_IMAGES = 300
# Longest side of a picture, for at most so many images.
_SIDES_PX = ((40, 480), (120, 320), (MAX_IMAGES, 240))
_JPEG_SUFFIXES = frozenset({".jpg", ".jpeg"})


def thumbnails(context: Context, rows: Sequence[PairRow]) -> dict[str, NDArray[np.uint8]]:
    """image_id -> picture (h, w) or (h, w, 3) as stored, of the images of the first rows, MAX_IMAGES of them at most;
    without those that cannot be read any more."""
    wanted: dict[str, None] = {}
    for row in rows:
        new = {row.image_id0, row.image_id1} - wanted.keys()
        if len(wanted) + len(new) <= MAX_IMAGES:
            wanted |= dict.fromkeys(sorted(new))
    side_px = next(side for most, side in _SIDES_PX if len(wanted) <= most)
    found = {}
    for image_id in wanted:
        try:
            found[image_id] = _small(context.image_path(context.image_by_id[image_id]), side_px)
        except ItemError:
            continue
    return found


def _small(path: Path, side_px: int) -> NDArray[np.uint8]:
    """The stored raster, reduced. A JPEG is decoded at reduced size: a tenth of the time."""
    if path.suffix.lower() in _JPEG_SUFFIXES:
        from PIL import Image

        try:
            with Image.open(path) as picture:
                if picture.mode in ("RGB", "L"):
                    picture.draft(picture.mode, (side_px, side_px))
                    picture.thumbnail((side_px, side_px), reducing_gap=2.0)
                    return np.asarray(picture)
        except (OSError, ValueError) as error:
            raise ItemError(f"{path}: {error}") from error
    pixels: NDArray[Any] = read_pixels(path, colour=True)
    return to_colour8(shrink(pixels, min(1.0, side_px / max(pixels.shape[:2]))))
