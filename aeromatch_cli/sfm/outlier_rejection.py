"""Outlier rejection finds verified matches that contradict the adjusted block.

Repeated patterns (facades, roof tiles, rows of plants) pass every test of two views when the repetition runs along the
epipolar lines, or the geometry of the pair was itself estimated from such matches. The adjusted block knows better: it
holds the pair's geometry from all images, and a point that two images see has its place in every third one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import AdjustedBlock, BoolArray, Camera, FloatArray, IntArray
from aeromatch_cli.geometry.cameras import focal_px, world_rays
from aeromatch_cli.geometry.components import component_labels
from aeromatch_cli.geometry.epipolar import ray_depths
from aeromatch_cli.sfm.probability import (
    MatchEvidence,
    least_probability,
    off_neighbours_px,
    probabilities,
    probable_enough,
    usual_off_px,
)

# Rays that meet at a smaller angle do not tell whether they meet in front of the cameras.
_LEAST_ANGLE_DEG = 0.5
# An image with a larger share of contradicting matches is held in a wrong place: where facades repeat, a tenth of the
# matches of an image in its right place contradict.
_MANY = 0.3
# Images in wrong places are taken out in so many rounds at most.
_MOST_ROUNDS = 10
# Standard deviation of a keypoint, pixels: the place of a point along its ray is as uncertain as this makes it.
_KEYPOINT_PX = 1.0
# A keypoint of a third image confirms a match that near to the place of the point there.
_CONFIRMING_PX = 1.0


@dataclass(frozen=True)
class Limits:
    """When a match contradicts the block.

    epipolar_px: distance from its epipolar line. medians: in a pair whose median distance times this is larger, that
    counts: an image that the block holds less exactly than others has larger distances in all of its matches. third_px:
    distance of a third image's keypoint from the place of the point there; where the rays leave that place open by more
    than a pixel, it grows with that. min_probability: a match that is less likely to be right counts as contradicting
    unless images would fall apart by that, and so are the least likely ones where a smaller share than
    min_expected_right of the others would be right; 0 for never. most_given_up: a larger share is not dropped for that.
    min_matches: a pair with fewer ties nothing.
    """

    epipolar_px: float
    medians: float
    third_px: float
    min_probability: float = 0.0
    min_expected_right: float = 0.0
    most_given_up: float = 1.0
    min_matches: int = 15

    @property
    def by_probability(self) -> bool:
        """Whether it is asked how likely matches are to be right."""
        return max(self.min_probability, self.min_expected_right) > 0.0


@dataclass(frozen=True, eq=False)
class Contradictions:
    """Holds what contradicts the block.

    masks: of every pair, which matches (M,) do, or are not likely to be right. by_distance: number of those that do.
    doubtful: image ids whose adjusted poses too many of their matches contradict: there the block is wrong, and none of
    their matches counts as contradicting. expected_right: the share of the matches left that is right to 3 pixels, by
    their probabilities; None where the block judges none.
    """

    masks: list[BoolArray]
    by_distance: int
    doubtful: list[str]
    expected_right: float | None


@dataclass(frozen=True, eq=False)
class MatchedKeypoints:
    """Verified matches of two images: keypoint indices (M, 2) and the matcher's scores (M,). alone: both images placed
    by these matches, for where the block does not hold them; None where that is not known."""

    image_id0: str
    image_id1: str
    indices: IntArray
    scores: FloatArray
    alone: AdjustedBlock | None = None


def contradicting(
    block: AdjustedBlock,
    cameras: Mapping[str, Camera],
    keypoints_px: Callable[[str], FloatArray],
    pairs: Sequence[MatchedKeypoints],
    limits: Limits,
) -> Contradictions:
    """Find the matches that contradict the block; none in pairs of images that it does not hold together.

    cameras: image_id -> adjusted camera. A match contradicts the block where it lies beside the epipolar line, where
    its rays meet behind a camera, or where more of the keypoints that its two keypoints are matched with in third
    images lie beside the place of its point there than lie on it; see also `Limits`. Groups of images that no point
    connects have a frame each, less exact than matches: pairs between them are not judged. Of a pair that comes with
    its own geometry, as the block lacks one of its images, the matches are judged by that.
    """
    settled = Settled.of(block, cameras, keypoints_px, pairs, limits)
    masks: list[BoolArray | None] = settled.masks
    if limits.by_probability:
        masks, known = settled.with_lone_pairs(cameras, keypoints_px, limits)
    else:
        known = settled.evidence()
    found = [
        np.zeros(len(pair.indices), dtype=bool) if mask is None else mask.copy()
        for pair, mask in zip(pairs, masks, strict=True)
    ]
    by_distance = sum(int(mask.sum()) for mask in found)
    usual_px = usual_off_px(evidence for evidence in known if evidence is not None)
    likely = [None if evidence is None else probabilities(evidence, usual_px) for evidence in known]
    if limits.by_probability:
        ends = [(pair.image_id0, pair.image_id1) for pair in pairs]
        least = least_probability(likely, limits.min_probability, limits.min_expected_right, limits.most_given_up)
        stays = probable_enough(ends, likely, least, limits.min_matches)
        for n, (mask, p, keep) in enumerate(zip(found, likely, stays, strict=True)):
            if p is not None and keep is not None:
                mask[~mask] = ~keep
                likely[n] = p[keep]
    judged = np.concatenate([np.zeros(0), *(p for p in likely if p is not None)])
    expected_right = float(judged.mean()) if len(judged) else None
    return Contradictions(found, by_distance, sorted(settled.doubtful), expected_right)


@dataclass(frozen=True, eq=False)
class Settled:
    """Holds what contradicts the block by distances alone, once images in wrong places are left out.

    view: the block's rays. masks: of every pair, which matches (M,) contradict the block, None where it is not judged.
    """

    view: _Rays
    pairs: Sequence[MatchedKeypoints]
    masks: list[BoolArray | None]
    doubtful: set[str]

    @classmethod
    def of(
        cls,
        block: AdjustedBlock,
        cameras: Mapping[str, Camera],
        keypoints_px: Callable[[str], FloatArray],
        pairs: Sequence[MatchedKeypoints],
        limits: Limits,
    ) -> Settled:
        """Arguments as of `contradicting`."""
        group, doubtful = _groups(block), set[str]()
        view = _Rays.of(block, cameras, keypoints_px, sorted(group.keys() & _images(pairs)))
        for _ in range(_MOST_ROUNDS):
            masks = _masks(view, pairs, limits, group)
            worse = _worst_held(pairs, masks)
            if not worse:
                return cls(view, pairs, masks, doubtful)
            doubtful |= worse
            group = {image_id: number for image_id, number in group.items() if image_id not in worse}
        # So many images in wrong places: the block itself is no judge.
        return cls(view, pairs, [None] * len(pairs), doubtful)

    def with_lone_pairs(
        self, cameras: Mapping[str, Camera], keypoints_px: Callable[[str], FloatArray], limits: Limits
    ) -> tuple[list[BoolArray | None], list[MatchEvidence | None]]:
        """masks and `evidence` of all pairs; those that the block lacks are judged by their own geometry."""
        masks, known = list(self.masks), self.evidence()
        for n, pair in enumerate(self.pairs):
            if masks[n] is None and pair.alone is not None and len(pair.indices):
                own = Settled.of(pair.alone, cameras, keypoints_px, [pair], replace(limits, epipolar_px=np.inf))
                masks[n], known[n] = own.masks[0], own.evidence()[0]
        return masks, known

    def evidence(self) -> list[MatchEvidence | None]:
        """Return, for every pair, what tells how probable those of its matches are that do not contradict the block, by
        each other alone; None where there are none."""
        kept = [
            None
            if mask is None or mask.all()
            else replace(pair, indices=pair.indices[~mask], scores=pair.scores[~mask])
            for pair, mask in zip(self.pairs, self.masks, strict=True)
        ]
        ends = [None if pair is None else self.view.keypoints_of(pair) for pair in kept]
        ties = _Ties.of(len(self.view.rays), [both for both in ends if both is not None])
        return [
            None if pair is None or both is None else _of_pair(self.view, ties, *both, pair.scores)
            for pair, both in zip(kept, ends, strict=True)
        ]


def _images(pairs: Sequence[MatchedKeypoints]) -> set[str]:
    return {image_id for pair in pairs for image_id in (pair.image_id0, pair.image_id1)}


def _masks(
    view: _Rays, pairs: Sequence[MatchedKeypoints], limits: Limits, group: Mapping[str, int]
) -> list[BoolArray | None]:
    """Return, for every pair, which matches (M,) contradict the block; None where it is not judged. group: of the
    images that are."""
    held = [p.image_id0 in group and group[p.image_id0] == group.get(p.image_id1) for p in pairs]
    ends = {n: view.keypoints_of(pair) for n, pair in enumerate(pairs) if held[n]}
    ties = _Ties.of(len(view.rays), list(ends.values()))
    masks: list[BoolArray | None] = [None] * len(pairs)
    for n, both in ends.items():
        masks[n] = _judged(view, ties, *both, limits)
    return masks


def _worst_held(pairs: Sequence[MatchedKeypoints], masks: Sequence[BoolArray | None]) -> set[str]:
    """Images too many of whose matches contradict the block, where none of those that they are paired with is worse."""
    wrong, whole = Counter[str](), Counter[str]()
    for pair, mask in zip(pairs, masks, strict=True):
        if mask is None:
            continue
        for image_id in (pair.image_id0, pair.image_id1):
            wrong[image_id] += int(mask.sum())
            whole[image_id] += len(mask)
    share = {image_id: wrong[image_id] / count for image_id, count in whole.items() if count}
    bad = {image_id for image_id, value in share.items() if value > _MANY}
    better = set()
    for pair in pairs:
        ends = pair.image_id0, pair.image_id1
        if bad.issuperset(ends):
            better.add(min(ends, key=lambda image_id: (share[image_id], image_id)))
    return bad - better


def _groups(block: AdjustedBlock) -> dict[str, int]:
    """image_id -> number of its group: images that points connect."""
    ids = sorted(block.poses)
    tracks = [block.tracks.get(i, np.zeros((0, 2), np.int32))[:, 1] for i in ids]
    rows = np.repeat(np.arange(len(ids)), [len(one) for one in tracks])
    points = np.concatenate([np.zeros(0, np.int64), *tracks])
    labels = component_labels(len(ids) + len(block.points_m), np.column_stack([rows, len(ids) + points]))
    return dict(zip(ids, labels[: len(ids)].tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class _Rays:
    """Holds the rays of all keypoints of the block in one row. rays: (K, 3) in the world; image: (K,) rows of centers_m
    (N, 3) and focal_px (N,). first: image_id -> its first keypoint."""

    rays: FloatArray
    image: IntArray
    centers_m: FloatArray
    focal_px: FloatArray
    first: Mapping[str, int]

    @classmethod
    def of(
        cls,
        block: AdjustedBlock,
        cameras: Mapping[str, Camera],
        keypoints_px: Callable[[str], FloatArray],
        image_ids: Sequence[str],
    ) -> _Rays:
        rays = [world_rays(cameras[i], block.poses[i].rotation, np.asarray(keypoints_px(i), float)) for i in image_ids]
        for image_id, one in zip(image_ids, rays, strict=True):
            # What the adjusted lens shows nowhere lies behind its camera: it contradicts whatever it is matched with.
            one[~np.isfinite(one).all(axis=1)] = -block.poses[image_id].rotation[2]
        counts = [len(one) for one in rays]
        return cls(
            rays=np.concatenate([np.zeros((0, 3)), *rays]),
            image=np.repeat(np.arange(len(image_ids)), counts),
            centers_m=np.array([block.poses[i].center_m for i in image_ids]).reshape(-1, 3),
            focal_px=np.array([focal_px(cameras[i]) for i in image_ids]),
            first=dict(zip(image_ids, np.cumsum([0, *counts]).tolist(), strict=False)),
        )

    def keypoints_of(self, pair: MatchedKeypoints) -> tuple[IntArray, IntArray]:
        """(M,) keypoints of either image, as rows of the block."""
        return (
            pair.indices[:, 0].astype(np.int64) + self.first[pair.image_id0],
            pair.indices[:, 1].astype(np.int64) + self.first[pair.image_id1],
        )


@dataclass(frozen=True, eq=False)
class _Ties:
    """Lists the keypoints that each keypoint is matched with: those from start[k] to start[k + 1]."""

    start: IntArray
    others: IntArray

    @classmethod
    def of(cls, keypoints: int, ends: Sequence[tuple[IntArray, IntArray]]) -> _Ties:
        here = np.concatenate([np.zeros(0, np.int64), *(end for both in ends for end in both)])
        there = np.concatenate([np.zeros(0, np.int64), *(end for both in ends for end in both[::-1])])
        order = np.argsort(here, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(here, minlength=keypoints))])
        return cls(start, there[order])

    def of_keypoints(self, keypoints: IntArray) -> tuple[IntArray, IntArray]:
        """(T,) rows of the keypoints (M,) asked for, and the keypoints that these are matched with."""
        counts = self.start[keypoints + 1] - self.start[keypoints]
        rows = np.repeat(np.arange(len(keypoints)), counts)
        within = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        return rows, self.others[self.start[keypoints][rows] + within]


@dataclass(frozen=True, eq=False)
class _Meeting:
    """Describes where the rays of matches (M,) of one pair meet.

    error_px, depth_m (along rays0), angle_rad: (M,). points_m, shifted_m: (M, 3) the points, and as far along rays0 as
    the error of a keypoint may put them.
    """

    error_px: FloatArray
    depth_m: FloatArray
    angle_rad: FloatArray
    points_m: FloatArray
    shifted_m: FloatArray

    @classmethod
    def of(cls, view: _Rays, ends0: IntArray, ends1: IntArray) -> _Meeting:
        image0, image1 = view.image[ends0[0]], view.image[ends1[0]]
        between_m = view.centers_m[image1] - view.centers_m[image0]
        rays0, rays1 = view.rays[ends0], view.rays[ends1]
        error_px = _epipolar_px(between_m, rays0, rays1, view.focal_px[image0], view.focal_px[image1])
        depth_m, angle_rad = _depths(between_m, rays0, rays1)
        shift_m = depth_m * _KEYPOINT_PX / (view.focal_px[image1] * np.maximum(angle_rad, 1e-6))
        points_m = view.centers_m[image0] + rays0 * depth_m[:, None]
        return cls(error_px, depth_m, angle_rad, points_m, points_m + rays0 * shift_m[:, None])

    @property
    def meet(self) -> BoolArray:
        return np.asarray(self.angle_rad > np.deg2rad(_LEAST_ANGLE_DEG))

    @property
    def behind(self) -> BoolArray:
        return self.meet & (self.depth_m <= 0.0)

    def in_third_images(
        self, view: _Rays, ties: _Ties, ends0: IntArray, ends1: IntArray, near_px: float
    ) -> tuple[IntArray, IntArray]:
        """(M,) with how many keypoints of third images either end is matched, and how many of these lie this near to
        the place of the point there: pixels, or shares of what the keypoints' error leaves open."""
        known, near = (np.zeros(len(ends0), dtype=np.int64) for _ in range(2))
        usable = self.meet & ~self.behind
        for ends, other in ((ends0, view.image[ends1[0]]), (ends1, view.image[ends0[0]])):
            rows, third = ties.of_keypoints(ends)
            judged = usable[rows] & (view.image[third] != other)
            rows, third = rows[judged], third[judged]
            open_px = np.maximum(_apart_px(view, third, self.points_m[rows], self.shifted_m[rows]), 1.0)
            np.add.at(known, rows, 1)
            np.add.at(near, rows, _away_px(view, third, self.points_m[rows]) / open_px <= near_px)
        return known, near


