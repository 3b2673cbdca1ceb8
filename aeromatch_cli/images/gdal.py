"""TIFF and JPEG 2000 of any number of bands and depth, whole or by windows, as GDAL (rasterio) reads them.

The only file that knows its band order.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray
from aeromatch_cli.errors import ItemError
from aeromatch_cli.images.depth import STRIP_PIXELS

# GDAL's own cache, which would else take a twentieth of the machine.
_CACHE_MB = 128

TIFF = frozenset({".tif", ".tiff"})
SUFFIXES = TIFF | {".jp2", ".j2k"}
# GDAL's name of a band whose numbers stand for colours of a table.
_PALETTE = "palette"
# OpenCV decodes no more (CV_IO_MAX_IMAGE_PIXELS). The largest aerial cameras have half as many.
MAX_PIXELS = 1 << 30


def check_pixels(path: Path, width_px: int, height_px: int) -> None:
    """Raises ItemError for a picture that is too large to decode: a file of some kilobytes may claim any size."""
    if width_px * height_px > MAX_PIXELS:
        raise ItemError(
            f"image {path} has {width_px * height_px / 1e6:,.0f} megapixels; more than {MAX_PIXELS / 1e6:,.0f} are not "
            "decoded: cut it into parts, or reduce it"
        )


def stored_size(path: Path) -> tuple[int, int]:
    """Width and height of the stored raster, from the header alone. Raises ItemError."""
    with _opened(path) as source:
        return int(source.width), int(source.height)


def beyond_bytes(path: Path) -> bool:
    """Whether the first band has other numbers than bytes, or bytes that stand for colours of a table, from the header;
    False where that cannot be read."""
    try:
        with _opened(path) as source:
            return bool(source.dtypes[0] != "uint8" or source.colorinterp[0].name == _PALETTE)
    except ItemError:
        return False


def read_bands(path: Path, part: tuple[int, int, int, int] | None = None) -> tuple[NDArray[Any], BoolArray | None]:
    """(H, W) or (H, W, 3) of whole or floating numbers as stored, and where the file has values (None = everywhere).

    part: left, top, width, height of what is read, None for everything. The first three bands of four or more, the
    first of two; a band of transparency is none of them. Of one band with a table of colours, these. Raises ItemError.
    """
    with _opened(path) as source:
        if part is None:
            check_pixels(path, source.width, source.height)
        left, top, width, height = part or (0, 0, source.width, source.height)
        rows = height if part else _strip_rows(path, source)
        strips = [(left, y, width, min(rows, top + height - y)) for y in range(top, top + height, rows)]
        pixels, known = _read_strip(path, source, strips[0])
        if len(strips) == 1:
            return pixels, known.valid(known.alpha_is_mask)
        first, parts = pixels, [known]
        pixels = np.empty((height, *first.shape[1:]), first.dtype)
        pixels[:rows] = first
        for strip in strips[1:]:
            pixels[strip[1] - top : strip[1] - top + strip[3]], known = _read_strip(path, source, strip)
            parts.append(known)
    # Whether the last band is one of transparency, only all of its values tell.
    alpha_is_mask = all(each.alpha_is_mask for each in parts)
    valid = [mask for each in parts if (mask := each.valid(alpha_is_mask)) is not None]
    return pixels, np.concatenate(valid) if valid else None


@dataclass(frozen=True, eq=False)
class _Known:
    """Where rows of a picture have values.

    known: (h, W) by nodata and the file's own mask, None where neither says anything. alpha: (h, W) where a last band
    that may be one of transparency is not 0.
    """

    known: BoolArray | None
    alpha: BoolArray | None
    alpha_is_mask: bool

    def valid(self, alpha_is_mask: bool) -> BoolArray | None:
        alpha = self.alpha if alpha_is_mask else None
        if self.known is None:
            return alpha
        if alpha is None:
            return self.known
        return np.asarray(self.known & alpha)


def _strip_rows(path: Path, source: Any) -> int:
    """Rows that are decoded at once: whole tiles of a TIFF. What is compressed as a whole is decoded once."""
    if path.suffix.lower() not in TIFF:
        return int(source.height)
    tile_rows = int(source.block_shapes[0][0])
    return max(1, STRIP_PIXELS // (source.width * tile_rows)) * tile_rows


def _read_strip(path: Path, source: Any, part: tuple[int, int, int, int]) -> tuple[NDArray[Any], _Known]:
    left, top, width, height = part
    window = ((top, top + height), (left, left + width))
    extra = _transparency(source)
    shown = [index for index in source.indexes if index != extra]
    shown = shown[:3] if len(shown) >= 3 else shown[:1]
    # One call: in most files the bands of a pixel lie together, and a second call would decode them again.
    bands = source.read([*shown, extra] if extra else shown, window=window)
    planes, last = bands[: len(shown)], bands[len(shown) :]
    if bands.dtype.kind not in "iuf":
        raise ItemError(f"image {path} holds {bands.dtype} numbers: write their magnitudes, as uint16 or float32")
    known = _has_values(planes, [source.nodatavals[index - 1] for index in shown])
    flags = {flag.name for flag in source.mask_flag_enums[0]}
    if "per_dataset" in flags and "alpha" not in flags:
        mask = source.read_masks(1, window=window) > 0
        known = mask if known is None else known & mask
    if source.colorinterp[shown[0] - 1].name == _PALETTE and planes.dtype.kind == "u":
        pixels, known = _coloured(planes[0], known, source.colormap(shown[0]))
    else:
        pixels = np.ascontiguousarray(np.moveaxis(planes, 0, 2)) if len(planes) == 3 else np.array(planes[0])
    if not extra:
        return pixels, _Known(known, None, alpha_is_mask=False)
    named = source.colorinterp[extra - 1].name == "alpha"
    return pixels, _Known(known, last[0] > 0, alpha_is_mask=named or _is_mask(last[0]))


def _coloured(
    numbers: NDArray[Any], known: BoolArray | None, colours: Mapping[int, tuple[int, int, int, int]]
) -> tuple[NDArray[np.uint8], BoolArray | None]:
    """(H, W, 3) colours that numbers (H, W) stand for, and where they have values: also not where transparent."""
    table = np.zeros((int(np.iinfo(numbers.dtype).max) + 1, 4), np.uint8)
    table[list(colours)] = list(colours.values())
    opaque = table[:, 3] > 0
    if not opaque[list(colours)].all():
        there = opaque[numbers]
        known = there if known is None else known & there
    return table[numbers, :3], known


def may_have_a_mask(path: Path) -> bool:
    """Whether only all values of the last band say if it is one of transparency. Raises ItemError."""
    with _opened(path) as source:
        extra = _transparency(source)
        return bool(extra) and source.colorinterp[extra - 1].name != "alpha"


def _transparency(source: Any) -> int:
    """Number of the alpha band, or of the last of two or four bands that may be one without the name; 0 for none."""
    kinds = [kind.name for kind in source.colorinterp]
    if "alpha" in kinds[1:]:
        return kinds.index("alpha", 1) + 1
    return len(kinds) if len(kinds) in (2, 4) and kinds[-1] == "undefined" else 0


def _is_mask(band: NDArray[Any]) -> bool:
    """Whether a band holds nothing but 0 and its type's largest value: many writers leave alpha without its name."""
    return band.dtype.kind == "u" and bool(((band == 0) | (band == np.iinfo(band.dtype).max)).all())


