"""Frames of a video that are as far apart as pictures of a flight are: by the overlap that they have left.

Corners are tracked from one frame to the next (Lucas and Kanade's optical flow) and give a similarity; its products say
how much of the last frame that was taken is still in view. A camera that hovers gives no frames, whatever it films.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.images.sharpness import picture_quality

# Frames are looked at at this rate, with this longer side.
_RATE_HZ, _SIDE_PX = 10.0, 480
_CORNERS, _LEAST_CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX = 300, 12, 0.01, 8
# Of the frames whose overlap is larger than what is asked for by less than this the sharpest is taken.
_MARGIN = 0.04


@dataclass(frozen=True, eq=False)
class Frame:
    """number: in the video, from 0. time_s: since its first frame. pixels: (H, W, 3) RGB."""

    number: int
    time_s: float
    pixels: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class _Seen:
    """A frame, its blur, and the similarity (3, 3) from the last frame that was taken, reduced pixels."""

    frame: Frame
    blur: float
    from_taken: FloatArray


def chosen_frames(path: Path, overlap: float) -> Iterator[Frame]:
    """Frames each of which shows about the share `overlap` of the one before, and between them none. Where nothing can
    be tracked the frame is taken: it shows something else. Raises ConfigError where the video cannot be read."""
    best: _Seen | None = None
    before: NDArray[np.uint8] | None = None
    moved = np.eye(3)
    for frame in _frames(path):
        gray = _reduced(frame.pixels)
        step = None if before is None else _similarity(before, gray)
        before = gray
        moved = step @ moved if step is not None else np.eye(3)
        seen = _Seen(frame, picture_quality(gray, None).blur, moved)
        if step is None:
            if best is not None:
                yield best.frame
            yield frame
            best = None
            continue
        left = shared(moved, gray.shape[1], gray.shape[0])
        if left <= overlap + _MARGIN and (best is None or seen.blur < best.blur):
            best = seen
        if left <= overlap:
            assert best is not None
            yield best.frame
            # Onwards from the frame that was taken, which may lie a little behind this one.
            moved = moved @ np.linalg.inv(best.from_taken)
            best = None


def shared(second_from_first: FloatArray, width: int, height: int) -> float:
    """Share of a picture that the next one shows, too. second_from_first: (3, 3)."""
    from shapely.geometry import Polygon, box

    corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], dtype=np.float64)
    there = corners @ second_from_first.T
    outline = Polygon(there[:, :2] / there[:, 2:])
    return float(outline.intersection(box(0, 0, width, height)).area / max(outline.area, float(width * height)))


def _frames(path: Path) -> Iterator[Frame]:
    """At about _RATE_HZ."""
    import cv2

    if not path.is_file():
        raise ConfigError(f"the video {path} does not exist: check the path")
    capture = cv2.VideoCapture(str(path))
    try:
        rate_hz = float(capture.get(cv2.CAP_PROP_FPS)) if capture.isOpened() else 0.0
        if not rate_hz > 0.0:
            raise ConfigError(f"{path} cannot be read as a video: convert it to MP4 (H.264), or extract its frames")
        every, number = max(1, round(rate_hz / _RATE_HZ)), 0
        while capture.grab():
            if number % every == 0:
                good, pixels = capture.retrieve()
                if good:
                    yield Frame(number, number / rate_hz, np.ascontiguousarray(pixels[..., ::-1]))
            number += 1
        if number == 0:
            raise ConfigError(f"{path} has no frame that can be read: convert it to MP4 (H.264)")
    finally:
        capture.release()


def _reduced(pixels: NDArray[np.uint8]) -> NDArray[Any]:
    import cv2

    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, _SIDE_PX / max(gray.shape))
    return np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def _similarity(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> FloatArray | None:
    """(3, 3) from the pixels of one frame to those of the next, None where nothing can be tracked."""
    import cv2

    corners = cv2.goodFeaturesToTrack(first, _CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX)
    if corners is None or len(corners) < _LEAST_CORNERS:
        return None
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, corners.copy())
    good = found.ravel() == 1
    if good.sum() < _LEAST_CORNERS:
        return None
    matrix, inliers = cv2.estimateAffinePartial2D(corners[good], there[good])
    if matrix is None or inliers.sum() < _LEAST_CORNERS:
        return None
    return np.vstack([matrix, [0.0, 0.0, 1.0]])
