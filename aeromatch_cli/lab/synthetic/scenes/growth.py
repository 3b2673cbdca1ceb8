"""What several natural scenes share: clumps painted on the ground, paths, and places for solids."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.fields import random_waves
from aeromatch_cli.lab.synthetic.noise import hash01, inside, octave
from aeromatch_cli.lab.synthetic.paint import Samples
from aeromatch_cli.lab.synthetic.terrain import Area

# Cells are counted from far outside any scene: a generator takes no negative numbers.
_FAR = 1_000_000


def clumps(
    s: Samples, cell_m: float, density: float | FloatArray, number: int, height: float, ragged: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Tufts, shrubs or stones, at most one to a cell: coverage (N,), each one's own number (N,) in 0-1, and the slope
    (N, 2) of a dome that is `height` of its radius high.

    density: share of cells that hold one, constant or (N,); clumps shrink and vanish where it falls. ragged: noise (N,)
    of unit variance that outlines follow.
    """
    salt = s.seed * 101 + 8 * number
    x, y = s.u_m / np.float32(cell_m), s.v_m / np.float32(cell_m)
    ix, iy = np.floor(x), np.floor(y)
    room = np.clip(3.0 * (density - hash01(ix, iy, salt + 4)), 0.0, 1.0)
    coverage, own = np.zeros_like(x), np.zeros_like(x)
    dome = np.zeros((len(x), 2), dtype=np.float32)
    at = np.flatnonzero(room > 0.0)
    ix, iy = ix[at], iy[at]
    number_of = hash01(ix, iy, salt + 3)
    radius = (0.10 + 0.20 * number_of * number_of) * room[at]
    offset = np.stack([x[at] - ix, y[at] - iy], axis=1) - 0.5
    offset -= 0.34 * (np.stack([hash01(ix, iy, salt + 1), hash01(ix, iy, salt + 2)], axis=1) - 0.5)
    distance = np.hypot(offset[:, 0], offset[:, 1]) * np.clip(1.0 + 0.28 * ragged[at], 0.5, 1.7)
    blur = 2.0 * s.footprint_m[at] / np.float32(cell_m)
    # What is smaller than a sample keeps its mean brightness.
    whole = np.minimum(1.0, (radius / blur) ** 2)
    coverage[at] = np.clip((radius - distance) / blur + 0.5, 0.0, 1.0) * whole
    own[at] = number_of
    dome[at] = np.float32(-2.0 * height) * (coverage[at] / np.maximum(radius, 0.02))[:, None] * offset
    return coverage, own, dome


def winding_path(s: Samples, wavelength_m: float, width_m: float, number: int) -> tuple[FloatArray, FloatArray]:
    """Paths of a width along a level line of waves: coverage (N,) and the distance (N,) from their middle, metres."""
    waves = random_waves((s.seed, number), 0.5 * wavelength_m, 1.5 * wavelength_m, 5)
    steep = waves.slope_at(s.u_m, s.v_m)
    # Around tops and hollows there is no slope to divide by: the path stays narrow there.
    least = np.float32(2.0 / wavelength_m)
    distance = np.abs(waves.at(s.u_m, s.v_m)) / np.maximum(np.hypot(steep[:, 0], steep[:, 1]), least)
    uneven = 1.0 + 0.18 * octave(s.u_m, s.v_m, 2.3, s.seed, number)
    return inside(0.5 * width_m * uneven - distance, s.footprint_m), distance


def scattered(
    key: tuple[int, ...], area: Area, cell_m: float, share: Callable[[FloatArray], FloatArray]
) -> Iterator[tuple[np.random.Generator, float, float]]:
    """Places (x, y) inside an area, at most one to a cell, each with its own random numbers; key seeds them.

    share: how likely (N,), 0-1, a cell holds one, from world places (N, 2).
    """
    salt = sum(part * factor for part, factor in zip(key, (101, 7919, 104729), strict=False))
    x, y = np.meshgrid(
        np.arange(np.floor(area.x0_m / cell_m), np.ceil(area.x1_m / cell_m)),
        np.arange(np.floor(area.y0_m / cell_m), np.ceil(area.y1_m / cell_m)),
    )
    cells = np.stack([x.ravel(), y.ravel()], axis=1)
    jitter = np.stack([hash01(cells[:, 0], cells[:, 1], salt + k) for k in (1, 2)], axis=1)
    places = (cells + 0.1 + 0.8 * jitter.astype(np.float64)) * cell_m
    chosen = hash01(cells[:, 0], cells[:, 1], salt + 3) < share(places)
    for (i, j), (px, py) in zip(cells[chosen].astype(int).tolist(), places[chosen].tolist(), strict=True):
        if area.contains(px, py):
            yield np.random.default_rng([*key, i + _FAR, j + _FAR]), px, py
