"""Stage 2: groups of views of one place, and where each pixel of the first is in the others.

Of a real picture: homographies, each view under a light of its own. Of a rendered block: ground views of several
images, with parallax, occlusion and two suns; like levels of their pyramids side by side.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.strategies.extractors.pyramid import STEP
from trainings.detector.scenes import Sight, angles_deg, transfer
from trainings.lightglue.homographies import developed

SIDE_PX = 144
# Pictures are read no larger than this, the longer side.
_PICTURE_PX = 1800
# How often each level is drawn: as often as it gives keypoints, about.
LEVEL_SHARES = (0.34, 0.24, 0.18, 0.12, 0.07, 0.05)
# A place counts if so much of the first view is seen in another.
LEAST_SEEN = 0.2
# How many views are sharpened: renders are not, photographs are.
_SHARPENED = 0.3
# How often the other views are those at the largest angles.
_STEEP_SHARE = 0.6
Array = NDArray[np.float64]
Gray = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Group:
    """grays: (V, S, S) uint8. places: (V - 1, S, S, 2) float32, x and y in each other view of the first one's pixels,
    NaN where it does not show the same."""

    grays: Gray
    places: NDArray[np.float32]


def pictures(folders: list[Path]) -> list[Gray]:
    """Gray 8-bit pictures of real blocks."""
    found = []
    for folder in folders:
        for path in sorted((folder / "images").iterdir()):
            gray = read_pixels(path, colour=False)
            if gray.dtype != np.uint8:
                gray = cv2.convertScaleAbs(gray, alpha=255.0 / max(1.0, float(np.percentile(gray, 99.5))))
            scale = min(1.0, _PICTURE_PX / max(gray.shape))
            found.append(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    return found


def homography_group(sources: list[Gray], views: int, rng: np.random.Generator) -> Group:
    """Views of a place of one of the pictures: turned a little (in one of five groups at will), scaled, in perspective,
    blurred along a direction as an oblique view is."""
    gray = sources[int(rng.integers(len(sources)))]
    scale = float(STEP ** rng.uniform(0.0, 4.0))
    gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    free = rng.random() < 0.2
    low = np.minimum(SIDE_PX * 0.6, np.array(gray.shape[::-1]) / 2.0)
    middle = rng.uniform(low, np.array(gray.shape[::-1]) - low)
    matrices = [_view_from_picture(middle, free, rng) for _ in range(views)]
    size = (SIDE_PX, SIDE_PX)
    grays = []
    for matrix in matrices:
        view = cv2.warpPerspective(gray, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        grays.append(_sharpened(developed(_smeared(view, rng), rng), rng))
    inside = cv2.warpPerspective(np.full(gray.shape, 255, np.uint8), matrices[0], size) == 255
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX].astype(np.float64)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    places = np.empty((views - 1, SIDE_PX, SIDE_PX, 2), np.float32)
    for number, matrix in enumerate(matrices[1:]):
        there = pixels @ (matrix @ np.linalg.inv(matrices[0])).T
        places[number] = there[..., :2] / there[..., 2:]
        places[number][~inside | _outside(places[number])] = np.nan
    return Group(np.stack(grays), places)


def _view_from_picture(middle: Array, free: bool, rng: np.random.Generator) -> Array:
    turn = rng.uniform(-np.pi, np.pi) if free else np.deg2rad(rng.normal(0.0, 6.0))
    scale = np.exp(rng.normal(0.0, 0.12))
    cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
    similar = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    similar[:2, 2] = SIDE_PX / 2 + rng.normal(0.0, 5.0, 2) - similar[:2, :2] @ middle
    corners = np.float32([[0, 0], [SIDE_PX, 0], [SIDE_PX, SIDE_PX], [0, SIDE_PX]])
    moved = corners + rng.uniform(-0.13, 0.13, (4, 2)).astype(np.float32) * SIDE_PX
    return np.asarray(cv2.getPerspectiveTransform(corners, moved.astype(np.float32)) @ similar)


def _smeared(gray: Gray, rng: np.random.Generator) -> Gray:
    """Blurred along one direction in half of the cases: what a ground view of an oblique picture has been stretched."""
    if rng.random() < 0.5:
        return gray
    length, angle = rng.uniform(0.5, 2.0), rng.uniform(0.0, np.pi)
    cosine, sine = np.cos(angle), np.sin(angle)
    steps = np.arange(-4, 5)
    along = steps[None, :] * cosine + steps[:, None] * sine
    across = steps[:, None] * cosine - steps[None, :] * sine
    kernel = np.exp(-((along / length) ** 2 + (across / 0.4) ** 2) / 2.0)
    return cv2.filter2D(gray, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


def _sharpened(gray: Gray, rng: np.random.Generator) -> Gray:
    """Some views as cameras write them: more than the lens has seen of everything that is small."""
    if rng.random() < 1.0 - _SHARPENED:
        return gray
    blurred = cv2.GaussianBlur(gray, (0, 0), float(rng.uniform(0.7, 1.5)))
    more = float(rng.uniform(0.2, 1.2))
    return cv2.addWeighted(gray, 1.0 + more, blurred, -more, 0.0)


def block_group(blocks: list[list[Sight]], views: int, rng: np.random.Generator) -> Group | None:
    """Views of a place of one of the blocks at one level, or None where the drawn place is seen by too few."""
    sights = blocks[int(rng.integers(len(blocks)))]
    first, *others = (sights[int(n)] for n in rng.permutation(len(sights)))
    level = int(rng.choice(len(LEVEL_SHARES), p=LEVEL_SHARES))
    step = float(STEP**-level)  # view pixels per level pixel
    half = SIDE_PX / 2 * step
    height, width = first.gray.shape
    if min(height, width) < 2 * half or not first.valid.any():
        return None
    middle = _on_grid(rng.uniform(half, np.array([width, height]) - half), level)
    steps = (np.arange(SIDE_PX) - (SIDE_PX - 1) / 2) * step
    grid = np.stack(np.meshgrid(steps, steps), axis=-1)
    places = (middle + grid).reshape(-1, 2)
    grays, found = [_cut(first, middle, step)], []
    middle_m = first.points_m(middle[None])
    if rng.random() < _STEEP_SHARE and np.isfinite(middle_m).all():
        others.sort(key=lambda other: -float(angles_deg(first, other, middle_m)[0]))
    coarse = (middle + grid[:: SIDE_PX // 12, :: SIDE_PX // 12]).reshape(-1, 2)
    for other in others:
        if np.isfinite(transfer(first, other, coarse, step)[:, 0]).mean() < LEAST_SEEN:
            continue
        there = transfer(first, other, places, step)
        centre = other.places_px(middle_m)[0]
        if not np.isfinite(centre).all():
            seen = there[np.isfinite(there[:, 0])]
            centre = np.median(seen, axis=0) if len(seen) else centre
        if not np.isfinite(centre).all():
            continue
        # Level pixels of two views fall on the ground in no relation to each other.
        centre = _on_grid(centre + rng.uniform(-3.0, 3.0, 2) * step, level)
        local = ((there - centre) / step + (SIDE_PX - 1) / 2).astype(np.float32).reshape(SIDE_PX, SIDE_PX, 2)
        local[_outside(local)] = np.nan
        if np.isfinite(local[..., 0]).mean() < LEAST_SEEN:
            continue
        grays.append(_cut(other, centre, step))
        found.append(local)
        if len(grays) == views:
            break
    if len(grays) < views:
        return None
    if rng.random() < 0.3:
        grays = [developed(gray, rng) for gray in grays]
    grays = [_sharpened(gray, rng) for gray in grays]
    return _turned(Group(np.stack(grays), np.stack(found)), rng)


def _on_grid(middle: Array, level: int) -> Array:
    """At the picture's own scale, so that pixels are whole ones: no smoothing that use does not have."""
    return np.asarray(np.floor(middle) + 0.5) if level == 0 else middle


