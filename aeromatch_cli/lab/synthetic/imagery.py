"""Real pictures as ground texture: tiles of a mosaic, filtered down to the footprint of each sample."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError, InputError
from aeromatch_cli.lab.synthetic.noise import hash01
from aeromatch_cli.lab.synthetic.rasters import interpolated

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
_MOST_PICTURES, _TILE_PX = 12, 1024
# Neighbouring tiles blend over this share of a tile: no seam is there to be matched.
_BLEND = 0.15


@dataclass(frozen=True, eq=False)
class GroundImagery:
    """Square pictures (linear RGB pyramids) laid over the plan in a mosaic that is drawn from the seed.

    pyramids: per picture, levels (S, S, 3) float32, each half as wide as the one before. gsd_m: ground size of a pixel
    of level 0.
    """

    pyramids: tuple[tuple[NDArray[np.float32], ...], ...]
    gsd_m: float
    seed: int

    def albedo(self, u_m: FloatArray, v_m: FloatArray, footprint_m: FloatArray) -> FloatArray:
        """Linear RGB (N, 3) at plan points for samples that far apart."""
        tile_m = self.gsd_m * _TILE_PX * (1.0 - _BLEND)
        x, y = u_m / tile_m, v_m / tile_m
        ix, iy = np.floor(x), np.floor(y)
        colour = np.zeros((len(u_m), 3), dtype=np.float32)
        total = np.zeros(len(u_m), dtype=np.float32)
        for dx in (-1, 0):
            for dy in (-1, 0):
                # A tile reaches past its cell by the blending strip; there two or four tiles share.
                inside_x, inside_y = (x - ix - dx) * (1.0 - _BLEND), (y - iy - dy) * (1.0 - _BLEND)
                weight = _ramp(inside_x) * _ramp(inside_y)
                chosen = np.flatnonzero(weight > 0.0)
                if len(chosen):
                    own = (ix[chosen] + dx, iy[chosen] + dy)
                    found = self._tile(own, inside_x[chosen], inside_y[chosen], footprint_m[chosen])
                    colour[chosen] += weight[chosen, None] * found
                    total[chosen] += weight[chosen]
        return colour / total[:, None]

    def _tile(
        self, cell: tuple[FloatArray, FloatArray], x: FloatArray, y: FloatArray, footprint_m: FloatArray
    ) -> FloatArray:
        """Colours (N, 3) at x, y in 0-1 of each sample's own tile: a picture, turned and mirrored by chance."""
        which = (hash01(*cell, self.seed * 13 + 1) * len(self.pyramids)).astype(int)
        turn = (hash01(*cell, self.seed * 13 + 2) * 8).astype(int)
        x, y = np.where(turn & 1, 1.0 - x, x), np.where(turn & 2, 1.0 - y, y)
        x, y = np.where(turn & 4, y, x), np.where(turn & 4, x, y)
        level = np.clip(np.log2(np.maximum(2.0 * footprint_m / self.gsd_m, 1.0)), 0.0, len(self.pyramids[0]) - 1.001)
        colour = np.zeros((len(x), 3), dtype=np.float32)
        for picture, pyramid in enumerate(self.pyramids):
            for k, raster in enumerate(pyramid):
                share = np.clip(1.0 - np.abs(level - k), 0.0, 1.0) * (which == picture)
                chosen = np.flatnonzero(share > 0.0)
                if len(chosen):
                    colour[chosen] += share[chosen, None] * _sample(raster, x[chosen], y[chosen])
        return colour


def _ramp(inside: FloatArray) -> FloatArray:
    """Weight of a tile from the place in it, 0-1: rises over the blending strip, falls over the next."""
    ramp: FloatArray = np.clip(np.minimum(inside, 1.0 - inside) / _BLEND, 0.0, 1.0)
    return ramp


def _sample(raster: NDArray[np.float32], x: FloatArray, y: FloatArray) -> FloatArray:
    import cv2

    side = len(raster)
    return interpolated(raster, x * side - 0.5, y * side - 0.5, cv2.BORDER_REFLECT_101)


def load_imagery(folder: Path, gsd_m: float, seed: int) -> GroundImagery:
    """The middle squares of the first pictures of a folder, by name, as ground texture.

    gsd_m: ground size of a pixel. Raises ConfigError where the folder holds no picture, InputError where one cannot be
    read.
    """
    import cv2

    paths = sorted(p for p in folder.glob("*") if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    pyramids = []
    for path in paths[:_MOST_PICTURES]:
        stored = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if stored is None:
            raise InputError(f"{path} cannot be read as a picture; remove it from the texture folder")
        pyramids.append(_pyramid(stored))
    if not pyramids:
        raise ConfigError(f"{folder} holds no pictures ({', '.join(SUFFIXES)}) for the ground; give another --texture")
    return GroundImagery(tuple(pyramids), gsd_m, seed)


def _pyramid(stored: NDArray[Any]) -> tuple[NDArray[np.float32], ...]:
    """Linear RGB levels of the middle square, _TILE_PX wide at first; brightness brought to a common mean."""
    import cv2

    side = min(stored.shape[:2])
    top, left = (stored.shape[0] - side) // 2, (stored.shape[1] - side) // 2
    square = cv2.resize(
        stored[top : top + side, left : left + side, ::-1], (_TILE_PX, _TILE_PX), interpolation=cv2.INTER_AREA
    )
    coded = square.astype(np.float32) / 255.0
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4).astype(np.float32)
    levels: list[NDArray[Any]] = [linear * np.float32(0.18 / max(float(linear.mean()), 0.01))]
    while len(levels[-1]) > 8:
        half = len(levels[-1]) // 2
        levels.append(cv2.resize(levels[-1], (half, half), interpolation=cv2.INTER_AREA))
    return tuple(levels)
