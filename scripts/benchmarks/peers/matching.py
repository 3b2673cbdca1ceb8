"""Nearest neighbours, as users of OpenCV and kornia call them, and the presets' verification.

Peers that are features and a matcher are verified as the presets are: what a pair has of correct matches then tells of
both alone. By MAGSAC++ and a fundamental matrix, 1 px, as most users verify them, ALIKED with LightGlue on ground views
had 1,294 correct of 1,388 matches on six pairs of lewis; relative poses of known cameras leave 1,555 of 1,795.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from aeromatch_cli.data import Candidates, FloatArray, IntArray, Pair, PairGeometry
from aeromatch_cli.strategies.filters.chain import apply_chain
from aeromatch_cli.strategies.filters.epipolar import Epipolar
from benchmarks.peers.base import Candidates as Matched
from benchmarks.peers.base import Described, Found, Options, Scene, found

RATIO = 0.8
_ROWS = 256  # of the distance matrix at a time


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


def verified(scene: Scene, image0: str, image1: str, points0: FloatArray, points1: FloatArray, seed: int) -> IntArray:
    """Indices of the matches (N, 2), stored pixels, that the filter `epipolar` of the presets keeps: the relative pose
    of cameras that are known, or nothing where fewer than 15 or no more than chance gives agree with it."""
    pair = Pair(image0, image1, np.nan, np.nan, "benchmark")
    geometry = PairGeometry(pair, scene.cameras[image0], scene.cameras[image1], None, None, None)
    verdict = apply_chain([Epipolar()], Candidates(points0, points1), geometry, seed)
    return np.flatnonzero(verdict.keep) if verdict.state == "verified" else np.zeros(0, np.int64)


class Peer:
    """A method on pictures: features of its own, mutual nearest neighbours, the presets' verification.

    ratio: of nearest to second distance that a match has to keep below; None for peers whose users ask for none.
    """

    ratio: ClassVar[float | None] = RATIO

    def __init__(self, scene: Scene, options: Options) -> None:
        self.scene, self.options = scene, options

    def candidates(self, image0: str, image1: str, features0: Described, features1: Described) -> Matched:
        del image0, image1
        rows, columns, scores = mutual_nearest(features0.descriptors, features1.descriptors, self.ratio)
        return features0.places_px[rows], features1.places_px[columns], scores

    def match(self, image0: str, image1: str, features0: Described, features1: Described) -> Found:
        points0, points1, scores = self.candidates(image0, image1, features0, features1)
        kept = verified(self.scene, image0, image1, points0, points1, self.options.seed)
        return found(features0, features1, points0[kept], points1[kept], scores[kept])
