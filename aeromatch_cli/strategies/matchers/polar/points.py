"""Least-squares tie points: every grid point of image 0 that image 1 shows too, measured there.

The registration says about where. Windows on reduced pictures are searched for around it, each with its own shift, so
that relief and what is left of tilt are followed, which no similarity does; least squares on the way up to stored
pixels measure. At every step the neighbours have a say: what contradicts them starts again from where they see it, and
in the end is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray, IntArray, Raster
from aeromatch_cli.geometry.frames import apply_homography, homography_jacobians
from aeromatch_cli.strategies.matchers.polar.affine import Windows, adjusted, carried, offsets
from aeromatch_cli.strategies.matchers.polar.level import Level, level_of
from aeromatch_cli.strategies.matchers.polar.pyramid import FINEST_PX, Pyramid
from aeromatch_cli.strategies.matchers.polar.registration import SECOND_PX, Registration
from aeromatch_cli.strategies.matchers.polar.sides import Side

# Half windows and reach of the search, level px; how far off a point may be from what its neighbours say, whatever they
# scatter, on every level.
_COARSE_HALF, _COARSE_REACH, _FINE_HALF, _FINE_REACH = 7, 6, 8, 3
_LEAST_OFF_PX = 1.0
_LARGEST_STEP = 4.0  # between levels
_TILE_PX = 1024
_MARGIN_PX = 6
_STEP_PX = 8.0  # over which shapes are taken from one frame to another
_NEIGHBOURS = 10
_LEAST_CORRELATION = 0.3
# What may be off: so many times what the neighbours scatter, and never more than so many times what always may.
_DEVIATIONS, _MOST = 4.0, 3.0
_PROBES = 4000  # places across side 0 that the area of the overlap is found from


@dataclass(frozen=True, eq=False)
class TiePoints:
    """rows: (M,) int32 of the grid. places_px: (M, 2) stored pixels of image 1. correlations: (M,). sigmas_px:
    (M,) in stored pixels of image 1.
    """

    rows: IntArray
    places_px: FloatArray
    correlations: FloatArray
    sigmas_px: FloatArray


@dataclass(frozen=True)
class Limits:
    """half: of the final window, stored px. correlation: least. sigma_px: largest."""

    half: int
    correlation: float
    sigma_px: float


def tie_points(
    side0: Side, side1: Side, levels: Pyramid, registration: Registration, grid_px: FloatArray, limits: Limits
) -> TiePoints:
    """Of grid points (K, 2), stored pixels of image 0."""
    frame0 = side0.frame_from_source(grid_px)
    frame1 = apply_homography(registration.warp, frame0)
    rows = np.flatnonzero(_inside(side1.source_from_frame(frame1), side1.raster) & np.isfinite(frame0).all(axis=1))
    if not len(rows):
        return _found(rows, Windows.start(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2))))
    expected = frame1[rows]
    start = Windows.start(frame0[rows], expected, homography_jacobians(registration.warp, frame0[rows], expected))
    windows = _followed(levels, start)
    stored = _stored(side0, side1, windows, grid_px[rows])
    straight = side1.source_from_frame(expected)
    for scale in _scales(levels.scale(FINEST_PX), min(side0.raster.finest, side1.raster.finest)):
        stored = _measured(side0.raster, side1.raster, stored, scale, limits.half)
        shifts, good = agreed(stored.places0_px, stored.places1_px - straight, stored.matched, _LEAST_OFF_PX)
        last, stored = replace(stored, matched=good), _corrected(stored, straight + shifts, good)
    good = last.matched & (last.correlations >= limits.correlation) & (last.sigmas_px <= limits.sigma_px)
    good &= _inside(last.places1_px, side1.raster)
    return _found(rows[good], last.take(good))


def lattice(side0: Side, side1: Side, warp: FloatArray, count: int, rim_px: int) -> FloatArray:
    """About `count` places (N, 2), stored pixels of image 0, on an even grid over what image 1 shows too.

    warp: (3, 3) homography between the frames that says so. rim_px: least distance from the rims of both images.
    """
    size = np.array([side0.raster.width_px, side0.raster.height_px], float)

    def usable(step_px: float) -> FloatArray:
        xs, ys = (np.arange(rim_px + 0.5 * step_px, length - rim_px, step_px) for length in size)
        places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
        there = side1.source_from_frame(apply_homography(warp, side0.frame_from_source(places)))
        return places[_inside(there, side1.raster, rim_px)]

    probing = float(np.sqrt(size.prod() / _PROBES))
    return usable(probing * float(np.sqrt(max(len(usable(probing)), 1) / count)))


def _found(rows: IntArray, windows: Windows) -> TiePoints:
    return TiePoints(rows.astype(np.int32), windows.places1_px, windows.correlations, windows.sigmas_px)


def _followed(levels: Pyramid, start: Windows) -> Windows:
    """In frame px, searched for on two levels and adjusted on the finer."""
    straight = start.places1_px
    windows = start
    for size, half, reach in ((SECOND_PX, _COARSE_HALF, _COARSE_REACH), (FINEST_PX, _FINE_HALF, _FINE_REACH)):
        scale = levels.scale(size)
        level = levels.at(size, even=size < FINEST_PX)
        found = searched(*level, windows.rescaled(scale), half, reach)
        if size == FINEST_PX:
            tried = adjusted(*level, found, half)
            found = replace(tried, matched=found.matched)
        found = found.rescaled(1.0 / scale)
        shifts, good = agreed(start.places0_px, found.places1_px - straight, found.matched, _LEAST_OFF_PX / scale)
        windows = _corrected(found, straight + shifts, good)
    return windows


def _corrected(windows: Windows, expected_px: FloatArray, good: BoolArray) -> Windows:
    """Those that are not good start again from where they are expected."""
    places = np.where(good[:, None], windows.places1_px, expected_px)
    return replace(windows, places1_px=places, matched=np.asarray(np.isfinite(places).all(axis=1)))


def _stored(side0: Side, side1: Side, windows: Windows, grid_px: FloatArray) -> Windows:
    """Windows of frames in stored pixels."""
    places1 = side1.source_from_frame(windows.places1_px)
    columns = []
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = _STEP_PX
        ends = []
        for sign in (-1.0, 1.0):
            arms = side0.frame_from_source(grid_px + sign * step) - windows.places0_px
            ends.append(side1.source_from_frame(windows.places1_px + np.einsum("nij,nj->ni", windows.shapes, arms)))
        columns.append((ends[1] - ends[0]) / (2.0 * _STEP_PX))
    shapes = np.stack(columns, axis=2)
    usable = np.isfinite(places1).all(axis=1) & np.isfinite(shapes).all(axis=(1, 2))
    found = Windows.start(grid_px.astype(np.float64), places1, shapes)
    return replace(found, matched=np.asarray(usable))


def _scales(reached: float, finest: float) -> list[float]:
    """Of the levels from the registration's up to the finest: halves of it, none more than four times the last."""
    found = [reached]
    while len(found) == 1 or found[-1] < finest:
        halvings = np.ceil(np.log2(finest / (_LARGEST_STEP * found[-1])) - 1e-9)
        found.append(float(finest / 2.0 ** max(0.0, halvings)))
    return found[1:]


