"""What a similarity cannot follow: every window's own shift, searched for, and agreed with its neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.strategies.matchers.polar.affine import Windows, carried, offsets
from aeromatch_cli.strategies.matchers.polar.level import Level

_NEIGHBOURS = 10
_LEAST_CORRELATION = 0.3
# What may be off: so many times what the neighbours scatter, and never more than so many times what always may.
_DEVIATIONS, _MOST = 4.0, 3.0


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
