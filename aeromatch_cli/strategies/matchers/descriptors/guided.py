"""Guided search around the places that verified matches predict: a point instead of an epipolar line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import BoolArray, Camera, Features, FloatArray, IntArray, PairGeometry
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.epipolar import sampson_distance_px
from aeromatch_cli.geometry.prediction import inverse_depths, places_of_heights, stereo_of
from aeromatch_cli.geometry.two_view import TwoView
from aeromatch_cli.strategies.matchers.descriptors.assignment import is_first, one_to_one
from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Found, joined
from aeromatch_cli.strategies.matchers.descriptors.evidence import evidence_of

# Matches around a point whose heights are tried.
_NEIGHBOURS = 6
# Predicting and searching: what is found predicts once more.
_ROUNDS = 2
# Standard deviations of true matches: Sampson distance and distance to the nearest predicted place, pixels of the view
# that found the keypoint (a reduced view tells places no better than its own pixels); octaves between both sizes beyond
# those of the matches around; distance of descriptors over the one that wrong pairs have.
_LINE_PX, _PLACE_PX, _SIZE_OCTAVES, _LOOK = 0.7, 1.0, 0.2, 0.4
# Smallest share of the model's matches that the search around their predicted places must find again.
_LEAST_KEPT = 0.5
# Sum of the four squares that 95 % of the true matches stay below (chi-square).
_LARGEST_COST = 9.49
# Within this many times the distance from place and line, no other keypoint may have a more similar descriptor:
# repeated structures lie side by side.
_RIVALS = 2.0
# Matches that another matcher found may lie so many times as far from predicted place and size, and the squares less
# the log odds sum up to so much: of what it adds to 14 pairs of each of 7 rendered scenes, nine tenths are right.
_PLACE_SLACK, _SIZE_SLACK, _LARGEST_KEPT = 2.0, 2.5, 3.0
# Share of random keypoint pairs that look at most as different as "wrong pairs have".
_CHANCE = 0.02
_DRAWS = 8192
_CHUNK = 4096


@dataclass(frozen=True, eq=False)
class Side:
    """One image in the search. places_px: (K, 2) undistorted. first, count: (K,) run of its descriptors.

    units_px: (K,) stored pixels per pixel of the view that found each keypoint, 1 at least.
    """

    features: Features
    places_px: FloatArray
    first: IntArray
    count: IntArray
    units_px: FloatArray


@dataclass(frozen=True, eq=False)
class Prediction:
    """What verified matches say about all keypoints of image 0.

    places_px: (K0, Q, 2) in image 1, undistorted, as high as each of the Q nearest matches of other keypoints; not
    finite where unknown. octaves: (K0,) that things grow by around there.
    """

    model: TwoView
    places_px: FloatArray
    octaves: FloatArray


class SecondSearch:
    """Matches around the places that a verified model and the heights of its matches predict.

    A match must agree with its epipolar line, a place and a size predicted by other matches, and its descriptor.
    """

    def __init__(self, comparison: Comparison) -> None:
        self.comparison = comparison
        geometry = comparison.geometry
        self._side0, self._side1 = (
            side_of(comparison.features0, geometry.camera0),
            side_of(comparison.features1, geometry.camera1),
        )
        self._wrong = distance_of_wrong_pairs(self._side0, self._side1, comparison.comparable)

    def __call__(self, found: Found, *, keep: bool = False) -> Found:
        """The new matches. Those given are returned unchanged where they support no significant model.

        keep: the costs of `found` are 1 - probability of a network. Its matches that agree with line, place and size
        are added where the search found no match for either keypoint.
        """
        # A keypoint that occurred twice would confirm itself.
        first = found = found.take(one_to_one(*self.comparison.keypoints(found), found.costs))
        if self._wrong == 0.0:
            return found
        last: Prediction | None = None
        for _ in range(_ROUNDS):
            prediction = self._predicted(found)
            if prediction is None:
                break
            again = around(self._side0, self._side1, prediction, self.comparison.comparable, self._wrong)
            if len(again.rows) < _LEAST_KEPT * prediction.model.inliers.sum():
                break  # the heights of neighbours predict badly here: the earlier matches are better
            found, last = again, prediction
        if not keep or last is None:
            return found
        return self._added(found, first.take(plausible(first, self._side0, self._side1, last)))

    def _predicted(self, found: Found) -> Prediction | None:
        evidence = evidence_of(self.comparison, found, self._side0.places_px, self._side1.places_px)
        if evidence is None or not evidence.beyond_chance:
            return None
        idx0, idx1 = self.comparison.keypoints(found.take(evidence.model.inliers))
        return predicted(self._side0, self._side1, idx0, idx1, evidence.model, self.comparison.geometry)

    def _added(self, first: Found, second: Found) -> Found:
        """All of the first, and of the second what shares no keypoint with it."""
        (used0, used1), (idx0, idx1) = self.comparison.keypoints(first), self.comparison.keypoints(second)
        return joined([first, second.take(~np.isin(idx0, used0) & ~np.isin(idx1, used1))])


def plausible(found: Found, side0: Side, side1: Side, prediction: Prediction) -> BoolArray:
    """Whether each match (N,) of costs 1 - probability agrees enough with its line, the places and the size predicted.

    The odds stand where `around` has the looks.
    """
    idx0 = side0.features.descriptor_keypoint_idx[found.rows]
    idx1 = side1.features.descriptor_keypoint_idx[found.columns]
    line, place, size = disagreements(side0, side1, idx0, idx1, prediction)
    probability = np.clip(1.0 - found.costs, 1e-6, 1.0 - 1e-6)
    odds = np.log(probability / (1.0 - probability))
    return np.asarray(line**2 + (place / _PLACE_SLACK) ** 2 + (size / _SIZE_SLACK) ** 2 - odds <= _LARGEST_KEPT)


def disagreements(
    side0: Side, side1: Side, idx0: IntArray, idx1: IntArray, prediction: Prediction
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of keypoint pairs (N,) with epipolar line, nearest predicted place, predicted size: standard deviations (N,)."""
    errors_px = sampson_distance_px(prediction.model.pixel_model, side0.places_px[idx0], side1.places_px[idx1])
    apart_px = np.linalg.norm(prediction.places_px[idx0] - side1.places_px[idx1][:, None], axis=2)
    apart_px = np.where(np.isfinite(apart_px), apart_px, np.inf).min(axis=1)
    line_px = _LINE_PX * np.sqrt((side0.units_px[idx0] ** 2 + side1.units_px[idx1] ** 2) / 2.0)
    place_px = _PLACE_PX * side1.units_px[idx1]
    steps = _octaves(side0, side1, idx0, idx1) - prediction.octaves[idx0]
    return errors_px / line_px, apart_px / place_px, steps / _SIZE_OCTAVES


