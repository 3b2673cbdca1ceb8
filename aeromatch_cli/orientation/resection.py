"""Poses of single images by resection: from points that images of known pose see.

Source: PoseLib (Larsson, https://github.com/PoseLib/PoseLib), P3P in LO-RANSAC with non-linear refinement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.geometry.cameras import parameters, undistort
from aeromatch_cli.orientation.judgement import PairPoints, triangulated

_MIN_POINTS = 12
_MIN_SHARE = 0.3


def resected(
    pairs: Sequence[PairPoints],
    known: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
    thresholds_px: Mapping[str, float],
    sigmas: tuple[float, float],
) -> dict[str, Pose]:
    """Poses of images that are not known, as many as points tie to the known ones or, through them, to others.

    cameras: by image_id. thresholds_px: by image_id, the largest error of an inlier in stored pixels. sigmas: of the
    poses found, metres and degrees. The image with most inliers comes first and is known from then on.
    """
    poses, found = dict(known), dict[str, Pose]()
    waiting = sorted({i for pair in pairs for i in (pair.image_id0, pair.image_id1)} - poses.keys())
    if not waiting:
        return found
    seen = _PointsSeen(pairs, poses, cameras)
    failed: dict[str, int] = {}
    while waiting:
        ties = {i: seen.ties(i, poses) for i in waiting}
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
        seen.add(best, poses)
    return found


class _PointsSeen:
    """World points by image and keypoint, from the pair whose points are most: each keypoint of a known image."""

    def __init__(self, pairs: Sequence[PairPoints], poses: Mapping[str, Pose], cameras: Mapping[str, Camera]) -> None:
        self._cameras = cameras
        self._of: dict[str, list[PairPoints]] = {}
        for pair in pairs:
            for image_id in (pair.image_id0, pair.image_id1):
                self._of.setdefault(image_id, []).append(pair)
        self._points: dict[str, dict[int, list[FloatArray]]] = {}
        self._add([p for p in pairs if p.image_id0 in poses and p.image_id1 in poses], poses)

    def add(self, image_id: str, poses: Mapping[str, Pose]) -> None:
        """Points of the pairs of an image that has become known."""
        self._add([p for p in self._of[image_id] if p.image_id0 in poses and p.image_id1 in poses], poses)

    def _add(self, pairs: Sequence[PairPoints], poses: Mapping[str, Pose]) -> None:
        for pair, points in zip(pairs, triangulated(pairs, poses, self._cameras), strict=True):
            for row in np.flatnonzero(np.isfinite(points).all(axis=1)):
                for side, image_id in enumerate((pair.image_id0, pair.image_id1)):
                    place = self._points.setdefault(image_id, {})
                    place.setdefault(int(pair.indices[row, side]), []).append(points[row])

    def ties(self, image_id: str, poses: Mapping[str, Pose]) -> tuple[FloatArray, FloatArray]:
        """Stored pixels (N, 2) of an image and the world points (N, 3) that known images see there."""
        pixels, points = [], []
        for pair in self._of.get(image_id, ()):
            side = 0 if pair.image_id0 == image_id else 1
            other = pair.image_id1 if side == 0 else pair.image_id0
            if other not in poses:
                continue
            known = self._points.get(other, {})
            own_px = (pair.points0_px, pair.points1_px)[side]
            for row, keypoint in enumerate(pair.indices[:, 1 - side]):
                if int(keypoint) in known:
                    pixels.append(own_px[row])
                    points.append(np.median(known[int(keypoint)], axis=0))
        return np.array(pixels).reshape(-1, 2), np.array(points).reshape(-1, 3)


def _resection(
    pixels: FloatArray, points_m: FloatArray, camera: Camera, threshold_px: float, sigmas: tuple[float, float]
) -> Pose | None:
    import poselib

    p = parameters(camera)
    pinhole = {
        "model": "PINHOLE",
        "width": camera.width_px,
        "height": camera.height_px,
        "params": [p["fx"], p["fy"], p["cx"], p["cy"]],
    }
    middle = np.median(points_m, axis=0)
    options = {"max_reproj_error": threshold_px, "seed": 0}
    found, info = poselib.estimate_absolute_pose(
        undistort(camera, pixels), points_m - middle, pinhole, options, {"loss_type": "TRUNCATED"}
    )
    inliers = int(np.sum(info["inliers"]))
    if inliers < max(_MIN_POINTS, _MIN_SHARE * len(pixels)):
        return None
    rotation = np.asarray(found.R)
    return Pose(middle - rotation.T @ np.asarray(found.t), rotation, *sigmas)
