"""How much texture a part of an image has, from its grey levels alone.

The image is reduced to 1000 px on its longer side (so that images of all sizes compare), smoothed lightly (Gaussian,
1 px: sensor noise goes, structure stays) and cut into cells of 16 px. Each cell has a relative deviation, standard
deviation over mean grey level, so that exposure cancels. The texture of an overlap is the upper quartile over its
cells: matches live on the better part.

Classes (scores.TEXTURE_CLASSES) are set by the mean over whole images: rendered desert 0.04, grass 0.04 and a ploughed
field in false colour 0.05 (poor up to here); rendered farmland 0.06, bare earth 0.10 (medium); suburb and meadow with
trees 0.16, city 0.20 real and rendered, forest 0.23 (rich). Single pairs spread by half of these figures.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.images.files import read_pixels

_LONGER_SIDE_PX, _CELL_PX = 1000, 16
_SMOOTHING_PX, _PERCENTILE = 1.0, 75
_DARKEST = 8.0  # grey levels; below, a ratio to the mean says nothing


@dataclass(frozen=True, eq=False)
class Texture:
    """deviations: (rows, columns) of the cells; cell_px: side of a cell in stored pixels."""

    deviations: FloatArray
    cell_px: float

    def over(self, overlap_px: FloatArray) -> float:
        """Upper quartile of the cells that hold samples (S, 2) of the overlap, stored pixels; NaN without any."""
        if not len(overlap_px):
            return float("nan")
        rows, columns = self.deviations.shape
        column, row = np.clip((overlap_px + 0.5) // self.cell_px, 0, [columns - 1, rows - 1]).astype(int).T
        return float(np.percentile(self.deviations.reshape(-1)[np.unique(row * columns + column)], _PERCENTILE))


def read_texture(path: Path) -> Texture:
    """The texture of an image. Raises ItemError where it cannot be read."""
    import cv2

    gray: NDArray[Any] = read_pixels(path, colour=False).astype(np.float32)
    scale = min(1.0, _LONGER_SIDE_PX / max(gray.shape))
    if scale < 1.0:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    gray = cv2.GaussianBlur(gray, (0, 0), _SMOOTHING_PX)
    rows, columns = (max(side // _CELL_PX, 1) for side in gray.shape)
    cut = gray[: rows * _CELL_PX, : columns * _CELL_PX]
    cells = cut.reshape(rows, cut.shape[0] // rows, columns, cut.shape[1] // columns)
    return Texture(cells.std(axis=(1, 3)) / np.maximum(cells.mean(axis=(1, 3)), _DARKEST), _CELL_PX / scale)
