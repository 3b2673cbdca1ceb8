"""Trees of matched keypoints: in which order the keypoints of one point are measured, each by one measured before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.geometry.components import component_labels


@dataclass(frozen=True, eq=False)
class Trees:
    """parent: (K,) the keypoint by which each is measured, -1 for those that stand for their points and for those
    without matches. depth: (K,) matches on the way to the first one, -1 without matches."""

    parent: IntArray
    depth: IntArray


def trees_of(keypoints: int, ends: IntArray, scores: FloatArray) -> Trees:
    """Return the trees of matches (M, 2) between keypoints that are numbered through, with the matches' scores (M,).

    The keypoint of a point with most matches is its first one; each other is measured by the nearest to that, by the
    match with the best score. The result does not depend on the order of the matches.
    """
    parent, depth = np.full(keypoints, -1, np.int32), np.full(keypoints, -1, np.int32)
    if not len(ends):
        return Trees(parent, depth)
    both = np.concatenate([ends, ends[:, ::-1]]).astype(np.int32)
    order = np.lexsort((both[:, 0], -np.concatenate([scores, scores]), both[:, 1]))
    towards, nearer = both[order, 1], both[order, 0]
    degree = np.bincount(ends.ravel(), minlength=keypoints)
    point = component_labels(keypoints, ends)
    matched = np.flatnonzero(degree)
    matched = matched[np.lexsort((matched, -degree[matched], point[matched]))]
    first = matched[np.unique(point[matched], return_index=True)[1]]
    depth[first] = 0
    while True:
        open_ = (depth[towards] < 0) & (depth[nearer] >= 0)
        if not open_.any():
            return Trees(parent, depth)
        found, place = np.unique(towards[open_], return_index=True)
        parent[found] = nearer[open_][place]
        depth[found] = depth[parent[found]] + 1
        # What is measured needs no further match.
        towards, nearer = towards[depth[towards] < 0], nearer[depth[towards] < 0]


def shifts_through(trees: Trees, matrices: FloatArray, shifts: FloatArray) -> FloatArray:
    """Return by how much (K, 2) each keypoint is moved so that it shows what the first one of its point shows.

    shifts: (K, 2) that bring each onto its parent where the detector put that one. matrices: (K, 2, 2) pixels of its
    image from pixels of its parent's.
    """
    moved = np.array(shifts, dtype=np.float64)
    for depth in range(2, int(trees.depth.max(initial=0)) + 1):
        here = np.flatnonzero(trees.depth == depth)
        moved[here] += np.einsum("nij,nj->ni", matrices[here], moved[trees.parent[here]])
    return moved
