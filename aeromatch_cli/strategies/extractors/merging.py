"""Features that describe the same point of an image become one keypoint with several descriptors."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray

# Two views of one image see a point at the same place and size, up to the detector's own scatter.
_MERGE_DISTANCE_PX = 1.0
_MERGE_SIZE_RATIO = 1.5


def merge_keypoints(
    points_px: FloatArray, sizes_px: FloatArray, view_idx: IntArray, factor: int = 1
) -> tuple[IntArray, IntArray]:
    """Keypoint number of each feature (N,) and the feature that stands for each keypoint (K,), both int64.

    points_px (N, 2), sizes_px (N,) in the source frame, views ascending. Neighbours in the list of equal view, place
    and size are one keypoint (several orientations). A keypoint of a later view joins the nearest one of the views
    before it, if each is the other's nearest, within 1 px and a size ratio of 1.5; the earliest view's place stands.
    factor: by which the views were reduced, and so the pixels that the detector scatters by are larger.
    """
    if len(points_px) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    rows = np.column_stack([view_idx, points_px, sizes_px])
    starts = np.concatenate([[True], (rows[1:] != rows[:-1]).any(axis=1)])
    first, keypoint_idx = np.flatnonzero(starts), np.cumsum(starts) - 1
    target = np.arange(len(first))
    views = view_idx[first]
    for view in np.unique(views)[1:]:
        old, new = np.flatnonzero((views < view) & (target == np.arange(len(first)))), np.flatnonzero(views == view)
        hit_new, hit_old = _same_points(points_px[first] / factor, sizes_px[first], new, old)
        target[hit_new] = hit_old
    standing = np.flatnonzero(target == np.arange(len(first)))
    number = np.empty(len(first), np.int64)
    number[standing] = np.arange(len(standing))
    return number[target][keypoint_idx], first[standing]


def _same_points(
    points_px: FloatArray, sizes_px: FloatArray, new: IntArray, old: IntArray
) -> tuple[IntArray, IntArray]:
    from scipy.spatial import cKDTree

    if len(new) == 0 or len(old) == 0:
        return new[:0], old[:0]
    distance, forward = (np.asarray(x) for x in cKDTree(points_px[old]).query(points_px[new]))
    backward = np.asarray(cKDTree(points_px[new]).query(points_px[old])[1])
    ratio = sizes_px[new] / sizes_px[old[forward]]
    same = (distance <= _MERGE_DISTANCE_PX) & (backward[forward] == np.arange(len(new)))
    same &= (ratio <= _MERGE_SIZE_RATIO) & (ratio >= 1.0 / _MERGE_SIZE_RATIO)
    return new[same], old[forward[same]]
