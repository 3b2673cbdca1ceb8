"""Rasters from files and back: the stored frame whatever the EXIF Orientation, RGB order, 8 and 16 bit.

The only file that knows OpenCV's BGR.
"""

from __future__ import annotations

import io
import os
import re
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray
from aeromatch_cli.errors import ItemError
from aeromatch_cli.images import gdal, heif
from aeromatch_cli.images.depth import in_16_bits, to_gray8
from aeromatch_cli.images.masks import both_valid, without_frames
from aeromatch_cli.images.png import SIGNATURE, chunks

# A byte 0xff that is neither escaped (0x00), nor a restart (0xd0-0xd7), nor padding of another 0xff; and what it may
# announce (ITU T.81, table B.1): frames, tables, scans, application data, comments.
_JPEG_MARKER = re.compile(rb"\xff([^\x00\xff\xd0-\xd7])", re.DOTALL)

# Of files that hold a JPEG.
JPEG_SUFFIXES = (".jpg", ".jpeg", ".jpe", ".jfif")
_JPEG_SEGMENTS = frozenset((*range(0xC0, 0xD0), *range(0xDA, 0xF0), 0xFE))

_END_OF_IMAGE = 0xD9
# What libjpeg prints of damaged data (jerror.h); it goes on with gray or noise.
_COMPLAINT = re.compile(
    r"(Corrupt JPEG data|Premature end of JPEG|Inconsistent progression|Invalid SOS|Unsupported marker)"
)
# There is one stderr: threads take turns with it.
_STDERR = threading.Lock()
_JPEG_QUALITY = 95
# Where a PNG says how many bits its numbers have.
_PNG_BITS = 24
# A reduced mask has the shape of its image but for rounding to whole pixels.
_MASK_ROUNDING_PX = 1.0


def read_pixels(path: Path, *, colour: bool) -> NDArray[Any]:
    """The stored raster: (H, W) uint8 gray, or with `colour` uint8 or uint16 and (H, W, 3) RGB where it has colour.

    Other depths come as `in_16_bits` makes them. Raises ItemError when the file cannot be decoded.
    """
    return read_raster(path, colour=colour)[0]


def read_raster(path: Path, *, colour: bool) -> tuple[NDArray[Any], BoolArray | None]:
    """The same, and where it is valid (H, W) by what the file says (None = everywhere); what is not is 0.

    Invalid are transparent pixels, those of the nodata value in all bands, NaN, and frames of zeros. A file that calls
    every pixel invalid is not believed: some writers leave alpha empty.
    """
    return read_examined(path, colour=colour)[:2]


def read_examined(path: Path, *, colour: bool) -> tuple[NDArray[Any], BoolArray | None, str]:
    """The same, and what the decoder complains of, "" for nothing."""
    import cv2

    valid, complaint = None, ""
    if path.suffix.lower() in gdal.SUFFIXES:
        pixels, valid = gdal.read_bands(path)
    else:
        # Gray straight from the decoder is fastest, but it would cast a 16-bit PNG to 8 bit.
        straight = not colour and path.suffix.lower() in JPEG_SUFFIXES
        flag = cv2.IMREAD_GRAYSCALE if straight else cv2.IMREAD_UNCHANGED
        pixels, complaint = _decode(path, flag | cv2.IMREAD_IGNORE_ORIENTATION)
        if pixels.ndim == 3 and pixels.shape[2] == 4:
            valid = pixels[..., 3] > 0
            pixels = cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGB)
        elif pixels.ndim == 3:
            pixels = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
    if valid is not None and bool(valid.all()) == bool(valid.any()):
        valid = None
    pixels = in_16_bits(pixels, valid)
    if valid is not None:
        pixels[~valid] = 0  # like a black frame, whatever the value was: no stretch counts it, no edge is higher
    # Frames are zeros as stored: stretched to 8 bits, the darkest pixels of a picture are 0 too.
    shown = pixels if colour else to_gray8(pixels)
    return shown, both_valid(valid, without_frames(shown if pixels.dtype == np.uint8 else pixels)), complaint


def beyond_bytes(path: Path) -> bool:
    """Whether a picture has other numbers than bytes, or a TIFF's table of colours, by its header; False where that
    cannot be read."""
    if path.suffix.lower() in gdal.SUFFIXES:
        return gdal.beyond_bytes(path)
    with path.open("rb") as stream:
        head = stream.read(_PNG_BITS + 1)
    return head.startswith(SIGNATURE) and head[_PNG_BITS:] == b"\x10"


def _decode(path: Path, flags: int) -> tuple[NDArray[Any], str]:
    """The raster as OpenCV gives it, and what libjpeg complains of."""
    import cv2

    check_size(path)
    if path.suffix.lower() in heif.SUFFIXES:
        return _decoded_heif(path), ""
    said: list[str] = []
    try:
        data = path.read_bytes()
        if fault := _png_fault(data):
            raise ItemError(f"image {path} is {fault}")
        with _held(said):
            pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    except (OSError, cv2.error) as error:
        raise ItemError(f"cannot read image {path}: {error}") from None
    if pixels is None:
        raise ItemError(f"cannot decode image {path}: the file is corrupt or no picture; replace or remove it")
    if fault := _jpeg_fault(data):
        raise ItemError(f"image {path} is {fault}")
    return np.asarray(pixels), next((line for line in said if _COMPLAINT.match(line)), "")


