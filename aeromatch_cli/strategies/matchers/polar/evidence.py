"""Whether a registration is right: does the picture agree everywhere in the overlap, and only there?

Least squares always ends somewhere, and over ploughed rows or bare ground the correlation there says little: a road
alone can carry it, and rows fit as well one period off. So the overlap is divided into cells, and every cell is asked
whether it correlates better as registered than at any of the places around it. Where a registration is wrong, the
answer is a lottery. Among these places are those where the ground resembles itself most, along rows and a row further:
anywhere else rows that are in step beat rows that are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.strategies.matchers.polar.level import Level, normalised

_CELLS = 64  # over the overlap, about
_LEAST_CELL_PX = 10
_SPREAD_PX = 3.0  # pictures are normalised within
_FULL = 0.6  # share of a cell that must be known to judge it
_HALF = 0.5  # of what is known as registered, for another place to be compared
# Rivals: rings of places around, farther off than the normalised pictures resemble themselves.
_RIVAL_RADII_PX, _RIVALS_A_RING = (5.0, 9.0, 14.0), 8
# Those of most resemblance: so many, within these distances, so far from each other.
_ALIKE, _ALIKE_PX, _ALIKE_APART_PX = 24, (5.0, 30.0), 2.0


@dataclass(frozen=True, eq=False)
class RegistrationQuality:
    """cells: number judged. agreeing: which correlate best as registered. by_chance: expected to, were it wrong.
    correlations: (rows, columns) of every cell of side 0, of locally normalised pictures; NaN where not judged.
    """

    cells: int
    agreeing: int
    by_chance: float
    correlations: FloatArray

    @property
    def correlation(self) -> float:
        """The median."""
        return float(np.nanmedian(self.correlations)) if self.cells else 0.0

    def preferred_to(self, other: RegistrationQuality) -> float:
        """Share of the cells that both judge, which correlate better here than there; 1 where none."""
        with np.errstate(invalid="ignore"):
            better = self.correlations > other.correlations
        both = np.isfinite(self.correlations) & np.isfinite(other.correlations)
        return float(better[both].mean()) if both.any() else 1.0

    @property
    def share(self) -> float:
        return self.agreeing / self.cells if self.cells else 0.0


def evidence(level0: Level, level1: Level, matrix: FloatArray, cell_px: int) -> RegistrationQuality:
    """Of a homography (3, 3), level px1 from px0."""
    import cv2

    width, height = level0.size_px
    ones0, ones1 = (
        np.ones(level.values.shape, np.float32) if level.known is None else level.known for level in (level0, level1)
    )
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = np.asarray(cv2.warpPerspective(level1.values, matrix, (width, height), flags=flags), np.float32)
    known1 = (cv2.warpPerspective(ones1, matrix, (width, height), flags=flags) > 0.99).astype(np.float32)
    flat0, flat1 = (normalised(values, mask, _SPREAD_PX) for values, mask in ((level0.values, ones0), (moved, known1)))
    shared = ones0 * known1
    shifts = [(0, 0), *_around(), *_alike(flat0 * shared)]
    both = _sums(shared, cell_px)
    judged = both >= _FULL * cell_px**2
    # By what is known of either place: at the rim a place further out would fit badly for want of a picture.
    found = np.array([_sums(flat0 * _shifted(flat1, *shift), cell_px)[judged] for shift in shifts])
    known = np.array([_sums(ones0 * _shifted(known1, *shift), cell_px)[judged] for shift in shifts])
    correlations = np.where(known >= _HALF * both[judged], found / np.maximum(known, 1.0), -np.inf)
    agreeing = correlations[0] > correlations[1:].max(axis=0) if judged.any() else np.zeros(0, bool)
    of_cells = np.full(both.shape, np.nan)
    of_cells[judged] = correlations[0]
    count = int(judged.sum())
    return RegistrationQuality(count, int(agreeing.sum()), count / len(shifts), of_cells)


def _around() -> list[tuple[int, int]]:
    """Shifts on rings."""
    angles = 2.0 * np.pi * np.arange(_RIVALS_A_RING) / _RIVALS_A_RING
    return [(round(r * np.cos(a)), round(r * np.sin(a))) for r in _RIVAL_RADII_PX for a in angles]


def _alike(picture: NDArray[np.float32]) -> list[tuple[int, int]]:
    """Shifts (dx, dy) at which a picture (H, W) of mean 0 correlates most with itself."""
    from scipy import fft

    reach = int(_ALIKE_PX[1])
    size = [fft.next_fast_len(length + reach, real=True) for length in picture.shape]
    spectrum = fft.rfft2(picture, size)
    found = fft.irfft2((spectrum * spectrum.conj()).real, size)
    steps = np.arange(-reach, reach + 1)
    dx, dy = (grid.ravel() for grid in np.meshgrid(steps, steps))
    distance = np.hypot(dx, dy)
    near = (distance >= _ALIKE_PX[0]) & (distance <= _ALIKE_PX[1])
    dx, dy = dx[near], dy[near]
    kept: list[tuple[int, int]] = []
    for index in np.argsort(-found[dy, dx], kind="stable"):
        x, y = int(dx[index]), int(dy[index])
        if all((x - a) ** 2 + (y - b) ** 2 >= _ALIKE_APART_PX**2 for a, b in kept):
            kept.append((x, y))
            if len(kept) == _ALIKE:
                break
    return kept


def cell_size_px(level0: Level, share: float) -> int:
    """For a few dozen cells over the part of side 0 that is shared."""
    width, height = level0.size_px
    return max(_LEAST_CELL_PX, int(np.sqrt(share * width * height / _CELLS)))


def _shifted(picture: NDArray[np.float32], dx: int, dy: int) -> NDArray[np.float32]:
    """What stands dx, dy off, 0 from outside."""
    height, width = picture.shape
    found = np.zeros_like(picture)
    rows, columns = slice(max(0, -dy), height - max(0, dy)), slice(max(0, -dx), width - max(0, dx))
    of_rows, of_columns = slice(max(0, dy), height - max(0, -dy)), slice(max(0, dx), width - max(0, -dx))
    found[rows, columns] = picture[of_rows, of_columns]
    return found


def _sums(values: NDArray[np.float32], cell: int) -> NDArray[np.float32]:
    """Over square cells, what is left over at the far edges left out."""
    rows, columns = values.shape[0] // cell, values.shape[1] // cell
    part = values[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    return np.asarray(part.sum(axis=(1, 3)))
