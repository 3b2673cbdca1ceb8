"""The SIFT side of every comparison: OpenCV, 20,000 features, precise upscale, FLANN mutual ratio, partial affine."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.geometry.frames import apply_homography, resize_matrix
from aeromatch_cli.images import shrink

FEATURES = 20_000
_RANSAC_PX = 3.0
_FEWEST = 15


@dataclass(frozen=True, eq=False)
class SiftResult:
    """matrix: (3, 3) px1 from px0, identity where nothing was found. inliers, matches: counts. points0, points1: (M, 2)
    matched. seconds: of everything but decoding.
    """

    matrix: FloatArray
    inliers: int
    points0: FloatArray
    points1: FloatArray
    seconds: float

    @property
    def accepted(self) -> bool:
        return self.inliers >= _FEWEST


def features(gray: NDArray[np.uint8]) -> tuple[FloatArray, Any]:
    """Keypoints (K, 2) and descriptors."""
    detector = cv2.SIFT.create(nfeatures=FEATURES, enable_precise_upscale=True)
    keypoints, descriptors = detector.detectAndCompute(gray, None)
    return np.array([keypoint.pt for keypoint in keypoints]).reshape(-1, 2), descriptors


def mutual_ratio(descriptors0: Any, descriptors1: Any, ratio: float) -> IntArray:
    """(M, 2) that are each other's nearest and pass the ratio test from both sides."""
    if descriptors0 is None or descriptors1 is None or min(len(descriptors0), len(descriptors1)) < 2:
        return np.zeros((0, 2), np.int64)
    ways = []
    for first, second in ((descriptors0, descriptors1), (descriptors1, descriptors0)):
        matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 4}, {"checks": 64})
        found = matcher.knnMatch(first, second, k=2)
        ways.append({a.queryIdx: a.trainIdx for a, b in found if a.distance < ratio * b.distance})
    pairs = [(i, j) for i, j in ways[0].items() if ways[1].get(j) == i]
    return np.array(pairs, np.int64).reshape(-1, 2)


def registered(
    first: NDArray[np.uint8], second: NDArray[np.uint8], scale: float = 1.0, ratio: float = 0.8
) -> SiftResult:
    """On pictures reduced to `scale`; the result is of stored pixels."""
    cv2.setRNGSeed(0)
    started = time.perf_counter()
    small = [shrink(picture, scale) for picture in (first, second)]
    (points0, own0), (points1, own1) = (features(picture) for picture in small)
    rows = mutual_ratio(own0, own1, ratio)
    back = np.linalg.inv(resize_matrix(scale))
    matched0, matched1 = points0[rows[:, 0]].reshape(-1, 2), points1[rows[:, 1]].reshape(-1, 2)
    matrix, count = np.eye(3), 0
    if len(rows) >= 2:
        affine, mask = cv2.estimateAffinePartial2D(matched0, matched1, ransacReprojThreshold=_RANSAC_PX)
        if affine is not None:
            matrix, count = back @ np.vstack([affine, [0.0, 0.0, 1.0]]) @ np.linalg.inv(back), int(mask.sum())
    seconds = time.perf_counter() - started
    matched0, matched1 = (apply_homography(back, points) for points in (matched0, matched1))
    return SiftResult(matrix, count, matched0, matched1, seconds)
