"""Which pairs of footprints are worth an exact intersection.

In an oblique block an image may touch the footprints of a thousand others, of which its cap keeps a few dozen. Where
an image touches more than can be kept, its neighbours are ranked by an estimate from a few points of the footprint.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Block, FloatArray, IntArray
from aeromatch_cli.geometry.footprints import Footprint, border_rays, view_angles_deg

# Rings of sample points: distance from the middle as share of the border's, and share of the footprint's area.
_RINGS = ((0.5, 0.40), (0.85, 0.51))
_POINTS_PER_RING = 8
_IMAGES_AT_ONCE = 64
_SECTORS, _PER_SECTOR = 8, 2
# The estimated view angle is taken at the middle of a few points: allow it to be off by this much.
_ANGLE_SLACK_DEG = 20.0


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
