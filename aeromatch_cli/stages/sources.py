"""Stored pictures for matchers that compare pixels: read once per worker, gray, with every mask that applies."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.images import shrink
from aeromatch_cli.stages.enhance import EnhanceTask, load_source

# Pictures that a worker keeps, by the fingerprint of all that they depend on: a row compares one image with a handful
# of others.
_KEPT = 4
_pictures: OrderedDict[str, tuple[NDArray[np.uint8], BoolArray | None]] = OrderedDict()


class StoredRaster:
    """`data.Raster` of an image as it was taken, decoded when it is first read."""

    def __init__(self, task: EnhanceTask) -> None:
        self._task = task
        self.width_px, self.height_px = task.camera.width_px, task.camera.height_px
        self.finest = task.scale

    def reduced(self, scale: float) -> tuple[FloatArray, BoolArray | None]:
        pixels, valid = self._picture()
        relative = min(1.0, scale / self.finest)
        small = shrink(pixels.astype(np.float32), relative)
        if valid is None or relative == 1.0:
            return small, valid
        return small, np.asarray(shrink(valid.astype(np.uint8) * 255, relative) > 254)

    def window(self, left: int, top: int, width: int, height: int) -> tuple[FloatArray, BoolArray | None]:
        pixels, valid = self._picture()
        part = (slice(top, top + height), slice(left, left + width))
        return pixels[part].astype(np.float32), None if valid is None else valid[part]

    def _picture(self) -> tuple[NDArray[np.uint8], BoolArray | None]:
        """(H, W) gray at the working scale and where it is valid."""
        key = self._task.fingerprint
        if key not in _pictures:
            _pictures[key] = load_source(self._task, colour=False)
            if len(_pictures) > _KEPT:
                _pictures.popitem(last=False)
        _pictures.move_to_end(key)
        return _pictures[key]