def _measured(raster0: Raster, raster1: Raster, windows: Windows, scale: float, half: int) -> Windows:
    """After least squares at a scale."""
    if scale < 1.0:
        levels = [level_of(*raster.reduced(scale), scale, even=False) for raster in (raster0, raster1)]
        return adjusted(levels[0], levels[1], windows.rescaled(scale), half).rescaled(1.0 / scale)
    found = windows.take(np.arange(len(windows.matched)))  # a copy
    found.matched[:] = False
    for rows in _tiles(windows):
        part = windows.take(rows)
        level0, corner0 = _window(raster0, part.places0_px, half + _MARGIN_PX)
        reach = int(np.ceil(half * (1.0 + np.abs(part.shapes).sum(axis=2).max()))) + _MARGIN_PX
        level1, corner1 = _window(raster1, part.places1_px, reach)
        moved = replace(part, places0_px=part.places0_px - corner0, places1_px=part.places1_px - corner1)
        done = adjusted(level0, level1, moved, half)
        found.places1_px[rows] = done.places1_px + corner1
        for name in ("shapes", "correlations", "sigmas_px", "matched"):
            vars(found)[name][rows] = vars(done)[name]
    return found


def _tiles(windows: Windows) -> Iterator[IntArray]:
    """Rows of the windows that can be matched, by tiles of image 0."""
    usable = np.flatnonzero(windows.matched)
    tiles = (windows.places0_px[usable] // _TILE_PX).astype(np.int64)
    _, numbers = np.unique(tiles, axis=0, return_inverse=True)
    for number in range(int(numbers.max(initial=-1)) + 1):
        yield usable[numbers.ravel() == number]


def _window(raster: Raster, places_px: FloatArray, reach: int) -> tuple[Level, FloatArray]:
    """Stored pixels around places (N, 2), and the first one's place (2,)."""
    low = np.clip(np.floor(places_px.min(axis=0)).astype(int) - reach, 0, None)
    high = np.ceil(places_px.max(axis=0)).astype(int) + reach + 1
    size = np.minimum(high, (raster.width_px, raster.height_px)) - low
    size = np.maximum(size, 8)
    low = np.clip(np.minimum(low, np.array([raster.width_px, raster.height_px]) - size), 0, None)
    pixels, valid = raster.window(int(low[0]), int(low[1]), int(size[0]), int(size[1]))
    return level_of(pixels, valid, 1.0, even=False), low.astype(np.float64)


def _inside(points_px: FloatArray, raster: Raster, rim_px: int = 0) -> BoolArray:
    size = np.array([raster.width_px, raster.height_px])
    with np.errstate(invalid="ignore"):
        return np.asarray(((points_px >= rim_px) & (points_px <= size - 1.0 - rim_px)).all(axis=1))


def searched(level0: Level, level1: Level, start: Windows, half: int, reach: int) -> Windows:
    """Windows moved to the shift, of up to `reach` px along both axes of side 0, where they correlate most.

    Not matched is what is not wholly known there, or correlates best at the end of its reach.
    """
    count, wide = len(start.matched), 2 * (half + reach) + 1
    template, known0 = level0.sample((start.places0_px[:, None] + offsets(half)).reshape(-1, 2))
    there = start.places1_px[:, None] + carried(start.shapes, offsets(half + reach))
    planes, known1 = level1.sample(there.reshape(-1, 2))
    size = 2 * half + 1
    scores = _correlations(template[:, 0].reshape(count, size, size), planes[:, 0].reshape(count, wide, wide))
    known = known0.reshape(count, -1).all(axis=1) & known1.reshape(count, -1).all(axis=1)
    best = scores.reshape(count, -1).argmax(axis=1)
    row, column = np.divmod(best, 2 * reach + 1)
    inner = (np.abs(row - reach) < reach) & (np.abs(column - reach) < reach)
    shift = np.stack([column - reach, row - reach], axis=1) + _between(scores, row, column)
    places = start.places1_px + np.einsum("nij,nj->ni", start.shapes, shift)
    found = scores.reshape(count, -1)[np.arange(count), best]
    matched = start.matched & known & inner & (found > _LEAST_CORRELATION)
    return replace(start, places1_px=np.where(matched[:, None], places, start.places1_px), correlations=found,
                   matched=matched)  # fmt: skip


def _correlations(values0: NDArray[np.float32], values1: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, 2 R + 1, 2 R + 1) of windows (N, S, S) with those of (N, S + 2 R, S + 2 R) at every shift."""
    import cv2

    shifts = values1.shape[1] - values0.shape[1] + 1
    scores = np.empty((len(values0), shifts, shifts), np.float32)
    for wide, window, found in zip(values1, values0, scores, strict=True):
        cv2.matchTemplate(wide, window, cv2.TM_CCOEFF_NORMED, result=found)
    return scores


def _between(scores: NDArray[np.float32], row: NDArray[np.intp], column: NDArray[np.intp]) -> FloatArray:
    """(N, 2) x, y of the top of a parabola through the best score and its neighbours; 0 at the border."""
    count, length = scores.shape[:2]
    found = np.zeros((count, 2))
    index = np.arange(count)
    for axis, (along, other) in enumerate(((column, row), (row, column))):
        inner = (along > 0) & (along < length - 1)
        at = [np.clip(along + step, 0, length - 1) for step in (-1, 0, 1)]
        low, top, high = (scores[index, other, a] if axis == 0 else scores[index, a, other] for a in at)
        bend = low - 2.0 * top + high
        offset = np.divide(0.5 * (low - high), bend, out=np.zeros(count), where=bend < 0.0)
        found[:, axis] = np.where(inner, np.clip(offset, -0.5, 0.5), 0.0)
    return found


def agreed(
    places_px: FloatArray, shifts_px: FloatArray, usable: BoolArray, least_px: float
) -> tuple[FloatArray, BoolArray]:
    """The shift (N, 2) that each point's neighbours say it should have, and who of the usable does not contradict.

    places_px: (N, 2). shifts_px: (N, 2) against what the registration says. From the nearest usable neighbours, their
    shift by a robust plane through them; contradicts what lies farther off than four of the neighbours' own deviations,
    which counts for `least_px` at least and thrice that at most. With too few neighbours nothing agrees.
    """
    good = usable
    expected = np.zeros_like(shifts_px)
    for _ in range(2):  # once more without those that contradicted
        if int(good.sum()) <= _NEIGHBOURS:
            return np.zeros_like(shifts_px), np.zeros(len(places_px), bool)
        expected, spread_px = _expected(places_px, shifts_px, np.flatnonzero(good))
        off = np.linalg.norm(shifts_px - expected, axis=1)
        allowed = np.clip(_DEVIATIONS * spread_px, least_px, _MOST * least_px)
        good = np.asarray(usable & (off <= allowed))
    return expected, good


def _expected(places: FloatArray, shifts: FloatArray, known: IntArray) -> tuple[FloatArray, FloatArray]:
    """The shift (N, 2) that the nearest of the known points but oneself say, and how they scatter about theirs (N,)."""
    from scipy.spatial import cKDTree

    _, near = cKDTree(places[known]).query(places, _NEIGHBOURS + 1)
    near = known[near]
    # Not oneself: where it is among the nearest it goes, elsewhere the farthest does.
    own = near == np.arange(len(places))[:, None]
    own[~own.any(axis=1), -1] = True
    near = near[~own].reshape(len(places), _NEIGHBOURS)
    expected = _planes(places, places[near], shifts[near])
    return expected, np.median(np.linalg.norm(shifts[near] - expected[near], axis=2), axis=1)


def _planes(places: FloatArray, near: FloatArray, shifts: FloatArray) -> FloatArray:
    """(N, 2): shifts (N, K, 2) of neighbours (N, K, 2) at places (N, 2), by robust planes."""
    arms = near - places[:, None]
    scale = np.maximum(np.abs(arms).max(axis=(1, 2)), 1e-6)
    design = np.concatenate([np.ones((*arms.shape[:2], 1)), arms / scale[:, None, None]], axis=2)
    weights = np.ones(arms.shape[:2])
    found = np.median(shifts, axis=1)
    for _ in range(4):
        weighted = design * weights[..., None]
        # A little stiffness: neighbours in a row do not say how it goes on across.
        normal = np.matmul(weighted.transpose(0, 2, 1), design) + np.diag([1e-6, 0.3, 0.3])
        answer = np.linalg.solve(normal, np.matmul(weighted.transpose(0, 2, 1), shifts))
        found = answer[:, 0]
        off = np.linalg.norm(shifts - np.matmul(design, answer), axis=2)
        typical = np.maximum(np.median(off, axis=1, keepdims=True), 1e-3)
        weights = 1.0 / np.maximum(1.0, off / typical) ** 2
    return np.asarray(found)