def _cut(sight: Sight, middle: Array, step: float) -> Gray:
    """The picture around a place, one pixel for `step` of the view's, averaged as a level of its pyramid is."""
    gray = sight.gray
    if step > 1.01:
        reach = SIDE_PX / 2 * step + 8.0 * step
        low = np.maximum(np.floor(middle - reach), 0).astype(int)
        high = np.minimum(np.ceil(middle + reach) + 1, gray.shape[::-1]).astype(int)
        window = gray[low[1] : high[1], low[0] : high[0]]
        if min(window.shape) < 2 * step:
            return np.zeros((SIDE_PX, SIDE_PX), np.uint8)
        size = tuple(np.maximum(np.rint(np.array(window.shape[::-1]) / step), 1).astype(int))
        small = cv2.resize(window, size, interpolation=cv2.INTER_AREA)
        exact = np.array(window.shape[::-1]) / np.array(size)
        start = (middle - low + 0.5) / exact - 0.5 - (SIDE_PX - 1) / 2 * step / exact
        matrix = np.array([[step / exact[0], 0.0, start[0]], [0.0, step / exact[1], start[1]]])
        gray = small
    else:
        start = middle - (SIDE_PX - 1) / 2
        matrix = np.array([[1.0, 0.0, start[0]], [0.0, 1.0, start[1]]])
    return cv2.warpAffine(
        gray, matrix, (SIDE_PX, SIDE_PX), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_CONSTANT
    )


def _turned(group: Group, rng: np.random.Generator) -> Group:
    """All views turned by the same quarter turns and mirrored alike."""
    last = SIDE_PX - 1.0
    grays, places = group.grays, group.places
    if rng.random() < 0.5:
        grays, places = grays[:, :, ::-1], places[:, :, ::-1] * np.float32([-1, 1]) + np.float32([last, 0])
    for _ in range(int(rng.integers(4))):
        # A quarter turn as np.rot90 does it takes the pixel (x, y) to (y, last - x).
        grays = np.rot90(grays, axes=(1, 2))
        places = np.rot90(places, axes=(1, 2))
        places = np.stack([places[..., 1], np.float32(last) - places[..., 0]], axis=-1)
    return Group(np.ascontiguousarray(grays), np.ascontiguousarray(places))


def _outside(places: NDArray[np.float32]) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        inside: NDArray[np.bool_] = ((places >= 3.0) & (places <= SIDE_PX - 4.0)).all(axis=-1)
    return ~inside
