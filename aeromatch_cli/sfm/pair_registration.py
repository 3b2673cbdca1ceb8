"""Poses of images that the model lacks: by a pair and the given position or the ground, or as their strip predicts
them.

An image may hang on the oriented block by pairs without keypoints in common with others.

A pair tells the attitude of the second image and the direction to it, not the distance: mappers put such images
anywhere along that direction. The given position tells the distance; blocks that need it: every 2nd and every 3rd image
of lewis with positions (2 of 16 and 1 of 11 images). A weak model may itself lie beside its positions: then they tell
the distance from each other (every 4th image of seneca). Without a position the ground does: what the pair shows of it
is about as high as what the block shows beside it. Blocks that need it: every 4th image of seneca, lewis and ochota
without positions (2 of 7, 1 of 8, 3 of 10).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from aeromatch_cli.data import Block, Camera, FloatArray, Image, Pair, PairGeometry, Pose
from aeromatch_cli.geometry.rotations import angle_between_deg
from aeromatch_cli.geometry.two_view import Sampling, TwoView, estimate, undistorted
from aeromatch_cli.sfm.epipolar_agreement import EXPLAINED_SHARE, PairPoints, explained_share, triangulated

# Fewer matches do not tell an attitude. Of a pair that is verified there are so many; every 4th image of ochota needs
# 20 and 29.
_LEAST_MATCHES = 15
# A position lies beside the direction that the pair tells by at most so many standard deviations.
_SIGMAS = 3.0
# Where positions are as near to each other as they are exact, the images are this many standard deviations apart.
_NEAREST = 0.5
# Errors of exact matches, times this: the pose comes from one pair.
_SLACK = 3.0
# Standard deviation of the attitude, degrees.
_SIGMA_DEG = 1.0
# The height of the ground beside tells the distance: by the nearest third of the pair's matches, so many at least,
# where they agree to this share (median deviation). The ground beside a match is as high as so many points in the
# median.
_NEAREST_SHARE, _FEWEST_NEAREST, _MOST_SCATTER, _BESIDE = 0.33, 12, 0.15, 12
# The ground need not go on level from one to the other.
_LEAST_SCATTER = 0.05
# An image between two oriented ones of its strip is as they are; where these differ by more, the flight turned there.
_TURN_DEG = 30.0
# An aircraft's attitude changes by so much from one image to the next.
_LEAST_SIGMA_DEG = 5.0


def tied_by_pairs(
    pairs: Sequence[PairPoints],
    known: Mapping[str, Pose],
    given: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
) -> dict[str, tuple[Pose, str]]:
    """Return poses of further images, and the image that each was tied to.

    known: oriented images, in the frame of the given positions. given: image_id -> pose whose position counts, of known
    images, too. thresholds_px: by image_id, errors of exact matches in stored pixels. The pair with most matches comes
    first; what it ties is known from then on.
    """

    def placed(pair: PairPoints, poses: Mapping[str, Pose]) -> Pose | None:
        return _tied(pair, poses[pair.image_id0], given, cameras, thresholds_px)

    return _one_by_one(pairs, known, given.keys(), placed)


def tied_by_ground(
    pairs: Sequence[PairPoints],
    known: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
) -> dict[str, tuple[Pose, str]]:
    """Return poses of further images without positions, and the image that each was tied to.

    known: oriented images of one model, z upwards. Arguments otherwise as of `tied_by_pairs`.
    """
    inside = [p for p in pairs if {p.image_id0, p.image_id1} <= known.keys()]

    def placed(pair: PairPoints, poses: Mapping[str, Pose]) -> Pose | None:
        pose = _on_ground(pair, inside, poses, cameras, thresholds_px)
        if pose is not None:
            inside.append(pair)
        return pose

    return _one_by_one(pairs, known, {i for p in pairs for i in (p.image_id0, p.image_id1)}, placed)


def _one_by_one(
    pairs: Sequence[PairPoints],
    known: Mapping[str, Pose],
    wanted: Collection[str],
    placed: Callable[[PairPoints, Mapping[str, Pose]], Pose | None],
) -> dict[str, tuple[Pose, str]]:
    """Return poses of the images wanted that pairs tie, one after the other, and the image that each was tied to.

    placed: the pose of the second image of a pair whose first one is known, None where it cannot be tied.
    """
    poses = dict(known)
    found: dict[str, tuple[Pose, str]] = {}
    left = [p for p in pairs if len(p.indices) >= _LEAST_MATCHES and not {p.image_id0, p.image_id1} <= poses.keys()]
    left.sort(key=lambda p: -len(p.indices))
    while True:
        best = _best_tie(left, poses, wanted)
        if best is None:
            return found
        left = [p for p in left if {p.image_id0, p.image_id1} != {best.image_id0, best.image_id1}]
        pose = placed(best, poses)
        if pose is not None:
            poses[best.image_id1] = pose
            found[best.image_id1] = pose, best.image_id0


def _on_ground(
    pair: PairPoints,
    inside: Sequence[PairPoints],
    poses: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
) -> Pose | None:
    """Return the pose of the second image by the height of the ground that the first one shows in pairs `inside`."""
    known = poses[pair.image_id0]
    seen = [p for p in inside if pair.image_id0 in (p.image_id0, p.image_id1)]
    points_m = np.concatenate([np.zeros((0, 3)), *triangulated(seen, poses, cameras)])
    points_m = points_m[np.isfinite(points_m).all(axis=1)]
    view = relative_orientation(pair, cameras, thresholds_px)
    if view is None or view.rotation is None or len(points_m) < _FEWEST_NEAREST:
        return None
    assert known.world_rotation is not None
    rotation = view.rotation @ known.world_rotation
    for direction in directions(view.model, view.rotation, known.world_rotation):
        unit_m = Pose(known.center_m + direction, rotation, 0.0, _SIGMA_DEG)
        both = {pair.image_id0: known, pair.image_id1: unit_m}
        limits_px = {i: _SLACK * thresholds_px[i] for i in both}
        if explained_share(pair, both, cameras, limits_px) < EXPLAINED_SHARE:
            continue
        distance_m, scatter = _by_height(triangulated([pair], both, cameras)[0], points_m, known.center_m)
        if distance_m > 0.0 and scatter <= _MOST_SCATTER:
            sigma_m = max(scatter, _LEAST_SCATTER) * distance_m
            return replace(unit_m, center_m=known.center_m + distance_m * direction, sigma_position_m=sigma_m)
    return None


def _by_height(unit_m: FloatArray, points_m: FloatArray, center_m: FloatArray) -> tuple[float, float]:
    """Return the distance between two images and its scatter, as a share of it.

    unit_m: (M, 3) points of the pair with images one metre apart, NaN where the angle is too flat. points_m: (K, 3)
    points that the first image, at center_m (3,), sees beside them.
    """
    from scipy.spatial import cKDTree

    unit_m = unit_m[np.isfinite(unit_m).all(axis=1)] - center_m
    others_m = points_m - center_m
    rays, others = (way / np.linalg.norm(way, axis=1, keepdims=True) for way in (unit_m, others_m))
    if len(rays) < _FEWEST_NEAREST:
        return 0.0, np.inf
    apart, nearest = cKDTree(others).query(rays, k=_BESIDE)
    order = np.argsort(apart[:, -1], kind="stable")[: max(_FEWEST_NEAREST, round(_NEAREST_SHARE * len(rays)))]
    distances_m = np.median(others_m[nearest[order], 2], axis=1) / unit_m[order, 2]
    distance_m = float(np.median(distances_m))
    return distance_m, float(np.median(np.abs(distances_m / distance_m - 1.0))) if distance_m > 0.0 else np.inf


def _best_tie(pairs: Sequence[PairPoints], poses: Mapping[str, Pose], wanted: Collection[str]) -> PairPoints | None:
    """Return the first pair of a known image and one that is wanted, pairs with most matches first; the last by name
    of several alike."""
    best: PairPoints | None = None
    for pair in pairs:
        if best is not None and len(pair.indices) < len(best.indices):
            break
        if (pair.image_id0 in poses) == (pair.image_id1 in poses):
            continue
        tie = _from_known(pair, poses)
        later = best is None or (tie.image_id0, tie.image_id1) > (best.image_id0, best.image_id1)
        if tie.image_id1 in wanted and later:
            best = tie
    return best


def _from_known(pair: PairPoints, poses: Mapping[str, Pose]) -> PairPoints:
    """The pair with the known image first."""
    if pair.image_id0 in poses:
        return pair
    return PairPoints(pair.image_id1, pair.image_id0, pair.points1_px, pair.points0_px, pair.indices[:, ::-1])


def _tied(
    pair: PairPoints,
    known: Pose,
    given: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
) -> Pose | None:
    """Pose of the second image, None where its position or the matches contradict it."""
    assert known.world_rotation is not None
    ends, view = (pair.image_id0, pair.image_id1), relative_orientation(pair, cameras, thresholds_px)
    if view is None or view.rotation is None:
        return None
    rotation = view.rotation @ known.world_rotation
    limits_px = {i: _SLACK * thresholds_px[i] for i in ends}
    for direction in directions(view.model, view.rotation, known.world_rotation):
        center_m = _along(known, given[ends[1]], direction)
        if center_m is None and ends[0] in given:
            center_m = _apart(known, given[ends[0]], given[ends[1]], direction)
        if center_m is None:
            continue
        pose = replace(given[ends[1]], center_m=center_m, world_rotation=rotation, sigma_angle_deg=_SIGMA_DEG)
        both = {ends[0]: known, ends[1]: pose}
        if explained_share(pair, both, cameras, limits_px) >= EXPLAINED_SHARE:
            return pose
    return None


def relative_orientation(
    pair: PairPoints, cameras: Mapping[str, Camera], thresholds_px: Mapping[str, float]
) -> TwoView | None:
    """Relative orientation of a pair, None where too few of its matches agree on one."""
    ends = pair.image_id0, pair.image_id1
    geometry = PairGeometry(Pair(*ends, np.nan, np.nan, ""), cameras[ends[0]], cameras[ends[1]], None, None, None)
    points0, points1, _ = undistorted(pair.points0_px, pair.points1_px, geometry)
    if len(points0) < _LEAST_MATCHES:
        return None
    sampling = Sampling(min(thresholds_px[i] for i in ends))
    view = estimate(points0, points1, geometry, "relative_pose", sampling, 0)
    held = view.rotation is not None and view.inliers.sum() >= EXPLAINED_SHARE * len(points0)
    return view if held else None


def directions(model: FloatArray, rotation: FloatArray, known: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors in the world, one of them from the known centre to the other, of an essential matrix [t]x R."""
    crossed = model @ rotation.T
    t = np.array([crossed[2, 1], crossed[0, 2], crossed[1, 0]])
    way = -known.T @ rotation.T @ (t / np.linalg.norm(t))
    return way, -way


