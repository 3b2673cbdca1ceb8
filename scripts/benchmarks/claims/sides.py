"""Both sides of paper B's comparison, on pictures in memory: polar registration, and SIFT (OpenCV, 20,000 features,
precise upscale, FLANN mutual ratio, partial affine). Seconds are of the processor, decoding excluded on both sides."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pair, PairGeometry
from aeromatch_cli.geometry.frames import apply_homography
from aeromatch_cli.images.scaling import shrink
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.grid import Grid
from aeromatch_cli.strategies.matchers.polar import Measured, Polar, Registered
from aeromatch_cli.strategies.simulators.none import source_view

TIE_POINTS = 1000
FEATURES, RATIO = 20_000, 0.8
_RANSAC_PX, _EPIPOLAR_PX, _FEWEST = 3.0, 2.0, 15
_NEIGHBOURS = 4


@dataclass(frozen=True, eq=False)
class Shot:
    """A decoded picture (H, W) as a `data.Raster`, and where it is valid (None = everywhere)."""

    pixels: NDArray[Any]
    valid: BoolArray | None = None
    finest: float = 1.0

    @property
    def width_px(self) -> int:
        return self.pixels.shape[1]

    @property
    def height_px(self) -> int:
        return self.pixels.shape[0]

    def reduced(self, scale: float) -> tuple[FloatArray, BoolArray | None]:
        if scale > self.finest:
            raise ValueError(f"asked for scale {scale:g}, nothing is finer than {self.finest:g}")
        small = shrink(self.pixels, scale).astype(np.float32)
        if self.valid is None:
            return small, None
        return small, shrink(self.valid.astype(np.uint8) * 255, scale) > 254

    def window(self, left: int, top: int, width: int, height: int) -> tuple[FloatArray, BoolArray | None]:
        part = (slice(top, top + height), slice(left, left + width))
        return self.pixels[part].astype(np.float32), None if self.valid is None else self.valid[part]


@dataclass(frozen=True, eq=False)
class PolarResult:
    """registered: what the matrix (3, 3), px1 from px0 of stored pixels, was found from. exact: (3, 3) once more on
    full-size pixels. measured: tie points. seconds: of the registration, with the exact one, with tie points.
    """

    registered: Registered
    exact: FloatArray
    measured: Measured
    seconds: tuple[float, float, float]

    @property
    def accepted(self) -> bool:
        return self.registered.registration.accepted

    @property
    def matrix(self) -> FloatArray:
        return self.registered.registration.matrix

    def places1(self, places0: FloatArray) -> FloatArray:
        """Where stored pixels (N, 2) of picture 0 lie in picture 1: the homography, and what the nearest tie points
        of each place lie off it, which is relief.
        """
        from scipy.spatial import cKDTree

        warp, points = self.registered.registration.warp, self.measured
        there = apply_homography(warp, places0)
        count = min(_NEIGHBOURS, len(points.points0_px))
        if not count:
            return there
        off = points.points1_px - apply_homography(warp, points.points0_px)
        apart, near = (part.reshape(len(places0), count) for part in cKDTree(points.points0_px).query(places0, k=count))
        weights = 1.0 / np.maximum(apart, 1.0)
        return there + (weights[..., None] * off[near]).sum(axis=1) / weights.sum(axis=1, keepdims=True)


def registered(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> PolarResult:
    """Without poses. About 1,000 tie points over the overlap, half of them measured either way."""
    polar = Polar()
    started = time.process_time()
    found = polar.registered(Shot(first), Shot(second), unknown_geometry(first, second))
    plain = time.process_time() - started
    accepted = found.registration.accepted
    exact = polar.exact(found) if accepted else found.registration.matrix
    once_more = time.process_time() - started
    grids = [np.zeros((0, 2)), np.zeros((0, 2))]
    if accepted and found.registration.fit is not None:
        cells = int(np.ceil(0.5 * TIE_POINTS / max(found.registration.fit.share, 0.05)))
        for side, picture in enumerate((first, second)):
            camera = unknown_geometry(first, second).camera0
            points = Grid(points=cells)(camera, [ViewPixels(source_view(camera), picture, None)])
            grids[side] = points.keypoints_px.astype(np.float64)
    measured = polar.measured(found, *grids)
    # The tie points' seconds do without the similarity, which they do not need.
    whole = time.process_time() - started - (once_more - plain)
    return PolarResult(found, exact, measured, (plain, once_more, whole))


def unknown_geometry(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> PairGeometry:
    """Nothing but the sizes."""
    cameras = [
        Camera("PINHOLE", p.shape[1], p.shape[0], (p.shape[1], p.shape[1], (p.shape[1] - 1) / 2, (p.shape[0] - 1) / 2))
        for p in (first, second)
    ]
    pair = Pair("0", "1", float("nan"), float("nan"), "bench")
    return PairGeometry(pair, cameras[0], cameras[1], None, None, None)


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
    def accepted(self) -> bool:
        return int(self.agree.sum()) >= _FEWEST


def sift(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> SiftResult:
    """Mutual matches, and the similarity that most of them agree on."""
    cv2.setRNGSeed(0)
    started = time.process_time()
    (points0, own0), (points1, own1) = (_features(picture) for picture in (first, second))
    back = dict(_nearest(own1, own0))
    pairs = np.array([(i, j) for i, j in _nearest(own0, own1) if back.get(j) == i], np.int64).reshape(-1, 2)
    found0, found1 = points0[pairs[:, 0]].reshape(-1, 2), points1[pairs[:, 1]].reshape(-1, 2)
    matrix, agree = np.eye(3), np.zeros(len(pairs), bool)
    if len(pairs) >= 2:
        affine, mask = cv2.estimateAffinePartial2D(found0, found1, ransacReprojThreshold=_RANSAC_PX)
        if affine is not None:
            matrix, agree = np.vstack([affine, [0.0, 0.0, 1.0]]), np.asarray(mask).ravel() > 0
    return SiftResult(matrix, found0, found1, agree, time.process_time() - started)


def _features(gray: NDArray[np.uint8]) -> tuple[FloatArray, Any]:
    """Keypoints (K, 2) and descriptors."""
    detector = cv2.SIFT.create(nfeatures=FEATURES, enable_precise_upscale=True)
    keypoints, descriptors = detector.detectAndCompute(gray, None)
    return np.array([keypoint.pt for keypoint in keypoints]).reshape(-1, 2), descriptors


def _nearest(descriptors0: Any, descriptors1: Any) -> list[tuple[int, int]]:
    """Of each descriptor its nearest on the other side, where that is clearly nearer than the second."""
    if descriptors0 is None or descriptors1 is None or min(len(descriptors0), len(descriptors1)) < 2:
        return []
    matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 4}, {"checks": 64})
    found = matcher.knnMatch(descriptors0, descriptors1, k=2)
    return [(a.queryIdx, a.trainIdx) for a, b in found if a.distance < RATIO * b.distance]
