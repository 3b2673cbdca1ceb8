"""Least squares over turn, scale, shift, gain and offset on the dynamic polar grid, at one level.

The picture of side 0 is read once on rings about the overlap's middle. Side 1 is read on the same rings as they lie
there, until gain * value1 + offset fits value0. About the rings' centre a turn moves a sample along its ring, by its
radius, and a change of scale across it: their columns of the Jacobian are the gradient along and across the rings,
times the radius. Gauss-Newton, with Tukey's weights scaled by the median of the residuals, so that what moved, or lies
in another shadow, does not count. Steps are composed in side 0, so that the columns stay the same as it converges.

A tilt between the pictures bends the rings: `tilted` adds the four parameters of a homography that a similarity lacks.

Source: least-squares matching, Gruen 1985; on a dynamic polar grid, J. Geo-inf. Sci. 2019(10), 1586-1593;
composition of steps, Baker and Matthews, IJCV 56(3), 2004.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.strategies.matchers.polar.level import Level, bilinear_at

# Offsets (S, 2) from the middle, px, to a radius; each sample stands for the square of the second number, about.
Grid = Callable[[int, float], FloatArray]
_INNERMOST = 6  # samples of the innermost ring
_TUKEY = 4.0  # residuals beyond so many standard deviations weigh nothing
_CONVERGED_PX = 2e-3  # at the edge of the grid, level px
_STILL_PX = 0.5  # weights that change with every step keep relief moving a little
_PROBES = 41  # places across side 0 that the overlap's middle is found from
_ITERATIONS = 12
_FEWEST = 300  # samples
_TYPICAL = 5000  # residuals that their deviation is taken from
# Gain, and offset with first and second powers of x and y: vignetting and the sun's hot spot stay with the camera. On
# ploughed ground pairs are lost without (4 of 22, with poses 5 % and 3 degrees off), even where contrast was made even.
_LIGHT = 7
# Stretch, shear and both perspective terms at the edge of the grid: what tilts of a few degrees make. Where the picture
# says nothing of them, they stay at 0.
_TILT_SIGMA = 0.1
_NEIGHBOURS = 10.0  # samples that say the same, because their errors are alike


@dataclass(frozen=True, eq=False)
class PolarGrid:
    """The dynamic polar grid: samples ring by ring from the inside, in proportion to the radius, each ring from +x
    towards +y.

    A turn of the picture about the grid's centre is a shift along the rings, a change of scale one across them. A plain
    polar grid has equally many samples on every ring: they crowd inside and starve outside. For rings 1 px apart out to
    100 px, distance of samples along a ring and area that each stands for:

        ring at                           10 px             50 px             100 px
        plain, 628 samples a ring         0.10 px 0.10 px2  0.50 px 0.50 px2  1.00 px 1.00 px2    62,800 samples
        dynamic, 2 pi r samples a ring    1.00 px 1.00 px2  1.00 px 1.00 px2  1.00 px 1.00 px2    31,416 samples

    so the plain grid needs twice the samples and weighs the ground by one over its distance from the centre, where a
    turn moves it least.

    step_px: between rings, and along each of them. counts: (R,) samples of every ring. ring_idx: (S,) of every sample.
    offsets_px: (S, 2) from the centre.
    """

    step_px: float
    counts: IntArray
    ring_idx: IntArray
    offsets_px: FloatArray

    @property
    def radii_px(self) -> FloatArray:
        """Radii (R,) of the rings."""
        return (np.arange(len(self.counts)) + 0.5) * self.step_px


def polar_grid(radius_px: float, step_px: float = 1.0) -> PolarGrid:
    """Rings to the radius, whose samples stand for step_px squared each. Raises ValueError for less than one ring."""
    rings = int(radius_px / step_px)
    if rings < 1:
        raise ValueError(f"a radius of {radius_px} px holds no ring {step_px} px wide")
    radii = np.arange(rings) + 0.5
    counts = np.maximum(np.rint(2.0 * np.pi * radii), _INNERMOST).astype(np.int64)
    ring_idx = np.repeat(np.arange(rings), counts)
    angles = 2.0 * np.pi * (np.arange(len(ring_idx)) - _first(counts)[ring_idx]) / counts[ring_idx]
    radii_px = radii[ring_idx] * step_px
    offsets = np.stack([radii_px * np.cos(angles), radii_px * np.sin(angles)], axis=1)
    return PolarGrid(float(step_px), counts, ring_idx, offsets)


def _first(counts: IntArray) -> IntArray:
    return np.cumsum(counts) - counts


@dataclass(frozen=True, eq=False)
class Fit:
    """matrix: (3, 3) level px1 from level px0, a similarity, or a homography with `tilted`. middle_px: (2,) of the
    overlap, in side 0. gain, offset: value0 = gain value1 + offset at the
    middle; the offset changes to second order. correlation: of all samples. sigma: standard
    deviation of the residuals (of value0). share: of side 0 that lies in side 1. covariance: (4, 4) of shift x, y
    (level px of side 0, at the middle), turn (rad) and log scale, from the residuals, samples being taken for
    independent. condition: of the normal matrix of these four, turn and scale at the edge of the grid. moved_px: in
    the last step, at the edge. samples: how many took part.
    """

    matrix: FloatArray
    middle_px: FloatArray
    gain: float
    offset: float
    correlation: float
    sigma: float
    share: float
    covariance: FloatArray
    condition: float
    moved_px: float
    samples: int

    @property
    def converged(self) -> bool:
        return self.moved_px < _STILL_PX


@dataclass(frozen=True, eq=False)
class Overlap:
    """Of side 0. middle_px: (2,). radius_px: of the circle about it that holds all. share: of side 0, in area."""

    middle_px: FloatArray
    radius_px: float
    share: float


def overlap_of(level0: Level, level1: Level, matrix: FloatArray) -> Overlap | None:
    """What of side 0 a homography (3, 3) puts into side 1; None for next to nothing."""
    shared = shared_places(level0, level1, matrix)
    if len(shared) < _PROBES:
        return None
    middle = shared.mean(axis=0)
    return Overlap(middle, float(np.linalg.norm(shared - middle, axis=1).max()), len(shared) / _PROBES**2)


def shared_places(level0: Level, level1: Level, matrix: FloatArray) -> FloatArray:
    """Places (N, 2) of side 0 on an even grid that a homography (3, 3) puts into side 1."""
    width, height = level0.size_px
    places = np.stack(np.meshgrid(np.linspace(0, width - 1, _PROBES), np.linspace(0, height - 1, _PROBES)), axis=-1)
    places = places.reshape(-1, 2)
    return np.asarray(places[level0.knows(places) & level1.knows(apply_homography(matrix, places))])


def fit(
    level0: Level,
    level1: Level,
    start: FloatArray,
    *,
    samples: int,
    still_px: float = _CONVERGED_PX,
    tilted: bool = False,
    grid: Grid | None = None,
) -> Fit | None:
    """From a start (3, 3) between level px; None where too little is shared. samples: about so many. still_px: a step
    that moves the edge by less is the last. grid: another than the dynamic polar one, for comparisons.
    """
    shared = overlap_of(level0, level1, start)
    if shared is None:
        return None
    width, height = level0.size_px
    step = max(1.0, float(np.sqrt(shared.share * width * height / samples)))
    if shared.radius_px < 2.0 * step:
        return None
    offsets = (grid or _rings)(round(shared.radius_px), round(step, 2))
    planes0, known0 = level0.sample(offsets + shared.middle_px)
    problem = _Problem(level1, offsets[known0], planes0[known0, 0], shared, 8 if tilted else 4)
    matrix, light, moved, linear = start, None, np.inf, None
    tilt = np.zeros(4 if tilted else 0)
    for _ in range(_ITERATIONS):
        linear = problem.linearised(matrix, light)
        if linear is None:
            return None
        change, light = linear.solution(tilt, _TILT_SIGMA * shared.radius_px)
        if not np.isfinite(change).all() or np.linalg.norm(change) > shared.radius_px:
            return None
        if tilted:
            tilt = tilt + change[4:]
        matrix = matrix @ _step(change, shared)
        matrix /= matrix[2, 2]
        # Every parameter is in px at the edge of the grid.
        moved = float(np.linalg.norm(change))
        if moved < still_px:
            break
    assert linear is not None
    assert light is not None
    return linear.judged(matrix, light, shared, moved)


@lru_cache(maxsize=32)
def _rings(radius_px: int, step_px: float) -> FloatArray:
    """Pairs of a block share sizes, and so grids."""
    return polar_grid(float(radius_px), step_px).offsets_px


def _step(change: FloatArray, shared: Overlap) -> FloatArray:
    """(3, 3) of side 0, about the middle, from parameters (4,) or (8,) in px at the edge."""
    radius = shared.radius_px
    shift, turn, scale = change[:2], change[2] / radius, np.exp(change[3] / radius)
    cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
    step = np.array([[cosine, -sine, shift[0]], [sine, cosine, shift[1]], [0.0, 0.0, 1.0]])
    if len(change) == 8:
        stretch, shear, *bend = change[4:] / radius
        bend_x, bend_y = np.array(bend) / radius
        step = step @ np.array([[1.0 + stretch, shear, 0.0], [shear, 1.0 - stretch, 0.0], [bend_x, bend_y, 1.0]])
    there = np.array([[1.0, 0.0, -shared.middle_px[0]], [0.0, 1.0, -shared.middle_px[1]], [0.0, 0.0, 1.0]])
    return np.asarray(np.linalg.inv(there) @ step @ there)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Side 0 on the rings: offsets_px (S, 2) from the middle of the overlap and values (S,)."""

    level1: Level
    offsets_px: FloatArray
    values0: NDArray[np.float32]
    shared: Overlap
    parameters: int

    def linearised(self, matrix: FloatArray, light: NDArray[np.float32] | None) -> _Linear | None:
        """light: gain and offsets; found from means and deviations the first time."""
        places = self.offsets_px + self.shared.middle_px
        there = apply_homography(matrix, places)
        known = self.level1.knows(there)
        if np.count_nonzero(known) < _FEWEST:
            return None
        places, there, values0 = places[known], there[known], self.values0[known]
        value, dx, dy = bilinear_at(self.level1.planes, there).T
        if light is None:
            gain = float(values0.std() / max(float(value.std()), 1e-6))
            light = np.zeros(_LIGHT, np.float32)
            light[:2] = gain, float(values0.mean() - gain * value.mean())
        # The gradient as side 0 sees it, times the gain.
        linear = float(light[0]) * _jacobians(matrix, places, there)
        x, y = (self.offsets_px[known] / self.shared.radius_px).astype(np.float32).T
        jacobian = np.empty((self.parameters + _LIGHT, len(value)), np.float32)
        dx0, dy0, along, across = jacobian[:4]
        dx0[:], dy0[:] = linear[0, 0] * dx + linear[1, 0] * dy, linear[0, 1] * dx + linear[1, 1] * dy
        along[:], across[:] = dy0 * x - dx0 * y, dx0 * x + dy0 * y
        if self.parameters == 8:
            jacobian[4:8] = dx0 * x - dy0 * y, dx0 * y + dy0 * x, -x * across, -y * across
        lit = jacobian[self.parameters :]
        lit[:] = value, np.ones_like(value), x, y, x * x, x * y, y * y
        residuals = np.asarray(values0 - light @ lit, np.float32)
        sigma = 1.4826 * float(np.median(np.abs(residuals[:: 1 + len(residuals) // _TYPICAL]))) + 1e-6
        weights = np.maximum(0.0, 1.0 - (residuals / np.float32(_TUKEY * sigma)) ** 2) ** 2
        return _Linear(jacobian, residuals, weights, light, values0, value)


def _jacobians(matrix: FloatArray, places: FloatArray, there: FloatArray) -> NDArray[np.float32]:
    """(2, 2, N) or (2, 2, 1): how places (N, 2) that a homography moves to `there` move there."""
    if not matrix[2, :2].any():
        return matrix[:2, :2, None].astype(np.float32) / np.float32(matrix[2, 2])
    depth = places @ matrix[2, :2] + matrix[2, 2]
    return ((matrix[:2, :2, None] - there.T[:, None] * matrix[2, :2, None]) / depth).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Linear:
    """One Gauss-Newton step: jacobian (P, S) by the parameters of the place, px at the edge, and gain and offsets."""

    jacobian: NDArray[np.float32]
    residuals: NDArray[np.float32]
    weights: NDArray[np.float32]
    light: NDArray[np.float32]
    values0: NDArray[np.float32]
    values1: NDArray[np.float32]

    def _normal(self) -> FloatArray:
        return np.asarray(((self.jacobian * self.weights) @ self.jacobian.T).astype(np.float64))

    @property
    def _variance(self) -> float:
        return float((self.weights * self.residuals**2).sum() / max(float(self.weights.sum()), 1.0))

    def solution(self, tilt: FloatArray, sigma_px: float) -> tuple[FloatArray, NDArray[np.float32]]:
        """Changes of the place's parameters, and the new gain and offsets. tilt: (T,) what there is of it so far."""
        normal = self._normal()
        right = (self.jacobian @ (self.weights * self.residuals)).astype(np.float64)
        if len(tilt):
            pull = _NEIGHBOURS * self._variance / sigma_px**2
            index = np.arange(4, 8)
            normal[index, index] += pull
            right[index] -= pull * tilt
        lengths = np.sqrt(np.maximum(np.diag(normal), 1e-12))
        change = np.linalg.lstsq(normal / np.outer(lengths, lengths), right / lengths, rcond=1e-9)[0] / lengths
        return change[:-_LIGHT], self.light + change[-_LIGHT:].astype(np.float32)

    def judged(self, matrix: FloatArray, light: NDArray[np.float32], shared: Overlap, moved_px: float) -> Fit:
        normal = self._normal()
        per_unit = np.array([1.0, 1.0, shared.radius_px, shared.radius_px])
        covariance = self._variance * np.linalg.pinv(normal, hermitian=True)[:4, :4] / np.outer(per_unit, per_unit)
        flat = min(float(self.values0.std()), float(self.values1.std())) < 1e-6
        return Fit(
            matrix=matrix,
            middle_px=shared.middle_px,
            gain=float(light[0]),
            offset=float(light[1]),
            correlation=0.0 if flat else float(np.corrcoef(self.values0, self.values1)[0, 1]),
            sigma=float(np.sqrt(self._variance)),
            share=shared.share,
            covariance=covariance,
            condition=float(np.linalg.cond(normal[:4, :4])),
            moved_px=moved_px,
            samples=len(self.residuals),
        )
