"""The polar side of every comparison, on pictures in memory."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pair, PairGeometry
from aeromatch_cli.images import shrink
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.lattice import Lattice
from aeromatch_cli.strategies.matchers.polar import Polar
from aeromatch_cli.strategies.matchers.polar.registration import Registration
from aeromatch_cli.strategies.simulators.none import source_view


@dataclass(frozen=True, eq=False)
class Shot:
    """A decoded picture (H, W) as a `data.Raster`, and where it is valid (None = everywhere)."""

    pixels: NDArray[Any]
    valid: BoolArray | None = None
    finest: float = 1.0

    @property
    def width_px(self) -> int:
        return self.pixels.shape[1]

    @property
    def height_px(self) -> int:
        return self.pixels.shape[0]

    def reduced(self, scale: float) -> tuple[FloatArray, BoolArray | None]:
        small = shrink(self.pixels, scale).astype(np.float32)
        if self.valid is None:
            return small, None
        return small, shrink(self.valid.astype(np.uint8) * 255, scale) > 254

    def window(self, left: int, top: int, width: int, height: int) -> tuple[FloatArray, BoolArray | None]:
        part = (slice(top, top + height), slice(left, left + width))
        return self.pixels[part].astype(np.float32), None if self.valid is None else self.valid[part]


@dataclass(frozen=True, eq=False)
class PolarResult:
    """points0_px, points1_px: (M, 2) tie points. seconds: of the registration; seconds_tie_points: of everything.

    Everything but decoding, as for SIFT: the lattice too.
    """

    registration: Registration
    points0_px: FloatArray
    points1_px: FloatArray
    seconds: float
    seconds_tie_points: float


def registered(
    first: NDArray[np.uint8], second: NDArray[np.uint8], tie_points: int, geometry: PairGeometry | None = None
) -> PolarResult:
    """tie_points: wanted over what both show, about; 0 for none. Without geometry nothing is known of the poses."""
    polar, shots = Polar(), (Shot(first), Shot(second))
    geometry = geometry or unknown_geometry(first, second)
    started = time.perf_counter()
    found = polar.registered(*shots, geometry)
    seconds = time.perf_counter() - started
    points0 = np.zeros((0, 2))
    if tie_points and found.registration.fit is not None:
        cells = int(np.ceil(tie_points / max(found.registration.fit.share, 0.1)))
        view = ViewPixels(source_view(geometry.camera0), first, None)
        points0 = Lattice(points=cells)(geometry.camera0, [view]).keypoints_px.astype(np.float64)
    points = polar.measured(found, points0)
    total = time.perf_counter() - started
    return PolarResult(found.registration, points0[points.rows], points.points1_px, seconds, total)


def unknown_geometry(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> PairGeometry:
    """Nothing but the sizes."""
    cameras = [
        Camera("PINHOLE", p.shape[1], p.shape[0], (p.shape[1], p.shape[1], (p.shape[1] - 1) / 2, (p.shape[0] - 1) / 2))
        for p in (first, second)
    ]
    pair = Pair("0", "1", float("nan"), float("nan"), "bench")
    return PairGeometry(pair, cameras[0], cameras[1], None, None, None)
