"""The terrain of an oriented block on file: a GeoTIFF of heights in the block's CRS."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.formats.reading import readable


def terrain_bytes(
    heights_m: FloatArray, west_m: float, north_m: float, cell_m: float, origin_m: FloatArray, crs: str
) -> bytes:
    """A GeoTIFF of world heights (H, W) whose first cell's centre is at (west_m, north_m) of the world.

    In the file positions and heights are those of the CRS: origin_m (3,) is added. crs: "local" writes none.
    """
    import rasterio
    from rasterio.io import MemoryFile

    corner = west_m + origin_m[0] - 0.5 * cell_m, north_m + origin_m[1] + 0.5 * cell_m
    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff",
            height=heights_m.shape[0],
            width=heights_m.shape[1],
            count=1,
            dtype="float32",
            crs=None if crs == "local" else crs,
            transform=rasterio.Affine(cell_m, 0.0, corner[0], 0.0, -cell_m, corner[1]),
            compress="deflate",
        ) as dataset:
            dataset.write((np.asarray(heights_m, np.float64) + origin_m[2]).astype(np.float32), 1)
        return bytes(memory.read())


def read_terrain(path: Path, origin_m: FloatArray) -> tuple[FloatArray, float, float, float]:
    """World heights (H, W) float64, west_m, north_m of the first cell's centre and cell_m. Raises BrokenFileError."""
    import rasterio
    from rasterio.errors import RasterioError

    with readable(path, RasterioError, ValueError), rasterio.open(path) as dataset:
        heights = dataset.read(1).astype(np.float64) - origin_m[2]
        own = dataset.transform
        west, north = own.c + 0.5 * own.a - origin_m[0], own.f + 0.5 * own.e - origin_m[1]
        return heights, float(west), float(north), float(own.a)
