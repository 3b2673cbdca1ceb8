"""This module decides which focal lengths images and EXIF support, where those of a camera file cannot be right.

Given poses explain matches with the right focal length alone, unless all images look straight down on flat ground:
there any focal length goes with some flying height, and EXIF decides. A block that needs it: rendered farmland, flight
`cross`, with right poses and half the focal length, whose poses are kept by it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.geometry.cameras import MODELS, focal_px, undistort
from aeromatch_cli.geometry.epipolar import fundamental_from_poses, sampson_distance_px
from aeromatch_cli.sfm.epipolar_agreement import MIN_MATCHES, PairPoints

# Errors of matches are measured on so many pairs, spread over the block, and so many matches of each.
_MOST_PAIRS, _MOST_MATCHES = 300, 200
# EXIF's focal length is taken where errors with it are larger by no more than this share.
_SAME = 0.05
# Another focal length than the one stated must make the errors smaller by this factor and this much (in units of an
# exact match's), and be off by this share.
_BETTER, _LEAST_GAIN, _LEAST_CHANGE = 0.8, 0.02, 0.05
# Focal lengths tried: so many octaves to either side, in these steps; the last is the accuracy.
_OCTAVES = 1.25
_STEPS = (0.25, 0.125, 0.0625, 0.03125, 0.015625)


def better_cameras(
    pairs: Sequence[PairPoints],
    poses: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    camera_ids: Mapping[str, str],
    thresholds_px: Mapping[str, float],
    likely_px: Mapping[str, float],
) -> dict[str, Camera]:
    """Return camera_id -> camera with another focal length, for those whose own cannot be right; most often none.

    poses: image_id -> given pose. cameras: by camera_id. camera_ids, thresholds_px (error of an exact match, stored
    pixels): by image_id. likely_px: camera_id -> focal length that EXIF speaks for, of cameras that contradict it.
    """
    likely = {k: with_focal_length(cameras[k], px) for k, px in likely_px.items()}
    ties = list(_posed(pairs, poses))

    def error(tried: Mapping[str, Camera]) -> float:
        return _mean_error(ties, poses, {i: tried[k] for i, k in camera_ids.items()}, thresholds_px)

    if not ties:
        return likely
    stated, changed = error(cameras), {**cameras, **likely}
    if likely and error(changed) <= (1.0 + _SAME) * stated:
        cameras = changed
    best, octaves = error(cameras), 0.0
    least = min(_BETTER * best, best - _LEAST_GAIN)
    for step in _STEPS:
        near = np.arange(-_OCTAVES, _OCTAVES + step, step) if step == _STEPS[0] else octaves + step * np.array([-1, 1])
        for tried in near:
            found = error(_scaled(cameras, 2.0 ** float(tried)))
            if found < best:
                best, octaves = found, float(tried)
        if step == _STEPS[0] and octaves == 0.0:
            break
    if best < least and abs(octaves) > np.log2(1.0 + _LEAST_CHANGE):
        return _scaled(cameras, 2.0**octaves)
    return {k: cameras[k] for k in likely} if cameras is changed else {}


def with_focal_length(camera: Camera, wanted_px: float) -> Camera:
    """Return the camera with another focal length, and what else it has."""
    factor = wanted_px / focal_px(camera)
    named = zip(MODELS[camera.model], camera.params, strict=True)
    params = tuple(value * factor if name in ("f", "fx", "fy", "b1", "b2") else value for name, value in named)
    return replace(camera, params=params)


def _scaled(cameras: Mapping[str, Camera], factor: float) -> dict[str, Camera]:
    return {k: with_focal_length(camera, factor * focal_px(camera)) for k, camera in cameras.items()}


def _posed(pairs: Sequence[PairPoints], poses: Mapping[str, Pose]) -> Iterator[PairPoints]:
    """Pairs of images that both have an attitude, without most of their matches."""
    known = {i for i, pose in poses.items() if pose.world_rotation is not None}
    ties = [p for p in pairs if {p.image_id0, p.image_id1} <= known and len(p.indices) >= MIN_MATCHES]
    for pair in ties[:: 1 + len(ties) // _MOST_PAIRS]:
        kept = slice(None, None, 1 + len(pair.indices) // _MOST_MATCHES)
        points0_px, points1_px = pair.points0_px[kept], pair.points1_px[kept]
        yield replace(pair, indices=pair.indices[kept], points0_px=points0_px, points1_px=points1_px)


def _mean_error(
    pairs: Sequence[PairPoints],
    poses: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
) -> float:
    """Return the mean Sampson distance of the matches of posed pairs in units of that of an exact match, at most 1
    each."""
    errors = []
    for pair, points0, points1 in zip(pairs, *_undistorted(pairs, cameras), strict=True):
        ids = pair.image_id0, pair.image_id1
        camera0, camera1 = (cameras[i] for i in ids)
        matrix = fundamental_from_poses(camera0, poses[ids[0]], camera1, poses[ids[1]])
        off_px = sampson_distance_px(matrix, points0, points1)
        errors.append(np.minimum(off_px / max(thresholds_px[i] for i in ids), 1.0))
    return float(np.concatenate(errors).mean())


def _undistorted(
    pairs: Sequence[PairPoints], cameras: Mapping[str, Camera]
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Points of all pairs in their first, and in their second images; those of one camera at once, which is quicker."""
    sides = [(pair.image_id0, pair.points0_px) for pair in pairs] + [(p.image_id1, p.points1_px) for p in pairs]
    found: list[FloatArray] = [points for _, points in sides]
    of_camera: dict[Camera, list[int]] = {}
    for k, (image_id, _) in enumerate(sides):
        of_camera.setdefault(cameras[image_id], []).append(k)
    for camera, own in of_camera.items():
        ends = np.cumsum([len(sides[k][1]) for k in own])[:-1]
        parts = np.split(undistort(camera, np.concatenate([sides[k][1] for k in own])), ends)
        for k, part in zip(own, parts, strict=True):
            found[k] = part
    return found[: len(pairs)], found[len(pairs) :]
