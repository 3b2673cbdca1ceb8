"""The lots of a suburb: rows of them back to back between bent streets, and what each lot holds.

The plan is drawn straight in (p, q) metres and then bent: `bent` gives the (u, v) of a (p, q), `straight` the reverse.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.noise import hash01

ROW_M, CROSS_M = 78.0, 165.0
# Nothing is bent farther than this from its straight place.
BEND_M = 34.0
VERGE_M, PATH_M = 1.3, 1.4
STREET_HALF_M = (2.7, 3.5)
_LOT_STREAM = 41


@dataclass(frozen=True)
class Box:
    """A rectangle of the straight plan."""

    p0_m: float
    q0_m: float
    p1_m: float
    q1_m: float


@dataclass(frozen=True, eq=False)
class Lot:
    """A piece of land. facing: -1 where its street lies at q0, 1 at q1. own: 0-1, how it is kept. park: no house.

    house: of its main house, longer side along p. paved, beds: rectangles of the ground. shed, pool: or None.
    key: (row, block, number).
    """

    land: Box
    facing: float
    own: float
    park: bool
    house: Box
    paved: tuple[Box, ...]
    beds: tuple[Box, ...]
    shed: Box | None
    pool: Box | None
    garage: Box | None
    key: tuple[int, int, int]

    def rng(self, seed: int, stream: int) -> np.random.Generator:
        row, block, number = self.key
        return np.random.default_rng([seed, stream, row + 100_000, block + 100_000, number])


def _chance(seed: int, salt: int, i: int, j: int = 0) -> float:
    return float(hash01(np.array([i]), np.array([j]), seed * 137 + salt)[0])


@lru_cache(maxsize=64)
def _phases(seed: int) -> tuple[float, ...]:
    return tuple(6.2832 * _chance(seed, 60 + k, 0) for k in range(4))


def _bend(seed: int, p_m: FloatArray, q_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    a, b, c, d = _phases(seed)
    du = 14.0 * np.sin(q_m / 62.0 + a) + 9.0 * np.sin(p_m / 95.0 + 0.4 * q_m / 95.0 + b)
    dv = 16.0 * np.sin(p_m / 71.0 + c) + 9.0 * np.sin(q_m / 110.0 - 0.3 * p_m / 80.0 + d)
    return du, dv


def bent(seed: int, pq_m: FloatArray) -> FloatArray:
    """(N, 2) places in the plan of points (N, 2) of the straight plan."""
    du, dv = _bend(seed, pq_m[:, 0], pq_m[:, 1])
    return pq_m + np.column_stack([du, dv])


def straight(seed: int, uv_m: FloatArray) -> FloatArray:
    """The reverse of `bent`, good to a millimetre."""
    pq_m = uv_m.copy()
    for _ in range(14):
        pq_m = uv_m - np.column_stack(_bend(seed, pq_m[:, 0], pq_m[:, 1]))
    return pq_m


@lru_cache(maxsize=4096)
def street_q(seed: int, row: int) -> tuple[float, float]:
    """Axis and half width of the street below a row."""
    narrow, wide = STREET_HALF_M
    q = ROW_M * row + 12.0 * (_chance(seed, 1, row) - 0.5)
    return q, narrow + (wide - narrow) * _chance(seed, 2, row)


@lru_cache(maxsize=4096)
def cross_p(seed: int, row: int, k: int) -> tuple[float, float]:
    """Axis and half width of cross street k of a row."""
    p = CROSS_M * (k + 0.5 * (row % 2)) + 55.0 * (_chance(seed, 3, row, k) - 0.5)
    return p, STREET_HALF_M[0] + 0.4 * _chance(seed, 4, row, k)


@lru_cache(maxsize=4096)
def block_lots(seed: int, row: int, k: int) -> tuple[Lot, ...]:
    """The lots between cross streets k and k + 1 of a row."""
    (q0, half0), (q1, half1) = street_q(seed, row), street_q(seed, row + 1)
    (p0, left), (p1, right) = cross_p(seed, row, k), cross_p(seed, row, k + 1)
    rng = np.random.default_rng([seed, _LOT_STREAM, row + 100_000, k + 100_000])
    edge = VERGE_M + PATH_M
    p0, p1, q0, q1 = p0 + left + edge, p1 - right - edge, q0 + half0 + edge, q1 - half1 - edge
    middle = 0.5 * (q0 + q1) + rng.uniform(-3.0, 3.0)
    found: list[Lot] = []
    is_park = rng.random() < 0.07
    for facing, low, high in ((-1.0, q0, middle), (1.0, middle, q1)):
        count = 1 if is_park else max(1, round((p1 - p0) / rng.uniform(15.0, 24.0)))
        cuts = np.linspace(p0, p1, count + 1)
        cuts[1:-1] += rng.uniform(-2.2, 2.2, count - 1)
        for n in range(count):
            land = Box(float(cuts[n]), low, float(cuts[n + 1]), high)
            # Every lot draws from its own stream, so that one lot's choices move no other's.
            own = np.random.default_rng([seed, _LOT_STREAM + 1, row + 100_000, k + 100_000, len(found)])
            found.append(_lot(own, land, facing, is_park, (row, k, len(found))))
    return tuple(found)


def _lot(rng: np.random.Generator, land: Box, facing: float, park: bool, key: tuple[int, int, int]) -> Lot:
    wide, deep = land.p1_m - land.p0_m, land.q1_m - land.q0_m
    own = float(rng.random())

    def place(p: float, from_street: float, length: float, depth: float) -> Box:
        """A rectangle by its left edge from p0, its distance from the street, and its lengths."""
        q = land.q0_m + from_street if facing < 0.0 else land.q1_m - from_street - depth
        return Box(land.p0_m + p, q, land.p0_m + p + length, q + depth)

    drive_left = rng.random() < 0.5
    drive = rng.uniform(2.7, 3.6) if wide < 19.0 else rng.uniform(3.0, 5.4)
    length, depth = min(wide - drive - 2.6, rng.uniform(9.5, 15.0)), rng.uniform(7.5, 10.0)
    setback = rng.uniform(4.5, 9.5)
    start = drive + 1.0 + rng.uniform(0.0, max(wide - drive - length - 2.2, 0.0))
    start = start if drive_left else wide - start - length
    house = place(start, setback, length, min(depth, length - 0.5))
    drive_p = 0.5 if drive_left else wide - drive - 0.5
    has_garage = rng.random() < 0.4
    reach = setback + rng.uniform(0.3, 0.9) * depth
    paved = [place(drive_p, -0.2, drive, reach)]
    garage = place(drive_p + 0.1, reach, min(drive - 0.2, 3.4), 5.8) if has_garage else None
    door = start + rng.uniform(0.2, 0.8) * length
    paved.append(place(door - 0.6, -0.2, 1.2, setback))
    behind = setback + house.q1_m - house.q0_m
    terrace = rng.uniform(0.4, 0.9) * length
    paved.append(place(start + rng.uniform(0.0, length - terrace), behind, terrace, rng.uniform(2.2, 4.5)))
    beds = [place(start, setback - 1.1, length, 1.0)] if rng.random() < 0.6 else []
    for _ in range(int(rng.integers(0, 4))):
        along = rng.random() < 0.5
        bed_l, bed_d = (
            (rng.uniform(4.0, 9.0), rng.uniform(0.8, 1.6)) if along else (rng.uniform(1.0, 2.4), rng.uniform(2.0, 6.0))
        )
        beds.append(
            place(
                rng.uniform(0.3, max(wide - bed_l, 0.4)),
                rng.uniform(behind + 4.0, max(deep - bed_d - 0.3, behind + 4.1)),
                bed_l,
                bed_d,
            )
        )
    room = deep - behind - 6.0
    shed = pool = None
    if room > 5.0 and rng.random() < 0.55:
        shed_l, shed_d = rng.uniform(2.0, 4.2), rng.uniform(1.8, 3.0)
        shed = place(
            rng.choice([0.8, max(wide - shed_l - 0.8, 0.8)]), deep - shed_d - rng.uniform(0.8, 2.5), shed_l, shed_d
        )
    if room > 9.0 and rng.random() < 0.2:
        pool_l, pool_d = rng.uniform(5.5, 9.0), rng.uniform(3.2, 4.4)
        pool = place(rng.uniform(1.5, max(wide - pool_l - 1.5, 1.6)), behind + 5.5, min(pool_l, wide - 3.0), pool_d)
        paved.append(Box(pool.p0_m - 1.6, pool.q0_m - 1.5, pool.p1_m + 1.6, pool.q1_m + 1.5))
    if park:
        paved, beds, shed, pool, garage = [], [], None, None, None
    return Lot(land, facing, own, park, house, tuple(paved), tuple(beds), shed, pool, garage, key)


def rows_near(seed: int, p0_m: float, q0_m: float, p1_m: float, q1_m: float) -> list[tuple[int, int]]:
    """(row, block) of all blocks that may reach into a rectangle of the straight plan."""
    rows = range(int(np.floor(q0_m / ROW_M)) - 2, int(np.ceil(q1_m / ROW_M)) + 2)
    blocks = range(int(np.floor(p0_m / CROSS_M)) - 2, int(np.ceil(p1_m / CROSS_M)) + 2)
    return [(row, k) for row in rows for k in blocks]