@contextmanager
def _held(said: list[str]) -> Iterator[None]:
    """Gathers the lines that a C library prints to stderr, where nobody could tell which picture they speak of."""
    with _STDERR, tempfile.TemporaryFile() as lines:
        kept = os.dup(2)
        try:
            os.dup2(lines.fileno(), 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            lines.seek(0)
            said += lines.read().decode("utf-8", "replace").splitlines()


def _decoded_heif(path: Path) -> NDArray[Any]:
    """(H, W, 3) BGR, as OpenCV would give it."""
    from PIL import Image

    if not heif.readable():
        raise ItemError(f"image {path} is HEIC: pip install 'aeromatch[heif]' reads it")
    try:
        with Image.open(path) as picture:
            return np.ascontiguousarray(np.asarray(picture.convert("RGB"))[..., ::-1])
    except (OSError, ValueError, SyntaxError, RuntimeError) as error:
        raise ItemError(f"cannot decode image {path}: {error}; replace or remove it") from None


def check_size(path: Path) -> None:
    """Raises ItemError for a picture that is too large to decode, by its header: a file of some kilobytes may claim
    any size. To be called before Pillow opens a picture, too."""
    from PIL import Image

    # Pillow's own guard refuses a mapping camera's frame; nothing is decoded here.
    Image.MAX_IMAGE_PIXELS = None
    if path.suffix.lower() in heif.SUFFIXES:
        heif.readable()
    try:
        with Image.open(path) as picture:
            width, height = picture.size
    except (OSError, ValueError, SyntaxError):
        return  # the decoder says what is wrong with it
    gdal.check_pixels(path, width, height)


def _png_fault(data: bytes) -> str:
    """What is wrong with a PNG's structure, "" for nothing; other formats pass.

    A chunk may claim any length: OpenCV makes room for up to 2 GB of it, and fills that, before it finds that the file
    ends; so no chunk may claim more than is left.
    """
    if data.startswith(SIGNATURE) and any(after > len(data) for *_, after in chunks(io.BytesIO(data))):
        return "cut off: its PNG data ends early; copy it again or remove it"
    return ""


def _jpeg_fault(data: bytes) -> str:
    """What is wrong with a JPEG's structure, "" for nothing; other formats pass.

    The decoder makes a picture of a cut or overwritten file without an error: gray, or noise, from there on. So the
    segments are walked here. The end marker must come, though not as the file's last bytes (some cameras append data),
    and compressed data must hold no marker but restarts. Markers inside segments (a thumbnail) do not count.
    """
    if data[:2] != b"\xff\xd8":
        return ""
    place = 2
    while found := _JPEG_MARKER.search(data, place):
        marker, place = found[1][0], found.end()
        if marker == _END_OF_IMAGE:
            return ""
        if marker not in _JPEG_SEGMENTS:
            return "corrupt: its compressed data is damaged; copy it again or remove it"
        # A segment's length counts its own two bytes.
        place += int.from_bytes(data[place : place + 2], "big")
    return "cut off: its JPEG data ends early; copy it again or remove it"


def write_png(stream: Any, pixels: NDArray[Any]) -> None:
    """PNG of (H, W) or (H, W, 3) RGB, uint8 or uint16, into a binary stream. Raises ValueError for other types."""
    import cv2

    if pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"a PNG holds uint8 or uint16, not {pixels.dtype}")  # OpenCV would cast without a word
    ordered = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels
    ok, data = cv2.imencode(".png", ordered)
    if not ok:
        raise ValueError(f"cannot encode a picture of shape {pixels.shape}")
    stream.write(data.tobytes())


def write_jpeg(stream: Any, pixels: NDArray[np.uint8]) -> None:
    """JPEG of (H, W, 3) RGB into a binary stream, of a quality that costs no match."""
    import cv2

    ok, data = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not ok:
        raise ValueError(f"cannot encode a picture of shape {pixels.shape}")
    stream.write(data.tobytes())


def read_mask(path: Path, width_px: int, height_px: int) -> BoolArray:
    """(H, W) bool, True = use: where any band but alpha is not 0; a mask of another size is resized by nearest
    neighbour. Raises ItemError, also where its shape is another one: it would be stretched over other ground."""
    import cv2

    # As it is stored: of 16 bits, gray from the decoder would be 0 below 256, and of colours where they are faint. But
    # a JPEG's colours are noise around zero.
    flag = cv2.IMREAD_GRAYSCALE if path.suffix.lower() in JPEG_SUFFIXES else cv2.IMREAD_UNCHANGED
    try:
        stored, _ = _decode(path, flag | cv2.IMREAD_IGNORE_ORIENTATION)
    except ItemError as error:
        raise ItemError(f"mask: {error}") from None
    # Alpha is no part of it: programs that paint masks leave it opaque everywhere.
    bands = [stored] if stored.ndim == 2 else [stored[..., index] for index in range(min(3, stored.shape[2]))]
    mask: NDArray[Any] = np.zeros(stored.shape[:2], np.uint8)
    for band in bands:
        mask |= band != 0
    if mask.shape != (height_px, width_px):
        height, width = mask.shape
        if abs(width * height_px - height * width_px) > max(width_px, height_px) * _MASK_ROUNDING_PX:
            raise ItemError(
                f"mask: {path} is {width} x {height} pixels, its image {width_px} x {height_px}, another shape: "
                "turn it as the stored image lies, or make it anew"
            )
        mask = cv2.resize(mask, (width_px, height_px), interpolation=cv2.INTER_NEAREST)
    return np.asarray(mask) > 0
