"""How farmland is divided: fields of uneven size along a slightly bent grid, and what runs along their borders."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.lab.synthetic.fields import Waves, random_waves
from aeromatch_cli.lab.synthetic.noise import hash01

PITCH_U_M, PITCH_V_M = 78.0, 112.0
_JITTER = 0.30
BEND_M = 2.5

# What runs along a border across u: the share of borders with a road, a track, a hedge; the rest have a strip of grass.
ROAD, TRACK, HEDGE, STRIP = range(4)
_U_SHARES = (0.16, 0.46, 0.70)
_V_SHARES = (0.0, 0.0, 0.45)
# A farm takes the corner at low u and low v of some fields that lie beside a track or a road.
FARM_U_M, FARM_V_M, _FARM_SHARE = 44.0, 40.0, 0.3
HALF_WIDTH_M = np.array([3.9, 2.4, 1.8, 0.7], dtype=np.float32)


@lru_cache(maxsize=8)
def _bends(seed: int) -> tuple[Waves, Waves]:
    bends = [random_waves((seed, 31, k), 260.0, 700.0, 3).scaled(BEND_M) for k in range(2)]
    return bends[0], bends[1]


@dataclass(frozen=True, eq=False)
class Parcels:
    """The fields that N places lie in. column, row: (N,) whole-numbered.

    from_u0, to_u1, from_v0, to_v1: (N,) distances to the middles of the four borders, metres. kind_u0, kind_u1,
    kind_v0, kind_v1: (N,) what runs along them.
    """

    column: FloatArray
    row: FloatArray
    from_u0: FloatArray
    to_u1: FloatArray
    from_v0: FloatArray
    to_v1: FloatArray
    kind_u0: IntArray
    kind_u1: IntArray
    kind_v0: IntArray
    kind_v1: IntArray

    def own(self, seed: int, salt: int) -> FloatArray:
        """A random number (N,) in 0-1 of each field."""
        return hash01(self.column, self.row, seed * 101 + salt)


def bent(u_m: FloatArray, v_m: FloatArray, seed: int) -> tuple[FloatArray, FloatArray]:
    """The coordinates in which borders are straight."""
    bend_u, bend_v = _bends(seed)
    return u_m + bend_u.at(u_m, v_m), v_m + bend_v.at(u_m, v_m)


def unbent(u_m: FloatArray, v_m: FloatArray, seed: int) -> tuple[FloatArray, FloatArray]:
    """The inverse of `bent`, by fixed-point steps; bends are so slight that six are exact to a micrometre."""
    bend_u, bend_v = _bends(seed)
    u, v = u_m, v_m
    for _ in range(6):
        u, v = u_m - bend_u.at(u, v), v_m - bend_v.at(u, v)
    return u, v


def border_u_m(number: FloatArray, seed: int) -> FloatArray:
    """Bent u of the borders across u; whole-numbered."""
    jitter = hash01(number, np.zeros_like(number), seed * 101 + 41) - 0.5
    return (number + 2.0 * _JITTER * jitter) * PITCH_U_M


def border_v_m(column: FloatArray, number: FloatArray, seed: int) -> FloatArray:
    """Bent v of the borders across v in a column of fields."""
    jitter = hash01(number, column, seed * 101 + 42) - 0.5
    return (number + 2.0 * _JITTER * jitter) * PITCH_V_M


def border_u_kind(number: FloatArray, seed: int) -> IntArray:
    """What runs along a border across u; the one nearest to the origin always has a track."""
    kind = np.searchsorted(_U_SHARES, hash01(number, np.zeros_like(number), seed * 101 + 43), side="right")
    return np.where(number == 0, TRACK, kind)


def border_v_kind(column: FloatArray, number: FloatArray, seed: int) -> IntArray:
    """What runs along a border across v in a column of fields."""
    return np.searchsorted(_V_SHARES, hash01(number, column, seed * 101 + 44), side="right")


def parcels_at(u_m: FloatArray, v_m: FloatArray, seed: int) -> Parcels:
    """The fields of places given in bent coordinates."""
    near = np.round(u_m / PITCH_U_M)
    column = near - (u_m < border_u_m(near, seed))
    near = np.round(v_m / PITCH_V_M)
    row = near - (v_m < border_v_m(column, near, seed))
    return Parcels(
        column=column,
        row=row,
        from_u0=u_m - border_u_m(column, seed),
        to_u1=border_u_m(column + 1, seed) - u_m,
        from_v0=v_m - border_v_m(column, row, seed),
        to_v1=border_v_m(column, row + 1, seed) - v_m,
        kind_u0=border_u_kind(column, seed),
        kind_u1=border_u_kind(column + 1, seed),
        kind_v0=border_v_kind(column, row, seed),
        kind_v1=border_v_kind(column, row + 1, seed),
    )


def is_farm(column: FloatArray, row: FloatArray, seed: int) -> BoolArray:
    """Whether (N,) fields hold a farm."""
    beside = border_u_kind(column, seed) <= TRACK
    return beside & (hash01(column, row, seed * 101 + 45) < _FARM_SHARE)
