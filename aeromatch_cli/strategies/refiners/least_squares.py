"""Least-squares matching of tie points: where in one image the surroundings of a keypoint of another one lie.

Gruen, Adaptive least squares correlation (1985), with the shift alone as unknown: rotation, scale and shear are those
of level ground between both poses, brightness and contrast those of the windows themselves. In its inverse
compositional form (Baker and Matthews 2004) the derivatives are those of the template, once for all iterations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.strategies import Strategy

# A window has so many samples to each side of its middle, weighted by a Gaussian of so many samples. Smaller ones are
# better at roofs (city 0.29 for 0.37 px with 5 for 7), larger ones on grass (0.22 for 0.16 px).
_HALF, _SIGMA = 6, 4.0
# A patch has so many pixels to each side of its middle.
PATCH_HALF_PX = 15
_ITERATIONS = 8
# A step, in samples, below which a window has come to rest, and beyond which no single step goes.
_REST, _LONGEST = 0.1, 1.0
# All windows are left alone once none of them moves by more samples.
_STILL = 0.01
# Samples are at least and at most so many pixels of the first image apart.
_FINEST, _COARSEST = 0.6, 1.6
# And in the second image at most so many.
_MOST_STRETCHED = 1.6
# Contrast of a window, in grey levels, and least share of the stronger derivative that the weaker one has: edges slide.
_LEAST_CONTRAST, _LEAST_CORNER = 1.0, 0.02
# No window, shifted or not, reaches further from its keypoint.
REACH_PX = 13
# Of the pixels beside a sample interpolation reads one.
_MARGIN_PX = 1.0
# OpenCV's remap takes pictures of 32,767 rows at most.
_PATCHES_AT_ONCE = 1000

Values = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Patches:
    """Square pieces of an image, (N, 2 PATCH_HALF_PX + 1, same) uint8, and where the places that count lie, (N, 2) x
    and y from the middle of the middle pixel."""

    pixels: NDArray[np.uint8]
    places_px: FloatArray


class LeastSquares(Strategy):
    """Least-squares matching: every tie point is measured anew in the pixels of its images, to a tenth of a pixel."""

    version: ClassVar[int] = 2
    name: Literal["least-squares"] = "least-squares"
    # Rendered hills, city and grass under two suns, `auto`: median errors 0.24, 0.38 and 0.17 px with 0.5 and with 0.3,
    # 0.26, 0.37 and 0.31 px with 0.7.
    min_correlation: float = Field(
        0.5,
        ge=-1.0,
        le=1.0,
        description="Least correlation of both windows (13 x 13 samples) of a keypoint that is moved. Larger: fewer "
        "keypoints are moved, the others stay where the detector put them.",
    )
    # The same blocks: 48,466 correct matches with 3 px, 48,043 with 2 px.
    max_shift_px: float = Field(
        3.0,
        gt=0.0,
        description="Largest distance from where the detector put the keypoint, pixels (reduced ones with "
        "block.max_size_px). Larger: more keypoints are moved, some to another place.",
    )

    def __call__(self, first: Patches, second: Patches, second_from_first: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Shifts (N, 2) that bring the places in the second image onto those in the first, pixels of the second, and
        which of them (N,) hold; those of the others are 0. second_from_first: (N, 2, 2) pixels."""
        shifts, held = np.zeros((len(first.pixels), 2)), np.zeros(len(first.pixels), dtype=bool)
        for start in range(0, len(held), _PATCHES_AT_ONCE):
            part = slice(start, start + _PATCHES_AT_ONCE)
            own, other = (Patches(one.pixels[part], one.places_px[part]) for one in (first, second))
            shifts[part], held[part] = self._shifts(own, other, second_from_first[part])
        return shifts, held

    def _shifts(self, first: Patches, second: Patches, second_from_first: FloatArray) -> tuple[FloatArray, BoolArray]:
        seen = np.nan_to_num(second_from_first)
        apart, comparable = _sampling(seen)
        matrices = seen * apart[:, None, None]
        template, inside = _sampled(first, apart[:, None, None] * np.eye(2), np.zeros((len(apart), 2)), _HALF + 1)
        held = comparable & inside
        middle, contrast = _levels(template[:, 1:-1, 1:-1])
        held &= contrast > _LEAST_CONTRAST
        template = (template - middle[:, None, None]) / np.maximum(contrast, 1e-3)[:, None, None]
        along = 0.5 * np.stack(
            [template[:, 1:-1, 2:] - template[:, 1:-1, :-2], template[:, 2:, 1:-1] - template[:, :-2, 1:-1]], axis=1
        ).reshape(len(apart), 2, -1)
        template = template[:, 1:-1, 1:-1].reshape(len(apart), -1)
        normal = np.einsum("nik,njk,k->nij", along, along, _WEIGHTS, optimize=True)
        weakest, strongest = np.linalg.eigvalsh(normal).T
        held &= weakest > _LEAST_CORNER * strongest
        inverse = np.linalg.inv(normal + 1e-6 * np.eye(2))
        weighted = along * _WEIGHTS
        steps, last = np.zeros((len(apart), 2)), np.zeros((len(apart), 2))
        for _ in range(_ITERATIONS):
            window, inside = _sampled(second, matrices, np.einsum("nij,nj->ni", matrices, steps), _HALF)
            middle, contrast = _levels(window)
            window = ((window - middle[:, None, None]) / np.maximum(contrast, 1e-3)[:, None, None]).reshape(
                template.shape
            )
            wrong = np.einsum("nik,nk->ni", weighted, window - template)
            last = np.clip(-np.einsum("nij,nj->ni", inverse, wrong), -_LONGEST, _LONGEST)
            held &= inside
            steps += last
            if not (np.abs(last[held]) > _STILL).any():
                break
        correlation = (window * template) @ _WEIGHTS
        shifts = np.einsum("nij,nj->ni", matrices, steps)
        held &= (correlation >= self.min_correlation) & (np.linalg.norm(last, axis=1) <= _REST)
        held &= np.maximum(np.linalg.norm(shifts, axis=1), np.linalg.norm(steps, axis=1) * apart) <= self.max_shift_px
        return np.where(held[:, None], shifts, 0.0), np.asarray(held)


