"""Rasters in and out: stored frame whatever the EXIF Orientation, RGB order, 8 and 16 bit, masks, views.

The only file that knows OpenCV's BGR.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli import tiff
from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pose, View
from aeromatch_cli.errors import ItemError
from aeromatch_cli.geometry.cameras import distort, resized, world_rays
from aeromatch_cli.geometry.footprints import sees_horizon
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.geometry.warps import area_scale

# 16-bit pictures are stretched between these percentiles: a cast would leave a 12-bit sensor black.
_STRETCH_PERCENTILES = (0.5, 99.5)
# The range of float pictures, and of whole numbers that are no uint16: a few outliers are not to make the rest flat.
_RANGE_PERCENTILES = (0.1, 99.9)
_TOP_16_BIT = 65535
_GRID_STEP_PX = 8
_COLOUR_LEVELS = 7  # squares of 1, 2, 4 ... 64 px
_GRID_ERROR_PX = 0.015
# Shrinking below this scale needs an area filter first, or the view aliases.
_ALIASING_SCALE = 0.75
_WHOLE_ERROR = 1e-6
_STRIP_PX = 4_000_000  # that are held as float32 at once while a large picture is reduced
# A byte 0xff that is neither escaped (0x00), nor a restart (0xd0-0xd7), nor padding of another 0xff; and what it may
# announce (ITU T.81, table B.1): frames, tables, scans, application data, comments.
_JPEG_MARKER = re.compile(rb"\xff([^\x00\xff\xd0-\xd7])", re.DOTALL)
_JPEG_SEGMENTS = frozenset((*range(0xC0, 0xD0), *range(0xDA, 0xF0), 0xFE))
_END_OF_IMAGE = 0xD9


def read_pixels(path: Path, *, colour: bool) -> NDArray[Any]:
    """The stored raster: (H, W) uint8 gray, or with `colour` uint8 or uint16 and (H, W, 3) RGB where it has colour.

    Other depths come as `in_16_bits` makes them. Raises ItemError when the file cannot be decoded.
    """
    return read_raster(path, colour=colour)[0]


def read_raster(path: Path, *, colour: bool) -> tuple[NDArray[Any], BoolArray | None]:
    """The same, and where it is valid (H, W) by what the file says (None = everywhere); what is not is 0.

    Invalid are transparent pixels, those of the nodata value in all bands, and NaN. A file that calls every pixel
    invalid is not believed: some writers leave alpha empty.
    """
    import cv2

    valid = None
    if path.suffix.lower() in tiff.SUFFIXES:
        pixels, valid = tiff.read_tiff(path)
    else:
        # Gray straight from the decoder is fastest, but it would cast a 16-bit PNG to 8 bit.
        straight = not colour and path.suffix.lower() in (".jpg", ".jpeg")
        flag = cv2.IMREAD_GRAYSCALE if straight else cv2.IMREAD_UNCHANGED
        pixels = _decode(path, flag | cv2.IMREAD_IGNORE_ORIENTATION)
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
    return pixels if colour else to_gray8(pixels), valid


def _decode(path: Path, flags: int) -> NDArray[Any]:
    import cv2

    try:
        data = path.read_bytes()
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    except (OSError, cv2.error) as error:
        raise ItemError(f"cannot read image {path}: {error}") from None
    if pixels is None:
        raise ItemError(f"cannot decode image {path}: the file is corrupt or no picture; replace or remove it")
    if fault := _jpeg_fault(data):
        raise ItemError(f"image {path} is {fault}")
    return np.asarray(pixels)


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


def in_16_bits(pixels: NDArray[Any], valid: BoolArray | None = None) -> NDArray[Any]:
    """A picture of whole or floating numbers as uint16; uint8 and uint16 as they are. NaN and infinity become 0.

    Whole numbers that all lie within 0-65535 keep their values. Others are scaled, all bands alike so that hue stays:
    the 99.9th percentile becomes 65535, and 0 stays 0, so that values stay proportional to light; where the 0.1th
    percentile is negative (temperatures, say), that becomes 0. Only what is valid (H, W; None = all) counts, and no
    zeros, for they may be a frame.
    """
    if pixels.dtype in (np.uint8, np.uint16):
        return pixels
    there = np.isfinite(pixels)
    if valid is not None:
        there &= valid if pixels.ndim == 2 else valid[..., None]
    seen = pixels[there & (pixels != 0)]
    if not seen.size:
        return np.zeros(pixels.shape, np.uint16)
    known = np.where(there, pixels, 0)
    if pixels.dtype.kind in "iu" and seen.min() >= 0 and seen.max() <= _TOP_16_BIT:
        return known.astype(np.uint16)
    exact = np.result_type(pixels.dtype, np.float32)
    low, high = (float(value) for value in np.percentile(seen.astype(exact), _RANGE_PERCENTILES))
    low = min(low, 0.0)
    with np.errstate(over="ignore"):  # an outlier may be beyond float32 once it is scaled
        scaled = np.rint((known.astype(exact) - low) * (_TOP_16_BIT / ((high - low) or 1.0)))
    return np.where(there, np.clip(scaled, 0, _TOP_16_BIT), 0).astype(np.uint16)


def to_gray8(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """(H, W) uint8 of a uint8 or uint16 picture; 16 bits are stretched between percentiles of their own values."""
    import cv2

    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) if pixels.ndim == 3 else pixels
    return np.asarray(gray) if gray.dtype == np.uint8 else _stretched(gray, gray)


def sample_colours(pixels: NDArray[Any], points_px: FloatArray, sizes_px: FloatArray) -> NDArray[np.uint8]:
    """(N, 3) uint8 RGB around points (N, 2) of a picture, averaged over a square of half to all of each size (N,).

    Gray pictures give it thrice; 16 bits are stretched as in `to_gray8`, all bands alike so that hue stays.
    """
    import cv2

    levels = min(_COLOUR_LEVELS, int(np.log2(min(pixels.shape[:2]))) + 1)
    level = np.clip(np.floor(np.log2(np.maximum(sizes_px, 1.0))), 0, levels - 1).astype(np.int64)
    found = np.zeros((len(points_px), 3), np.float32)
    reduced, scale = pixels, 1.0
    for step in range(levels):
        height, width = reduced.shape[:2]
        of_level = np.flatnonzero(level == step)
        places = np.rint((points_px[of_level].astype(np.float64) + 0.5) * scale - 0.5).astype(np.int64)
        values = reduced[np.clip(places[:, 1], 0, height - 1), np.clip(places[:, 0], 0, width - 1)]
        found[of_level] = values if values.ndim == 2 else values[:, None]
        if not (level > step).any():
            break
        reduced, scale = cv2.resize(reduced, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), scale * 0.5
    return _stretched(found, pixels)


def _stretched(values: NDArray[Any], pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Values of a picture in 8 bits: as they are where it has 8, else between percentiles of the picture."""
    if pixels.dtype == np.uint8:
        return np.clip(np.rint(values), 0, 255).astype(np.uint8)
    known = pixels.astype(np.float32)
    seen = known[known != 0]
    low, high = np.percentile(seen, _STRETCH_PERCENTILES) if seen.size else (0.0, 1.0)
    stretched = (values.astype(np.float32) - low) * (255.0 / max(float(high - low), 1e-6))
    return np.clip(np.rint(stretched), 0, 255).astype(np.uint8)


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


