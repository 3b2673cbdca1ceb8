"""A terrain model from the points of oriented images: robust against wrong points, complete within the block."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import BoolArray, Camera, FloatArray, IntArray, Pose
from aeromatch_cli.geometry.cameras import focal_px
from aeromatch_cli.sfm.epipolar_agreement import PairPoints, explained_matches, triangulated

# A cell is as wide as holds about this many points; no more cells a side than that.
_POINTS_PER_CELL = 4.0
_MAX_CELLS = 400
_NEIGHBOURS = 16
# Points farther from the median of their neighbours than so many median deviations are wrong.
_OUTLIER_DEVIATIONS = 4.0
_MIN_POINTS = 12
# More points than this say no more of a terrain.
_MOST_POINTS = 50_000
# A terrain of more pictures is the same up to this share of the flying height.
_SAME_SHARE = 0.02
# No ground lies nearer below the lowest of so many cameras around it than this share of the flying height, and none
# farther below than so many flying heights: wrong matches meet anywhere on their rays.
_NEAREST_SHARE, _FARTHEST, _CAMERAS_AROUND = 0.2, 4.0, 4
# Heights with a larger standard deviation, as a share of the flying height, say nothing: the rays are near-parallel.
_LARGEST_SIGMA = 0.05
# The surroundings of a point are so many places of about so many points each: by area, so that many points of one wrong
# pair do not speak for them.
_PLACES, _POINTS_PER_PLACE = 25, 16.0
# What differs from its surroundings by more than this share of the flying height must be seen by several pairs, which
# agree up to the second share, or up to so many standard deviations.
_DEPARTS, _AGREES, _AGREES_SIGMAS = 0.1, 0.04, 3.0
_PAIRS_THAT_AGREE = 2


@dataclass(frozen=True, eq=False)
class GroundPoints:
    """Points that pairs of oriented images show, some of them wrong.

    points_m: (P, 3) world points. sigmas_m: (P,) standard deviations of their heights. pair_idx: (P,) which pair has
    shown each.
    """

    points_m: FloatArray
    sigmas_m: FloatArray
    pair_idx: IntArray

    def __len__(self) -> int:
        return len(self.points_m)

    def take(self, which: IntArray | BoolArray | slice) -> GroundPoints:
        return GroundPoints(self.points_m[which], self.sigmas_m[which], self.pair_idx[which])

    @classmethod
    def joined(cls, parts: Sequence[GroundPoints]) -> GroundPoints:
        """Join several sets of pairs, no pair of which is in two."""
        shifts = np.cumsum([0, *(int(part.pair_idx.max(initial=-1)) + 1 for part in parts)])
        return cls(
            np.concatenate([np.zeros((0, 3)), *(part.points_m for part in parts)]),
            np.concatenate([np.zeros(0), *(part.sigmas_m for part in parts)]),
            np.concatenate(
                [np.zeros(0, np.int64), *(p.pair_idx + shift for p, shift in zip(parts, shifts, strict=False))]
            ),
        )


def ground_points(
    pairs: Sequence[PairPoints],
    poses: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    limits_px: Mapping[str, float],
) -> GroundPoints:
    """Return the matches of posed pairs in space, without those that the poses contradict or whose rays are
    near-parallel.

    cameras, limits_px: by image_id; the second are the largest errors of right matches, stored pixels.
    """
    parts = [GroundPoints.joined([])]
    for pair, points_m in zip(pairs, triangulated(pairs, poses, cameras), strict=True):
        good = np.isfinite(points_m).all(axis=1) & explained_matches(pair, poses, cameras, limits_px)
        if good.any():
            ends = pair.image_id0, pair.image_id1
            turns = [limits_px[i] / focal_px(cameras[i]) for i in ends]
            sigmas_m = _height_sigmas_m(points_m[good], [poses[i].center_m for i in ends], turns)
            parts.append(GroundPoints(points_m[good], sigmas_m, np.zeros(len(sigmas_m), np.int64)))
    return GroundPoints.joined(parts)


def _height_sigmas_m(points_m: FloatArray, centers_m: Sequence[FloatArray], turns: Sequence[float]) -> FloatArray:
    """Standard deviations (P,) of heights from rays whose directions have the standard deviations `turns`, radians.

    A ray of length r says nothing of a point along itself, and r times its deviation across: the inverse of the sum of
    these weights is the point's covariance (Foerstner and Wrobel 2016, section 13.4.1).
    """
    weights = np.zeros((len(points_m), 3, 3))
    for center_m, turn in zip(centers_m, turns, strict=True):
        rays = points_m - center_m
        squares = (rays**2).sum(axis=1)[:, None, None]
        weights += (np.eye(3) - rays[:, :, None] * rays[:, None] / squares) / (squares * turn**2)
    return np.sqrt(np.linalg.inv(weights)[:, 2, 2])


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights on a grid.

    heights_m: (H, W) world heights, rows from north to south, no gaps. west_m, north_m: world position of the centre
    of the first cell. cell_m: spacing, the same both ways.
    """

    heights_m: FloatArray
    west_m: float
    north_m: float
    cell_m: float