def side_of(features: Features, camera: Camera) -> Side:
    """Needs the descriptors of a keypoint side by side, as extractors write them."""
    count = np.bincount(features.descriptor_keypoint_idx, minlength=len(features.keypoints_px))
    first = np.cumsum(count) - count
    units_px = np.ones(len(count))
    described = np.flatnonzero(count)
    units_px[described] = features.sizes_px[described] / features.view_size_px[first[described]]
    return Side(features, undistort(camera, features.keypoints_px), first, count, np.maximum(units_px, 1.0))


def predicted(
    side0: Side, side1: Side, idx0: IntArray, idx1: IntArray, model: TwoView, geometry: PairGeometry
) -> Prediction:
    """What matches idx0, idx1 (M,) of a model predict."""
    from scipy.spatial import cKDTree

    usable = np.flatnonzero(np.isfinite(side0.places_px).all(axis=1))
    count = min(_NEIGHBOURS + 1, len(idx0))
    known0, known1 = side0.places_px[idx0], side1.places_px[idx1]
    nearest = np.zeros((len(side0.places_px), count), np.int64)
    nearest[usable] = cKDTree(known0).query(side0.places_px[usable], k=count)[1].reshape(-1, count)
    # No match confirms itself: it goes last, and the last one is dropped.
    itself = idx0[nearest] == np.arange(len(nearest))[:, None]
    nearest = np.take_along_axis(nearest, np.argsort(itself, axis=1, kind="stable"), axis=1)[:, :-1]
    pose = geometry.pose0
    up = None if pose is None or pose.world_rotation is None else np.asarray(pose.world_rotation)[:, 2]
    stereo = stereo_of(model.model, np.asarray(model.rotation), geometry.camera0, geometry.camera1, up)
    inverse = inverse_depths(stereo, known0, known1)
    places_px = places_of_heights(stereo, side0.places_px, known0[nearest], inverse[nearest])
    steps = _octaves(side0, side1, idx0, idx1)
    return Prediction(model, places_px, np.median(steps[nearest], axis=1))


def _octaves(side0: Side, side1: Side, idx0: IntArray, idx1: IntArray) -> FloatArray:
    """Size of keypoints of image 1 over those of image 0, (N,) as logarithms to base 2."""
    return np.asarray(np.log2(side1.features.sizes_px[idx1].astype(np.float64) / side0.features.sizes_px[idx0]))


def around(side0: Side, side1: Side, prediction: Prediction, comparable: BoolArray, wrong: float) -> Found:
    """Mutually best matches near the predicted places and sizes, by the sum of what disagrees.

    Both keypoints must be each other's nearest in looks, too, among all that lie about there.
    """
    farthest_px = _RIVALS * _PLACE_PX * np.sqrt(_LARGEST_COST) * float(side1.units_px.max(initial=1.0))
    idx0, idx1 = nearby(prediction.places_px, side1.places_px, farthest_px)
    line, place, size = disagreements(side0, side1, idx0, idx1, prediction)
    about = line <= _RIVALS * np.sqrt(_LARGEST_COST)
    idx0, idx1, costs = idx0[about], idx1[about], (line**2 + place**2 + size**2)[about]
    distances, rows, columns = closest(side0, side1, idx0, idx1, comparable)
    costs = costs + (distances / (_LOOK * wrong)) ** 2
    best = (costs <= _LARGEST_COST) & is_cheapest(idx0, costs) & is_cheapest(idx1, costs)
    best &= is_cheapest(idx0, distances) & is_cheapest(idx1, distances)
    return Found(rows[best], columns[best], costs[best] / _LARGEST_COST)


