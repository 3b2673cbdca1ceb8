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


def _first(counts: IntArray) -> IntArray:
    return np.cumsum(counts) - counts
