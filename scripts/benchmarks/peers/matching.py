"""Nearest neighbours and MAGSAC++, as users of OpenCV and kornia call them."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, IntArray
from aeromatch_cli.geometry.cameras import undistort
from benchmarks.peers.base import Candidates, Described, Found, Options, Scene, found

RATIO = 0.8
# OpenCV's threshold of MAGSAC++ in px. From 0.5 to 4 px on rendered city and grass, correct matches grow by 1 % (SIFT)
# and 7 % (ALIKED), correctness falls from 99.1 to 97.9 % and from 96.1 to 86.3 %: 1 px has most of both.
MAGSAC_PX, CONFIDENCE, ITERATIONS = 1.0, 0.9999, 10_000
_ROWS = 256  # of the distance matrix at a time
_FEWEST = 8  # USAC raises below 7 points


def mutual_nearest(
    descriptors0: FloatArray, descriptors1: FloatArray, ratio: float | None
) -> tuple[IntArray, IntArray, FloatArray]:
    """Rows, columns and scores of exact mutual nearest neighbours (N, C) float32; with `ratio` also below it from image
    0 to 1.

    Brute force as a matrix product: 30 s for the 88,000 descriptors of all ASIFT views, a sixth of OpenCV's own time.
    """
    if min(len(descriptors0), len(descriptors1)) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    nearest = np.empty(len(descriptors0), np.int64)
    two = np.empty((len(descriptors0), 2), np.float32)  # negated squared distances
    back = np.zeros(len(descriptors1), np.int64)
    back_best = np.full(len(descriptors1), -np.inf, np.float32)
    norms0, norms1 = ((d * d).sum(axis=1) for d in (descriptors0, descriptors1))
    for start in range(0, len(descriptors0), _ROWS):
        scores = (2.0 * descriptors0[start : start + _ROWS]) @ descriptors1.T
        scores -= norms1
        scores -= norms0[start : start + _ROWS, None]
        rows = np.arange(len(scores))
        at_row = scores.argmax(axis=0)
        columns = scores[at_row, np.arange(len(back))]
        better = columns > back_best
        back[better], back_best[better] = start + at_row[better], columns[better]
        best = scores.argmax(axis=1)
        nearest[start : start + _ROWS], two[start : start + _ROWS, 0] = best, scores[rows, best]
        scores[rows, best] = -np.inf
        two[start : start + _ROWS, 1] = scores.max(axis=1)
    distances = np.sqrt(np.maximum(-two, 0.0))
    ratios = distances[:, 0] / np.maximum(distances[:, 1], 1e-12)
    keep = back[nearest] == np.arange(len(nearest))
    if ratio is not None:
        keep &= ratios < ratio
    return np.flatnonzero(keep), nearest[keep], 1.0 - ratios[keep].astype(np.float64)


def magsac(camera0: Camera, camera1: Camera, points0: FloatArray, points1: FloatArray) -> IntArray:
    """Indices of the matches (N, 2), stored pixels, that MAGSAC++'s fundamental matrix explains.

    Lens distortion is taken out with the known cameras first: a fundamental matrix cannot express it.
    """
    import cv2

    flat0, flat1 = undistort(camera0, points0), undistort(camera1, points1)
    usable = np.flatnonzero(np.isfinite(flat0).all(axis=1) & np.isfinite(flat1).all(axis=1))
    if len(usable) < _FEWEST:
        return np.zeros(0, np.int64)
    try:
        _, mask = cv2.findFundamentalMat(
            flat0[usable], flat1[usable], cv2.USAC_MAGSAC, MAGSAC_PX, CONFIDENCE, ITERATIONS
        )
    except cv2.error:  # OpenCV 5 asserts where no sample gave a model: nothing is verified
        return usable[:0]
    return usable[:0] if mask is None else usable[mask.ravel().astype(bool)]


class Peer:
    """A method on pictures: features of its own, mutual nearest neighbours, MAGSAC++ on F.

    ratio: of nearest to second distance that a match has to keep below; None for peers whose users ask for none.
    """

    ratio: ClassVar[float | None] = RATIO

    def __init__(self, scene: Scene, options: Options) -> None:
        self.scene, self.options = scene, options

    def candidates(self, image0: str, image1: str, features0: Described, features1: Described) -> Candidates:
        del image0, image1
        rows, columns, scores = mutual_nearest(features0.descriptors, features1.descriptors, self.ratio)
        return features0.places_px[rows], features1.places_px[columns], scores

    def match(self, image0: str, image1: str, features0: Described, features1: Described) -> Found:
        points0, points1, scores = self.candidates(image0, image1, features0, features1)
        kept = magsac(self.scene.cameras[image0], self.scene.cameras[image1], points0, points1)
        return found(features0, features1, points0[kept], points1[kept], scores[kept])
