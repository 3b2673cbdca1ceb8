"""The dynamic polar grid: rings about a point, with samples in proportion to their radius.

A turn of the picture about the grid's centre is a shift along the rings, a change of scale one across them. A plain
polar grid has equally many samples on every ring: they crowd inside and starve outside. For rings 1 px apart out to
100 px, distance of samples along a ring and area that each stands for:

    ring at                           10 px             50 px             100 px
    plain, 628 samples a ring         0.10 px 0.10 px2  0.50 px 0.50 px2  1.00 px 1.00 px2    62,800 samples
    dynamic, 2 pi r samples a ring    1.00 px 1.00 px2  1.00 px 1.00 px2  1.00 px 1.00 px2    31,416 samples

so the plain grid needs twice the samples and weighs the ground by one over its distance from the centre, where a
turn moves it least.

Source: dynamic polar parameterisation of least-squares registration, J. Geo-inf. Sci. 2019(10), 1586-1593.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray

_FEWEST = 6  # samples of the innermost ring


@dataclass(frozen=True, eq=False)
class PolarGrid:
    """Samples ring by ring from the inside, each ring from +x towards +y.

    step_px: between rings, and along each of them. counts: (R,) samples of every ring. ring_idx: (S,) of every sample.
    offsets_px: (S, 2) from the centre.
    """

    step_px: float
    counts: IntArray
    ring_idx: IntArray
    offsets_px: FloatArray

    @property
    def radii_px(self) -> FloatArray:
        """(R,)."""
        return (np.arange(len(self.counts)) + 0.5) * self.step_px

    @property
    def first(self) -> IntArray:
        """(R,) the first sample of every ring."""
        return _first(self.counts)


def polar_grid(radius_px: float, step_px: float = 1.0) -> PolarGrid:
    """Rings to the radius, whose samples stand for step_px squared each. Raises ValueError for less than one ring."""
    rings = int(radius_px / step_px)
    if rings < 1:
        raise ValueError(f"a radius of {radius_px} px holds no ring {step_px} px wide")
    radii = np.arange(rings) + 0.5
    counts = np.maximum(np.rint(2.0 * np.pi * radii), _FEWEST).astype(np.int64)
    ring_idx = np.repeat(np.arange(rings), counts)
    angles = 2.0 * np.pi * (np.arange(len(ring_idx)) - _first(counts)[ring_idx]) / counts[ring_idx]
    radii_px = radii[ring_idx] * step_px
    offsets = np.stack([radii_px * np.cos(angles), radii_px * np.sin(angles)], axis=1)
    return PolarGrid(float(step_px), counts, ring_idx, offsets)


def resampled(
    pixels: FloatArray, grid: PolarGrid, center_px: FloatArray, turn_rad: float = 0.0, scale: float = 1.0
) -> FloatArray:
    """Values (S,) of a picture (H, W), bilinear, at center + scale R(turn) offset; NaN outside of it."""
    cosine, sine = scale * np.cos(turn_rad), scale * np.sin(turn_rad)
    places = grid.offsets_px @ np.array([[cosine, sine], [-sine, cosine]]) + center_px
    return bilinear(pixels, places)


def bilinear(pixels: FloatArray, places_px: FloatArray) -> FloatArray:
    """Values (N,) of a picture (H, W) at places (N, 2), pixel centres at whole numbers; NaN outside of them."""
    height, width = pixels.shape
    x, y = places_px[:, 0], places_px[:, 1]
    inside = (x >= 0.0) & (x <= width - 1.0) & (y >= 0.0) & (y <= height - 1.0)
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    left = np.minimum(x.astype(np.int64), max(width - 2, 0))
    top = np.minimum(y.astype(np.int64), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    dx, dy = x - left, y - top
    upper = pixels[top, left] * (1.0 - dx) + pixels[top, right] * dx
    lower = pixels[bottom, left] * (1.0 - dx) + pixels[bottom, right] * dx
    return np.where(inside, upper * (1.0 - dy) + lower * dy, np.nan)


def shifted(values: FloatArray, grid: PolarGrid, turn_rad: float) -> FloatArray:
    """Values (S,) as the grid turned by turn_rad reads them: each ring shifted along itself, linear between samples."""
    counts, first = grid.counts[grid.ring_idx], grid.first[grid.ring_idx]
    return _along(values, first, counts, np.arange(len(values)) - first + turn_rad / (2.0 * np.pi) * counts)


def as_picture(values: FloatArray, grid: PolarGrid, size_px: tuple[int, int], center_px: FloatArray) -> FloatArray:
    """The inverse of `resampled`: values (S,) as a picture (height, width) of size (width, height), linear along and
    between the rings; NaN beyond the outermost ring.
    """
    width, height = size_px
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    x, y = (x - center_px[0]).ravel(), (y - center_px[1]).ravel()
    turns = np.mod(np.arctan2(y, x) / (2.0 * np.pi), 1.0)
    place = np.hypot(x, y) / grid.step_px - 0.5
    inner = np.clip(np.floor(place), 0, max(len(grid.counts) - 2, 0)).astype(np.int64)
    outer = np.minimum(inner + 1, len(grid.counts) - 1)
    # Within the innermost ring there is nothing to interpolate towards.
    share = np.clip(place - inner, 0.0, 1.0)
    low, high = (
        _along(values, grid.first[ring], grid.counts[ring], turns * grid.counts[ring]) for ring in (inner, outer)
    )
    known = place <= len(grid.counts) - 1
    return np.where(known, low * (1.0 - share) + high * share, np.nan).reshape(height, width)


def _first(counts: IntArray) -> IntArray:
    return np.cumsum(counts) - counts


def _along(values: FloatArray, first: IntArray, counts: IntArray, place: FloatArray) -> FloatArray:
    """Values (N,) at places (N,), in samples, along the rings that start at first (N,)."""
    low = np.floor(place)
    share = place - low
    index = low.astype(np.int64)
    return values[first + index % counts] * (1.0 - share) + values[first + (index + 1) % counts] * share
