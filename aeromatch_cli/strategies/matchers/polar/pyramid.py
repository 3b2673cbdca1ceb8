"""Both sides of a pair from coarse to fine, read once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.geometry.frames import resize_matrix
from aeromatch_cli.strategies.matchers.polar.level import Level, level_of

Picture = tuple[FloatArray, BoolArray | None]
# Reads a side of a pair at a scale (frame px to level px): values (H, W) float32 and where they are valid.
Reader = Callable[[float], Picture]

# Longer side of the pictures that a registration ends on, px.
FINEST_PX = 920.0


class Pyramid:
    """Both sides of a pair at the scales asked for, each made once. longest_px: longer side of both frames. finest: the
    largest scale that both may be read at.
    """

    def __init__(self, read0: Reader, read1: Reader, longest_px: int, finest: float = 1.0) -> None:
        self.longest_px, self.finest = longest_px, finest
        self._readers = (read0, read1)
        self._finest: list[Picture] = []
        self._made: dict[tuple[float, bool], tuple[Level, Level]] = {}

    def turned(self) -> Pyramid:
        """The same with the sides exchanged, what is made already included."""
        other = Pyramid(self._readers[1], self._readers[0], self.longest_px, self.finest)
        other._finest = self._finest[::-1]
        other._made = {key: (second, first) for key, (first, second) in self._made.items()}
        return other

    def scale(self, size_px: float) -> float:
        return min(self.finest, size_px / self.longest_px)

    def pictures(self, scale: float) -> tuple[Picture, Picture]:
        """The finest is read, the others are made of it."""
        finest = self.scale(FINEST_PX)
        if not self._finest:
            self._finest = [read(finest) for read in self._readers]
        first, second = (_reduced(picture, scale / finest) for picture in self._finest)
        return first, second

    def at(self, size_px: float, *, even: bool) -> tuple[Level, Level]:
        key = size_px, even
        if key not in self._made:
            scale = self.scale(size_px)
            first, second = (level_of(*picture, scale, even=even) for picture in self.pictures(scale))
            self._made[key] = first, second
        return self._made[key]


def _reduced(picture: Picture, scale: float) -> Picture:
    """Area-averaged; valid is what is so all through."""
    import cv2

    pixels, valid = picture
    if scale >= 1.0:
        return picture
    small = np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.float32)
    if valid is None:
        return small, None
    share = cv2.resize(valid.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return small, np.asarray(share > 0.99)


def rescaled(matrix: FloatArray, scale: float, wanted: float) -> FloatArray:
    """A similarity between pictures at one scale, between those at another."""
    change = resize_matrix(wanted) @ np.linalg.inv(resize_matrix(scale))
    return change @ matrix @ np.linalg.inv(change)
