"""Pairs that see common ground, by pose, camera and terrain."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import Block, BoolArray, FloatArray, IntArray, Pair
from aeromatch_cli.geometry.footprints import MAX_DISTANCE_FACTOR, block_footprints
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.pairings.measure import footprint_polygons, measure_overlaps, measured_pairs, ordered
from aeromatch_cli.strategies.pairings.neighbours import fallback_pairs
from aeromatch_cli.strategies.pairings.screening import promising_pairs

# Pairs intersected exactly for each that the cap can keep.
_CANDIDATES_PER_NEIGHBOUR = 3


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
        fallback = fallback_pairs(block, unplaced, self.fallback_neighbours)
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