def _judged(view: _Rays, ties: _Ties, ends0: IntArray, ends1: IntArray, limits: Limits) -> BoolArray:
    """Return which matches (M,) of one pair contradict the block."""
    if not len(ends0):
        return np.zeros(0, dtype=bool)
    meeting = _Meeting.of(view, ends0, ends1)
    known, near = meeting.in_third_images(view, ties, ends0, ends1, limits.third_px)
    most_px = max(limits.epipolar_px, limits.medians * float(np.median(meeting.error_px)))
    return np.asarray((meeting.error_px > most_px) | meeting.behind | (2 * near < known))


def _of_pair(view: _Rays, ties: _Ties, ends0: IntArray, ends1: IntArray, scores: FloatArray) -> MatchEvidence:
    """Evidence of the matches (M,) of one pair, one at least."""
    meeting = _Meeting.of(view, ends0, ends1)
    _, confirming = meeting.in_third_images(view, ties, ends0, ends1, _CONFIRMING_PX)
    image0, image1 = view.image[ends0[0]], view.image[ends1[0]]
    side0, side1 = (view.centers_m[image0], view.rays[ends0]), (view.centers_m[image1], view.rays[ends1])
    heights_m = meeting.points_m[:, 2]
    return MatchEvidence(
        scores=np.asarray(scores, dtype=np.float64),
        error_px=meeting.error_px,
        confirming=confirming,
        off0_px=off_neighbours_px(*side0, *side1, heights_m, float(view.focal_px[image1])),
        off1_px=off_neighbours_px(*side1, *side0, heights_m, float(view.focal_px[image0])),
    )


