"""How many of exactly so many keypoints in the overlap of two unseen rendered views are found again, beside SIFT."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from scipy.spatial import cKDTree

from aeromatch_cli.data import FloatArray, View
from aeromatch_cli.nets.detector import Detector
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.heat import heat_keypoints
from aeromatch_cli.strategies.extractors.selection import distinct
from aeromatch_cli.strategies.extractors.sift import Sift
from trainings.detector.scenes import Sight, angles_deg, transfer

LIMITS_PX = (3.0, 1.0)
ANGLES_DEG = (0.0, 20.0, 40.0, 60.0, 90.0)
# Share of a view that the other shows at least.
_LEAST_OVERLAP = 0.15
# What a keypoint at a surface's edge shows may be the surface next to it.
_AROUND_PX = np.array([(x, y) for x in (0.0, -1.0, 1.0) for y in (0.0, -1.0, 1.0)])
# A view's points, the surest first.
Finder = Callable[[Sight], FloatArray]


@dataclass(frozen=True)
class Pair:
    """Two views of a block and the median angle between their rays."""

    view0: Sight
    view1: Sight
    angle_deg: float


def pairs_of(blocks: list[list[Sight]], least_deg: float = 0.0) -> list[Pair]:
    """All pairs with overlap enough."""
    found = []
    for sights in blocks:
        for view0, view1 in combinations(sights, 2):
            y, x = np.mgrid[4 : view0.gray.shape[0] : 12, 4 : view0.gray.shape[1] : 12].astype(np.float64)
            grid = np.column_stack([x.ravel(), y.ravel()])
            seen = grid[np.isfinite(transfer(view0, view1, grid)[:, 0])]
            if len(seen) >= _LEAST_OVERLAP * len(grid):
                angle = float(np.median(angles_deg(view0, view1, view0.points_m(seen))))
                if angle >= least_deg:
                    found.append(Pair(view0, view1, angle))
    return found


def thinned(pairs: list[Pair], most: int, seed: int = 0) -> list[Pair]:
    """At most so many pairs between two of ANGLES_DEG, drawn once."""
    bins = np.digitize([pair.angle_deg for pair in pairs], ANGLES_DEG)
    order = np.random.default_rng(seed).permutation(len(pairs))
    rank = [int((bins[order[:place]] == bins[order[place]]).sum()) for place in range(len(order))]
    return [pairs[n] for n in sorted(order[np.array(rank, int) < most])]


def by_sift(sight: Sight) -> FloatArray:
    """SIFT's points as the extractor ranks them."""
    sift = Sift()
    height, width = sight.gray.shape
    view = View("ground", width, height, np.eye(3), True, 0.0, north_up=True)
    raw = sift.detected(ViewPixels(view, sight.gray, sight.valid), 0)
    strengths = sift.strengths(raw)
    raw = raw.take(distinct(raw.points_px, raw.sizes_px, strengths, 2.0))
    return raw.points_px[np.argsort(-sift.strengths(raw), kind="stable")].astype(np.float64)


def by_heat(network: Detector | None) -> Finder:
    def find(sight: Sight) -> FloatArray:
        return heat_keypoints(sight.gray, 20_000, sight.valid, network)[0]

    return find


@dataclass(frozen=True)
class Score:
    """Of one pair: keypoints in the overlap of either view, and how many are one-to-one within each of LIMITS_PX."""

    angle_deg: float
    keypoints: int
    repeated: tuple[int, ...]
    error_px: float


def scores(pairs: list[Pair], find: Finder, count: int) -> list[Score]:
    """Of every pair, the first `count` of the points that the other view shows, too, or as many as there are."""
    known: dict[int, FloatArray] = {}
    found = []
    for pair in pairs:
        for view in (pair.view0, pair.view1):
            if id(view) not in known:
                known[id(view)] = find(view)
        found.append(_score(pair, known[id(pair.view0)], known[id(pair.view1)], count))
    return found


