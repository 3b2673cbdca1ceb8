"""Stored pictures for matchers that compare pixels: gray in full depth, with every mask that applies.

TIFFs are read by parts where nothing asks for all of them at once. Other formats can only be decoded whole, which is
done once per worker, as it is with what has a mask, a frame or sky.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.images import gdal
from aeromatch_cli.images.files import JPEG_SUFFIXES
from aeromatch_cli.images.masks import without_frames
from aeromatch_cli.images.scaling import shrink_in_strips
from aeromatch_cli.images.source import Source, read_source
from aeromatch_cli.recent import recent

# Gray as decoded, where it is valid, and what its values are multiplied with.
Picture = tuple[NDArray[Any], BoolArray | None, float]

# What a worker keeps, by the fingerprint of all that it depends on: a row compares one image with a handful of others.
_KEPT, _KEPT_REDUCED, _KEPT_UNITS = 4, 8, 4096
_wholes: dict[str, Picture] = {}
_units: dict[str, float | None] = {}
_reduced: dict[tuple[str, float], tuple[FloatArray, BoolArray | None]] = {}
# A TIFF is looked at on this scale first: for a frame, and for its largest value, which becomes _TOP, so that it makes
# no difference whether reflectances up to 1 are stored or gray values up to 65535, nor whether a picture is read by
# parts or whole. Only what is decoded whole and has 8 bits stays as it is.
_GLANCE, _TOP = 0.0625, 255.0
_KNOWN = 0.999  # of the area of a reduced pixel


class StoredRaster:
    """`data.Raster` of an image as it was taken, read when it is needed."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.width_px, self.height_px = source.camera.width_px, source.camera.height_px
        self.finest = source.scale

    def reduced(self, scale: float) -> tuple[FloatArray, BoolArray | None]:
        return recent(_reduced, (self._source.fingerprint, scale), lambda: self._made(scale), _KEPT_REDUCED)

    def window(self, left: int, top: int, width: int, height: int) -> tuple[FloatArray, BoolArray | None]:
        unit = self._unit()
        if unit is not None:
            return self._part((left, top, width, height), unit)
        pixels, valid, gain = self._whole()
        part = (slice(top, top + height), slice(left, left + width))
        return pixels[part].astype(np.float32) * np.float32(gain), None if valid is None else valid[part]

    def _made(self, scale: float) -> tuple[FloatArray, BoolArray | None]:
        unit = self._unit()
        if unit is not None:
            return self._of_parts(scale, unit)
        pixels, valid, gain = self._whole()
        relative = min(1.0, scale / self.finest)
        size = pixels.shape[1], pixels.shape[0]
        small = shrink_in_strips(lambda top, count: pixels[top : top + count], size, relative) * np.float32(gain)
        if valid is None:
            return small, None
        share = shrink_in_strips(lambda top, count: valid[top : top + count], size, relative)
        return small, np.asarray(share > _KNOWN)

    def _unit(self) -> float | None:
        """What values of a file that is read by parts are multiplied with; None where it is decoded whole."""
        return recent(_units, self._source.fingerprint, self._glanced, _KEPT_UNITS)

    def _glanced(self) -> float | None:
        source = self._source
        if (
            source.path.suffix.lower() not in gdal.SUFFIXES
            or source.mask is not None
            or source.sky_rotation is not None
        ):
            return None
        if gdal.stored_size(source.path) != (self.width_px, self.height_px) or gdal.may_have_a_mask(source.path):
            return None  # where all is decoded the size is judged, and whether the last band is a mask
        small, valid = self._of_parts(_GLANCE, 1.0)
        if without_frames(small) is not None or (valid is not None and not valid.any()):
            return None
        return _gain(small)

    def _of_parts(self, scale: float, unit: float) -> tuple[FloatArray, BoolArray | None]:
        known: list[BoolArray | None] = []

        def read(top: int, count: int) -> NDArray[Any]:
            pixels, valid = self._part((0, top, self.width_px, count), unit)
            known.append(valid)
            return pixels

        def read_known(top: int, count: int) -> NDArray[Any]:
            del top  # strips come in the same order
            valid = known.pop(0)
            return np.ones((count, self.width_px), bool) if valid is None else valid

        size = self.width_px, self.height_px
        small = shrink_in_strips(read, size, scale)
        if all(valid is None for valid in known):
            return small, None
        return small, np.asarray(shrink_in_strips(read_known, size, scale) > _KNOWN)

    def _part(self, part: tuple[int, int, int, int], unit: float) -> tuple[NDArray[np.float32], BoolArray | None]:
        pixels, valid = gdal.read_bands(self._source.path, part)
        gray = _gray(pixels).astype(np.float32) * np.float32(unit)
        if valid is None or valid.all():
            return gray, None
        gray[~valid] = 0.0
        return gray, valid

    def _whole(self) -> Picture:
        """(H, W) gray at the working scale, where it is valid, and the gain of its values."""
        return recent(_wholes, self._source.fingerprint, self._decoded, _KEPT)

    def _decoded(self) -> Picture:
        # JPEGs have 8 bits: straight from the decoder. Others keep their depth.
        straight = self._source.path.suffix.lower() in JPEG_SUFFIXES
        pixels, valid = read_source(self._source, colour=not straight)
        gray = _gray(pixels)
        if gray.dtype == np.uint8:
            return gray, valid, 1.0
        size = gray.shape[1], gray.shape[0]
        relative = min(1.0, _GLANCE / self.finest)
        return gray, valid, _gain(shrink_in_strips(lambda top, count: gray[top : top + count], size, relative))


def _gain(small: NDArray[np.float32]) -> float:
    """What brings the largest value of a picture, of which this is a glance, to _TOP."""
    return _TOP / max(float(np.abs(small).max()), 1e-30)


def _gray(pixels: NDArray[Any]) -> NDArray[Any]:
    """(H, W) of the same depth, or of float32 where that has no gray of its own."""
    import cv2

    if pixels.ndim == 2:
        return pixels
    if pixels.dtype not in (np.uint8, np.uint16, np.float32):
        pixels = pixels.astype(np.float32)
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))