def _epipolar_px(
    between_m: FloatArray, rays0: FloatArray, rays1: FloatArray, focal0_px: float, focal1_px: float
) -> FloatArray:
    """(M,) distance of matched rays from coplanarity with the base, shared between both images (Sampson), pixels."""
    normals0, normals1 = np.cross(between_m, rays0), np.cross(between_m, rays1)
    across = (rays1 * normals0).sum(axis=1)
    # Per pixel of either image the triple product changes by the length of the other's plane normal over f.
    per_px = np.hypot(np.linalg.norm(normals0, axis=1) / focal1_px, np.linalg.norm(normals1, axis=1) / focal0_px)
    return np.asarray(np.abs(across) / np.maximum(per_px, 1e-12))


def _depths(between_m: FloatArray, rays0: FloatArray, rays1: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(M,) distance along rays0 to where the rays meet, negative behind either camera, and the angle between them."""
    depth0, depth1, sine = ray_depths(between_m, rays0, rays1)
    return np.where(depth1 > 0.0, depth0, -np.abs(depth0)), np.arcsin(np.minimum(sine, 1.0))


def _away_px(view: _Rays, keypoints: IntArray, points_m: FloatArray) -> FloatArray:
    """(T,) how far keypoints lie from where their images see the points, pixels near the image's middle."""
    there = _towards(view, keypoints, points_m)
    away = np.linalg.norm(np.cross(view.rays[keypoints], there), axis=1)
    facing = (view.rays[keypoints] * there).sum(axis=1) > 0.0
    return np.asarray(np.where(facing, away, np.inf) * view.focal_px[view.image[keypoints]])


def _apart_px(view: _Rays, keypoints: IntArray, points_m: FloatArray, others_m: FloatArray) -> FloatArray:
    """(T,) how far apart the images of the keypoints see two points, pixels."""
    turned = np.cross(_towards(view, keypoints, points_m), _towards(view, keypoints, others_m))
    return np.asarray(np.linalg.norm(turned, axis=1) * view.focal_px[view.image[keypoints]])


def _towards(view: _Rays, keypoints: IntArray, points_m: FloatArray) -> FloatArray:
    """(T, 3) unit vectors from the images of keypoints to points."""
    ways = points_m - view.centers_m[view.image[keypoints]]
    return np.asarray(ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12))
