"""Both sides of every comparison, on pictures in memory: polar registration, and SIFT (OpenCV, 20,000 features, precise
upscale, FLANN mutual ratio, partial affine)."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pair, PairGeometry
from aeromatch_cli.geometry.frames import apply_homography, closest_similarity, resize_matrix
from aeromatch_cli.images.scaling import shrink
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.grid import Grid
from aeromatch_cli.strategies.matchers.polar import Measured, Polar, Registered
from aeromatch_cli.strategies.matchers.polar.registration import Registration
from aeromatch_cli.strategies.simulators.none import source_view

_NEIGHBOURS = 4
_PROBES = 40  # places across a picture that its overlap is found from


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
    """matrix: (3, 3) px1 from px0 of stored pixels. found: what it is of. measured: tie points. seconds: of the
    registration; seconds_tie_points: of everything. Everything but decoding, as for SIFT: the grid too.
    """

    matrix: FloatArray
    found: Registered
    measured: Measured
    seconds: float
    seconds_tie_points: float

    @property
    def registration(self) -> Registration:
        return self.found.registration

    @property
    def points0(self) -> FloatArray:
        return self.measured.points0_px

    @property
    def points1(self) -> FloatArray:
        return self.measured.points1_px

    def adjusted(self) -> FloatArray:
        """(3, 3) px1 from px0 by the tie points, else as registered."""
        return self.measured.similarity() if len(self.points0) >= _FEWEST else self.matrix

    def places1(self, places0: FloatArray) -> FloatArray:
        """Where stored pixels (N, 2) of picture 0 lie in picture 1: the homography, and what the nearest tie points
        of each place lie off it, which is relief.
        """
        from scipy.spatial import cKDTree

        there = self._by_homography(places0)
        count = min(_NEIGHBOURS, len(self.points0))
        if not count:
            return there
        off = self.points1 - self._by_homography(self.points0)
        apart, near = (found.reshape(len(places0), count) for found in cKDTree(self.points0).query(places0, k=count))
        weights = 1.0 / np.maximum(apart, 1.0)
        return there + (weights[..., None] * off[near]).sum(axis=1) / weights.sum(axis=1, keepdims=True)

    def _by_homography(self, places0: FloatArray) -> FloatArray:
        there = apply_homography(self.registration.warp, self.found.side0.frame_from_source(places0))
        return self.found.side1.source_from_frame(there)


def registered(
    first: NDArray[np.uint8], second: NDArray[np.uint8], tie_points: int, geometry: PairGeometry | None = None
) -> PolarResult:
    """tie_points: wanted over what both show, about; 0 for none. Without geometry nothing is known of the poses."""
    polar, shots = Polar(), (Shot(first), Shot(second))
    geometry = geometry or unknown_geometry(first, second)
    started = time.perf_counter()
    found = polar.registered(*shots, geometry)
    seconds = time.perf_counter() - started
    grids = [np.zeros((0, 2)), np.zeros((0, 2))]
    shared0, shared1 = _shared(found)
    if tie_points and found.registration.accepted:
        # Half of them are measured either way, on grids that are as dense on the ground.
        cells = int(np.ceil(0.5 * tie_points * _PROBES**2 / max(len(shared0), 1)))
        for side, (camera, picture) in enumerate(((geometry.camera0, first), (geometry.camera1, second))):
            found_points = Grid(points=cells)(camera, [ViewPixels(source_view(camera), picture, None)])
            grids[side] = found_points.keypoints_px.astype(np.float64)
    points = polar.measured(found, *grids)
    total = time.perf_counter() - started
    # Of frames that look from above, the similarity of stored pixels that is closest.
    straight = found.registration.matrix if found.side0.camera is None else np.eye(3)
    if found.side0.camera is not None and len(shared0) >= 2:
        straight = closest_similarity(shared0, shared1)
    return PolarResult(straight, found, points, seconds, total)


def _shared(found: Registered) -> tuple[FloatArray, FloatArray]:
    """Stored pixels (N, 2) of picture 0 on an even grid that picture 1 shows, and where."""
    sides = found.side0, found.side1
    sizes = [np.array([side.raster.width_px, side.raster.height_px]) for side in sides]
    xs, ys = (np.linspace(0, length - 1, _PROBES) for length in sizes[0])
    places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    there = apply_homography(found.registration.warp, sides[0].frame_from_source(places))
    there = sides[1].source_from_frame(there)
    with np.errstate(invalid="ignore"):
        shared = ((there >= 0.0) & (there < sizes[1])).all(axis=1)
    return places[shared], there[shared]


def unknown_geometry(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> PairGeometry:
    """Nothing but the sizes."""
    cameras = [
        Camera("PINHOLE", p.shape[1], p.shape[0], (p.shape[1], p.shape[1], (p.shape[1] - 1) / 2, (p.shape[0] - 1) / 2))
        for p in (first, second)
    ]
    pair = Pair("0", "1", float("nan"), float("nan"), "bench")
    return PairGeometry(pair, cameras[0], cameras[1], None, None, None)


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
