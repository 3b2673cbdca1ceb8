"""Pairs that see common ground, by pose, camera and terrain.

In an oblique block an image may touch the footprints of a thousand others, of which its cap keeps a few dozen. Where
an image touches more than can be kept, its neighbours are ranked by an estimate from a few points of the footprint, and
only the best ones are intersected exactly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import Block, BoolArray, FloatArray, IntArray, Pair
from aeromatch_cli.geometry.footprints import (
    MAX_DISTANCE_FACTOR,
    Footprint,
    block_footprints,
    border_rays,
    view_angles_deg,
)
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.pairings.measure import footprint_polygons, measure_overlaps, measured_pairs, ordered
from aeromatch_cli.strategies.pairings.neighbours import fallback_pairs

# Pairs intersected exactly for each that the cap can keep.
_CANDIDATES_PER_NEIGHBOUR = 3
# Rings of sample points: distance from the middle as share of the border's, and share of the footprint's area.
_RINGS = ((0.5, 0.40), (0.85, 0.51))
_POINTS_PER_RING = 8
_IMAGES_AT_ONCE = 64
_SECTORS, _PER_SECTOR = 8, 2
# The estimated view angle is taken at the middle of a few points: allow it to be off by this much.
_ANGLE_SLACK_DEG = 20.0


class Overlap(Strategy):
    """Pairs of images whose footprints on the ground overlap.

    Of the pairs that pass both limits, each image keeps its `max_neighbours` largest overlaps (equal overlaps: the
    smaller view angle); a pair stays if either image keeps it. The pairs of a maximum spanning forest stay whatever
    their rank, so that the cap never splits a block. Images without a footprint (no pose, no attitude, looking above
    the horizon, below the ground) and images that overlap with nothing get neighbours by position, time or name. Pairs
    that a first pass has matched stay where the overlap is unknown.
    """

    name: Literal["overlap"] = "overlap"
    min_overlap: float = Field(
        default=0.1,
        ge=0.0,
        le=1.0,
        description="Smallest overlap of two footprints, as a share (0-1) of the smaller one. Larger: fewer pairs.",
    )
    max_view_angle_deg: float = Field(
        default=60.0,
        gt=0.0,
        le=180.0,
        description="Largest angle between both viewing directions, degrees. Larger: more pairs, harder to match.",
    )
    max_neighbours: int = Field(
        default=30,
        ge=1,
        description="Largest number of pairs per image; those with most overlap are kept. Larger: more pairs, more "
        "time.",
    )
    max_distance_factor: float = Field(
        default=MAX_DISTANCE_FACTOR,
        gt=0.0,
        description="Ground farther away than this many flying heights is ignored. Larger: oblique images get larger "
        "footprints.",
    )
    fallback_neighbours: int = Field(
        default=20,
        ge=1,
        description="Number of neighbours of an image without usable pose, chosen by position, capture time or name. "
        "Larger: more pairs.",
    )

    def __call__(self, block: Block) -> list[Pair]:
        """Pairs of a block; see the family's table for the contract."""
        footprints = block_footprints(block, self.max_distance_factor)
        ids = list(footprints)
        chosen: list[Pair] = []
        if len(ids) >= 2:
            polygons = footprint_polygons(footprints)
            centers = np.array([block.poses[image_id].center_m for image_id in ids])
            heights = np.array([footprint.ground_z_m for footprint in footprints.values()])
            candidates = promising_pairs(
                block,
                footprints,
                polygons,
                min_overlap=self.min_overlap,
                max_view_angle_deg=self.max_view_angle_deg,
                max_distance_factor=self.max_distance_factor,
                per_image=_CANDIDATES_PER_NEIGHBOUR * self.max_neighbours,
            )
            shares, angles = measure_overlaps(polygons, centers, heights, candidates)
            good = (shares >= self.min_overlap) & (shares > 0.0) & (angles <= self.max_view_angle_deg)
            candidates, shares, angles = candidates[good], shares[good], angles[good]
            keep = _within_cap(candidates, shares, angles, len(ids), self.max_neighbours)
            keep |= _spanning_forest(candidates, shares, len(ids))
            for (idx0, idx1), share, angle in zip(candidates[keep], shares[keep], angles[keep], strict=True):
                chosen.append(Pair(*ordered(ids[idx0], ids[idx1]), float(share), float(angle), self.name))
        paired = {image_id for pair in chosen for image_id in (pair.image_id0, pair.image_id1)}
        unplaced = {image.image_id for image in block.images} - paired
        fallback = fallback_pairs(block, unplaced, self.fallback_neighbours, within_places=True)
        present = {(pair.image_id0, pair.image_id1) for pair in chosen} | fallback.keys()
        placed = footprints.keys()
        tied = {ids: "first pass" for ids in block.tied if ids not in present and not placed >= set(ids)}
        others = measured_pairs(block, fallback | tied, footprints)
        return sorted([*chosen, *others], key=lambda pair: (pair.image_id0, pair.image_id1))