def _along(known: Pose, given: Pose, direction: FloatArray) -> FloatArray | None:
    """The place on a ray from the known centre that is nearest to the given position, None where that lies beside."""
    return _reached(known, given.center_m - known.center_m, given.sigma_position_m, direction)


def _apart(known: Pose, given0: Pose, given1: Pose, direction: FloatArray) -> FloatArray | None:
    """The place on a ray from the known centre as far away as two given positions are apart, None where the way between
    them has another direction."""
    sigma_m = float(np.hypot(given0.sigma_position_m, given1.sigma_position_m))
    return _reached(known, given1.center_m - given0.center_m, sigma_m, direction)


def _reached(known: Pose, ahead_m: FloatArray, sigma_m: float, direction: FloatArray) -> FloatArray | None:
    distance_m, limit_m = float(ahead_m @ direction), _SIGMAS * sigma_m
    if distance_m < -limit_m or float(np.linalg.norm(ahead_m - distance_m * direction)) > limit_m:
        return None
    return np.asarray(known.center_m + max(distance_m, _NEAREST * sigma_m) * direction)


def predicted(block: Block, found: Mapping[str, Pose]) -> dict[str, Pose]:
    """Return poses of images outside `found` that have a position, from the nearest images before and after in their
    strip.

    A strip is the images of one camera in the order of capture time, or of name where times are missing. The attitude
    is that between both neighbours, its standard deviation the angle between them; no attitude where the flight turns
    or there is no neighbour on either side.
    """
    poses = {}
    for strip in _strips(block.images):
        oriented = [row for row, image in enumerate(strip) if image.image_id in found]
        for row, image in enumerate(strip):
            given, behind = block.poses.get(image.image_id), bisect_left(oriented, row)
            if given is None or image.image_id in found or not 0 < behind < len(oriented):
                continue
            rotations = [found[strip[oriented[k]].image_id].world_rotation for k in (behind - 1, behind)]
            pose = _between(given, *rotations)
            if pose is not None:
                poses[image.image_id] = pose
    return poses


def _strips(images: Sequence[Image]) -> list[list[Image]]:
    """Return the images of every camera in the order of capture time, or of name where times are missing."""
    strips = []
    for camera_id in sorted({image.camera_id for image in images}):
        strip = [image for image in images if image.camera_id == camera_id]
        timed = all(image.time for image in strip)
        strip.sort(key=lambda image: ((image.time or "") if timed else "", image.name))
        strips.append(strip)
    return strips


def _between(given: Pose, before: FloatArray | None, behind: FloatArray | None) -> Pose | None:
    """Return the given pose with the attitude between those of both neighbours, (3, 3) cam_from_world; None where one
    is unknown or the flight turns."""
    from scipy.spatial.transform import Rotation

    if before is None or behind is None:
        return None
    apart_deg = angle_between_deg(before, behind)
    if apart_deg > _TURN_DEG:
        return None
    middle = Rotation.from_matrix(np.array([before, behind])).mean().as_matrix()
    return replace(given, world_rotation=middle, sigma_angle_deg=max(_LEAST_SIGMA_DEG, apart_deg))
