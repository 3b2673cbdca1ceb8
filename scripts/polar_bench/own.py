"""The polar side of every comparison, on pictures in memory."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pair, PairGeometry
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.images import shrink
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.lattice import Lattice
from aeromatch_cli.strategies.matchers.polar import Polar, Registered
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
    """matrix: (3, 3) px1 from px0 of stored pixels. points0, points1: (M, 2) tie points. seconds: of the registration;
    seconds_tie_points: of everything. Everything but decoding, as for SIFT: the lattice too.
    """

    matrix: FloatArray
    registration: Registration
    points0: FloatArray
    points1: FloatArray
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
    return PolarResult(_stored(found), found.registration, points0[points.rows], points.points1_px, seconds, total)


def _stored(found: Registered) -> FloatArray:
    """(3, 3) of stored pixels: of frames that look from above the similarity closest to it where both see ground."""
    matrix, raster = found.registration.matrix, found.side0.raster
    if found.side0.camera is None:
        return matrix
    xs, ys = np.linspace(0, raster.width_px - 1, 40), np.linspace(0, raster.height_px - 1, 30)
    places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    there = found.side1.source_from_frame(apply_homography(matrix, found.side0.frame_from_source(places)))
    size = np.array([found.side1.raster.width_px, found.side1.raster.height_px])
    with np.errstate(invalid="ignore"):
        shared = ((there >= 0.0) & (there < size)).all(axis=1)
    return closest_similarity(places[shared], there[shared]) if shared.sum() >= 2 else np.eye(3)


def closest_similarity(places0: FloatArray, places1: FloatArray) -> FloatArray:
    """(3, 3) that takes places (P, 2) to others by least squares."""
    first, second = ((places - places.mean(axis=0)) @ np.array([1.0, 1j]) for places in (places0, places1))
    factor = complex(np.vdot(first, second) / np.vdot(first, first))
    linear = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    shift = places1.mean(axis=0) - linear @ places0.mean(axis=0)
    return np.vstack([np.column_stack([linear, shift]), [0.0, 0.0, 1.0]])


def unknown_geometry(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> PairGeometry:
    """Nothing but the sizes."""
    cameras = [
        Camera("PINHOLE", p.shape[1], p.shape[0], (p.shape[1], p.shape[1], (p.shape[1] - 1) / 2, (p.shape[0] - 1) / 2))
        for p in (first, second)
    ]
    pair = Pair("0", "1", float("nan"), float("nan"), "bench")
    return PairGeometry(pair, cameras[0], cameras[1], None, None, None)
