"""Poses of single images by resection: from points that images of known pose see.

A block that needs it: rendered farmland, flight `cross`, every third attitude wrong (10 of 16 right without it).
Source: PoseLib (Larsson, https://github.com/PoseLib/PoseLib), P3P in LO-RANSAC with non-linear refinement.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, IntArray, Pose
from aeromatch_cli.geometry.cameras import poselib_camera, undistort, without_skew
from aeromatch_cli.sfm.epipolar_agreement import PairPoints, triangulated

_MIN_POINTS = 12
_MIN_SHARE = 0.3


def resected(
    pairs: Sequence[PairPoints],
    known: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
    sigmas: tuple[float, float],
) -> dict[str, Pose]:
    """Return poses of images that are not known, as many as points tie to the known ones or, through them, to others.

    cameras: by image_id. thresholds_px: by image_id, the largest error of an inlier in stored pixels. sigmas: of the
    poses found, metres and degrees. The image with most inliers comes first and is known from then on.
    """
    poses, found = dict(known), dict[str, Pose]()
    waiting = sorted({i for pair in pairs for i in (pair.image_id0, pair.image_id1)} - poses.keys())
    if not waiting:
        return found
    seen = _PointsSeen(pairs, poses, cameras)
    failed: dict[str, int] = {}
    ties = {i: seen.ties(i, poses) for i in waiting}
    while waiting:
        order = sorted(waiting, key=lambda i: (-len(ties[i][0]), i))
        best = next((i for i in order if len(ties[i][0]) > max(failed.get(i, 0), _MIN_POINTS - 1)), None)
        if best is None:
            return found
        pose = _resection(*ties[best], cameras[best], thresholds_px[best], sigmas)
        if pose is None:
            failed[best] = len(ties[best][0])  # again only with more points
            continue
        poses[best] = found[best] = pose
        waiting.remove(best)
        ties |= {i: seen.ties(i, poses) for i in seen.add(best, poses).intersection(waiting)}
    return found


class _PointsSeen:
    """World points by image and keypoint: the median over the pairs of known images that see it.

    Of images alone that share a pair with one that is not known at first: in a large block these are few.
    """

    def __init__(self, pairs: Sequence[PairPoints], poses: Mapping[str, Pose], cameras: Mapping[str, Camera]) -> None:
        self._cameras = cameras
        self._of: dict[str, list[PairPoints]] = {}
        for pair in pairs:
            for image_id in (pair.image_id0, pair.image_id1):
                self._of.setdefault(image_id, []).append(pair)
        waiting = [pair for pair in pairs if not {pair.image_id0, pair.image_id1} <= poses.keys()]
        self._asked = {i for pair in waiting for i in (pair.image_id0, pair.image_id1)}
        self._points: dict[str, list[tuple[IntArray, FloatArray]]] = {}
        self._medians: dict[str, tuple[IntArray, FloatArray]] = {}
        self._add([pair for pair in pairs if {pair.image_id0, pair.image_id1} & self._asked], poses)

    def add(self, image_id: str, poses: Mapping[str, Pose]) -> set[str]:
        """Points of the pairs of an image that has become known. The images whose ties this changes."""
        changed = {image_id} | self._add(self._of[image_id], poses)
        return {i for one in changed for pair in self._of[one] for i in (pair.image_id0, pair.image_id1)}

    def _add(self, pairs: Iterable[PairPoints], poses: Mapping[str, Pose]) -> set[str]:
        """Points of those pairs of which both images are known; the images that have more of them now."""
        known = [pair for pair in pairs if pair.image_id0 in poses and pair.image_id1 in poses]
        changed = set()
        for pair, points in zip(known, triangulated(known, poses, self._cameras), strict=True):
            rows = np.flatnonzero(np.isfinite(points).all(axis=1))
            for side, image_id in enumerate((pair.image_id0, pair.image_id1)):
                if image_id in self._asked and len(rows):
                    self._points.setdefault(image_id, []).append((pair.indices[rows, side], points[rows]))
                    self._medians.pop(image_id, None)
                    changed.add(image_id)
        return changed

    def ties(self, image_id: str, poses: Mapping[str, Pose]) -> tuple[FloatArray, FloatArray]:
        """Stored pixels (N, 2) of an image and the world points (N, 3) that known images see there."""
        pixels, points = [np.zeros((0, 2))], [np.zeros((0, 3))]
        for pair in self._of.get(image_id, ()):
            side = 0 if pair.image_id0 == image_id else 1
            other = pair.image_id1 if side == 0 else pair.image_id0
            if other not in poses or other not in self._points:
                continue
            if other not in self._medians:
                self._medians[other] = _medians(self._points[other])
            keypoints, places = self._medians[other]
            wanted = pair.indices[:, 1 - side]
            at = np.minimum(np.searchsorted(keypoints, wanted), len(keypoints) - 1)
            seen = keypoints[at] == wanted
            pixels.append((pair.points0_px, pair.points1_px)[side][seen])
            points.append(places[at[seen]])
        return np.concatenate(pixels), np.concatenate(points)


def _medians(parts: Sequence[tuple[IntArray, FloatArray]]) -> tuple[IntArray, FloatArray]:
    """Keypoints (K,) in order, each once, and the median (K, 3) of its points."""
    numbers = np.concatenate([keypoints for keypoints, _ in parts])
    order = np.argsort(numbers, kind="stable")
    points = np.concatenate([places for _, places in parts])[order]
    keypoints, starts, counts = np.unique(numbers[order], return_index=True, return_counts=True)
    medians = np.empty((len(keypoints), 3))
    for count in np.unique(counts):
        rows = starts[counts == count, None] + np.arange(count)
        medians[counts == count] = np.median(points[rows], axis=1)
    return keypoints, medians


def _resection(
    pixels: FloatArray, points_m: FloatArray, camera: Camera, threshold_px: float, sigmas: tuple[float, float]
) -> Pose | None:
    import poselib

    middle = np.median(points_m, axis=0)
    options = {"max_reproj_error": threshold_px, "seed": 0}
    found, info = poselib.estimate_absolute_pose(
        without_skew(camera, undistort(camera, pixels)), points_m - middle, poselib_camera(camera), options,
        {"loss_type": "TRUNCATED"},
    )  # fmt: skip
    inliers = int(np.sum(info["inliers"]))
    if inliers < max(_MIN_POINTS, _MIN_SHARE * len(pixels)):
        return None
    rotation = np.asarray(found.R)
    return Pose(middle - rotation.T @ np.asarray(found.t), rotation, *sigmas)