def _within_cap(pairs: IntArray, shares: FloatArray, angles: FloatArray, count: int, cap: int) -> BoolArray:
    """(P,) True where either image ranks the pair among its first `cap`."""
    if len(pairs) == 0:
        return np.zeros(0, dtype=bool)
    images = np.concatenate([pairs[:, 0], pairs[:, 1]])
    pair_idx = np.tile(np.arange(len(pairs)), 2)
    order = np.lexsort((pair_idx, angles[pair_idx], -np.round(shares[pair_idx], 9), images))
    starts = np.searchsorted(images[order], np.arange(count))
    rank = np.arange(len(order)) - starts[images[order]]
    keep = np.zeros(len(pairs), dtype=bool)
    keep[pair_idx[order[rank < cap]]] = True
    return keep


def _spanning_forest(pairs: IntArray, shares: FloatArray, count: int) -> BoolArray:
    """(P,) True for the pairs of a maximum spanning forest by overlap."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import minimum_spanning_tree

    # Weights must be positive (zero means no edge) and smallest for the largest overlap.
    graph = csr_array((2.0 - shares, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    rows, columns = minimum_spanning_tree(graph).nonzero()
    return np.isin(pairs[:, 0] * count + pairs[:, 1], rows.astype(np.int64) * count + columns)


@dataclass(frozen=True, eq=False)
class _Looks:
    """What the estimate reads, by footprint: float32, relative to the middle of the block.

    samples_m (N, S, 3) with weights (S,); centers_m (N, 3); rotations (N, 3, 3) cam_from_world; bounds (N, 4) smallest
    and largest x/z, y/z of the image; reach_m (N,) distance of the cut; areas_m2 (N,).
    """

    samples_m: FloatArray
    weights: FloatArray
    centers_m: FloatArray
    rotations: FloatArray
    bounds: FloatArray
    reach_m: FloatArray
    areas_m2: FloatArray


def promising_pairs(
    block: Block,
    footprints: Mapping[str, Footprint],
    polygons: NDArray[Any],
    *,
    min_overlap: float,
    max_view_angle_deg: float,
    max_distance_factor: float,
    per_image: int,
) -> IntArray:
    """Pairs (P, 2) of footprint indices, first < second, sorted, that may overlap enough.

    Complete where no image has more than `per_image` neighbours whose bounding boxes share enough area; else the
    `per_image` best estimated overlaps of either image, and the best two towards each of 8 directions.
    """
    import shapely

    tree = shapely.STRtree(polygons)
    boxes, areas = shapely.bounds(polygons), shapely.area(polygons)
    looks: _Looks | None = None
    kept = []
    for start in range(0, len(polygons), _IMAGES_AT_ONCE):
        local, second = tree.query(polygons[start : start + _IMAGES_AT_ONCE])
        first = local + start
        common = np.minimum(boxes[first, 2:], boxes[second, 2:]) - np.maximum(boxes[first, :2], boxes[second, :2])
        possible = (first != second) & (common.prod(axis=1) >= min_overlap * np.minimum(areas[first], areas[second]))
        first, second = first[possible], second[possible]
        if len(first) and np.bincount(first - start).max() > per_image:
            looks = looks or _looks(block, footprints, areas, max_distance_factor)
            best = _best_estimated(looks, first, second, max_view_angle_deg + _ANGLE_SLACK_DEG, per_image)
            first, second = first[best], second[best]
        kept.append(np.stack([np.minimum(first, second), np.maximum(first, second)], axis=1))
    return np.unique(np.concatenate(kept), axis=0)


def _looks(
    block: Block, footprints: Mapping[str, Footprint], areas_m2: FloatArray, max_distance_factor: float
) -> _Looks:
    cameras = {image.image_id: block.camera(image) for image in block.images}
    middle = np.median([footprint.middle_m for footprint in footprints.values()], axis=0)
    samples, centers, rotations, bounds, reach = [], [], [], [], []
    for image_id, footprint in footprints.items():
        pose, uv = block.poses[image_id], border_rays(cameras[image_id])[:, :2]
        polygon = footprint.polygon_m
        ring = polygon[np.arange(_POINTS_PER_RING) * len(polygon) // _POINTS_PER_RING]
        ring = np.column_stack([ring, np.full(len(ring), footprint.ground_z_m)]) - footprint.middle_m
        points = np.concatenate([np.zeros((1, 3)), *(share * ring for share, _ in _RINGS)])
        samples.append(points + footprint.middle_m - middle)
        centers.append(pose.center_m - middle)
        rotations.append(pose.world_rotation)
        bounds.append([*uv.min(axis=0), *uv.max(axis=0)])
        reach.append(max_distance_factor * (float(pose.center_m[2]) - footprint.ground_z_m))
    ring_weights = [np.full(_POINTS_PER_RING, area / _POINTS_PER_RING) for _, area in _RINGS]
    weights = np.concatenate([[1.0 - sum(area for _, area in _RINGS)], *ring_weights])
    return _Looks(
        samples_m=np.array(samples, dtype=np.float32),
        weights=weights.astype(np.float32),
        centers_m=np.array(centers, dtype=np.float32),
        rotations=np.array(rotations, dtype=np.float32),
        bounds=np.array(bounds, dtype=np.float32),
        reach_m=np.array(reach, dtype=np.float32),
        areas_m2=areas_m2,
    )


def _best_estimated(
    looks: _Looks, first: IntArray, second: IntArray, max_view_angle_deg: float, per_image: int
) -> IntArray:
    """Indices of the pairs that their first image ranks among its best by estimate, see `promising_pairs`."""
    swap = looks.areas_m2[second] < looks.areas_m2[first]
    small, other = np.where(swap, second, first), np.where(swap, first, second)
    points = looks.samples_m[small]
    rays = points - looks.centers_m[other][:, None]
    seen = rays @ looks.rotations[other].transpose(0, 2, 1)
    depth, bounds = seen[..., 2], looks.bounds[other][:, :, None]
    inside = (depth > 0.0) & (np.hypot(rays[..., 0], rays[..., 1]) <= looks.reach_m[other][:, None])
    for axis in (0, 1):
        inside &= (seen[..., axis] >= bounds[:, axis] * depth) & (seen[..., axis] <= bounds[:, axis + 2] * depth)
    weighted = inside * looks.weights
    shares = weighted.sum(axis=1)
    middles = (weighted[..., None] * points).sum(axis=1) / np.maximum(shares, 1e-6)[:, None]
    angles = view_angles_deg(looks.centers_m[small], looks.centers_m[other], middles)
    # Where no sample is shared the overlap is small or nothing and its middle unknown: last, by distance.
    lost = shares <= 0.0
    apart = np.linalg.norm(looks.samples_m[small, 0] - looks.samples_m[other, 0], axis=1)
    possible = np.flatnonzero(lost | (angles <= max_view_angle_deg))
    tie = np.where(lost, apart, angles)[possible]
    order = possible[np.lexsort((second[possible], tie, -np.round(shares[possible], 6), first[possible]))]
    # The best towards each side as well: dense strips must not lose the strips beside them.
    offset = looks.samples_m[second[order], 0] - looks.samples_m[first[order], 0]
    sector = np.floor(np.arctan2(offset[:, 1], offset[:, 0]) * (_SECTORS / (2.0 * np.pi))).astype(np.int64) % _SECTORS
    best = _rank_in_group(first[order]) < per_image
    return np.asarray(order[best | (_rank_in_group(first[order] * _SECTORS + sector) < _PER_SECTOR)])


def _rank_in_group(groups: IntArray) -> IntArray:
    """Place (N,) of each element among those of its group, in the order given."""
    order = np.argsort(groups, kind="stable")
    rank = np.empty(len(groups), dtype=np.int64)
    rank[order] = np.arange(len(groups)) - np.searchsorted(groups[order], groups[order])
    return rank
