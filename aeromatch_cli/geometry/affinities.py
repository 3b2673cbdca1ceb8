"""Local affinities among matches: which neighbours of a match move with it.

All points are undistorted pixels, matches are rows. Neighbours are nearest by where they lie in both images together:
wrong matches, which scatter in four dimensions, do not crowd the neighbours of the true ones, which lie on a surface.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray

# Area of a triangle of neighbours over the square of its longer side at the match: flatter ones give no affinity.
_FLATTEST = 0.1
# Neighbours closer than float32 tells apart span no affinity; its terms would overflow.
_LEAST_AREA_PX = 1e-6
_VOTES_AT_ONCE = 3_500_000  # float32, of every neighbour on every two of them
_TINY = 1e-12


def joint_places(points0: FloatArray, points1: FloatArray) -> FloatArray:
    """Where matches (M, 2) lie in both images (M, 4), each image over its spread: both count alike at any scale."""
    return np.concatenate([_scaled(points0), _scaled(points1)], axis=1)


def _scaled(points: FloatArray) -> FloatArray:
    """Points (M, 2) over their spread."""
    if not len(points):
        return points
    return (points - points.mean(axis=0)) / max(float(np.sqrt(points.var(axis=0).mean())), _TINY)


def nearest_matches(places: FloatArray, count: int) -> IntArray:
    """(M, n) the other matches nearest to each of the places (M, D), nearest first; n is at most count and M - 1."""
    from scipy.spatial import cKDTree

    count = max(0, min(count, len(places) - 1))
    if count == 0:
        return np.zeros((len(places), 0), np.int64)
    around = np.asarray(cKDTree(places).query(places, k=count + 1)[1])
    # A match at the very place of another may not be its own first neighbour.
    return np.where(around[:, 1:] == np.arange(len(places))[:, None], around[:, :1], around[:, 1:])


def local_support(
    points0: FloatArray, points1: FloatArray, around: IntArray, threshold_px: float
) -> tuple[FloatArray, FloatArray]:
    """How many of its neighbours around (M, n) move with each match by one affinity.

    Every two neighbours propose an affinity through the match, unless it mirrors: no surface is seen from behind. Each
    neighbour counts 1 - (distance / threshold)^2, distances in image 1, the two that define it not. Returns the support
    (M,) of the best, 0 to n - 2, and the weights (M, n) behind it.
    """
    support, weights = np.zeros(len(around)), np.zeros(around.shape)
    if around.shape[1] < 2:
        return support, weights
    count = around.shape[1]
    chunk = max(1, _VOTES_AT_ONCE // (count * count * (count - 1) // 2))
    for start in range(0, len(around), chunk):
        part = slice(start, start + chunk)
        # Float32 is exact to 1e-4 px here and twice as fast; matches run along the last axis.
        move0, move1 = (
            np.ascontiguousarray((p[around[part]] - p[part, None]).transpose(2, 1, 0), np.float32)
            for p in (points0, points1)
        )
        support[part], weights[part] = _best_affinity(move0, move1, threshold_px)
    return support, weights


def _best_affinity(move0: FloatArray, move1: FloatArray, threshold_px: float) -> tuple[FloatArray, FloatArray]:
    """Support (M,) and weights (M, n) of moves (2, n, M) from matches to their neighbours in either image."""
    count, rows = move0.shape[1], np.arange(move0.shape[2])
    pairs = np.array(list(combinations(range(count), 2)))
    a, b = move0[:, pairs[:, 0]], move0[:, pairs[:, 1]]
    area = a[0] * b[1] - a[1] * b[0]
    usable = np.abs(area) > np.maximum(_FLATTEST * np.maximum((a**2).sum(axis=0), (b**2).sum(axis=0)), _LEAST_AREA_PX)
    to_a, to_b = move1[:, pairs[:, 0]], move1[:, pairs[:, 1]]
    usable &= area * (to_a[0] * to_b[1] - to_a[1] * to_b[0]) > 0.0
    over = np.divide(1.0, area, out=np.zeros_like(area), where=usable)
    # Rows of the affinity that maps the moves a, b of a pair to theirs in image 1.
    of_a, of_b = to_a * over, to_b * over
    along_x, along_y = of_a * b[1] - of_b * a[1], of_b * a[0] - of_a * b[0]
    votes = np.empty((count, len(pairs), len(rows)), np.float32)
    for n in range(count):
        apart = along_x * move0[0, n] + along_y * move0[1, n] - move1[:, n][:, None]
        squared = apart[0] * apart[0] + apart[1] * apart[1]
        np.maximum(1.0 - squared / np.float32(threshold_px**2), 0.0, out=votes[n])
    score = np.where(usable, votes.sum(axis=0) - 2.0, 0.0)
    best = score.argmax(axis=0)
    weights = votes[:, best, rows].T * usable[best, rows][:, None]
    return np.maximum(score[best, rows], 0.0).astype(np.float64), weights


def fit_affinities(points0: FloatArray, points1: FloatArray, around: IntArray, weights: FloatArray) -> FloatArray:
    """(M, 2, 3) affinities, x1 = A (x0, 1), by least squares on each match and its weighted neighbours (M, n)."""
    which = np.column_stack([np.arange(len(around)), around])
    weights = np.concatenate([np.ones((len(which), 1)), weights], axis=1)
    origin0, origin1 = points0[which[:, 0]], points1[which[:, 0]]
    x, y = points0[which] - origin0[:, None], points1[which] - origin1[:, None]
    design = np.concatenate([x, np.ones((*x.shape[:2], 1))], axis=2)
    weighted = (design * weights[..., None]).transpose(0, 2, 1)
    # Next to nothing on the diagonal keeps a match without supporters solvable; its affinity is never the best.
    normal = weighted @ design + 1e-6 * np.eye(3)
    solved = np.linalg.solve(normal, weighted @ y).transpose(0, 2, 1)
    solved[:, :, 2] += origin1 - (solved[:, :, :2] @ origin0[..., None])[..., 0]
    return np.asarray(solved)
