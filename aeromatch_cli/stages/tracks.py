"""Multi-view tracks of points that were measured without a detector.

A grid point of an image and its measurements in others are one track. Exporters want keypoints: those of an image
become its grid and then what others measured in it. Where a measurement falls on a grid point, or on another
image's measurement, both are one keypoint if all that is known of their tracks agrees; and what two images measured of
the same track is a match of theirs too, where the pair's model says so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import BoolArray, Camera, FloatArray, IntArray, Matches, Pair
from aeromatch_cli.formats.rows import VerifiedEntry
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.epipolar import fundamental, sampson_distance_px

SAME_PX = 0.5  # keypoints of an image that are nearer may be one
_AGREE_PX = 1.0  # what two tracks see in any image, if they are one
# Matches that follow from a track may be so far from the pair's model: measured twice, they are less exact than one.
_LARGEST_ERROR_PX = 2.0


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """A pair with its matches before any filter and what the filters said."""

    pair: Pair
    raw: Matches
    verified: VerifiedEntry

    @property
    def kept(self) -> BoolArray:
        """(M,) which of the raw matches the filters kept: a grid point is measured once in a pair."""
        raw, kept = self.raw.indices, self.verified.matches.indices
        forward = np.isin(raw[:, 0], kept[kept[:, 1] < 0, 0])
        return np.where(raw[:, 1] < 0, forward, np.isin(raw[:, 1], kept[kept[:, 0] < 0, 1]))


@dataclass(frozen=True, eq=False)
class Tracks:
    """keypoints_px: image_id -> (K, 2) float32 stored pixels. raw, verified: (image_id0, image_id1) -> (M, 2) int32."""

    keypoints_px: Mapping[str, FloatArray]
    raw: Mapping[tuple[str, str], IntArray]
    verified: Mapping[tuple[str, str], IntArray]


def tracks_of(
    pairs: Sequence[MatchedPair], grid_px: Callable[[str], FloatArray], camera_of: Callable[[str], Camera]
) -> Tracks:
    """Return the tracks of pairs whose matches lead from a keypoint of one image to a place in the other."""
    table = _Table()
    for item in pairs:
        table.add_image(item.pair.image_id0, grid_px)
        table.add_image(item.pair.image_id1, grid_px)
    numbered = [table.number(item) for item in pairs]
    table.join()
    verified = {
        (item.pair.image_id0, item.pair.image_id1): table.matches_of(item, own, camera_of)
        for item, own in zip(pairs, numbered, strict=True)
    }
    raw = {
        (item.pair.image_id0, item.pair.image_id1): np.unique(table.standing_pairs(item, own), axis=0).astype(np.int32)
        for item, own in zip(pairs, numbered, strict=True)
    }
    return Tracks({name: table.places(name).astype(np.float32) for name in table.sizes}, raw, verified)


class _Table:
    """Keypoints of every image as they are numbered, and the track that each belongs to."""

    def __init__(self) -> None:
        self.sizes: dict[str, int] = {}
        self._places: dict[str, list[FloatArray]] = {}
        self._tracks: dict[str, list[IntArray]] = {}
        self._first: dict[str, int] = {}
        self._count = 0
        self._joined: dict[str, IntArray] = {}
        self._standing: dict[str, IntArray] = {}

    def add_image(self, image_id: str, grid_px: Callable[[str], FloatArray]) -> None:
        """Add an image's grid, every point a track of its own."""
        if image_id in self.sizes:
            return
        points = np.asarray(grid_px(image_id), np.float64)
        self.sizes[image_id], self._first[image_id] = len(points), self._count
        self._places[image_id] = [points]
        self._tracks[image_id] = [np.arange(self._count, self._count + len(points))]
        self._count += len(points)

    def number(self, item: MatchedPair) -> IntArray:
        """Keypoint numbers (M, 2) for the raw matches; measurements that are not verified belong to no track."""
        ids = item.pair.image_id0, item.pair.image_id1
        numbers = item.raw.indices.astype(np.int64)
        for side, measured in enumerate((item.raw.points0_px, item.raw.points1_px)):
            assert measured is not None
            image_id, other = ids[side], ids[1 - side]
            new = np.flatnonzero(item.raw.indices[:, side] < 0)
            numbers[new, side] = self.sizes[image_id] + np.arange(len(new))
            tracks = np.where(item.kept[new], self._first[other] + item.raw.indices[new, 1 - side], -1)
            self._places[image_id].append(measured[new])
            self._tracks[image_id].append(tracks)
            self.sizes[image_id] += len(new)
        return numbers

    def places(self, image_id: str) -> FloatArray:
        return np.concatenate(self._places[image_id])

    def join(self) -> None:
        """Make one of the tracks that meet in some image and agree in all; then one keypoint of theirs in each."""
        seen: dict[int, dict[str, FloatArray]] = {}
        for image_id in self.sizes:
            for track, place in zip(np.concatenate(self._tracks[image_id]), self.places(image_id), strict=True):
                if track >= 0:
                    seen.setdefault(int(track), {})[image_id] = place
        parent = {track: track for track in seen}
        for image_id in self.sizes:
            for first, second in self._meeting(image_id):
                roots = sorted((_root(parent, first), _root(parent, second)))
                if roots[0] != roots[1] and _agree(seen[roots[0]], seen[roots[1]]):
                    parent[roots[1]] = roots[0]
                    seen[roots[0]] = seen[roots[1]] | seen[roots[0]]
        roots_of = np.arange(self._count + 1)  # the last for keypoints of no track
        for track in parent:
            roots_of[track] = _root(parent, track)
        roots_of[-1] = -1
        for image_id in self.sizes:
            tracks = self._joined[image_id] = roots_of[np.concatenate(self._tracks[image_id])]
            standing = np.arange(len(tracks))
            _, index, inverse = np.unique(tracks, return_index=True, return_inverse=True)
            self._standing[image_id] = np.where(tracks >= 0, index[inverse], standing)

    def _meeting(self, image_id: str) -> list[tuple[int, int]]:
        """Tracks that pass the same place of an image."""
        from scipy.spatial import cKDTree

        tracks = np.concatenate(self._tracks[image_id])
        usable = np.flatnonzero(tracks >= 0)
        close = cKDTree(self.places(image_id)[usable]).query_pairs(SAME_PX, output_type="ndarray")
        return [(int(a), int(b)) for a, b in np.sort(tracks[usable][close], axis=1)]

    def standing(self, image_id: str, numbers: IntArray) -> IntArray:
        """The keypoint that stands for each."""
        return np.asarray(self._standing[image_id][numbers])

    def standing_pairs(self, item: MatchedPair, numbers: IntArray) -> IntArray:
        """(M, 2) of keypoint numbers (M, 2) of a pair."""
        ids = item.pair.image_id0, item.pair.image_id1
        return np.column_stack([self.standing(image_id, numbers[:, side]) for side, image_id in enumerate(ids)])

    def matches_of(self, item: MatchedPair, own: IntArray, camera_of: Callable[[str], Camera]) -> IntArray:
        """(M, 2) of a verified pair: what was measured, and what both images share of other tracks."""
        id0, id1 = item.pair.image_id0, item.pair.image_id1
        verdict = item.verified.verdict
        if verdict.state != "verified":
            return np.zeros((0, 2), np.int32)
        direct = self.standing_pairs(item, own[item.kept])
        side0, side1 = self._joined[id0], self._joined[id1]
        shared = np.intersect1d(side0[side0 >= 0], side1[side1 >= 0])
        found = [self._first_of(side, shared) for side in (side0, side1)]
        places = [self.places(image_id)[numbers] for image_id, numbers in zip((id0, id1), found, strict=True)]
        good = _on_model(verdict.model_kind, verdict.model, places, camera_of(id0), camera_of(id1))
        derived = np.column_stack([found[0], found[1]])[good]
        return np.unique(np.concatenate([direct, derived]), axis=0).astype(np.int32)

    @staticmethod
    def _first_of(tracks: IntArray, wanted: IntArray) -> IntArray:
        values, index = np.unique(tracks, return_index=True)
        return np.asarray(index[np.searchsorted(values, wanted)])


def _root(parent: dict[int, int], track: int) -> int:
    while parent[track] != track:
        parent[track] = parent[parent[track]]
        track = parent[track]
    return track


def _agree(first: Mapping[str, FloatArray], second: Mapping[str, FloatArray]) -> bool:
    """Return whether two tracks agree in every image that both are seen in."""
    return all(float(np.hypot(*(first[name] - second[name]))) <= _AGREE_PX for name in first.keys() & second.keys())


def _on_model(kind: str, model: FloatArray, places: Sequence[FloatArray], camera0: Camera, camera1: Camera) -> IntArray:
    """Return which matches lie on a pair's model; none where it is no epipolar one."""
    if kind not in ("E", "F") or not len(places[0]):
        return np.zeros(0, np.int64)
    matrix = fundamental(model, camera0, camera1) if kind == "E" else model
    errors = sampson_distance_px(matrix, undistort(camera0, places[0]), undistort(camera1, places[1]))
    return np.flatnonzero(errors <= _LARGEST_ERROR_PX)