class NoRefinement(Strategy):
    """Tie points stay where the detector put them."""

    name: Literal["none"] = "none"


def _grid(half: int) -> FloatArray:
    """(2 half + 1, same, 2) x and y."""
    side = np.arange(-half, half + 1, dtype=np.float64)
    return np.stack(np.meshgrid(side, side), axis=-1)


def _weights() -> Values:
    weights = np.exp(-0.5 * (np.linalg.norm(_grid(_HALF), axis=-1) / _SIGMA) ** 2)
    return (weights / weights.sum()).ravel().astype(np.float32)


_WEIGHTS = _weights()


def _sampling(second_from_first: FloatArray) -> tuple[FloatArray, BoolArray]:
    """(N,) pixels of the first image from sample to sample, so that the coarser image is sampled once a pixel, and
    whether both images (N,) can be compared at all."""
    with np.errstate(divide="ignore", invalid="ignore"):
        area = np.abs(np.linalg.det(second_from_first))
        stretch = np.linalg.norm(second_from_first, ord=2, axis=(1, 2))
        apart = np.maximum(1.0, 1.0 / np.sqrt(area))
        apart = np.minimum(apart, _MOST_STRETCHED / stretch)
    comparable = np.isfinite(apart) & (apart >= _FINEST) & (apart <= _COARSEST)
    return np.where(comparable, apart, 1.0), np.asarray(comparable)


def _sampled(patches: Patches, matrices: FloatArray, shifts: FloatArray, half: int) -> tuple[Values, BoolArray]:
    """Windows (N, 2 half + 1, same) around the places, shifted by (N, 2) pixels, and which of them (N,) lie in their
    patches. matrices: (N, 2, 2) pixels from samples."""
    import cv2

    count, side = len(patches.pixels), 2 * PATCH_HALF_PX + 1
    grid = _grid(half).reshape(-1, 2).astype(np.float32)
    middles = (patches.places_px + shifts + PATCH_HALF_PX).astype(np.float32)
    places = middles[:, None, :] + grid @ matrices.transpose(0, 2, 1).astype(np.float32)
    inside = ((places >= _MARGIN_PX) & (places <= side - 1 - _MARGIN_PX)).all(axis=(1, 2))
    places = np.clip(places, _MARGIN_PX, side - 1 - _MARGIN_PX)
    places[..., 1] += np.arange(count, dtype=np.float32)[:, None] * side
    sheet = patches.pixels.reshape(-1, side).astype(np.float32)
    # OpenCV's bicubic weights move what they interpolate by up to 0.04 px, bilinear ones by 0.01 px.
    found = cv2.remap(sheet, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
    return np.asarray(found, np.float32).reshape(count, 2 * half + 1, 2 * half + 1), np.asarray(inside)


def _levels(windows: Values) -> tuple[Values, Values]:
    """Weighted mean and standard deviation (N,) of windows (N, S, S)."""
    flat: Any = windows.reshape(len(windows), -1)
    middle = flat @ _WEIGHTS
    return middle, np.sqrt(np.maximum((flat * flat) @ _WEIGHTS - middle * middle, 0.0))
