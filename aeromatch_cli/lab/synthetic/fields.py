"""Smooth heights of bare ground: sums of random waves, rolling land and dunes. Exact in float64, endless, seeded."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from aeromatch_cli.data import FloatArray

# A relief is what the land rises and falls within this distance of the origin, measured at this spacing.
RELIEF_REACH_M, _RELIEF_STEP_M = 250.0, 10.0


@dataclass(frozen=True, eq=False)
class Waves:
    """A sum of plane waves. vectors: (K, 2) radians a metre. phases: (K,) radians. amplitudes: (K,)."""

    vectors: FloatArray
    phases: FloatArray
    amplitudes: FloatArray

    def at(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Values at places of any shape, in the precision of the places."""
        total = np.zeros(np.shape(x_m), dtype=np.result_type(x_m))
        for (kx, ky), phase, amplitude in zip(
            self.vectors.tolist(), self.phases.tolist(), self.amplitudes.tolist(), strict=True
        ):
            total += amplitude * np.sin(kx * x_m + ky * y_m + phase)
        return total

    def slope_at(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Gradients (N, 2) at places (N,), in their precision."""
        total = np.zeros((len(x_m), 2), dtype=np.result_type(x_m))
        for (kx, ky), phase, amplitude in zip(
            self.vectors.tolist(), self.phases.tolist(), self.amplitudes.tolist(), strict=True
        ):
            climb = amplitude * np.cos(kx * x_m + ky * y_m + phase)
            total[:, 0] += kx * climb
            total[:, 1] += ky * climb
        return total

    def scaled(self, factor: float) -> Waves:
        return Waves(self.vectors, self.phases, self.amplitudes * factor)

    def joined(self, other: Waves) -> Waves:
        return Waves(
            np.concatenate([self.vectors, other.vectors]),
            np.concatenate([self.phases, other.phases]),
            np.concatenate([self.amplitudes, other.amplitudes]),
        )


def random_waves(key: tuple[int, ...], shortest_m: float, longest_m: float, count: int) -> Waves:
    """Waves of unit variance and lengths between the two, longer ones higher; key seeds them.

    Directions are spread evenly and then jittered, so that few waves already look the same in all directions.
    """
    rng = np.random.default_rng(list(key))
    lengths_m = shortest_m * (longest_m / shortest_m) ** ((np.arange(count) + rng.random(count)) / count)
    # The golden angle keeps neighbouring lengths from sharing a direction.
    directions = 2.399963 * np.arange(count) + rng.uniform(0.0, 2.0 * np.pi) + rng.uniform(-0.3, 0.3, count)
    vectors = (2.0 * np.pi / lengths_m)[:, None] * np.stack([np.cos(directions), np.sin(directions)], axis=1)
    amplitudes = lengths_m / np.sqrt(0.5 * np.sum(lengths_m**2))
    return Waves(vectors, rng.uniform(0.0, 2.0 * np.pi, count), amplitudes)


def turned(xy_m: FloatArray, heading_deg: float) -> FloatArray:
    """(N, 2) plan coordinates u, v along axes turned counter-clockwise by the heading, from world x, y."""
    a = np.deg2rad(heading_deg)
    c, s = np.cos(a), np.sin(a)
    return np.stack([c * xy_m[..., 0] + s * xy_m[..., 1], c * xy_m[..., 1] - s * xy_m[..., 0]], axis=-1)


def unturned(uv_m: FloatArray, heading_deg: float) -> FloatArray:
    """(N, 2) world x, y from plan coordinates u, v: the inverse of `turned`."""
    return turned(uv_m, -heading_deg)


@lru_cache(maxsize=16)
def scene_heading_deg(seed: int) -> float:
    """The heading of a scene's own u axis; any direction, since nature follows no grid of streets."""
    return float(np.random.default_rng([seed, 11]).uniform(5.0, 85.0))


@dataclass(frozen=True, eq=False)
class Rolling:
    """Waves as heights."""

    waves: Waves
    cell_m: float

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        return self.waves.at(xy_m[:, 0], xy_m[:, 1])


def rolling_land(waves: Waves, relief_m: float, cell_m: float) -> Rolling:
    """Waves scaled so that the land rises and falls by relief_m within RELIEF_REACH_M of the origin along x and y."""
    steps = np.arange(-RELIEF_REACH_M, RELIEF_REACH_M + 1.0, _RELIEF_STEP_M)
    heights = waves.at(*np.meshgrid(steps, steps))
    return Rolling(waves.scaled(relief_m / float(np.ptp(heights))), cell_m)


@dataclass(frozen=True, eq=False)
class Dunes:
    """Transverse dunes: crests across the wind, long windward slopes and short slip faces to the lee.

    heading_deg: where the wind blows to, counter-clockwise from east. length_m: from crest to crest.
    height_above_base_m: of the highest. skew: above 0 (sine waves) and below 1 (saw teeth).
    winding: metres by which crests are shifted along the wind.
    envelope: below -1 there are no dunes, above 1 they are full. base: the land below them.
    """

    heading_deg: float
    length_m: float
    height_above_base_m: float
    skew: float
    winding: Waves
    envelope: Waves
    base: Waves
    cell_m: float

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """World heights (N,) at plan points (N, 2).

        The profile is sum(skew^n sin(n phase) / n), the power series of a saw tooth made smooth, in closed form.
        """
        u, v = np.moveaxis(turned(xy_m, self.heading_deg), -1, 0)
        phase = -2.0 * np.pi * (u + self.winding.at(u, v)) / self.length_m
        saw = np.arctan2(self.skew * np.sin(phase), 1.0 - self.skew * np.cos(phase))
        profile = 0.5 + 0.5 * saw / np.arcsin(self.skew)
        share = np.clip(0.5 + 0.5 * self.envelope.at(u, v), 0.0, 1.0)
        full = share * share * (3.0 - 2.0 * share)
        return self.height_above_base_m * full * profile + self.base.at(u, v)