def _has_values(planes: NDArray[Any], nodata: Sequence[float | None]) -> BoolArray | None:
    """(H, W) False where all planes (B, H, W) are their nodata value, or any is no number; None where nothing says."""
    known: BoolArray | None = np.isfinite(planes).all(axis=0) if planes.dtype.kind == "f" else None
    values = [value for value in nodata if value is not None and _can_hold(planes.dtype, value)]
    if len(values) == len(planes):
        with np.errstate(over="ignore"):  # a double beyond float32 is its infinity there
            stored = np.array(values).astype(planes.dtype)
        there = (planes != stored[:, None, None]).any(axis=0)
        known = there if known is None else known & there
    return known


def _can_hold(dtype: np.dtype[Any], value: float) -> bool:
    if dtype.kind == "f":
        return True
    limits = np.iinfo(dtype)
    return float(value).is_integer() and limits.min <= value <= limits.max


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """rasterio's dataset; what it raises within becomes an ItemError."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.Env(GDAL_CACHEMAX=_CACHE_MB), rasterio.open(path) as source:
                yield source
    except (RasterioError, OSError) as error:
        words = str(error.__cause__ or error)  # rasterio's own refer to "previous exception"
        raise ItemError(f"cannot decode image {path}: {words}; copy it again or remove it") from None
