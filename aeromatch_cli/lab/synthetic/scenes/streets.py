"""The streets of a city: a bent, uneven net whose meshes, some of them cut in two, are the blocks.

Everything is in the plan's own frame (u, v metres) and follows from the seed and the number of the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.noise import hash01
from aeromatch_cli.lab.synthetic.solids import shrunk

PITCH_U_M, PITCH_V_M = 118.0, 92.0
# No corner is farther than this from its place in the even net.
STRAY_M = 48.0
_CORNER_M = 4.0  # kerbs turn corners in an arc about this wide


@dataclass(frozen=True, eq=False)
class Side:
    """One side of a block, counter-clockwise, on the axis of the street along it.

    start_uv, end_uv: (2,). half_m: of the carriageway. pavement_m: width. first_uv, last_uv: the ends of the street
    between its crossings, the same from both sides; its markings begin first_gap_m and end last_gap_m away from them.
    number: the street's own, 0-1. wide: it has two lanes each way.
    """

    start_uv: FloatArray
    end_uv: FloatArray
    half_m: float
    pavement_m: float
    first_uv: FloatArray
    last_uv: FloatArray
    first_gap_m: float
    last_gap_m: float
    number: float
    wide: bool


@dataclass(frozen=True, eq=False)
class Block:
    """A convex block between street axes. key: (i, j, part) of the mesh."""

    sides: tuple[Side, ...]
    key: tuple[int, int, int]

    @property
    def corners_uv(self) -> FloatArray:
        """(K, 2) corners, counter-clockwise, on the street axes."""
        return np.stack([side.start_uv for side in self.sides])

    def plot_uv(self, further_m: float = 0.0) -> FloatArray:
        """(K, 2) corners of the ground behind the pavements, or of what lies that much further inside."""
        return shrunk(self.corners_uv, [side.half_m + side.pavement_m + further_m for side in self.sides])

    def rng(self, seed: int, stream: int) -> np.random.Generator:
        # The generator takes no negative numbers; meshes are counted from far outside any scene.
        i, j, part = self.key
        return np.random.default_rng([seed, stream, i + 100_000, j + 100_000, part])


def chance(seed: int, salt: int, i: int, j: int = 0) -> float:
    """A number in 0-1 that belongs to a place."""
    return float(hash01(np.array([i]), np.array([j]), seed * 131 + salt)[0])


@lru_cache(maxsize=8192)
def _corner(seed: int, i: int, j: int) -> tuple[float, float]:
    """A crossing: lines stray as wholes, crossings a little more, and the whole net is bent."""
    u = PITCH_U_M * (i + 0.34 * (chance(seed, 1, i) - 0.5)) + 9.0 * (chance(seed, 3, i, j) - 0.5)
    v = PITCH_V_M * (j + 0.34 * (chance(seed, 2, j) - 0.5)) + 9.0 * (chance(seed, 4, i, j) - 0.5)
    bend_u = 15.0 * np.sin(v / 75.0 + 6.28 * chance(seed, 5, 0))
    bend_v = 13.0 * np.sin(u / 83.0 + 6.28 * chance(seed, 6, 0))
    return float(u + bend_u), float(v + bend_v)


@lru_cache(maxsize=1024)
def _street(seed: int, axis: int, k: int) -> tuple[float, float, float, bool]:
    """Half width, pavement, own number and whether it is wide, of street line k along u (axis 0) or v (axis 1)."""
    own = chance(seed, 10 + axis, k)
    if own < 0.24:
        return 8.3, 4.2 + 6.0 * own, own, True
    return 3.6 + 2.6 * chance(seed, 12 + axis, k), 2.3 + 1.9 * chance(seed, 14 + axis, k), own, False


@lru_cache(maxsize=4096)
def mesh(seed: int, i: int, j: int) -> tuple[Block, ...]:
    """The one or two blocks of a mesh of the net."""
    at = [np.array(_corner(seed, a, b)) for a, b in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))]
    row = [_street(seed, 0, k) for k in (j, j + 1)]
    column = [_street(seed, 1, k) for k in (i, i + 1)]
    gap = [line[0] + _CORNER_M - 1.0 for line in (column[0], column[1], row[0], row[1])]
    bottom = Side(at[0], at[1], *row[0][:2], at[0], at[1], gap[0], gap[1], *row[0][2:])
    right = Side(at[1], at[2], *column[1][:2], at[1], at[2], gap[2], gap[3], *column[1][2:])
    top = Side(at[2], at[3], *row[1][:2], at[3], at[2], gap[0], gap[1], *row[1][2:])
    left = Side(at[3], at[0], *column[0][:2], at[0], at[3], gap[2], gap[3], *column[0][2:])
    whole = Block((bottom, right, top, left), (i, j, 0))
    if chance(seed, 20, i, j) > 0.5:
        return (whole,)
    # A lane between points of the long sides; where they are not opposite each other it runs askew.
    t0, t1 = (0.36 + 0.28 * chance(seed, salt, i, j) for salt in (21, 22))
    low, high = at[0] + t0 * (at[1] - at[0]), at[3] + t1 * (at[2] - at[3])
    lane = (3.0 + 1.2 * chance(seed, 23, i, j), 1.8, low, high, row[0][0] + 3.0, row[1][0] + 3.0,
            chance(seed, 24, i, j), False)  # fmt: skip
    west = (_cut(bottom, at[0], low), Side(low, high, *lane), _cut(top, high, at[3]), left)
    east = (_cut(bottom, low, at[1]), right, _cut(top, at[2], high), Side(high, low, *lane))
    return Block(west, (i, j, 0)), Block(east, (i, j, 1))


def _cut(side: Side, start_uv: FloatArray, end_uv: FloatArray) -> Side:
    return Side(
        start_uv, end_uv, side.half_m, side.pavement_m, side.first_uv, side.last_uv, side.first_gap_m,
        side.last_gap_m, side.number, side.wide,
    )  # fmt: skip


def blocks_near(seed: int, u0_m: float, v0_m: float, u1_m: float, v1_m: float) -> list[Block]:
    """All blocks that may reach into a rectangle of the plan."""
    i0, i1 = int(np.floor((u0_m - STRAY_M) / PITCH_U_M)) - 1, int(np.ceil((u1_m + STRAY_M) / PITCH_U_M)) + 1
    j0, j1 = int(np.floor((v0_m - STRAY_M) / PITCH_V_M)) - 1, int(np.ceil((v1_m + STRAY_M) / PITCH_V_M)) + 1
    return [block for i in range(i0, i1) for j in range(j0, j1) for block in mesh(seed, i, j)]


@dataclass(frozen=True, eq=False)
class StreetMap:
    """Of points (N,) in a block: kerb_m, distance from the kerb, negative on the carriageway; plot_m, distance from
    the edge of the pavement, positive behind it; and of the nearest street: side_m, distance from its axis, signed;
    along_m; end_m, distance past the nearest crossing, negative on it; street, index of the side."""

    kerb_m: FloatArray
    plot_m: FloatArray
    side_m: FloatArray
    along_m: FloatArray
    end_m: FloatArray
    street: NDArray[np.int64]


def street_map(block: Block, uv_m: FloatArray) -> tuple[NDArray[np.bool_], StreetMap]:
    """Which of the points (N, 2) lie in the block, and the map of all of them, which is right inside only."""
    from_axis = np.stack([left_of(side.start_uv, side.end_uv, uv_m) for side in block.sides], axis=1)
    beyond = from_axis - [side.half_m for side in block.sides]
    kerb_m = np.full(len(uv_m), 1e3)
    for k in range(beyond.shape[1]):
        # Smooth minimum (polynomial, Quilez): the kerb turns corners in an arc.
        blend = np.clip(1.0 - np.abs(kerb_m - beyond[:, k]) / _CORNER_M, 0.0, None)
        kerb_m = np.minimum(kerb_m, beyond[:, k]) - 0.25 * _CORNER_M * blend**2
    plot_m = (beyond - [side.pavement_m for side in block.sides]).min(axis=1)
    street = np.argmin(beyond, axis=1)
    side_m, along_m, end_m = (np.zeros(len(uv_m)) for _ in range(3))
    for k, side in enumerate(block.sides):
        rows = np.flatnonzero(street == k)
        axis = side.last_uv - side.first_uv
        length = float(np.linalg.norm(axis))
        along = (uv_m[rows] - side.first_uv) @ (axis / length)
        along_m[rows], side_m[rows] = along, left_of(side.first_uv, side.last_uv, uv_m[rows])
        end_m[rows] = np.minimum(along - side.first_gap_m, length - along - side.last_gap_m)
    own: NDArray[np.bool_] = np.asarray((from_axis > -1e-6).all(axis=1))
    return own, StreetMap(kerb_m, plot_m, side_m, along_m, end_m, street)


def left_of(start_uv: FloatArray, end_uv: FloatArray, uv_m: FloatArray) -> FloatArray:
    """Signed distance (N,) of points from a line, positive on its left."""
    along = (end_uv - start_uv) / np.linalg.norm(end_uv - start_uv)
    left: FloatArray = (uv_m - start_uv) @ np.array([-along[1], along[0]])
    return left
