"""Pictures of flat ground with texture of every size, and pairs of them of which everything is known."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from benchmarks.claims.sides import Shot
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray


@lru_cache(maxsize=8)
def ground(seed: int, size: tuple[int, int] = (1400, 1100)) -> NDArray[np.float32]:
    """(H, W) of size (W, H), read-only: gray values around 120 whose spectrum falls as natural ground's does."""
    rng = np.random.default_rng(seed)
    width, height = size
    down, across = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)
    wave = np.maximum(np.hypot(down, across), 1.0 / max(size))
    spectrum = np.fft.rfft2(rng.standard_normal((height, width))) / wave**1.2
    spectrum[0, 0] = 0.0
    values = np.fft.irfft2(spectrum, (height, width))
    gray = (120.0 + 30.0 * values / values.std()).astype(np.float32)
    gray.flags.writeable = False
    return gray


def similarity(turn_deg: float, scale: float, at: tuple[float, float], to: tuple[float, float]) -> FloatArray:
    """(3, 3) that turns and scales about `at`, which goes to `to`."""
    cosine, sine = scale * np.cos(np.deg2rad(turn_deg)), scale * np.sin(np.deg2rad(turn_deg))
    linear = np.array([[cosine, -sine], [sine, cosine]])
    return np.vstack([np.column_stack([linear, np.array(to) - linear @ np.array(at)]), [0.0, 0.0, 1.0]])


def shot(
    source: NDArray[np.float32],
    source_from_shot: FloatArray,
    size: tuple[int, int] = (720, 540),
    *,
    gain: float = 1.0,
    offset: float = 0.0,
    noise: float = 2.0,
    seed: int = 0,
) -> Shot:
    """What a camera sees of the ground: rounded to whole gray values, as files are."""
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    values = cv2.warpAffine(source, source_from_shot[:2], size, flags=flags, borderMode=cv2.BORDER_REFLECT)
    values = gain * values + offset + noise * np.random.default_rng(seed).standard_normal(values.shape)
    return Shot(np.clip(np.rint(values), 0, 255).astype(np.float32))


def pair(
    turn_deg: float,
    scale: float,
    shift: tuple[float, float],
    *,
    seed: int = 0,
    gain: float = 1.0,
    offset: float = 0.0,
    noise: float = 2.0,
) -> tuple[Shot, Shot, FloatArray]:
    """Two shots of one ground and the (3, 3) similarity between their pixels. shift: of the middle, ground px."""
    source, middle = ground(seed), np.array([359.5, 269.5])
    center = np.array([700.0, 550.0])
    source_from0 = similarity(20.0, 0.9, tuple(middle), tuple(center - np.array(shift) / 2.0))
    source_from1 = similarity(20.0 - turn_deg, 0.9 / scale, tuple(middle), tuple(center + np.array(shift) / 2.0))
    second = shot(source, source_from1, gain=gain, offset=offset, noise=noise, seed=seed + 1)
    return shot(source, source_from0, noise=noise, seed=seed + 2), second, np.linalg.inv(source_from1) @ source_from0


def errors(found: FloatArray, truth: FloatArray, place: FloatArray) -> tuple[float, float, float]:
    """Displacement at a place of side 0 in px, turn in degrees, and relative scale."""
    there = [matrix[:2] @ np.append(place, 1.0) for matrix in (found, truth)]
    turns = [np.rad2deg(np.arctan2(matrix[1, 0], matrix[0, 0])) for matrix in (found, truth)]
    scales = [np.hypot(matrix[0, 0], matrix[1, 0]) for matrix in (found, truth)]
    turn = abs((turns[0] - turns[1] + 180.0) % 360.0 - 180.0)
    return float(np.linalg.norm(there[0] - there[1])), float(turn), float(abs(scales[0] / scales[1] - 1.0))