def read_mask(path: Path, width_px: int, height_px: int) -> BoolArray:
    """(H, W) bool, True = use; a mask of another size is resized by nearest neighbour. Raises ItemError."""
    import cv2

    mask = _decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if mask.shape != (height_px, width_px):
        mask = cv2.resize(mask, (width_px, height_px), interpolation=cv2.INTER_NEAREST)
    return np.asarray(mask) > 0


def mask_path(masks: str, name: str) -> Path | None:
    """Mask of an image: COLMAP's naming (a/1.jpg.png), the bare stem (a/1.png), or the one file for all."""
    if not masks:
        return None
    root = Path(masks)
    if root.is_file():
        return root
    for candidate in (root / f"{name}.png", (root / name).with_suffix(".png")):
        if candidate.is_file():
            return candidate
    return None


def shrink(pixels: NDArray[Any], scale: float) -> NDArray[Any]:
    """The picture reduced by `scale` <= 1 with an area filter: source pixel x lies at (x + 0.5) scale - 0.5.

    The size is rounded, the scale is not: a picture stretched to whole pixels would be off by up to a pixel.
    """
    import cv2

    if scale >= 1.0:
        return pixels
    if round(min(pixels.shape[:2]) * scale) < 1:
        size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
        return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
    return np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def shrink_in_strips(
    read: Callable[[int, int], NDArray[Any]], size_px: tuple[int, int], scale: float
) -> NDArray[np.float32]:
    """What `shrink` makes of float32, of a picture that is read by rows: read(top, count) gives (count, W).

    size_px: width, height. Rows and columns that are left over at the far edges may be left out.
    """
    import cv2

    width, height = size_px
    # A whole factor first. Where another follows that is to reduce to half at least: of pixels hardly smaller than its
    # own, an area filter makes averages of two.
    factor = 1.0 / scale
    whole = round(factor) if abs(factor - round(factor)) < _WHOLE_ERROR else int(factor / 2.0)
    whole = max(1, min(whole, width, height))
    count = max(1, _STRIP_PX // (width * whole)) * whole
    strips = []
    for top in range(0, height // whole * whole, count):
        rows = min(count, height // whole * whole - top)
        strip = np.ascontiguousarray(read(top, rows)[:, : width // whole * whole], np.float32)
        size = width // whole, rows // whole
        strips.append(strip if whole == 1 else cv2.resize(strip, size, interpolation=cv2.INTER_AREA))
    return np.asarray(shrink(np.concatenate(strips), min(1.0, scale * whole)), np.float32)


def shrink_camera(camera: Camera, scale: float) -> Camera:
    """The camera of the picture that `shrink` makes."""
    if scale >= 1.0:
        return camera
    return resized(camera, scale, max(1, round(camera.width_px * scale)), max(1, round(camera.height_px * scale)))


def sees_sky(camera: Camera, pose: Pose | None) -> bool:
    """Whether some part of the image's border looks level or above the horizon."""
    return pose is not None and pose.world_rotation is not None and sees_horizon(camera, pose.world_rotation)


def below_horizon(camera: Camera, world_rotation: FloatArray) -> BoolArray:
    """(H, W) bool, False where the image looks above the horizon (sky)."""
    width, height = camera.width_px, camera.height_px
    xs, ys = np.arange(0.0, width + 15, 16), np.arange(0.0, height + 15, 16)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    up = np.nan_to_num(world_rays(camera, world_rotation, grid)[:, 2], nan=1.0).reshape(len(ys), len(xs))
    return _interpolate(up, xs, ys, width, height) < 0.0


def _interpolate(values: FloatArray, xs: FloatArray, ys: FloatArray, width: int, height: int) -> FloatArray:
    rows = np.array([np.interp(np.arange(width), xs, row) for row in values])
    t = np.interp(np.arange(height), ys, np.arange(len(ys), dtype=float))
    lower = np.minimum(t.astype(int), len(ys) - 2)
    weight = (t - lower)[:, None]
    return rows[lower] * (1 - weight) + rows[lower + 1] * weight


def render_view(
    pixels: NDArray[Any], valid: BoolArray | None, camera: Camera, view: View
) -> tuple[NDArray[Any], BoolArray | None]:
    """Picture (H, W) or (H, W, C) of a view and where it saw something (None = everywhere).

    pixels, valid: the source raster of `camera` and its mask. Minified views are filtered against aliasing.
    """
    import cv2

    if view.is_source:
        return pixels, valid
    map_x, map_y = view_maps(camera, view)
    inside = (map_x >= 0) & (map_x <= camera.width_px - 1) & (map_y >= 0) & (map_y <= camera.height_px - 1)
    scale = _typical_scale(camera, view, inside)
    if scale < _ALIASING_SCALE:
        pixels = shrink(pixels, scale)
        map_x, map_y = (map_x + 0.5) * scale - 0.5, (map_y + 0.5) * scale - 0.5
    kernel = _smoothing_kernel(view, inside, scale if scale < _ALIASING_SCALE else 1.0)
    if kernel is not None:
        pixels = cv2.filter2D(pixels, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    map_x, map_y = map_x.astype(np.float32), map_y.astype(np.float32)
    picture = cv2.remap(pixels, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    picture[~inside] = 0
    if valid is not None:
        seen = shrink(valid.astype(np.uint8) * 255, scale) if scale < _ALIASING_SCALE else valid.astype(np.uint8) * 255
        inside &= cv2.remap(seen, map_x, map_y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 127
    return picture, inside


def view_maps(camera: Camera, view: View) -> tuple[FloatArray, FloatArray]:
    """Source x and y (H, W) float32 of every view pixel, far outside the raster where nothing is seen.

    Evaluated exactly on a grid and interpolated, within 0.02 px: the grid of 8 px is refined where the view bends more.
    """
    import cv2

    step = 2 * _GRID_STEP_PX
    error = np.inf
    while error > _GRID_ERROR_PX and step > 1:
        step //= 2
        columns, rows = -(-view.width_px // step) + 2, -(-view.height_px // step) + 2
        # cv2.resize puts node k of the small grid at (k + 0.5) step - 0.5: start one node outside the view.
        xs = (np.arange(columns) - 0.5) * step - 0.5
        ys = (np.arange(rows) - 0.5) * step - 0.5
        nodes = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
        grid = distort(camera, apply_homography(view.undistorted_from_view, nodes)).reshape(rows, columns, 2)
        error = _interpolation_error_px(grid, camera)
    full = cv2.resize(grid.astype(np.float32), (columns * step, rows * step), interpolation=cv2.INTER_LINEAR)
    part: FloatArray = np.asarray(full[step : step + view.height_px, step : step + view.width_px], dtype=np.float32)
    part[np.isnan(part)] = -1e6
    return part[..., 0], part[..., 1]


def _interpolation_error_px(grid: FloatArray, camera: Camera) -> float:
    """Largest error of linear interpolation between nodes (R, C, 2) inside the raster: second differences / 8."""
    with np.errstate(invalid="ignore"):
        inside = ((grid >= -1.0) & (grid <= (camera.width_px, camera.height_px))).all(axis=2)
    bend = np.zeros(grid.shape)
    bend[:, 1:-1] += np.abs(grid[:, 2:] - 2.0 * grid[:, 1:-1] + grid[:, :-2])
    bend[1:-1] += np.abs(grid[2:] - 2.0 * grid[1:-1] + grid[:-2])
    return float(np.nan_to_num(bend[inside]).max(initial=0.0)) / 8.0


def _smoothing_kernel(view: View, inside: BoolArray, scale: float) -> FloatArray | None:
    """Gaussian (K, K) on a source reduced by `scale` for what the view still shrinks along one axis; None if little.

    A shrink by t needs a blur of 0.8 sqrt(t^2 - 1) source pixels along its axis (Morel and Yu 2009, section 3.2).
    """
    ys, xs = np.nonzero(inside[::_GRID_STEP_PX, ::_GRID_STEP_PX])
    if not len(xs):
        return None
    at = np.array([xs.mean(), ys.mean()]) * _GRID_STEP_PX
    warp = view.undistorted_from_view
    depth = float(warp[2, :2] @ at + warp[2, 2])
    place = (warp[:2, :2] @ at + warp[:2, 2]) / depth
    jacobian = scale * (warp[:2, :2] - np.outer(place, warp[2, :2])) / depth
    axes, shrinks, _ = np.linalg.svd(jacobian)
    if shrinks[0] * _ALIASING_SCALE <= 1.0:
        return None
    # A variance of 0.01 leaves an axis as it is and keeps the matrix invertible.
    variances = np.maximum(0.64 * (shrinks**2 - 1.0), 0.01)
    reach = int(np.ceil(3.0 * np.sqrt(variances[0])))
    grid = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1.0)] * 2), axis=-1)
    weights = np.exp(-0.5 * (((grid @ axes) ** 2) / variances).sum(axis=-1))
    return np.asarray(weights / weights.sum())


def _typical_scale(camera: Camera, view: View, inside: BoolArray) -> float:
    """Median view px per source px over what the view shows: below 1 the view is a reduction."""
    ys, xs = np.nonzero(inside[::_GRID_STEP_PX, ::_GRID_STEP_PX])
    if not len(xs):
        return 1.0
    points = np.stack([xs, ys], axis=1)[:: max(1, len(xs) // 2000)] * float(_GRID_STEP_PX)
    return float(1.0 / np.median(area_scale(view.undistorted_from_view, points)))
