"""Planes in two views: clusters of matches, the homographies that explain each, and local affine support.

All points are undistorted pixels, matches are rows. K-means groups matches by where they lie in both images, so that
wrong ones, which scatter in four dimensions, do not fill the clusters of the true ones, which lie on a surface. Small
pieces of a surface map by an affinity: every match proposes one, through itself and its neighbours, and in each cluster
the proposal with most inliers grows into a homography; what it leaves is searched for the next one, so that one plane
need not explain roofs and street. Nothing but the start of K-means is drawn at random.

Source: K-means clustered RANSAC after J. Geo-inf. Sci. 2025(6), 1401-1419; number of false alarms after Moisan and
Stival, IJCV 2004; DLT after Hartley and Zisserman, 2nd ed., algorithm 4.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.geometry.affinities import fit_affinities, joint_places, local_support, nearest_matches

NEIGHBOURS = 8
# A cluster holds this many matches on average at least: fewer do not tell a plane from chance.
SMALLEST_CLUSTER = 24
# Planes that chance may give in a cluster of random matches, on average.
_FALSE_ALARMS = 0.1
_SMALLEST_PLANE = 6
_PROPOSALS = 48  # of a cluster, the best supported
_REFINEMENTS = 2
_NEARBY_CLUSTERS = 4
_KMEANS_STEPS = 8
_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Planes:
    """Planes found among matches (M,).

    homographies: (P, 3, 3), x1 ~ H x0. plane_cluster_idx: (P,) cluster that each was found in. inliers: (P,) matches
    of that cluster within the threshold that no earlier plane of it explained.
    cluster_idx: (M,) cluster of each match.
    labels: (M,) the plane of its own or a nearby cluster that explains each match best, -1 where none does within the
    threshold. residuals_px: (M,) distance to it, larger of both directions, infinite without a plane.
    support: (M,) how many neighbours move with a match by one affinity, those that define it not counted, each
    weighted by 1 - (distance / threshold)^2: 0 to NEIGHBOURS - 2.
    """

    homographies: FloatArray
    plane_cluster_idx: IntArray
    inliers: IntArray
    cluster_idx: IntArray
    labels: IntArray
    residuals_px: FloatArray
    support: FloatArray


def fit_planes(
    points0_px: FloatArray,
    points1_px: FloatArray,
    *,
    clusters: int,
    planes_per_cluster: int = 3,
    threshold_px: float = 3.0,
    seed: int = 0,
) -> Planes:
    """Clusters of matches (M, 2), finite, and up to planes_per_cluster homographies of each, one after the other.

    clusters: at most; fewer where they would hold less than SMALLEST_CLUSTER matches on average. A plane has six
    inliers at least and more than chance gives. The same for the same seed, which starts K-means.
    """
    points0, points1 = (np.ascontiguousarray(p, dtype=np.float64).reshape(-1, 2) for p in (points0_px, points1_px))
    places = joint_places(points0, points1)
    cluster_idx = cluster_places(places, max(1, min(clusters, len(places) // SMALLEST_CLUSTER)), seed)
    around = nearest_matches(places, NEIGHBOURS)
    support, weights = local_support(points0, points1, around, threshold_px)
    affinities = fit_affinities(points0, points1, around, weights)
    members = _padded(cluster_idx)
    found = _search(points0, points1, members, support, affinities, planes_per_cluster, threshold_px)
    homographies, plane_cluster_idx, inliers = found
    nearby = _nearby(_means(places, members))[cluster_idx][:, plane_cluster_idx]
    labels, residuals = _assign(points0, points1, homographies, nearby, threshold_px)
    return Planes(homographies, plane_cluster_idx, inliers, cluster_idx, labels, residuals, support)


def cluster_places(places: FloatArray, clusters: int, seed: int) -> IntArray:
    """Cluster (M,) of points (M, D) by K-means, k-means++ start, numbered from 0 without gaps."""
    from scipy.cluster.vq import kmeans2

    if clusters <= 1:
        return np.zeros(len(places), np.int64)
    centres = _spread_start(places, clusters, np.random.default_rng(seed))
    _, labels = kmeans2(places, centres, iter=_KMEANS_STEPS, minit="matrix")
    return np.asarray(np.unique(labels, return_inverse=True)[1], np.int64)


def _spread_start(places: FloatArray, clusters: int, rng: np.random.Generator) -> FloatArray:
    """Centres (K, D), distinct points each drawn by its squared distance to those before (k-means++)."""
    chosen = [int(rng.integers(len(places)))]
    apart = ((places - places[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < clusters and apart.max() > 0:
        heap = np.cumsum(apart)
        chosen.append(int(np.searchsorted(heap, rng.random() * heap[-1], side="right")))
        apart = np.minimum(apart, ((places - places[chosen[-1]]) ** 2).sum(axis=1))
    return places[chosen]


def _padded(groups: IntArray) -> IntArray:
    """(G, largest) positions of the members of every group, in order, -1 where a group has fewer."""
    sizes = np.bincount(groups)
    order = np.argsort(groups, kind="stable")
    column = np.arange(len(groups)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    padded = np.full((len(sizes), int(sizes.max(initial=0))), -1, np.int64)
    padded[groups[order], column] = order
    return padded


def _means(values: FloatArray, members: IntArray) -> FloatArray:
    """Mean (G, D) of values (M, D) over the members (G, S) of every group; no group is empty."""
    held = (members >= 0)[..., None]
    return np.asarray((values[members] * held).sum(axis=1) / np.maximum(held.sum(axis=1), 1))


def _nearby(centres: FloatArray) -> BoolArray:
    """(K, K) whether the second cluster is the first or among the three nearest to it."""
    apart = ((centres[:, None] - centres[None]) ** 2).sum(axis=2)
    near = np.zeros(apart.shape, dtype=bool)
    np.put_along_axis(near, np.argsort(apart, axis=1, kind="stable")[:, :_NEARBY_CLUSTERS], True, axis=1)
    return near


def _search(
    points0: FloatArray,
    points1: FloatArray,
    members: IntArray,
    support: FloatArray,
    affinities: FloatArray,
    rounds: int,
    threshold_px: float,
) -> tuple[FloatArray, IntArray, IntArray]:
    """Homographies (P, 3, 3), their clusters (P,) and inliers (P,), all clusters (K, S) at once, round by round."""
    if not members.size:
        return np.zeros((0, 3, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64)
    held = members >= 0
    x, y = points0[members], points1[members]
    ranked = np.argsort(np.where(held, -support[members], np.inf), axis=1, kind="stable")[:, :_PROPOSALS]
    proposals = affinities[np.take_along_axis(members, ranked, axis=1)]
    design = np.concatenate([x, np.ones((*x.shape[:2], 1))], axis=2)
    squared = np.zeros((len(members), proposals.shape[1], members.shape[1]))
    for axis in range(2):
        squared += (proposals[:, :, axis] @ design.transpose(0, 2, 1) - y[:, None, :, axis]) ** 2
    votes = np.maximum(1.0 - squared / threshold_px**2, 0.0)
    spread = _areas(y, held)
    alive, found = held.copy(), []
    for _ in range(rounds):
        best = (votes @ alive[..., None])[..., 0].argmax(axis=1)
        models, inliers = _grow(x, y, alive, proposals[np.arange(len(members)), best], threshold_px)
        counts, total = inliers.sum(axis=1), alive.sum(axis=1)
        good = (counts >= _SMALLEST_PLANE) & (false_alarms(counts, total, threshold_px, spread) < _FALSE_ALARMS)
        found += [(k, models[k], counts[k]) for k in np.flatnonzero(good)]
        alive &= ~(inliers & good[:, None])
        if not good.any():
            break
    found.sort(key=lambda plane: plane[0])  # stable: within a cluster in the order found
    clusters, homographies, sizes = zip(*found, strict=True) if found else ((), (), ())
    return np.array(homographies).reshape(-1, 3, 3), np.array(clusters, np.int64), np.array(sizes, np.int64)


def false_alarms(inliers: IntArray, total: IntArray, threshold_px: float, area_px: FloatArray) -> FloatArray:
    """How many planes with so many inliers chance gives in sets of `total` matches spread over area_px, on average.

    Three matches define a proposal; each other falls within the threshold by the share of the area that it covers.
    """
    from scipy.special import bdtrc

    chance = np.clip(np.pi * threshold_px**2 / np.maximum(area_px, _TINY), 0.0, 1.0)
    trials = np.maximum(total - 3, 1)
    tests = total * NEIGHBOURS * (NEIGHBOURS - 1) / 2
    return np.asarray(tests * bdtrc(np.clip(inliers - 4, 0, trials), trials, chance))


def _areas(y: FloatArray, held: BoolArray) -> FloatArray:
    """Area (K,) of the two-sigma ellipse of points (K, S, 2)."""
    count = np.maximum(held.sum(axis=1), 1)
    centred = (y - ((y * held[..., None]).sum(axis=1) / count[:, None])[:, None]) * held[..., None]
    covariance = centred.transpose(0, 2, 1) @ centred / count[:, None, None]
    return np.asarray(4.0 * np.pi * np.sqrt(np.maximum(np.linalg.det(covariance), 0.0)))


def _grow(
    x: FloatArray, y: FloatArray, alive: BoolArray, affinities: FloatArray, threshold_px: float
) -> tuple[FloatArray, BoolArray]:
    """The best homography (K, 3, 3) and inliers (K, S) on the way from an affinity (K, 2, 3) by least squares.

    Points (K, S, 2). An affinity is the safer fit to few matches, a homography the truer one to many: both are tried.
    """
    last = np.broadcast_to(np.array([[[0.0, 0.0, 1.0]]]), (len(x), 1, 3))
    models = np.concatenate([affinities, last], axis=1)
    squared = _squared(models, x, y)
    best, inliers, score = models, alive & (squared <= threshold_px**2), _score(squared, alive, threshold_px)
    for _ in range(_REFINEMENTS):
        weights = inliers.astype(np.float64)
        for fit in (_affine_fit, _projective_fit):
            models = fit(x, y, weights)
            squared = _squared(models, x, y)
            new = _score(squared, alive, threshold_px)
            better = new > score
            best = np.where(better[:, None, None], models, best)
            inliers = np.where(better[:, None], alive & (squared <= threshold_px**2), inliers)
            score = np.maximum(score, new)
    return best, inliers


def _score(squared: FloatArray, alive: BoolArray, threshold_px: float) -> FloatArray:
    return np.asarray((np.maximum(1.0 - squared / threshold_px**2, 0.0) * alive).sum(axis=1))


def _normalising(points: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres (K, 2) and scales (K,) that bring weighted points (K, S, 2) to unit spread."""
    total = np.maximum(weights.sum(axis=1), 1.0)
    centre = (points * weights[..., None]).sum(axis=1) / total[:, None]
    spread = (((points - centre[:, None]) ** 2).sum(axis=2) * weights).sum(axis=1) / total
    return centre, 1.0 / np.sqrt(np.maximum(spread, 1e-6))


