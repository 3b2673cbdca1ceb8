"""How well orientations of two patches of one place differ by the turn between them, on pairs that no training saw."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor

from aeromatch_cli.data import BoolArray, FloatArray
from trainings.patches.draws import Group, cropped, developed, drawn, sources_of, stored_of
from trainings.patches.tracks import Tracks

Orient = Callable[[NDArray[np.uint8]], FloatArray]  # (N, 32, 32) -> (N,) degrees
WITHIN_DEG = (10.0, 20.0)
_BINS, _SIGMA_PX, _STORED_BLUR_PX = 36, 2.5, 0.5


def turned(group: Group, stored: tuple[Tensor, Tensor], rng: np.random.Generator) -> tuple[Tensor, Tensor, FloatArray]:
    """Both sides (N, 1, 32, 32) in 0-1 of a group, `stored_of` it, each turned at will, off place and scale; and by how
    much (N,) the orientation of the second is to exceed that of the first, degrees."""
    sides, upright = [], []
    for rows, side in zip((group.rows0, group.rows1), stored, strict=True):
        along = rng.uniform(0.0, 360.0, len(rows))
        sides.append(cropped(side, along, np.ones(len(rows)), rng))
        # A patch that is cut along a direction shows its content turned back by it.
        upright.append(group.tracks.turn_deg[rows] - along)
    return sides[0], sides[1], upright[1] - upright[0]


def wrapped_deg(angles: FloatArray) -> FloatArray:
    return (angles + 180.0) % 360.0 - 180.0


@dataclass(frozen=True, eq=False)
class TurnedPairs:
    """patches0, patches1: (N, 32, 32). turn_deg: (N,). angle_deg: (N,) view angle. light: (N,) bool, homographies under
    another light. two_suns: (N,)."""

    patches0: NDArray[np.uint8]
    patches1: NDArray[np.uint8]
    turn_deg: FloatArray
    angle_deg: FloatArray
    light: BoolArray
    two_suns: BoolArray


def unseen_pairs(unseen: Mapping[str, Tracks], each: int) -> TurnedPairs:
    """A pair of each of at most `each` tracks of every set; always the same."""
    parts = []
    for number, (name, source) in enumerate(zip(unseen, sources_of(unseen), strict=True)):
        rng = np.random.default_rng([number, 51])
        group = drawn(source, min(each, len(source.order)), 0.0, rng)
        first, second, turn = turned(group, stored_of(group), rng)
        light = np.full(len(turn), name.startswith("homographies"))
        if light[0]:
            first, second = developed(first, rng), developed(second, rng)
        suns = (source.tracks.sun[rows] for rows in (group.rows0, group.rows1))
        parts.append((_bytes(first), _bytes(second), turn, group.angle_deg, light, np.not_equal(*suns) & ~light))
    return TurnedPairs(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _bytes(patches: Tensor) -> NDArray[np.uint8]:
    return (patches[:, 0].clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()


def gradient_peaks(patches: NDArray[np.uint8]) -> FloatArray:
    """(N,) degrees of the highest peak of SIFT's gradient histogram, for a keypoint of 5 px in the middle.

    Source: Lowe, IJCV 2004, section 5: gradients at the keypoint's scale (2.5 px), a Gaussian window of 1.5 times it,
    36 bins, smoothed as OpenCV does, parabola through the peak.
    """
    blur = np.sqrt(_SIGMA_PX**2 - _STORED_BLUR_PX**2)
    values = gaussian_filter(patches.astype(np.float32), (0.0, blur, blur))
    dy, dx = np.gradient(values, axis=(1, 2))
    grid = np.arange(values.shape[1]) - (values.shape[1] - 1) / 2.0
    window = np.exp(-(grid**2 + grid[:, None] ** 2) / (2.0 * (1.5 * _SIGMA_PX) ** 2))
    bins = np.rint(np.rad2deg(np.arctan2(dy, dx)) * _BINS / 360.0).astype(np.int64) % _BINS
    rows = np.arange(len(values))[:, None, None] * _BINS + bins
    weights = (np.hypot(dx, dy) * window).ravel()
    histogram = np.bincount(rows.ravel(), weights, len(values) * _BINS).reshape(-1, _BINS)
    taps = ((-2, 1), (-1, 4), (0, 6), (1, 4), (2, 1))
    smooth = sum(weight / 16.0 * np.roll(histogram, shift, axis=1) for shift, weight in taps)
    peak, row = smooth.argmax(axis=1), np.arange(len(smooth))
    left, middle, right = (smooth[row, (peak + step) % _BINS] for step in (-1, 0, 1))
    bend = np.where(left + right - 2.0 * middle < 0.0, left + right - 2.0 * middle, -1.0)
    return np.asarray((peak + 0.5 * (left - right) / bend) * 360.0 / _BINS)


def orinet(weights: Any) -> Orient:
    """kornia's OriNet, whose angles run the other way round."""
    from kornia.feature import OriNet

    network: Any = OriNet(pretrained=False)
    network.load_state_dict(weights)
    network.eval()

    def orient(patches: NDArray[np.uint8]) -> FloatArray:
        with torch.inference_mode():
            parts = (torch.from_numpy(patches)[:, None].float() / 255.0).split(512)
            return -np.rad2deg(torch.cat([network(part) for part in parts]).numpy())

    return orient


def errors_deg(orient: Orient, pairs: TurnedPairs) -> FloatArray:
    """(N,) by how much the difference of two orientations misses the turn, 0-180 degrees."""
    both = np.asarray(orient(np.concatenate([pairs.patches0, pairs.patches1])), np.float64)
    count = len(pairs.turn_deg)
    return np.abs(wrapped_deg(both[count:] - both[:count] - pairs.turn_deg))


def table(orient: Orient, pairs: TurnedPairs) -> dict[str, dict[str, float]]:
    """Median error and shares within 10 and 20 degrees, by view angle and light."""
    errors = errors_deg(orient, pairs)
    rendered, angle = ~pairs.light, pairs.angle_deg
    rows = {
        "all": np.ones(len(errors), bool),
        "other light": pairs.light,
        "one sun": rendered & ~pairs.two_suns,
        "two suns": pairs.two_suns,
        "one sun, below 20 degrees": rendered & ~pairs.two_suns & (angle < 20.0),
        "one sun, 20-40 degrees": rendered & ~pairs.two_suns & (angle >= 20.0) & (angle < 40.0),
        "one sun, above 40 degrees": rendered & ~pairs.two_suns & (angle >= 40.0),
    }
    return {name: _summary(errors[which]) for name, which in rows.items() if which.any()}


def _summary(errors: FloatArray) -> dict[str, float]:
    shares = {f"within_{limit:.0f}": round(float((errors <= limit).mean()), 4) for limit in WITHIN_DEG}
    return {"pairs": len(errors), "median_deg": round(float(np.median(errors)), 2), **shares}


def draw_distribution(found: Mapping[str, Sequence[float]], path: Any) -> None:
    """Share of pairs within an error, by estimator."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.5, 4.0), dpi=110, layout="constrained")
    axes = figure.subplots()
    for name, errors in found.items():
        axes.plot(np.sort(errors), np.linspace(0.0, 1.0, len(errors)), label=name)
    axes.set(xlabel="error, degrees", ylabel="share of pairs within it", xlim=(0, 180), ylim=(0, 1))
    axes.legend(frameon=False)
    figure.savefig(path)
