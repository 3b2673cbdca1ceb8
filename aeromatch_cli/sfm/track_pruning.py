"""Track pruning keeps the points of an adjusted block that are left once matches are dropped."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from aeromatch_cli.data import AdjustedBlock, BoolArray, IntArray
from aeromatch_cli.geometry.components import component_labels

# Ids of both images of a pair, its verified matches (M, 2) as numbers of their keypoints, and which are kept (M,).
JudgedPair = tuple[str, str, IntArray, BoolArray]


def without_dropped(adjusted: AdjustedBlock, pairs: Iterable[JudgedPair]) -> AdjustedBlock:
    """Return the block with the points and observations that the kept matches hold; poses and cameras stay, and the
    errors of points, which geometry.reprojection finds anew.

    A point that lost a match keeps the largest part of its observations that kept matches still tie to each other, and
    goes where none ties two. Points that lost no match stay as they are. pairs: all with verified matches.
    """
    ids = sorted(adjusted.tracks)
    first = dict(zip(ids, np.cumsum([0, *(len(adjusted.tracks[i]) for i in ids)]).tolist(), strict=False))
    point_of = np.concatenate([np.zeros(0, np.int64), *(adjusted.tracks[i][:, 1] for i in ids)]).astype(np.int64)
    order = {i: np.argsort(track[:, 0], kind="stable") for i, track in adjusted.tracks.items()}
    lost = np.zeros(len(adjusted.points_m), dtype=bool)
    ties = [np.zeros((0, 2), np.int32)]
    for id0, id1, indices, kept in pairs:
        if id0 not in first or id1 not in first:
            continue
        rows = [_rows(adjusted.tracks[i], order[i], indices[:, side]) for side, i in enumerate((id0, id1))]
        nodes = np.column_stack([row + first[i] for row, i in zip(rows, (id0, id1), strict=True)])
        inside = (rows[0] >= 0) & (rows[1] >= 0)
        inside[inside] = point_of[nodes[inside, 0]] == point_of[nodes[inside, 1]]
        lost[point_of[nodes[inside & ~kept, 0]]] = True
        ties.append(nodes[inside & kept].astype(np.int32))
    if not lost.any():
        return adjusted
    part = component_labels(len(point_of), np.concatenate(ties))
    return _with(adjusted, ids, ~lost[point_of] | _in_largest(part, point_of, len(lost)))


def _rows(track: IntArray, order: IntArray, keypoints: IntArray) -> IntArray:
    """Rows of a track (n, 2) that hold these keypoints (M,); -1 where it has none. order: (n,) rows by keypoint."""
    found = np.searchsorted(track[order, 0], keypoints)
    rows = order[np.minimum(found, len(order) - 1)] if len(order) else np.full(len(keypoints), -1)
    known = track[rows, 0] == keypoints if len(order) else np.zeros(len(keypoints), dtype=bool)
    return np.where(known, rows, -1).astype(np.int64)


def _in_largest(part: IntArray, point_of: IntArray, points: int) -> BoolArray:
    """Whether an observation lies in the largest part of its point, of two and more observations. part, point_of: (N,)
    of every observation; a part has observations of one point alone."""
    sizes = np.bincount(part)
    owner = np.zeros(len(sizes), dtype=np.int64)
    owner[part] = point_of
    order = np.lexsort((np.arange(len(sizes)), -sizes, owner))  # of equal ones the first
    largest = np.full(points, -1)
    heads = order[np.r_[True, owner[order][1:] != owner[order][:-1]]]
    largest[owner[heads]] = heads
    return np.asarray((largest[point_of] == part) & (sizes[part] > 1))


def _with(adjusted: AdjustedBlock, ids: list[str], keep: BoolArray) -> AdjustedBlock:
    """The block with some of its observations, in the order of ids, and the points that they see."""
    tracks, start = {}, 0
    for image_id in ids:
        track = adjusted.tracks[image_id]
        tracks[image_id] = track[keep[start : start + len(track)]]
        start += len(track)
    seen = np.zeros(len(adjusted.points_m), dtype=bool)
    for track in tracks.values():
        seen[track[:, 1]] = True
    number = np.cumsum(seen) - 1
    tracks = {i: np.column_stack([t[:, 0], number[t[:, 1]]]).astype(np.int32) for i, t in tracks.items()}
    return replace(adjusted, points_m=adjusted.points_m[seen], errors_px=adjusted.errors_px[seen], tracks=tracks)
