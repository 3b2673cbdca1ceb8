"""Band-limited building blocks of procedural texture: hashes, noise, spots and stripes.

Every function takes surface coordinates in metres and `footprint_m`, the spacing of the colour samples there, and fades
out whatever is too fine to be sampled: what is left is the same pattern in every image, so that keypoints are stable.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, IntArray

_TILE_PX = 1024
_TEXELS_PER_WAVELENGTH = 5.0
_ROW_PX = 4096  # cv2.remap wants both sides of its maps below 32768


def hash01(ix: IntArray | FloatArray, iy: IntArray | FloatArray, salt: IntArray | int) -> FloatArray:
    """Uniform float32 in [0, 1) from whole-numbered coordinates (N,) and a salt (scalar or (N,)); same everywhere.

    Source: the finaliser of MurmurHash3 (Appleby, public domain).
    """
    h = np.asarray(ix).astype(np.int64).astype(np.uint32) * np.uint32(0x9E3779B1)
    h = h ^ (np.asarray(iy).astype(np.int64).astype(np.uint32) * np.uint32(0x85EBCA77))
    h = h ^ (np.asarray(salt, dtype=np.int64).reshape(-1).astype(np.uint32) * np.uint32(0xC2B2AE3D))
    h = (h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B)
    h = (h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35)
    h = h ^ (h >> np.uint32(16))
    return ((h >> np.uint32(8)).astype(np.float32)) * np.float32(2.0**-24)


@lru_cache(maxsize=4)
def _noise_tile(seed: int) -> NDArray[np.float32]:
    """(1025, 1025) periodic smooth noise of unit variance; the last row and column repeat the first."""
    white = np.random.default_rng([seed, 0x7E17]).standard_normal((_TILE_PX, _TILE_PX))
    frequency = np.fft.fftfreq(_TILE_PX) * _TEXELS_PER_WAVELENGTH
    radius = np.hypot(frequency[:, None], frequency[None, :])
    # One octave: nothing above one cycle per wavelength, little below half a cycle.
    band = np.exp(-0.5 * ((radius - 0.75) / 0.22) ** 2)
    tile = np.fft.ifft2(np.fft.fft2(white) * band).real
    return np.pad((tile / tile.std()).astype(np.float32), ((0, 1), (0, 1)), mode="wrap")


@lru_cache(maxsize=4)
def _slope_tile(seed: int) -> NDArray[np.float32]:
    """(1025, 1025, 2) slope of the noise tile along its columns and rows, periodic, root mean square length 1."""
    spectrum = np.fft.fft2(_noise_tile(seed)[:-1, :-1])
    frequency = 2j * np.pi * np.fft.fftfreq(_TILE_PX)
    along_x, along_y = np.fft.ifft2(spectrum * frequency).real, np.fft.ifft2(spectrum * frequency[:, None]).real
    slope = np.stack([along_x, along_y], axis=2) / np.sqrt(np.mean(along_x**2 + along_y**2))
    return np.pad(slope.astype(np.float32), ((0, 1), (0, 1), (0, 0)), mode="wrap")


def octave(u_m: FloatArray, v_m: FloatArray, wavelength_m: float, seed: int, number: int) -> FloatArray:
    """One octave of noise (N,) float32, unit variance; `number` turns and shifts the tile so octaves never align."""
    return _sampled(_noise_tile(seed), u_m, v_m, wavelength_m, number)[:, 0]


def octave_slope(u_m: FloatArray, v_m: FloatArray, wavelength_m: float, seed: int, number: int) -> FloatArray:
    """Slope (N, 2) along u and v of the same octave taken as a height, scaled to a root mean square length of 1."""
    sampled = _sampled(_slope_tile(seed), u_m, v_m, wavelength_m, number)
    angle = _angle(number)
    c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    slope = np.empty_like(sampled)
    slope[:, 0] = c * sampled[:, 0] + s * sampled[:, 1]
    slope[:, 1] = c * sampled[:, 1] - s * sampled[:, 0]
    return slope


def _angle(number: int) -> float:
    return 0.7 + 2.4 * number


def _sampled(
    tile: NDArray[np.float32], u_m: FloatArray, v_m: FloatArray, wavelength_m: float, number: int
) -> NDArray[np.float32]:
    import cv2

    angle = _angle(number)
    scale = _TEXELS_PER_WAVELENGTH / wavelength_m
    c, s = np.float32(np.cos(angle) * scale), np.float32(np.sin(angle) * scale)
    x, y = c * u_m - s * v_m + np.float32(311.7 * number), s * u_m + c * v_m + np.float32(173.3 * number)
    x -= np.floor(x * np.float32(1.0 / _TILE_PX)) * np.float32(_TILE_PX)
    y -= np.floor(y * np.float32(1.0 / _TILE_PX)) * np.float32(_TILE_PX)
    rows = -(-len(x) // _ROW_PX)
    padded = np.zeros((2, rows * _ROW_PX), dtype=np.float32)
    padded[0, : len(x)], padded[1, : len(x)] = x, y
    maps = padded.reshape(2, rows, _ROW_PX)
    sampled: NDArray[Any] = cv2.remap(tile, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return sampled.reshape(rows * _ROW_PX, -1)[: len(x)]


def octaves(
    u_m: FloatArray, v_m: FloatArray, footprint_m: FloatArray, wavelengths_m: tuple[float, ...], seed: int, first: int
) -> FloatArray:
    """Sum (N,) of unit octaves over sqrt(count), each faded out between 4 and 2 samples per wavelength."""
    total = np.zeros(len(u_m), dtype=np.float32)
    finest = float(footprint_m.min(initial=np.inf))
    for i, wavelength_m in enumerate(wavelengths_m):
        if wavelength_m <= 2.0 * finest:
            continue
        total += fading(wavelength_m, footprint_m) * octave(u_m, v_m, wavelength_m, seed, first + i)
    return total / np.float32(np.sqrt(len(wavelengths_m)))


def slopes(
    u_m: FloatArray,
    v_m: FloatArray,
    footprint_m: FloatArray,
    bands: tuple[tuple[float, float], ...],
    seed: int,
    first: int,
) -> FloatArray:
    """Slope (N, 2) of a rough surface, from bands of (wavelength, root mean square slope), faded out as octaves."""
    total = np.zeros((len(u_m), 2), dtype=np.float32)
    finest = float(footprint_m.min(initial=np.inf))
    for i, (wavelength_m, steepness) in enumerate(bands):
        if wavelength_m <= 2.0 * finest:
            continue
        weight = np.float32(steepness) * fading(wavelength_m, footprint_m)
        total += weight[:, None] * octave_slope(u_m, v_m, wavelength_m, seed, first + i)
    return total


def fading(wavelength_m: float, footprint_m: FloatArray) -> FloatArray:
    """How much (N,), 0-1, of a wavelength is kept: all from 4 samples to a wavelength on, nothing below 2."""
    return np.clip(np.float32(0.5 * wavelength_m) / footprint_m - np.float32(1.0), 0.0, 1.0)


def stripes(coordinate_m: FloatArray, period_m: float, width_m: float, footprint_m: FloatArray) -> FloatArray:
    """Coverage (N,) in 0-1 by lines of the given width, centred on multiples of the period, box-filtered."""
    offset = np.abs(coordinate_m - np.round(coordinate_m / period_m) * period_m)
    blur = 2.0 * footprint_m
    return np.clip((0.5 * width_m - offset) / blur + 0.5, 0.0, np.minimum(1.0, width_m / blur))


def inside(signed_m: FloatArray, footprint_m: FloatArray) -> FloatArray:
    """Coverage (N,) in 0-1 of a region, from the signed distance (positive inside) to its border."""
    return np.clip(signed_m / (2.0 * footprint_m) + 0.5, 0.0, 1.0)


def spots(
    u_m: FloatArray, v_m: FloatArray, cell_m: float, density: float, salt: IntArray | int, footprint_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Round spots, at most one to a cell: coverage (N,) in 0-1 and each spot's own random number (N,) in 0-1."""
    x, y = u_m / cell_m, v_m / cell_m
    ix, iy = np.floor(x), np.floor(y)
    base = np.asarray(salt, dtype=np.int64) * 8
    shift_x, shift_y = hash01(ix, iy, base + 1) - 0.5, hash01(ix, iy, base + 2) - 0.5
    own = hash01(ix, iy, base + 3)
    # Radius plus shift stay below half a cell, so no neighbouring cell has to be looked at.
    radius = (0.10 + 0.16 * own) * (hash01(ix, iy, base + 4) < density)
    distance = np.hypot(x - ix - 0.5 - 0.45 * shift_x, y - iy - 0.5 - 0.45 * shift_y)
    blur = 2.0 * footprint_m / cell_m
    return np.where(
        radius > 0, np.clip((radius - distance) / blur + 0.5, 0.0, np.minimum(1.0, radius / blur)), 0.0
    ), own
