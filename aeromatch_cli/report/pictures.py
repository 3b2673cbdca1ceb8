"""PNG pictures of keypoints and matches upon the images, as stored (EXIF Orientation is not applied)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.files import write_atomically
from aeromatch_cli.images.files import write_png
from aeromatch_cli.images.scaling import shrink
from aeromatch_cli.report.previews import to_colour8

# Longer side of an image in a picture, pixels.
_SIDE_PX = 1400
_GAP_PX = 8
# A match with this error is yellow, one without any green.
_LARGE_ERROR_PX = 2.0
_GREEN, _YELLOW, _RED, _PALE = (60, 200, 80), (250, 220, 60), (230, 60, 60), (205, 215, 235)
# Lines of more matches hide the images.
_MOST_LINES = 400


def image_picture(pixels: NDArray[Any], keypoints_px: FloatArray, matched: BoolArray) -> NDArray[np.uint8]:
    """RGB picture with every keypoint (K, 2), matched ones (K,) green and above the others, which are no fault."""
    import cv2

    picture, ratio = small(pixels)
    places = (np.asarray(keypoints_px, np.float64) + 0.5) * ratio - 0.5
    for chosen, colour in ((~matched, _PALE), (matched, _GREEN)):
        for x, y in places[chosen]:
            cv2.circle(picture, (round(x), round(y)), 2, colour, -1, cv2.LINE_AA)
    return picture


def pair_picture(
    pixels: Sequence[NDArray[Any]],
    points_px: tuple[FloatArray, FloatArray],
    errors_px: FloatArray | None,
    dropped_px: tuple[FloatArray, FloatArray] | None,
) -> NDArray[np.uint8]:
    """Both images side by side with matches (M, 2) each, by error (M,); dropped_px: red, below the others."""
    import cv2

    sides = [small(one) for one in pixels]
    offset = sides[0][0].shape[1] + _GAP_PX
    height = max(picture.shape[0] for picture, _ in sides)
    whole = np.full((height, offset + sides[1][0].shape[1], 3), 255, np.uint8)
    for (picture, _), start in zip(sides, (0, offset), strict=True):
        whole[: picture.shape[0], start : start + picture.shape[1]] = picture

    def draw(points: tuple[FloatArray, FloatArray], colours: NDArray[Any]) -> None:
        first, second = (
            (np.asarray(p, np.float64).reshape(-1, 2) + 0.5) * ratio - 0.5
            for p, (_, ratio) in zip(points, sides, strict=True)
        )
        for row in range(0, len(first), max(1, -(-len(first) // _MOST_LINES))):
            ends = [
                (round(first[row, 0]), round(first[row, 1])),
                (round(second[row, 0]) + offset, round(second[row, 1])),
            ]
            colour = tuple(int(value) for value in colours[row])
            cv2.line(whole, ends[0], ends[1], colour, 1, cv2.LINE_AA)
            for end in ends:
                cv2.circle(whole, end, 3, colour, 1, cv2.LINE_AA)

    if dropped_px is not None:
        draw(dropped_px, np.tile(_RED, (len(dropped_px[0]), 1)))
    draw(points_px, _by_error(len(points_px[0]), errors_px))
    return whole


def small(pixels: NDArray[Any]) -> tuple[NDArray[np.uint8], FloatArray]:
    """RGB picture (h, w, 3) of at most _SIDE_PX, and its pixels per stored pixel in x and y."""
    height, width = pixels.shape[:2]
    small = to_colour8(shrink(pixels, min(1.0, _SIDE_PX / max(width, height))))
    if small.ndim == 2:
        small = np.repeat(small[:, :, None], 3, axis=2)
    return np.ascontiguousarray(small[:, :, :3]), np.array([small.shape[1] / width, small.shape[0] / height])


def _by_error(count: int, errors_px: FloatArray | None) -> NDArray[Any]:
    """(M, 3) from green to yellow; green where the error is not known."""
    errors = np.zeros(count) if errors_px is None else np.nan_to_num(np.asarray(errors_px, np.float64))
    share = np.clip(errors / _LARGE_ERROR_PX, 0.0, 1.0)[:, None]
    return np.asarray((1.0 - share) * _GREEN + share * _YELLOW)


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """As PNG, with the folders above it. Raises WorkspaceError where it cannot be written."""
    write_atomically(path, lambda stream: write_png(stream, picture))