def terrain_of(points: GroundPoints, centers_m: FloatArray) -> Terrain | None:
    """Return heights below a flight, None from too few points.

    centers_m: (N, 3) projection centres, which the grid must enclose (the points are enclosed in any case). A cell's
    height is the median of the points nearest to its centre, weighted by their standard deviations, so that the surface
    that most pictures see counts, and single wrong points do not; beyond the points the nearest go on.
    """
    from scipy.ndimage import gaussian_filter
    from scipy.spatial import cKDTree

    points = _without_outliers(points.take(slice(None, None, 1 + len(points) // _MOST_POINTS)), centers_m)
    if len(points) < _MIN_POINTS:
        return None
    places, heights_m = points.points_m[:, :2], points.points_m[:, 2]
    around = np.concatenate([places, centers_m[:, :2]])
    low, high = around.min(axis=0), around.max(axis=0)
    # The distance to the fourth nearest point tells the density where most points lie.
    near, _ = cKDTree(places).query(places, k=5)
    spacing = float(np.median(near[:, 4])) * np.sqrt(np.pi / 4.0)
    extent = float((high - low).max())
    cell = max(spacing * np.sqrt(_POINTS_PER_CELL), extent / _MAX_CELLS, 1e-6)
    columns, rows = (np.ceil((high - low) / cell).astype(int) + 1).tolist()
    x = low[0] + cell * np.arange(columns)
    y = low[1] + cell * np.arange(rows)[::-1]
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    _, nearest = cKDTree(places).query(centres, k=min(_NEIGHBOURS, len(points)))
    heights = _weighted_medians(heights_m[nearest], 1.0 / points.sigmas_m[nearest]).reshape(rows, columns)
    heights = gaussian_filter(heights, 0.7, mode="nearest").astype(np.float32)
    return Terrain(heights, float(x[0]), float(y[0]), cell)


def _weighted_medians(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Medians (N,) along the second axis of (N, K); with equal weights the lower of two middle values."""
    order = np.argsort(values, axis=1)
    summed = np.cumsum(np.take_along_axis(weights, order, axis=1), axis=1)
    middle = np.argmax(summed >= 0.5 * summed[:, -1:], axis=1)
    return np.take_along_axis(values, np.take_along_axis(order, middle[:, None], axis=1), axis=1)[:, 0]


def terrains_of(parts: Sequence[tuple[GroundPoints, FloatArray]]) -> tuple[Terrain, ...]:
    """Return terrains of flights that may lie anywhere, in the order of the first of them: one for all that lie
    together.

    parts: of every group of images, its points and its projection centres (N, 3). Flights far apart in one grid would
    have cells as wide as a valley.
    """
    flights: list[list[int]] = []  # rows of parts
    for row, (_, centers_m) in enumerate(parts):
        joined, others = list[int](), list[list[int]]()
        for flight in flights:
            if any(_meet(centers_m, parts[one][1]) for one in flight):
                joined += flight
            else:
                others.append(flight)
        flights = [*others, [*joined, row]]
    terrains = []
    for flight in sorted(flights, key=min):
        points = GroundPoints.joined([parts[row][0] for row in flight])
        terrain = terrain_of(points, np.concatenate([parts[row][1] for row in flight]))
        if terrain is not None:
            terrains.append(terrain)
    return tuple(terrains)


def _meet(centers0_m: FloatArray, centers1_m: FloatArray) -> bool:
    """Whether the boxes of two flights (N, 3) meet, each wider by its own extent on every side."""
    boxes = []
    for centers in (centers0_m[:, :2], centers1_m[:, :2]):
        margin = float(np.ptp(centers, axis=0).max())
        boxes.append((centers.min(axis=0) - margin, centers.max(axis=0) + margin))
    (low0, high0), (low1, high1) = boxes
    return bool((low0 <= high1).all() and (low1 <= high0).all())


def continued(old: Terrain, new: Terrain, centers_m: FloatArray) -> Terrain:
    """Return the old terrain of a block that has grown, with heights of the new one around it; the new one where they
    differ.

    centers_m: (N, 3) projection centres. Cells of the old terrain keep their places and heights, so that views made of
    it stay as they are.
    """
    inside = _sampled(new, _grid(old)).reshape(old.heights_m.shape)
    height_m = abs(float(np.median(centers_m[:, 2]) - np.median(old.heights_m)))
    if float(np.median(np.abs(inside - old.heights_m))) > _SAME_SHARE * height_m:
        return new
    low, high = _extent(old)
    low_new, high_new = _extent(new)
    before = np.maximum(np.ceil((low - low_new) / old.cell_m - 1e-6), 0).astype(int)
    after = np.maximum(np.ceil((high_new - high) / old.cell_m - 1e-6), 0).astype(int)
    if not before.any() and not after.any():
        return old
    rows, columns = np.array(old.heights_m.shape) + (before + after)[::-1]
    whole = Terrain(
        np.zeros((rows, columns)), old.west_m - before[0] * old.cell_m, old.north_m + after[1] * old.cell_m, old.cell_m
    )
    heights = _sampled(new, _grid(whole)).reshape(rows, columns)
    heights[after[1] : rows - before[1], before[0] : columns - after[0]] = old.heights_m
    return Terrain(heights, whole.west_m, whole.north_m, whole.cell_m)


def _extent(terrain: Terrain) -> tuple[FloatArray, FloatArray]:
    """South-west and north-east corner cell's centres."""
    rows, columns = terrain.heights_m.shape
    south, east = terrain.north_m - (rows - 1) * terrain.cell_m, terrain.west_m + (columns - 1) * terrain.cell_m
    return np.array([terrain.west_m, south]), np.array([east, terrain.north_m])


def _grid(terrain: Terrain) -> FloatArray:
    """(H W, 2) centres of its cells."""
    rows, columns = terrain.heights_m.shape
    x = terrain.west_m + terrain.cell_m * np.arange(columns)
    y = terrain.north_m - terrain.cell_m * np.arange(rows)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _sampled(terrain: Terrain, places_m: FloatArray) -> FloatArray:
    """Bilinear heights (N,), those of the border beyond it."""
    from scipy.ndimage import map_coordinates

    columns = (places_m[:, 0] - terrain.west_m) / terrain.cell_m
    rows = (terrain.north_m - places_m[:, 1]) / terrain.cell_m
    return np.asarray(map_coordinates(terrain.heights_m.astype(float), [rows, columns], order=1, mode="nearest"))


def _without_outliers(points: GroundPoints, centers_m: FloatArray) -> GroundPoints:
    """Points that can be ground: not far off sideways, well below the cameras, of a known height, and either near the
    height of their surroundings or shown by several pairs. centers_m: (N, 3)."""
    from scipy.spatial import cKDTree

    if len(points) < _MIN_POINTS:
        return points
    middle = np.median(points.points_m[:, :2], axis=0)
    far = np.linalg.norm(points.points_m[:, :2] - middle, axis=1)
    points = points.take(far <= 5.0 * float(np.percentile(far, 75)) + 1e-9)
    _, near = cKDTree(centers_m[:, :2]).query(
        points.points_m[:, :2], k=range(1, 1 + min(_CAMERAS_AROUND, len(centers_m)))
    )
    below_m = centers_m[near, 2].min(axis=1) - points.points_m[:, 2]
    flying_m = float(np.median(below_m[below_m > 0.0])) if (below_m > 0.0).any() else 0.0
    points = points.take((below_m >= _NEAREST_SHARE * flying_m) & (below_m <= _FARTHEST * flying_m))
    if len(points) < _MIN_POINTS:
        return points
    points = points.take(points.sigmas_m <= max(_LARGEST_SIGMA * flying_m, 2.0 * float(np.median(points.sigmas_m))))
    points = points.take(_is_supported(points, flying_m))
    if len(points) < _MIN_POINTS:
        return points
    _, nearest = cKDTree(points.points_m[:, :2]).query(points.points_m[:, :2], k=min(_NEIGHBOURS, len(points)))
    heights_m = points.points_m[:, 2][nearest]
    middles_m = np.median(heights_m, axis=1)
    off = np.abs(points.points_m[:, 2] - middles_m)
    usual = np.median(np.abs(heights_m - middles_m[:, None]), axis=1)
    limit = _OUTLIER_DEVIATIONS * np.maximum(usual, float(np.median(usual))) + 1e-9
    return points.take(off <= limit)


def _is_supported(points: GroundPoints, flying_m: float) -> BoolArray:
    """(P,) whether a point lies near the height of its surroundings, or several pairs show others beside it as high.

    A tower or a cliff is shown by all pairs that look at it; a wrong pair, or repetitive texture, is alone with what
    it shows. Of one pair there is no other to ask.
    """
    from scipy.spatial import cKDTree

    xy_m, heights_m = points.points_m[:, :2], points.points_m[:, 2]
    departs = np.abs(heights_m - _surroundings_m(points.points_m)) > _DEPARTS * flying_m
    _, near = cKDTree(xy_m).query(xy_m, k=min(_NEIGHBOURS, len(points)))
    limits_m = np.maximum(_AGREES * flying_m, _AGREES_SIGMAS * points.sigmas_m)
    agrees = np.abs(heights_m[near] - heights_m[:, None]) <= limits_m[:, None]
    shown_by = np.sort(np.where(agrees, points.pair_idx[near], -1), axis=1)
    # Of sorted numbers each rise is one pair more, the first too where it follows on -1.
    pairs = (np.diff(shown_by, axis=1) > 0).sum(axis=1) + (shown_by[:, 0] >= 0)
    needed = min(_PAIRS_THAT_AGREE, len(np.unique(points.pair_idx)))
    return np.asarray(~departs | (pairs >= needed))


def _surroundings_m(points_m: FloatArray) -> FloatArray:
    """(P,) median height of the places around each point."""
    from scipy.spatial import cKDTree

    xy_m = points_m[:, :2]
    near, _ = cKDTree(xy_m).query(xy_m, k=5)
    # The circle to the fourth nearest point holds four.
    side_m = max(float(np.median(near[:, 4])) * np.sqrt(np.pi / 4.0 * _POINTS_PER_PLACE), 1e-6)
    _, place = np.unique(np.floor(xy_m / side_m).astype(np.int64), axis=0, return_inverse=True)
    place = place.ravel()
    order = np.lexsort((points_m[:, 2], place))
    starts = np.searchsorted(place[order], np.arange(place.max() + 2))
    middles = order[(starts[:-1] + starts[1:]) // 2]  # the point of median height of each place
    _, around = cKDTree(xy_m[middles]).query(xy_m, k=range(1, 1 + min(_PLACES, len(middles))))
    return np.asarray(np.median(points_m[middles, 2][around], axis=1))