def _score(pair: Pair, points0: FloatArray, points1: FloatArray, count: int) -> Score:
    there0 = _candidates(pair.view0, pair.view1, points0)
    there1 = _candidates(pair.view1, pair.view0, points1)
    rows0 = np.flatnonzero(np.isfinite(there0).any(axis=(1, 2)))[:count]
    rows1 = np.flatnonzero(np.isfinite(there1).any(axis=(1, 2)))[:count]
    least = min(len(rows0), len(rows1))
    rows0, rows1 = rows0[:least], rows1[:least]
    if not least:
        return Score(pair.angle_deg, 0, (0,) * len(LIMITS_PX), float("nan"))
    errors, links = _links(points0[rows0], points1[rows1], there0[rows0], there1[rows1])
    repeated = []
    within = np.zeros(0)
    for limit in LIMITS_PX:
        chosen = _one_to_one(errors, links, limit)
        repeated.append(len(chosen))
        within = errors[chosen] if limit == LIMITS_PX[0] else within
    return Score(pair.angle_deg, least, tuple(repeated), float(np.median(within)) if len(within) else float("nan"))


def _candidates(view0: Sight, view1: Sight, points_px: FloatArray) -> FloatArray:
    """(N, 9, 2) where points (N, 2) of view 0 may be in view 1, by the surfaces within a pixel of them."""
    places = (points_px[:, None] + _AROUND_PX).reshape(-1, 2)
    moved = transfer(view0, view1, places).reshape(len(points_px), -1, 2)
    # Back by the offset, as the surface maps it: a finite difference of its own would leave the surface.
    return np.asarray(moved - _AROUND_PX)


def _links(
    points0: FloatArray, points1: FloatArray, there0: FloatArray, there1: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Errors (M,), the larger of both directions, and rows (M, 2) of the pairs of points within LIMITS_PX[0]."""
    forward = _distances(there0, points1)
    backward = _distances(there1, points0)
    both = [(rows, max(error, backward[rows[::-1]])) for rows, error in forward.items() if rows[::-1] in backward]
    links = np.array([rows for rows, _ in both], np.int64).reshape(-1, 2)
    return np.array([error for _, error in both]), links


def _distances(there: FloatArray, points: FloatArray) -> dict[tuple[int, int], float]:
    flat = there.reshape(-1, 2)
    known = np.flatnonzero(np.isfinite(flat[:, 0]))
    tree = cKDTree(points)
    found: dict[tuple[int, int], float] = {}
    for row, near in zip(known, tree.query_ball_point(flat[known], LIMITS_PX[0]), strict=True):
        for other in near:
            rows = int(row) // there.shape[1], int(other)
            error = float(np.hypot(*(flat[row] - points[other])))
            found[rows] = min(error, found.get(rows, np.inf))
    return found


def _one_to_one(errors: FloatArray, links: FloatArray, limit_px: float) -> FloatArray:
    """Links within the limit, the closest first, each point once."""
    taken: tuple[set[int], set[int]] = set(), set()
    chosen = []
    for row in np.argsort(errors, kind="stable"):
        first, second = (int(n) for n in links[row])
        if errors[row] > limit_px:
            break
        if first not in taken[0] and second not in taken[1]:
            taken[0].add(first)
            taken[1].add(second)
            chosen.append(int(row))
    return np.array(chosen, np.int64)


def table(found: list[Score]) -> dict[str, dict[str, float]]:
    """By angle: pairs, keypoints a pair, repeatability (mean over pairs) at each limit, median error in px."""
    rows = {}
    for low, high in pairwise(ANGLES_DEG):
        here = [score for score in found if low <= score.angle_deg < high and score.keypoints]
        if here:
            shares = np.array([[n / score.keypoints for n in score.repeated] for score in here]).mean(axis=0)
            row = {"pairs": len(here), "keypoints": round(float(np.mean([score.keypoints for score in here])))}
            row |= {f"{limit:g}px": round(float(share), 4) for limit, share in zip(LIMITS_PX, shares, strict=True)}
            rows[f"{low:g}-{high:g}"] = row | {"error_px": round(float(np.nanmean([s.error_px for s in here])), 3)}
    return rows
