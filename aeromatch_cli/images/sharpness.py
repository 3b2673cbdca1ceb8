"""How sharp and how well exposed a picture is, in figures that hardly depend on what it shows.

Blur is that of Crete, Dolmiere, Ladret and Nicolas (The blur effect: perception and estimation with a new no-reference
perceptual blur metric, SPIE 6492, 2007): the share of the differences of neighbouring pixels that is left when the
picture is blurred once more. A sharp picture loses most of them, a blurred one next to none, whatever its contrast.
Sharp pictures of drones have 0.15 to 0.35, of grass, roofs and water alike; blurred with a standard deviation of 2.5
pixels they have 0.4 to 0.7.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray, PictureQuality
from aeromatch_cli.images.files import read_examined

# Blur is measured in so many parts a side, in the middle of each of them, of so many pixels at most.
_PARTS, _PART_PX = 4, 256
# Length of the blur that is added, pixels; the source's.
_LENGTH_PX = 9
# Parts of less than this share of the picture's usual differences have nothing to be sharp, but noise.
_LEAST_CONTRAST = 0.5
# Values that show nothing, of 0 to 255, and the share of a picture that may have them.
_BLACK, _WHITE, _NOTHING = 12, 243, 0.85
# Blur beyond that of so many pictures before and behind, or of all of the camera; beyond so many standard deviations of
# what is usual; blur that no sharp picture has; and how many pictures tell what is usual.
_NEAR, _NEAR_STEP, _STEP, _SIGMAS, _LEAST_BLUR, _LEAST_PICTURES = 3, 0.12, 0.2, 4.0, 0.4, 5


def read_quality(path: Path) -> PictureQuality:
    """Of a file. Raises ItemError where it cannot be decoded."""
    pixels, valid, complaint = read_examined(path, colour=False)
    return picture_quality(pixels, valid)._replace(damage=complaint)


def picture_quality(gray: NDArray[Any], valid: BoolArray | None) -> PictureQuality:
    """gray, valid: (H, W), uint8; what is not valid counts nowhere, but a picture that is nothing else is black."""
    seen = gray if valid is None else gray[valid]
    if not seen.size:  # frames of black are not valid, and an entirely black picture is one
        return PictureQuality(float("nan"), 1.0, 0.0)
    counts = np.bincount(seen.ravel()[:: max(1, seen.size // 1_000_000)], minlength=256)
    black, white = counts[:_BLACK].sum() / counts.sum(), counts[_WHITE + 1 :].sum() / counts.sum()
    parts = [_blur(gray[rows, columns]) for rows, columns in _windows(gray.shape, valid)]
    if not parts:
        return PictureQuality(float("nan"), float(black), float(white))
    contrasts = np.array([contrast for _, contrast in parts])
    blurs = np.array([blur for blur, _ in parts])[contrasts >= _LEAST_CONTRAST * np.median(contrasts)]
    return PictureQuality(float(np.median(blurs)), float(black), float(white))


def unsharp(blurs: Sequence[float]) -> list[int]:
    """Numbers of the pictures of one camera, in the order of their names, that are far blurrier than those before and
    behind them, which show much the same, or than all.

    The difference must be large itself, and beyond what sharp pictures of this block differ by. Too few tell nothing.
    """
    values = np.array(blurs, dtype=np.float64)
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < _LEAST_PICTURES:
        return []
    own = values[known]
    usual = float(np.median(own))
    near = np.array(
        [np.median(np.delete(own[max(0, k - _NEAR) : k + _NEAR + 1], min(k, _NEAR))) for k in range(len(own))]
    )
    beside = own - near
    named = (beside >= max(_NEAR_STEP, _SIGMAS * _sigma(beside))) & (own - usual >= _NEAR_STEP)
    named |= own - usual >= max(_STEP, _SIGMAS * _sigma(own - usual))
    return [int(known[k]) for k in np.flatnonzero(named & (own >= _LEAST_BLUR))]


def _sigma(values: FloatArray) -> float:
    """Standard deviation of what is usual: of a normal distribution's median absolute deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def shows_nothing(quality: PictureQuality) -> str:
    """Return "black" or "white" of a picture that is little else, "without texture" where no pixels differ, else ""."""
    if quality.black >= _NOTHING:
        return "black"
    if quality.white >= _NOTHING:
        return "white"
    return "without texture" if quality.blur >= 1.0 else ""


def _windows(shape: tuple[int, ...], valid: BoolArray | None) -> list[tuple[slice, slice]]:
    """Middles of the parts, those that are valid everywhere."""
    found = []
    for k in range(_PARTS**2):
        sides = []
        for size, place in zip(shape[:2], divmod(k, _PARTS), strict=True):
            length = min(_PART_PX, size // _PARTS)
            first = int((place + 0.5) * size / _PARTS - 0.5 * length)
            sides.append(slice(first, first + length))
        if valid is None or bool(valid[sides[0], sides[1]].all()):
            found.append((sides[0], sides[1]))
    return found


def _blur(gray: NDArray[Any]) -> tuple[float, float]:
    """Blur and mean difference of neighbouring pixels; of the blurrier direction."""
    import cv2

    picture = gray.astype(np.float32)
    found = []
    for axis, size in ((0, (1, _LENGTH_PX)), (1, (_LENGTH_PX, 1))):
        again = cv2.blur(picture, size)
        before = np.abs(np.diff(picture, axis=axis))
        after = np.abs(np.diff(again, axis=axis))
        whole = float(before.sum())
        found.append(
            (1.0 - float(np.maximum(before - after, 0.0).sum()) / whole if whole else 1.0, whole / max(before.size, 1))
        )
    return max(found)