def _affine_fit(x: FloatArray, y: FloatArray, weights: FloatArray) -> FloatArray:
    """(K, 3, 3) affinities by weighted least squares; without weights the zero map."""
    centre, scale = _normalising(x, weights)
    u = (x - centre[:, None]) * scale[:, None, None]
    design = np.concatenate([u, np.ones((*u.shape[:2], 1))], axis=2)
    weighted = (design * weights[..., None]).transpose(0, 2, 1)
    solved = np.linalg.solve(weighted @ design + 1e-9 * np.eye(3), weighted @ y).transpose(0, 2, 1)
    models = np.zeros((len(x), 3, 3))
    models[:, :2, :2] = solved[:, :, :2] * scale[:, None, None]
    models[:, :2, 2] = solved[:, :, 2] - (models[:, :2, :2] @ centre[..., None])[..., 0]
    models[:, 2, 2] = 1.0
    return models


def _projective_fit(x: FloatArray, y: FloatArray, weights: FloatArray) -> FloatArray:
    """(K, 3, 3) homographies by the weighted normalised DLT."""
    (centre0, scale0), (centre1, scale1) = _normalising(x, weights), _normalising(y, weights)
    u = (x - centre0[:, None]) * scale0[:, None, None]
    v = (y - centre1[:, None]) * scale1[:, None, None]
    point = np.concatenate([u, np.ones((*u.shape[:2], 1))], axis=2)
    # The normal matrix of the DLT's rows (p, 0, -v0 p) and (0, p, -v1 p), by its 3 x 3 blocks.
    squares = v[..., 0] ** 2 + v[..., 1] ** 2
    plain, first, second, both = (
        (point * (weights * factor)[..., None]).transpose(0, 2, 1) @ point
        for factor in (1.0, v[..., 0], v[..., 1], squares)
    )
    normal = np.zeros((len(x), 9, 9))
    normal[:, :3, :3] = normal[:, 3:6, 3:6] = plain
    normal[:, :3, 6:] = normal[:, 6:, :3] = -first
    normal[:, 3:6, 6:] = normal[:, 6:, 3:6] = -second
    normal[:, 6:, 6:] = both
    _, vectors = np.linalg.eigh(normal)
    middle = vectors[:, :, 0].reshape(-1, 3, 3)
    models = _similarity(-centre1 * scale1[:, None], scale1, inverse=True) @ middle
    return np.asarray(models @ _similarity(-centre0 * scale0[:, None], scale0))


