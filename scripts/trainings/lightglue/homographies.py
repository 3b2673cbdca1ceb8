"""Stage 1: groups of views of one picture, warped by homographies and developed anew, with exact truth.

Every view has its own light (gain, gamma, contrast, a slope of brightness, cast-shadow polygons), blur, noise and
compression. Half of the groups are turned at will and described along their gradients; the others are turned a little,
as north-up views from noisy attitudes are, and described upright.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from aeromatch_cli.data import Camera, View
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.learned import Learned
from aeromatch_cli.strategies.extractors.sift import Sift
from trainings.lightglue.sides import Array, Partners, Seen, partners, seen

VIEWS, SIZE_PX, KEYPOINTS = 4, (480, 400), 700
_MARGIN_PX = 4.0


@dataclass(frozen=True, eq=False)
class Group:
    """views: V sides, whose places are their own pixels; matrices: (V, 3, 3), base pixel -> view pixel."""

    views: tuple[Seen, ...]
    matrices: Array

    def truth(self, first: int, second: int) -> Partners:
        forward = self.matrices[second] @ np.linalg.inv(self.matrices[first])
        sides = self.views[first], self.views[second]
        there = _moved(forward, sides[0].places_px), _moved(np.linalg.inv(forward), sides[1].places_px)
        return partners(*sides, *there)


def _moved(matrix: Array, points_px: Array) -> Array:
    """Points (N, 2) in another view, not finite outside of it or behind."""
    homogeneous = np.column_stack([points_px, np.ones(len(points_px))]) @ matrix.T
    with np.errstate(divide="ignore", invalid="ignore"):
        there = np.where(homogeneous[:, 2:] > 0.0, homogeneous[:, :2] / homogeneous[:, 2:], np.nan)
    inside = ((there >= -_MARGIN_PX) & (there <= np.array(SIZE_PX) + _MARGIN_PX)).all(axis=1)
    there[~inside] = np.nan
    return there


def extractor_of(features: str, *, free: bool) -> Sift | Learned:
    """features: "sift" or "learned". free: views are turned at will."""
    if features == "sift":
        return Sift(keypoints=KEYPOINTS, orientation="gradient" if free else "upright")
    return Learned(keypoints=KEYPOINTS, orientation="network" if free else "upright")


def make_group(paths: list[Path], seed: int, features: str = "sift") -> Group:
    """Group number `seed`; the same for the same list of pictures."""
    rng = np.random.default_rng([seed, 5])
    base = base_of(read_pixels(paths[int(rng.integers(len(paths)))], colour=False), rng)
    free = rng.random() < 0.5
    extractor = extractor_of(features, free=free)
    views, matrices = [], []
    for _ in range(VIEWS):
        matrix = random_homography(base.shape[::-1], free, rng)
        gray = cv2.warpPerspective(base, matrix, SIZE_PX, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT)
        seen_px = cv2.warpPerspective(np.full(base.shape, 255, np.uint8), matrix, SIZE_PX) > 254
        gray = developed(gray, rng)
        view = View("source", *SIZE_PX, np.eye(3), True, 0.0)
        camera = Camera("PINHOLE", *SIZE_PX, (500.0, 500.0, SIZE_PX[0] / 2, SIZE_PX[1] / 2))
        views.append(seen(extractor(camera, [ViewPixels(view, gray, seen_px)]), signed=features == "learned"))
        matrices.append(matrix)
    return Group(tuple(views), np.stack(matrices))


def base_of(gray: Array, rng: np.random.Generator) -> Array:
    """A random square of a picture, at most 1000 pixels wide."""
    if gray.dtype != np.uint8:
        gray = cv2.convertScaleAbs(gray, alpha=255.0 / max(1.0, float(np.percentile(gray, 99.5))))
    side = min(int(rng.uniform(500, 1100)), *gray.shape)
    y, x = int(rng.integers(gray.shape[0] - side + 1)), int(rng.integers(gray.shape[1] - side + 1))
    base = gray[y : y + side, x : x + side]
    scale = min(1.0, rng.uniform(0.5, 1.2))
    return cv2.resize(base, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1.0 else base


def random_homography(base_px: tuple[int, int], free: bool, rng: np.random.Generator) -> Array:
    """Base pixel -> view pixel: any turn (or a small one), scale within a factor of 1.41 of its mean, perspective."""
    width, height = SIZE_PX
    turn = rng.uniform(-np.pi, np.pi) if free else np.deg2rad(rng.normal(0.0, 5.0))
    scale = max(width / base_px[0], height / base_px[1]) * np.exp(rng.uniform(np.log(0.9), np.log(1.8)))
    cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
    shift = rng.normal(0.0, 0.08, 2) * base_px
    middle = np.array(base_px) / 2 + shift
    similar = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    similar[:2, 2] = np.array([width, height]) / 2 - similar[:2, :2] @ middle
    corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
    jitter = 0.16 if free else 0.10
    moved = corners + rng.uniform(-jitter, jitter, (4, 2)).astype(np.float32) * np.float32([width, height])
    return cv2.getPerspectiveTransform(corners, moved.astype(np.float32)) @ similar


def developed(gray: Array, rng: np.random.Generator) -> Array:
    """The view (H, W) uint8 under another light, through another camera."""
    level = gray.astype(np.float32) / 255.0
    height, width = gray.shape
    if rng.random() < 0.6:
        level = _with_shadows(level, rng)
    if rng.random() < 0.5:
        y, x = np.mgrid[0:height, 0:width].astype(np.float32)
        slope = rng.normal(0.0, 0.35, 2)
        level = level * np.exp(slope[0] * (x / width - 0.5) + slope[1] * (y / height - 0.5))
    level = np.clip(level, 1e-4, None) ** np.exp(rng.normal(0.0, 0.35)) * np.exp(rng.normal(-0.1, 0.35))
    if rng.random() < 0.3:
        level = 0.5 + (level - level.mean()) * rng.uniform(0.3, 1.5)
    if rng.random() < 0.1:
        level = 1.0 - level if rng.random() < 0.2 else np.sqrt(np.clip(level, 0.0, None))
    if rng.random() < 0.5:
        level = cv2.GaussianBlur(level, (0, 0), float(rng.uniform(0.3, 1.3)))
    level = level + rng.normal(0.0, rng.uniform(0.0, 0.03), level.shape)
    out = np.clip(np.rint(level * 255.0), 0, 255).astype(np.uint8)
    if rng.random() < 0.3:
        coded = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 95))])[1]
        out = cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)
    return out


def _with_shadows(level: Array, rng: np.random.Generator) -> Array:
    """Cast shadow: polygons with a narrow penumbra, of one light for the whole view."""
    height, width = level.shape
    mask = np.zeros((height, width), np.float32)
    for _ in range(int(rng.integers(1, 9))):
        corners = int(rng.integers(3, 7))
        radius = rng.uniform(15.0, 160.0)
        angles = np.sort(rng.uniform(0.0, 2 * np.pi, corners))
        stretch = rng.uniform(0.3, 1.0, (corners, 1))
        around = np.stack([np.cos(angles), np.sin(angles)], axis=1) * radius * stretch
        cv2.fillPoly(mask, [np.rint(around + rng.uniform(0, [width, height])).astype(np.int32)], 1.0)
    mask = cv2.GaussianBlur(mask, (0, 0), float(rng.uniform(0.4, 2.5)))
    light = rng.uniform(0.2, 0.65)
    shaded: Array = level * (1.0 - (1.0 - light) * mask)
    return shaded
