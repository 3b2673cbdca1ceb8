"""Maps of where things lie on the ground, drawn once in tiles and looked up by painters.

A layer that says "how far to the border of the lawn" is smooth: bilinear interpolation keeps straight borders straight,
though the cells are much coarser than the pictures.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.paint import Samples

CELL_M = 0.5
_TILE_CELLS = 256
_PIECE = 30_000  # cv2.remap wants both sides of its maps below 32768

# Seed, u and v (H, W) of the cells' corners in; layers (H, W, C) float32 out, C a multiple of four.
Draw = Callable[[int, FloatArray, FloatArray], NDArray[np.float32]]


@lru_cache(maxsize=96)
def _tile(draw: Draw, seed: int, iu: int, iv: int) -> tuple[NDArray[np.float32], ...]:
    """Layers of one tile, four to an array, with one more row and column for the interpolation."""
    steps = np.arange(_TILE_CELLS + 2)
    u_m, v_m = np.meshgrid((iu * _TILE_CELLS + steps) * CELL_M, (iv * _TILE_CELLS + steps) * CELL_M)
    layers = draw(seed, u_m, v_m)
    return tuple(np.ascontiguousarray(layers[..., k : k + 4]) for k in range(0, layers.shape[2], 4))


def interpolated(raster: NDArray[np.float32], x: FloatArray, y: FloatArray, border: int) -> FloatArray:
    """Values (N, C) float32 of a raster (H, W, C), C > 1, bilinear at places (N,) in cells; border: of OpenCV."""
    import cv2

    pieces = max(1, -(-len(x) // _PIECE))
    maps = (np.array_split(np.ascontiguousarray(a, dtype=np.float32)[:, None], pieces) for a in (x, y))
    parts = [cv2.remap(raster, a, b, cv2.INTER_LINEAR, borderMode=border) for a, b in zip(*maps, strict=True)]
    return np.asarray(np.concatenate(parts)[:, 0], dtype=np.float32)


def look_up(draw: Draw, s: Samples) -> FloatArray:
    """Layers (N, C) float32 of a drawn map at ground samples."""
    import cv2

    x, y = s.u_m * np.float32(1.0 / CELL_M), s.v_m * np.float32(1.0 / CELL_M)
    iu, iv = (np.floor(a * np.float32(1.0 / _TILE_CELLS)).astype(np.int64) for a in (x, y))
    key = iu * 1_000_003 + iv
    found: FloatArray = np.empty((len(x), 0), dtype=np.float32)
    for one in np.unique(key):
        rows = np.flatnonzero(key == one)
        first = rows[0]
        tile = _tile(draw, s.seed, int(iu[first]), int(iv[first]))
        if not found.shape[1]:
            found = np.empty((len(x), 4 * len(tile)), dtype=np.float32)
        at = (x[rows] - np.float32(iu[first] * _TILE_CELLS), y[rows] - np.float32(iv[first] * _TILE_CELLS))
        for k, layers in enumerate(tile):
            found[rows, 4 * k : 4 * k + 4] = interpolated(layers, *at, cv2.BORDER_REPLICATE)
    return found