def _similarity(shift: FloatArray, scale: FloatArray, *, inverse: bool = False) -> FloatArray:
    """(K, 3, 3) of x -> scale x + shift, or of its inverse."""
    if inverse:
        shift, scale = -shift / scale[:, None], 1.0 / scale
    matrices = np.zeros((len(scale), 3, 3))
    matrices[:, 0, 0] = matrices[:, 1, 1] = scale
    matrices[:, :2, 2], matrices[:, 2, 2] = shift, 1.0
    return matrices


def _squared(homographies: FloatArray, points0: FloatArray, points1: FloatArray) -> FloatArray:
    """Squared distances (K, S) in image 1 of points (K, S, 2) under homographies (K, 3, 3); huge towards infinity."""
    x, y = points0[..., 0], points0[..., 1]
    u, v, w = (row[:, :1] * x + row[:, 1:2] * y + row[:, 2:] for row in homographies.transpose(1, 0, 2))
    safe = np.where(np.abs(w) > _TINY, w, _TINY)
    return np.asarray((u / safe - points1[..., 0]) ** 2 + (v / safe - points1[..., 1]) ** 2)


def plane_distances_px(homographies: FloatArray, points0_px: FloatArray, points1_px: FloatArray) -> FloatArray:
    """Distance (P, M) of matches (M, 2) to homographies (P, 3, 3), the larger of both directions."""
    forward = _squared(homographies, points0_px[None], points1_px[None])
    backward = _squared(_adjugates(homographies), points1_px[None], points0_px[None])
    return np.sqrt(np.maximum(forward, backward))


def _adjugates(matrices: FloatArray) -> FloatArray:
    """Inverses (K, 3, 3) up to scale, without dividing by a determinant."""
    r0, r1, r2 = matrices[:, 0], matrices[:, 1], matrices[:, 2]
    return np.stack([np.cross(r1, r2), np.cross(r2, r0), np.cross(r0, r1)], axis=2)


def _assign(
    points0: FloatArray, points1: FloatArray, homographies: FloatArray, nearby: BoolArray, threshold_px: float
) -> tuple[IntArray, FloatArray]:
    """Label (M,) and residual (M,) of the best plane among those that nearby (M, P) allows."""
    if not len(homographies) or not len(points0):
        return np.full(len(points0), -1, np.int64), np.full(len(points0), np.inf)
    distances = np.where(nearby, plane_distances_px(homographies, points0, points1).T, np.inf)
    labels = distances.argmin(axis=1)
    residuals = distances[np.arange(len(labels)), labels]
    return np.where(residuals <= threshold_px, labels, -1), residuals