def nearby(places_px: FloatArray, points1_px: FloatArray, radius_px: float) -> tuple[IntArray, IntArray]:
    """Row of places (N, Q, 2) and point of (M, 2) of all that are closer than the radius, each once, sorted.

    Points are sorted by square cells of twice the radius, row by row: what is near a place lies in two runs of them.
    """
    row, column = np.nonzero(np.isfinite(places_px).all(axis=2))
    usable = np.flatnonzero(np.isfinite(points1_px).all(axis=1))
    if not len(row) or not len(usable):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    origin, side = points1_px[usable].min(axis=0) - 2.0 * radius_px, 2.0 * radius_px
    shape = np.floor((points1_px[usable].max(axis=0) - origin) / side).astype(np.int64) + 2

    def cells(points_px: FloatArray) -> IntArray:
        return np.asarray(np.clip(np.floor((points_px - origin) / side), -1, shape), np.int64)

    codes = cells(points1_px[usable]) @ [1, shape[0]]
    order = np.argsort(codes, kind="stable")
    codes, usable = codes[order], usable[order]
    places = places_px[row, column]
    low, high = cells(places - radius_px), cells(places + radius_px)
    found = []
    for lines in (low[:, 1], high[:, 1]):
        first = np.searchsorted(codes, np.maximum(low[:, 0], 0) + lines * shape[0], side="left")
        last = np.searchsorted(codes, np.minimum(high[:, 0], shape[0] - 1) + lines * shape[0], side="right")
        lengths = np.maximum(last - first, 0)
        queries = np.repeat(np.arange(len(row)), lengths)
        at = np.arange(len(queries)) - np.repeat(np.cumsum(lengths) - lengths, lengths) + first[queries]
        near = ((places[queries] - points1_px[usable[at]]) ** 2).sum(axis=1) <= radius_px**2
        found.append(row[queries[near]] * len(points1_px) + usable[at[near]])
    code = np.unique(np.concatenate(found))
    return code // len(points1_px), code % len(points1_px)


def closest(
    side0: Side, side1: Side, idx0: IntArray, idx1: IntArray, comparable: BoolArray
) -> tuple[FloatArray, IntArray, IntArray]:
    """Smallest descriptor distance (N,) of keypoint pairs over comparable views (infinite without any) and
    the descriptors (N,), (N,) of it."""
    distance, row, column = np.full(len(idx0), np.inf), np.zeros(len(idx0), np.int64), np.zeros(len(idx0), np.int64)
    widest = int((side0.count[idx0] * side1.count[idx1]).max(initial=0))
    for k in range(widest):
        # The k-th combination of both keypoints' descriptors, of the pairs that have so many.
        at = np.flatnonzero(side0.count[idx0] * side1.count[idx1] > k)
        d0 = side0.first[idx0[at]] + k // side1.count[idx1[at]]
        d1 = side1.first[idx1[at]] + k % side1.count[idx1[at]]
        allowed = comparable[side0.features.view_idx[d0], side1.features.view_idx[d1]]
        at, d0, d1 = at[allowed], d0[allowed], d1[allowed]
        measured = descriptor_distances(side0.features, side1.features, d0, d1)
        nearer = measured < distance[at]
        at = at[nearer]
        distance[at], row[at], column[at] = measured[nearer], d0[nearer], d1[nearer]
    return distance, row, column


def descriptor_distances(features0: Features, features1: Features, rows: IntArray, columns: IntArray) -> FloatArray:
    """Euclidean distances (N,) of descriptors."""
    squared = np.empty(len(rows))
    for start in range(0, len(rows), _CHUNK):
        part = slice(start, start + _CHUNK)
        apart = features0.descriptors[rows[part]].astype(np.float32)
        apart -= features1.descriptors[columns[part]]
        squared[part] = np.einsum("ij,ij->i", apart, apart)
    return np.sqrt(squared)


def distance_of_wrong_pairs(side0: Side, side1: Side, comparable: BoolArray) -> float:
    """Descriptor distance below which one in fifty random keypoint pairs lies: similarity by chance in this pair."""
    count0, count1 = len(side0.count), len(side1.count)
    if not min(count0, count1):
        return 0.0
    rng = np.random.default_rng(0)
    draws = [rng.integers(0, count, _DRAWS) for count in (count0, count1)]
    distances, _, _ = closest(side0, side1, draws[0], draws[1], comparable)
    known = distances[np.isfinite(distances)]
    return float(np.quantile(known, _CHANCE)) if len(known) else 0.0


def is_cheapest(groups: IntArray, costs: FloatArray) -> BoolArray:
    """Whether each (N,) is the first of the cheapest of its group."""
    order = np.lexsort((costs, groups))
    flags = np.zeros(len(order), dtype=bool)
    flags[order] = is_first(groups[order])
    return flags
