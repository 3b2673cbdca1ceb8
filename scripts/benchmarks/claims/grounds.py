"""Flat ground with detail down to the pixel, and pairs of pictures of it of which everything is known.

A ground is noise whose spectrum falls as natural ground's does, made at full size: nothing is enlarged. Both pictures
of a pair are cut out of it by a similarity, with cubic interpolation after the blur of a lens; then gain, offset and
noise are drawn for each, and gray values rounded to 8 bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, FloatArray

_LEAST_OVERLAP, _MOST_OVERLAP = 0.4, 0.9
_SCALES = (0.8, 1.25)
_ROOM = (1.75, 1.5)  # width and height over the pictures' width


@dataclass(frozen=True)
class Ground:
    """fall: exponent by which amplitudes fall with frequency. contrast: standard deviation, gray levels. along: how
    much longer structures are along x than across, as furrows are."""

    fall: float
    contrast: float
    along: float = 1.0


GROUNDS: Mapping[str, Ground] = {
    "grass": Ground(1.0, 30.0),
    "sand": Ground(1.2, 18.0),
    "furrows": Ground(1.2, 25.0, 6.0),
}


@dataclass(frozen=True, eq=False)
class KnownPair:
    """Two gray pictures (H, W) uint8, the (3, 3) similarity px1 from px0, and the share of picture 0 that is shared."""

    first: NDArray[np.uint8]
    second: NDArray[np.uint8]
    truth: FloatArray
    overlap: float


def ground(kind: str, size: tuple[int, int], seed: int) -> NDArray[np.uint8]:
    """(H, W) gray values of a ground with room for pairs of pictures of `size` (width, height)."""
    from scipy import fft

    asked = GROUNDS[kind]
    width, height = (fft.next_fast_len(int(room * size[0]), real=True) for room in _ROOM)
    rng = np.random.default_rng([seed, list(GROUNDS).index(kind)])
    spectrum = fft.rfft2(rng.standard_normal((height, width), np.float32), workers=-1, overwrite_x=True)
    across = (asked.along * fft.rfftfreq(width)).astype(np.float32)
    for row, down in enumerate(fft.fftfreq(height).astype(np.float32)):
        spectrum[row] /= np.maximum(np.hypot(down, across), 1.0 / width) ** asked.fall
    spectrum[0, 0] = 0.0
    values = fft.irfft2(spectrum, (height, width), workers=-1, overwrite_x=True)
    values *= asked.contrast / values.std()
    values += 128.0
    return np.clip(values, 0.0, 255.0, out=values).round().astype(np.uint8)


def known_pair(source: NDArray[np.uint8], size: tuple[int, int], rng: np.random.Generator) -> KnownPair:
    """Any turn, scale 0.8 to 1.25, overlap 0.4 to 0.9, gain, offset and noise."""
    wanted = rng.uniform(_LEAST_OVERLAP, _MOST_OVERLAP)
    extent = np.array(source.shape[::-1], float)
    for _ in range(20_000):
        turns, scale = rng.uniform(-np.pi, np.pi, 2), float(np.exp(rng.uniform(*np.log(_SCALES))))
        at0, way = extent * rng.uniform(0.3, 0.7, 2), rng.uniform(0.0, 0.7 * size[0])
        at1 = at0 + way * np.array([np.cos(turns[0] + turns[1]), np.sin(turns[0] + turns[1])])
        from0, from1 = _cut(turns[0], 1.0, at0, size), _cut(turns[1], 1.0 / scale, at1, size)
        if _inside(from0, size, extent) and _inside(from1, size, extent):
            truth = np.linalg.inv(from1) @ from0
            share = float(shared_places(truth, size)[1].mean())
            if abs(share - wanted) < 0.05:
                return KnownPair(_shot(source, from0, size, rng), _shot(source, from1, size, rng), truth, share)
    raise SystemExit(f"a ground of {source.shape[1]}x{source.shape[0]} is too small for pairs of {size[0]}x{size[1]}")


def _cut(turn: float, scale: float, middle: FloatArray, size: tuple[int, int]) -> FloatArray:
    """(3, 3) ground px from picture px."""
    cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
    linear = np.array([[cosine, -sine], [sine, cosine]])
    own = np.array([(size[0] - 1) / 2.0, (size[1] - 1) / 2.0])
    return np.vstack([np.column_stack([linear, middle - linear @ own]), [0.0, 0.0, 1.0]])


def _inside(matrix: FloatArray, size: tuple[int, int], extent: FloatArray) -> bool:
    width, height = size
    corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1.0]])
    places = corners @ matrix[:2].T
    return bool((places >= 0.0).all() and (places <= extent - 1.0).all())


def _shot(
    source: NDArray[np.uint8], matrix: FloatArray, size: tuple[int, int], rng: np.random.Generator
) -> NDArray[np.uint8]:
    # A picture that shows the ground smaller has seen it through a wider lens.
    scale = float(np.hypot(matrix[0, 0], matrix[1, 0]))
    values = cv2.warpAffine(
        cv2.GaussianBlur(source, (0, 0), 0.5 * max(1.0, scale)),
        matrix[:2], size, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
    ).astype(np.float32)  # fmt: skip
    gain, offset, noise = float(np.exp(rng.uniform(-0.3, 0.3))), rng.uniform(-20.0, 20.0), rng.uniform(1.0, 5.0)
    values -= 128.0
    values *= gain
    values += 128.0 + offset + noise * rng.standard_normal(values.shape, np.float32)
    return np.clip(np.rint(values, out=values), 0, 255, out=values).astype(np.uint8)


def shared_places(truth: FloatArray, size: tuple[int, int]) -> tuple[FloatArray, BoolArray]:
    """Places (N, 2) of picture 0 on an even grid, and which of them picture 1, of the same size, shows."""
    xs, ys = np.linspace(0, size[0] - 1, 64), np.linspace(0, size[1] - 1, 48)
    places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    there = places @ truth[:2, :2].T + truth[:2, 2]
    return places, ((there >= 0.0) & (there <= np.array(size) - 1.0)).all(axis=1)


def errors(found: FloatArray, truth: FloatArray, size: tuple[int, int]) -> tuple[float, float, float]:
    """Displacement at the overlap's middle (px of picture 1), turn (degrees), scale (relative)."""
    places, shared = shared_places(truth, size)
    return differences(found, truth, places[shared].mean(axis=0))


def differences(found: FloatArray, other: FloatArray, place: FloatArray) -> tuple[float, float, float]:
    """Of two similarities (3, 3): how far apart they take a place (2,), px, turn (degrees), scale (relative)."""
    turns = [turn_deg(matrix) for matrix in (found, other)]
    scales = [np.hypot(matrix[0, 0], matrix[1, 0]) for matrix in (found, other)]
    return (
        float(np.linalg.norm((found - other)[:2] @ np.append(place, 1.0))),
        float(abs((turns[0] - turns[1] + 180.0) % 360.0 - 180.0)),
        float(abs(scales[0] / scales[1] - 1.0)),
    )


def turn_deg(matrix: FloatArray) -> float:
    """Of a similarity (3, 3), -180 to 180."""
    return float(np.rad2deg(np.arctan2(matrix[1, 0], matrix[0, 0])))
