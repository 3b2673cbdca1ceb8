"""Which features of an image to keep: an exact budget, spread evenly over the ground, strongest first in each place;
and which of them describe the same point, and so become one keypoint with several descriptors.

Cells are anchored in the world where a view knows it, so that two images that see the same ground rank the same points
against each other, wherever their borders run.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.geometry.warps import area_scale
from aeromatch_cli.strategies import ViewPixels

# The visible area of a cell is counted on about so many samples of its view.
_AREA_SAMPLES = 40_000
# Of a cell that no sample hit, in samples.
_LEAST_SHOWN = 0.05
# Two views of one image see a point at the same place and size, up to the detector's own scatter.
_MERGE_DISTANCE_PX = 1.0
_MERGE_SIZE_RATIO = 1.5


def distinct(points_px: FloatArray, sizes_px: FloatArray, strengths: FloatArray, radius_px: float) -> BoolArray:
    """Which points (N, 2) have no stronger one within radius_px and a factor of two in size (N,).

    A blob that answers at neighbouring scales is one thing on the ground and shall cost one descriptor. Of equally
    strong ones the first in the list stands. The rule is local: every image that sees the place decides alike.
    """
    from scipy.spatial import cKDTree

    keep: BoolArray = np.ones(len(points_px), dtype=bool)
    if len(points_px) == 0:
        return keep
    pairs = np.sort(cKDTree(points_px).query_pairs(radius_px, output_type="ndarray"), axis=1)
    ratio = sizes_px[pairs[:, 0]] / sizes_px[pairs[:, 1]]
    first, second = pairs[(ratio <= 2.0) & (ratio >= 0.5)].T
    keep[np.where(strengths[second] > strengths[first], first, second)] = False
    return keep


def even_selection(
    views: Sequence[ViewPixels],
    view_idx: IntArray,
    points_px: FloatArray,
    strengths: FloatArray,
    budget: int,
    per_cell: int,
) -> IntArray:
    """Indices (ascending, int64) of the features that a budget buys; points_px (N, 2) in the frames of their views.

    Every cell gives its strongest feature, then its second strongest, and so on, each at a pace in proportion to what
    its view shows of it: the pixels of the picture as taken that went into it, or view pixels where these are fewer
    (distortion is left aside). Distance that a tilted picture squeezes and a ground view stretches so gets no more than
    it had. Views share the budget by what they show, and what one cannot use goes to the others. Cells hold about
    per_cell of `budget` features: squares of a power of two metres along the world's axes where the view's ground is
    known, else squares of view pixels. Equal features go by their order.
    """
    if len(points_px) <= budget or budget < 1:
        return np.arange(min(len(points_px), budget))
    samples = [_samples(view) for view in views]
    cell_px2 = sum(len(seen) * step**2 for seen, step in samples) * per_cell / budget
    turn = np.zeros(len(points_px))
    for number, (view, (seen, step)) in enumerate(zip(views, samples, strict=True)):
        of_view = np.flatnonzero(view_idx == number)
        if len(of_view):
            cells, seen_cells = _cells(view, cell_px2, points_px[of_view], seen)
            shown = np.minimum(area_scale(view.view.undistorted_from_view, seen) ** 2, 1.0)
            turn[of_view] = _turns(cells, strengths[of_view], seen_cells, shown) / step**2
    return np.sort(np.lexsort((-strengths, turn))[:budget])


def _samples(view: ViewPixels) -> tuple[FloatArray, int]:
    """Visible pixels (N, 2) on a regular grid over the view, and its step in pixels."""
    height, width = view.gray.shape
    step = max(1, int(np.sqrt(width * height / _AREA_SAMPLES)))
    y, x = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    grid = np.column_stack([x.ravel(), y.ravel()])
    seen = grid if view.valid is None else grid[view.valid[grid[:, 1], grid[:, 0]]]
    return seen.astype(np.float64), step


def _cells(view: ViewPixels, cell_px2: float, points_px: FloatArray, seen_px: FloatArray) -> tuple[IntArray, IntArray]:
    """Cell numbers of points (N,) and samples (S,) of a view, cells of about cell_px2 square pixels."""
    places: list[FloatArray] = [points_px.astype(np.float64), seen_px]
    side, warp = float(np.sqrt(cell_px2)), view.view.ground_from_view
    if warp is not None:
        side_m = side * float(np.median(area_scale(warp, places[0])))
        side = float(2.0 ** np.rint(np.log2(side_m)))
        places = [apply_homography(warp, place) for place in places]
    points, seen = (np.floor(place / side).astype(np.int64) @ [1 << 32, 1] for place in places)
    return points, seen


def _turns(cells: IntArray, strengths: FloatArray, seen_cells: IntArray, shown: FloatArray) -> FloatArray:
    """When each feature (N,) is taken: its rank by strength within its cell over what the cell's samples show (S,)."""
    order = np.lexsort((-strengths, cells))
    starts = np.flatnonzero(np.concatenate([[True], np.diff(cells[order]) != 0]))
    rank = np.empty(len(order))
    rank[order] = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    own, of_feature = np.unique(cells, return_inverse=True)
    place = np.minimum(np.searchsorted(own, seen_cells), len(own) - 1)
    inside = own[place] == seen_cells
    sums = np.bincount(place[inside], shown[inside], len(own))
    return (rank + 0.5) / np.maximum(sums, _LEAST_SHOWN)[of_feature]


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
