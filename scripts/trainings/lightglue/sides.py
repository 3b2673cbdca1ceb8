"""What the network sees of a picture, and pairs of such with their truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from aeromatch_cli.data import Features
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX
from aeromatch_cli.nets.descriptor_bytes import BYTE_ZERO
from aeromatch_cli.strategies.matchers.lightglue.inference import wrapped_rad

CORRECT_PX, WRONG_PX = 3.0, 5.0  # a partner lies within the one; without any within the other there is none
NONE, UNKNOWN = -1, -2
Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Seen:
    """One view. points_px: (N, 2) from the view's corner; sizes_px, angles_rad: (N,); descriptors: (N, 128) uint8,
    int8 of learned ones, whose values have a sign; size_px: (2,) width, height; places_px: (N, 2) of the same
    keypoints where truth speaks of them."""

    points_px: Array
    sizes_px: Array
    angles_rad: Array
    descriptors: Array
    size_px: Array
    places_px: Array

    def take(self, rows: Array) -> Seen:
        values = (self.points_px, self.sizes_px, self.angles_rad, self.descriptors)
        return Seen(*(value[rows] for value in values), self.size_px, self.places_px[rows])

    def arrays(self) -> dict[str, Array]:
        return vars(self)


def seen(features: Features, view: int = 0, *, signed: bool = False) -> Seen:
    """A view of extracted features; places are source pixels. signed: of learned ones (`nets.descriptor_bytes`)."""
    rows = np.flatnonzero(features.view_idx == view)
    descriptors = features.descriptors[rows]
    return Seen(
        points_px=(features.view_keypoints_px[rows] + np.float32(COLMAP_OFFSET_PX)).astype(np.float32),
        sizes_px=features.view_size_px[rows].astype(np.float32),
        angles_rad=wrapped_rad(features.view_orientation_deg[rows]),
        descriptors=(descriptors.astype(np.int16) - BYTE_ZERO).astype(np.int8) if signed else descriptors,
        size_px=features.view_sizes_px[view].astype(np.float32),
        places_px=features.keypoints_px[features.descriptor_keypoint_idx[rows]].astype(np.float32),
    )


@dataclass(frozen=True, eq=False)
class Partners:
    """Truth of a pair: the partner of every keypoint of either side, NONE, or UNKNOWN."""

    of0: Array
    of1: Array

    @property
    def count(self) -> int:
        """How many keypoints have a partner."""
        return int((self.of0 >= 0).sum())

    def take(self, rows0: Array, rows1: Array) -> Partners:
        """Of the given rows of either side, by their new numbers; whose partner is not among them has none."""
        return Partners(_renumbered(self.of0[rows0], rows1), _renumbered(self.of1[rows1], rows0))


def _renumbered(partners: Array, rows: Array) -> Array:
    numbers = np.full(max(int(rows.max(initial=-1)), int(partners.max(initial=-1))) + 1, NONE, np.int64)
    numbers[rows] = np.arange(len(rows))
    out = partners.astype(np.int64)
    out[out >= 0] = numbers[out[out >= 0]]
    return out


def partners(side0: Seen, side1: Seen, there0_px: Array, there1_px: Array) -> Partners:
    """From two sides and where their places truly are in the other picture, (M, 2), (N, 2), not finite: nowhere.

    Places are partners that are each other's nearest, within CORRECT_PX in both directions. A place is without partner
    where no other lies within WRONG_PX in either direction; in between nothing is known. SIFT describes a third of the
    places twice or more, along several gradients: of such, those that look most alike are partners, one to one, and of
    the others nothing is known.
    """
    (places0, rows0, of_place0), (places1, rows1, of_place1) = (
        np.unique(side.places_px, axis=0, return_index=True, return_inverse=True) for side in (side0, side1)
    )
    by_place = _of_places(places0, places1, there0_px[rows0], there1_px[rows1])
    of0, of1 = (
        np.where(mates[places] == NONE, NONE, UNKNOWN).astype(np.int32)
        for mates, places in ((by_place.of0, of_place0), (by_place.of1, of_place1))
    )
    groups0, groups1 = (
        np.split(np.argsort(p, kind="stable"), np.cumsum(np.bincount(p))[:-1]) for p in (of_place0, of_place1)
    )
    for place in np.flatnonzero(by_place.of0 >= 0):
        first, second = groups0[place], groups1[by_place.of0[place]]
        apart = side0.descriptors[first][:, None].astype(np.float32) - side1.descriptors[second]
        chosen = linear_sum_assignment((apart**2).sum(axis=2))
        of0[first[chosen[0]]], of1[second[chosen[1]]] = second[chosen[1]], first[chosen[0]]
    return Partners(of0, of1)


def _of_places(places0_px: Array, places1_px: Array, there0_px: Array, there1_px: Array) -> Partners:
    """Partners of places, each of which occurs once."""
    forward, backward = _nearest(there0_px, places1_px), _nearest(there1_px, places0_px)
    of0, of1 = (np.where(near[0] > WRONG_PX, NONE, UNKNOWN) for near in (forward, backward))
    candidates = np.flatnonzero(forward[0] <= CORRECT_PX)
    mates = forward[1][candidates]
    back = np.linalg.norm(np.nan_to_num(there1_px[mates], nan=1e9) - places0_px[candidates], axis=1)
    good = (back <= CORRECT_PX) & (backward[1][mates] == candidates)
    of0[candidates[good]], of1[mates[good]] = mates[good], candidates[good]
    # Who is near in the other direction only is unknown.
    reached1 = np.unique(forward[1][forward[0] <= WRONG_PX])
    reached0 = np.unique(backward[1][backward[0] <= WRONG_PX])
    of1[reached1] = np.where(of1[reached1] == NONE, UNKNOWN, of1[reached1])
    of0[reached0] = np.where(of0[reached0] == NONE, UNKNOWN, of0[reached0])
    return Partners(of0.astype(np.int32), of1.astype(np.int32))


def _nearest(points_px: Array, others_px: Array) -> tuple[Array, Array]:
    """Distance and row of the nearest other of each point; far away and 0 where there is none."""
    distance, row = np.full(len(points_px), np.inf), np.zeros(len(points_px), np.int64)
    known = np.flatnonzero(np.isfinite(points_px).all(axis=1))
    if len(known) and len(others_px):
        distance[known], row[known] = cKDTree(others_px).query(points_px[known])
    return distance, row
