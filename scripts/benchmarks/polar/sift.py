"""The SIFT side of every comparison: OpenCV, 20,000 features, precise upscale, FLANN mutual ratio, partial affine."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.geometry.frames import apply_homography, resize_matrix
from aeromatch_cli.images.scaling import shrink

FEATURES = 20_000
RATIO = 0.8
_RANSAC_PX, _EPIPOLAR_PX = 3.0, 2.0
_FEWEST = 15


@dataclass(frozen=True, eq=False)
class SiftResult:
    """matrix: (3, 3) px1 from px0, identity where nothing was found. points0, points1: (M, 2) matched. agree: (M,)
    which the matrix explains. seconds: of everything but decoding.
    """

    matrix: FloatArray
    points0: FloatArray
    points1: FloatArray
    agree: BoolArray
    seconds: float

    @property
    def verified(self) -> BoolArray:
        """(M,) which one fundamental matrix explains, whatever tilt and relief do."""
        if len(self.points0) < _FEWEST:
            return np.zeros(len(self.points0), bool)
        _, mask = cv2.findFundamentalMat(self.points0, self.points1, cv2.USAC_MAGSAC, _EPIPOLAR_PX, 0.999, 10_000)
        return np.zeros(len(self.points0), bool) if mask is None else np.asarray(mask).ravel() > 0

    @property
    def inliers(self) -> int:
        return int(self.agree.sum())

    @property
    def accepted(self) -> bool:
        return self.inliers >= _FEWEST


class SiftPair:
    """Features of both pictures, reduced to `scale`, and each one's nearest; matched at any ratio."""

    def __init__(self, first: NDArray[np.uint8], second: NDArray[np.uint8], scale: float = 1.0) -> None:
        cv2.setRNGSeed(0)
        started = time.perf_counter()
        (points0, own0), (points1, own1) = (_features(shrink(picture, scale)) for picture in (first, second))
        self._points = points0, points1
        self._ways = [_nearest(own0, own1), _nearest(own1, own0)]
        self._scale = scale
        self._seconds = time.perf_counter() - started

    def matched(self, ratio: float = RATIO) -> SiftResult:
        """Mutual matches at a ratio, in stored pixels, and the similarity that most of them agree on."""
        started = time.perf_counter()
        forward, back = ({a: b for a, b, quotient in way if quotient < ratio} for way in self._ways)
        pairs = np.array([(i, j) for i, j in forward.items() if back.get(j) == i], np.int64).reshape(-1, 2)
        found0, found1 = (points[pairs[:, axis]].reshape(-1, 2) for axis, points in enumerate(self._points))
        stored = np.linalg.inv(resize_matrix(self._scale))
        matrix, agree = np.eye(3), np.zeros(len(pairs), bool)
        if len(pairs) >= 2:
            affine, mask = cv2.estimateAffinePartial2D(found0, found1, ransacReprojThreshold=_RANSAC_PX)
            if affine is not None:
                matrix = stored @ np.vstack([affine, [0.0, 0.0, 1.0]]) @ np.linalg.inv(stored)
                agree = np.asarray(mask).ravel() > 0
        seconds = self._seconds + time.perf_counter() - started
        points = [apply_homography(stored, found) for found in (found0, found1)]
        return SiftResult(matrix, points[0], points[1], agree, seconds)


def _features(gray: NDArray[np.uint8]) -> tuple[FloatArray, Any]:
    """Keypoints (K, 2) and descriptors."""
    detector = cv2.SIFT.create(nfeatures=FEATURES, enable_precise_upscale=True)
    keypoints, descriptors = detector.detectAndCompute(gray, None)
    return np.array([keypoint.pt for keypoint in keypoints]).reshape(-1, 2), descriptors


def _nearest(descriptors0: Any, descriptors1: Any) -> list[tuple[int, int, float]]:
    """Of each descriptor its nearest on the other side, and its distance over the second's."""
    if descriptors0 is None or descriptors1 is None or min(len(descriptors0), len(descriptors1)) < 2:
        return []
    matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 4}, {"checks": 64})
    found = matcher.knnMatch(descriptors0, descriptors1, k=2)
    return [(a.queryIdx, a.trainIdx, a.distance / max(b.distance, 1e-9)) for a, b in found]
