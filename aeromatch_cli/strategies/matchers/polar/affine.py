"""Least-squares matching of many small windows at once: shift, affine distortion, gain and offset of each.

Source: Gruen, Adaptive least squares correlation, South African Journal of Photogrammetry 14(3), 1985.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.strategies.matchers.polar.level import Level

_ITERATIONS = 10
_CONVERGED_PX = 0.02
_FAR = 0.6  # of the half window: a match that moves on by more has lost its way
_AT_ONCE = 256  # windows: more do not fit into the cache
# Of every parameter's own weight: what keeps a window solvable that says nothing of some of them.
_DAMPING = 1e-4


@dataclass(frozen=True, eq=False)
class Windows:
    """N windows of side 0 and where they lie in side 1. places0_px, places1_px: (N, 2) level px. shapes: (N, 2, 2) how
    steps of side 0 go on in side 1. correlations: (N,). sigmas_px: (N,) of the place, both coordinates together, from
    the residuals. matched: (N,) bool, False where it left its window, or did not converge.
    """

    places0_px: FloatArray
    places1_px: FloatArray
    shapes: FloatArray
    correlations: FloatArray
    sigmas_px: FloatArray
    matched: BoolArray

    @classmethod
    def start(cls, places0_px: FloatArray, places1_px: FloatArray, shapes: FloatArray) -> Windows:
        count = len(places0_px)
        return cls(places0_px, places1_px, shapes, np.zeros(count), np.full(count, np.inf), np.ones(count, bool))

    def take(self, which: IntArray | BoolArray) -> Windows:
        return Windows(*(values[which] for values in vars(self).values()))

    def rescaled(self, scale: float) -> Windows:
        """In a level of `scale` times the size."""
        places = [(places + 0.5) * scale - 0.5 for places in (self.places0_px, self.places1_px)]
        return replace(self, places0_px=places[0], places1_px=places[1], sigmas_px=self.sigmas_px * scale)


def offsets(half: int) -> FloatArray:
    """(P, 2) of the pixels of a window from its middle."""
    steps = np.arange(-half, half + 1.0)
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def carried(shapes: FloatArray, steps: FloatArray) -> FloatArray:
    """(N, P, 2): steps (P, 2) of side 0 as they go on in side 1, by shapes (N, 2, 2)."""
    return np.matmul(steps, shapes.transpose(0, 2, 1))


def adjusted(level0: Level, level1: Level, start: Windows, half: int) -> Windows:
    """Windows of 2 half + 1 pixels after least squares; those that are not matched any more stay where they were."""
    parts = [
        _adjusted(level0, level1, start.take(np.arange(first, min(first + _AT_ONCE, len(start.matched)))), half)
        for first in range(0, len(start.matched), _AT_ONCE)
    ]
    if not parts:
        return start
    return Windows(*(np.concatenate([vars(part)[name] for part in parts]) for name in vars(start)))


def _adjusted(level0: Level, level1: Level, start: Windows, half: int) -> Windows:
    steps = offsets(half)
    count = len(start.matched)
    values0, known0 = level0.sample((start.places0_px[:, None] + steps).reshape(-1, 2))
    template = values0[:, 0].reshape(count, -1)
    template = template - template.mean(axis=1, keepdims=True)
    places, shapes = start.places1_px.copy(), start.shapes.copy()
    correlations, sigmas = start.correlations.copy(), start.sigmas_px.copy()
    live = start.matched & known0.reshape(count, -1).all(axis=1)
    done = np.zeros(count, bool)
    for _ in range(_ITERATIONS):
        rows = np.flatnonzero(live & ~done)
        if not len(rows):
            break
        where = places[rows, None] + carried(shapes[rows], steps)
        planes, known = level1.sample(where.reshape(-1, 2))
        planes = planes.reshape(len(rows), -1, 3)
        change, correlations[rows], sigmas[rows] = _solved(template[rows], planes, steps)
        places[rows] += change[:, :2]
        shapes[rows] += change[:, 2:].reshape(-1, 2, 2)
        moved = np.linalg.norm(change[:, :2], axis=1)
        lost = np.linalg.norm(places[rows] - start.places1_px[rows], axis=1) > _FAR * half
        lost |= ~known.reshape(len(rows), -1).all(axis=1) | ~np.isfinite(change).all(axis=1)
        live[rows[lost]] = False
        done[rows] = (moved < _CONVERGED_PX) & ~lost
    lost = ~(live & done)
    places[lost], shapes[lost] = start.places1_px[lost], start.shapes[lost]
    return Windows(start.places0_px, places, shapes, correlations, sigmas, ~lost)


def _solved(
    template: NDArray[np.float32], planes: NDArray[np.float32], steps: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Changes (N, 6) of place and shape, correlations (N,) before them, and sigmas (N,)."""
    value, dx, dy = (planes[..., index] for index in range(3))
    value = value - value.mean(axis=1, keepdims=True)
    square, cross = (value * value).sum(axis=1), (value * template).sum(axis=1)
    own = (template * template).sum(axis=1)
    correlations = cross / np.sqrt(np.maximum(square * own, 1e-9))
    gain = np.clip(cross / np.maximum(square, 1e-6), 0.1, 10.0)[:, None].astype(np.float32)
    residuals = template - gain * value
    u, v = steps.T.astype(np.float32)
    dx, dy = gain * dx, gain * dy
    columns = (dx, dy, dx * u, dx * v, dy * u, dy * v, value, np.ones_like(value))
    jacobian = np.stack(columns, axis=2)
    turned = jacobian.transpose(0, 2, 1)
    normal = np.matmul(turned, jacobian).astype(np.float64)
    right = np.matmul(turned, residuals[..., None])[..., 0].astype(np.float64)
    lengths = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-12))
    scaled = normal / lengths[:, :, None] / lengths[:, None, :] + _DAMPING * np.eye(normal.shape[1])
    inverse = np.linalg.inv(scaled)
    change = np.einsum("nij,nj->ni", inverse, right / lengths) / lengths
    variance = (residuals * residuals).sum(axis=1) / max(residuals.shape[1] - jacobian.shape[2], 1)
    spread = inverse[:, [0, 1], [0, 1]] / lengths[:, :2] ** 2
    return change[:, :6], correlations, np.sqrt(variance * spread.sum(axis=1) * _alike(residuals))


def _alike(residuals: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N,) how many residuals (N, P) of square windows say the same: neighbours' errors are alike where pictures are
    blurred. As if they were so along one direction only, for a shift is told from differences: on grounds of known
    shifts sigmas are 0.7 to 1.4 of the errors then, and 0.35 to 0.7 were every residual taken for itself.
    """
    side = int(np.sqrt(residuals.shape[1]))
    grid = residuals.reshape(-1, side, side)
    square = (grid * grid).mean(axis=(1, 2)) + np.float32(1e-12)
    found = np.ones(len(grid), np.float32)
    for step in ((grid[:, :, 1:], grid[:, :, :-1]), (grid[:, 1:], grid[:, :-1])):
        likeness = np.clip((step[0] * step[1]).mean(axis=(1, 2)) / square, 0.0, 0.95)
        found *= np.sqrt((1.0 + likeness) / (1.0 - likeness))
    return found
