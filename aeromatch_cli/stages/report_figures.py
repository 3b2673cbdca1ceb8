"""Histograms and match previews of the report as inline SVG. Arrays in, markup out; no disk.

Colours are CSS classes of the page (e0-e3: small to large error). Every text that comes from outside is escaped here.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.images.depth import to_gray8
from aeromatch_cli.images.scaling import shrink

MAX_PREVIEW_LINES = 150
MAX_PREVIEW_POINTS = 2000
ERROR_LIMITS_PX = (0.5, 1.0, 2.0)

_PREVIEW_SIDE_PX = 442
_PREVIEW_GAP_PX = 12
# (transpose, mirror x, mirror y) that turn the stored raster upright, by EXIF Orientation (TIFF 6.0, tag 274).
_TURNS = {
    1: (False, False, False),
    2: (False, True, False),
    3: (False, True, True),
    4: (False, False, True),
    5: (True, False, False),
    6: (True, True, False),
    7: (True, True, True),
    8: (True, False, True),
}


def nice_step(span: float, count: int) -> float:
    """The 1, 2 or 5 times a power of ten that divides `span` into about `count` parts."""
    raw = max(span, 1e-9) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    return next((m * power for m in (1.0, 2.0, 5.0) if m * power >= raw * 0.999), 10.0 * power)


def evenly_chosen(count: int, limit: int) -> IntArray:
    """At most `limit` of the indices 0 .. count-1, evenly spaced, ends included."""
    if count <= limit:
        return np.arange(count)
    return np.unique(np.rint(np.linspace(0, count - 1, limit)).astype(np.int64))


# --- histograms -------------------------------------------------------------------------------------------------


def histogram(values: Sequence[float], label: str, unit: str) -> str:
    """Bars over about 24 equal classes with a rounded width. values: counts, at least one of them."""
    width, height, left, right, bottom, top = 540.0, 210.0, 44.0, 26.0, 40.0, 12.0
    step = max(1.0, nice_step(max(max(values), 1.0), 24))
    bins = int(max(values) // step) + 1
    counts = np.bincount((np.asarray(values, dtype=np.float64) // step).astype(int), minlength=bins)
    inner_width, inner_height = width - left - right, height - bottom - top
    peak, bar = float(counts.max()), inner_width / bins
    parts = [f'<svg class="histogram" viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(label)}">']
    y_step = max(1.0, nice_step(peak, 4))
    for k in range(int(peak // y_step) + 1):
        y = top + inner_height * (1 - k * y_step / peak)
        parts.append(f'<path class="grid" d="M{left} {y:.1f}H{width - right:.1f}"/>')
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{k * y_step:,.0f}</text>')
    for index, count in enumerate(counts):
        if count:
            tall = inner_height * count / peak
            words = f"{index * step:,.0f} to {(index + 1) * step - 1:,.0f}: {count:,} {unit}"
            parts.append(
                f'<rect class="bar" x="{left + index * bar + 0.5:.1f}" y="{top + inner_height - tall:.1f}" '
                f'width="{max(bar - 1, 0.8):.1f}" height="{tall:.1f}"><title>{escape(words)}</title></rect>'
            )
    x_step = step * max(1, round(nice_step(bins * step, 6) / step))
    for k in range(int(bins * step // x_step) + 1):
        x = left + k * x_step / step * bar
        parts.append(f'<text x="{x:.1f}" y="{height - 24:.0f}" text-anchor="middle">{k * x_step:,.0f}</text>')
    parts.append(
        f'<text x="{left + inner_width / 2:.0f}" y="{height - 6:.0f}" text-anchor="middle">{escape(label)}</text>'
    )
    return "".join([*parts, "</svg>"])


# --- previews ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Side:
    """One image of a preview: stored raster (H, W) or (H, W, 3) RGB, EXIF Orientation, matches (M, 2) in stored px."""

    pixels: NDArray[Any]
    exif_orientation: int
    points_px: FloatArray


def turned(pixels: NDArray[Any], exif_orientation: int) -> NDArray[Any]:
    """The stored raster as a viewer shows it."""
    transpose, mirror_x, mirror_y = _TURNS.get(exif_orientation, _TURNS[1])
    if transpose:
        pixels = np.swapaxes(pixels, 0, 1)
    return pixels[:: -1 if mirror_y else 1, :: -1 if mirror_x else 1]


def turned_points(points_px: FloatArray, width_px: int, height_px: int, exif_orientation: int) -> FloatArray:
    """Where stored pixels (N, 2) of a width_px x height_px raster lie after `turned`."""
    transpose, mirror_x, mirror_y = _TURNS.get(exif_orientation, _TURNS[1])
    x, y = np.asarray(points_px, dtype=np.float64).T
    if transpose:
        x, y, width_px, height_px = y, x, height_px, width_px
    return np.stack([width_px - 1 - x if mirror_x else x, height_px - 1 - y if mirror_y else y], axis=1)


def preview(side0: Side, side1: Side, errors_px: FloatArray | None, label: str) -> str:
    """Both images side by side, upright, with match lines coloured by error (M,); None or NaN: no error known."""
    uri0, size0, points0 = _upright(side0)
    uri1, size1, points1 = _upright(side1)
    offset = size0[0] + _PREVIEW_GAP_PX
    width, height = offset + size1[0], max(size0[1], size1[1])
    points1 = points1 + np.array([float(offset), 0.0])
    classes = _error_classes(errors_px, len(points0))
    chosen = _spread(points0, MAX_PREVIEW_LINES)
    dots = _spread(points0, MAX_PREVIEW_POINTS)
    parts = [
        f'<svg class="preview" viewBox="0 0 {width} {height}" style="max-width:{1.14 * width:.0f}px" role="img" '
        f'aria-label="{escape(label)}">',
        f'<image href="{uri0}" x="0" y="0" width="{size0[0]}" height="{size0[1]}"/>',
        f'<image href="{uri1}" x="{offset}" y="0" width="{size1[0]}" height="{size1[1]}"/>',
    ]
    for name in sorted(set(classes)):
        lines = "".join(f"M{_xy(points0[i])}L{_xy(points1[i])}" for i in chosen if classes[i] == name)
        spots = "".join(f"M{_xy(points0[i])}h0M{_xy(points1[i])}h0" for i in dots if classes[i] == name)
        parts.append(f'<path class="tie {name}" d="{lines}"/><path class="spot {name}" d="{spots}"/>')
    return "".join([*parts, "</svg>"])


def _xy(point: FloatArray) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"


def _error_classes(errors_px: FloatArray | None, count: int) -> list[str]:
    if errors_px is None:
        return ["e9"] * count
    return ["e9" if math.isnan(e) else f"e{sum(e > limit for limit in ERROR_LIMITS_PX)}" for e in errors_px]


def _upright(side: Side) -> tuple[str, tuple[int, int], FloatArray]:
    """JPEG as data URI, its displayed (width, height), and the points (M, 2) in SVG units (corner origin)."""
    height, width = side.pixels.shape[:2]
    scale = min(1.0, _PREVIEW_SIDE_PX / max(width, height))
    small = to_colour8(shrink(side.pixels, scale))
    ratio = np.array([small.shape[1] / width, small.shape[0] / height])
    points = (np.asarray(side.points_px, dtype=np.float64).reshape(-1, 2) + 0.5) * ratio - 0.5
    points = turned_points(points, small.shape[1], small.shape[0], side.exif_orientation) + 0.5
    picture = turned(small, side.exif_orientation)
    return jpeg_uri(picture), (picture.shape[1], picture.shape[0]), points


def to_colour8(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """8 bits for display; other depths are stretched band by band."""
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.ndim == 2:
        return to_gray8(pixels)
    return np.stack([to_gray8(pixels[..., band]) for band in range(pixels.shape[2])], axis=-1)


def jpeg_uri(pixels: NDArray[np.uint8]) -> str:
    """data: URI of (H, W) gray or (H, W, 3) RGB."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "JPEG", quality=80, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def _spread(points_px: FloatArray, limit: int) -> IntArray:
    """Indices of at most `limit` points, evenly over the picture: every k-th along a raster of cells."""
    if len(points_px) <= limit:
        return np.arange(len(points_px))
    cells = np.floor(points_px / (_PREVIEW_SIDE_PX / 16)).astype(np.int64)
    return np.lexsort((cells[:, 0], cells[:, 1]))[evenly_chosen(len(points_px), limit)]
