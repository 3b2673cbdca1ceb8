"""Hedges, rows of trees and farms that stand along the borders of fields."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.fields import Rolling, turned, unturned
from aeromatch_cli.lab.synthetic.houses import house, roofed
from aeromatch_cli.lab.synthetic.scenes.parcels import (
    FARM_U_M,
    FARM_V_M,
    HEDGE,
    PITCH_U_M,
    PITCH_V_M,
    ROAD,
    TRACK,
    border_u_kind,
    border_u_m,
    border_v_kind,
    border_v_m,
    is_farm,
    unbent,
)
from aeromatch_cli.lab.synthetic.solids import Footprint, Material, Surface, patch, raised, shade, walls
from aeromatch_cli.lab.synthetic.terrain import Area
from aeromatch_cli.lab.synthetic.trees import Species, tree

_SHRUB_EVERY_M, _TREE_EVERY_M = 2.0, 11.0
_ROOFS = ((0.17, 0.085, 0.06), (0.20, 0.195, 0.19), (0.125, 0.115, 0.105))
_METAL = (0.26, 0.27, 0.28)
_SHEDS = ((0.23, 0.19, 0.14), (0.30, 0.29, 0.27), (0.20, 0.11, 0.08))


@dataclass(frozen=True, eq=False)
class _Land:
    seed: int
    area: Area
    terrain: Rolling
    heading_deg: float

    def world(self, u_m: float, v_m: float) -> tuple[float, float, float]:
        """x, y and the ground's height of a place in bent coordinates."""
        x, y, ground_m = self.worlds(np.array([[u_m, v_m]]))[0].tolist()
        return x, y, ground_m

    def worlds(self, uv_m: FloatArray) -> FloatArray:
        """(N, 3) the same of many places (N, 2) at once."""
        plain = np.stack(unbent(uv_m[:, 0], uv_m[:, 1], self.seed), axis=1)
        xy = unturned(plain, self.heading_deg)
        return np.column_stack([xy, self.terrain.height_m(xy)])


def farm_solids(seed: int, area: Area, terrain: Rolling, heading_deg: float) -> tuple[list[Surface], dict[str, int]]:
    """The solids inside an area and how many of each kind."""
    land = _Land(seed, area, terrain, heading_deg)
    surfaces: list[Surface] = []
    solids = {"trees": 0, "shrubs": 0, "buildings": 0}
    for column, row in _cells(area, heading_deg):
        # Cells are counted from far outside any scene: a generator takes no negative numbers.
        rng = np.random.default_rng([seed, 34, column + 100_000, row + 100_000])
        for kind, solid in (*_hedges(rng, land, column, row), *_roadside(rng, land, column, row)):
            surfaces += solid
            solids[kind] += 1
        if bool(is_farm(np.array([float(column)]), np.array([float(row)]), seed)[0]):
            for solid in _farm(rng, land, column, row):
                surfaces += solid
                solids["buildings"] += 1
    return surfaces, solids


def _cells(area: Area, heading_deg: float) -> Iterator[tuple[int, int]]:
    corners = np.array([[x, y] for x in (area.x0_m, area.x1_m) for y in (area.y0_m, area.y1_m)])
    low, high = (turned(corners, heading_deg).min(axis=0), turned(corners, heading_deg).max(axis=0))
    first, last = np.floor(low / [PITCH_U_M, PITCH_V_M]) - 1, np.ceil(high / [PITCH_U_M, PITCH_V_M]) + 1
    for column in range(int(first[0]), int(last[0]) + 1):
        for row in range(int(first[1]), int(last[1]) + 1):
            yield column, row


_Found = Iterator[tuple[str, list[Surface]]]


def _hedges(rng: np.random.Generator, land: _Land, column: int, row: int) -> _Found:
    """Shrubs, and now and then a tree, along the borders at a field's low u and low v where there is a hedge."""
    here = _borders(land.seed, column, row)
    lines = []
    if here.kind_u == HEDGE:
        lines.append((np.array([here.u0, here.v0]), np.array([here.u0, here.v1])))
    if here.kind_v == HEDGE:
        lines.append((np.array([here.u0 + 3.0, here.v0]), np.array([here.u1 - 3.0, here.v0])))
    for start, end in lines:
        count = int(np.hypot(*(end - start)) / _SHRUB_EVERY_M)
        drawn, places = [], []
        for t in (np.arange(count) + 0.5) / count:
            gap, tall = rng.random() < 0.10, rng.random() < 0.07
            radius = float(rng.uniform(0.9, 1.7))
            places.append(start + t * (end - start) + rng.uniform(-0.35, 0.35, 2))
            drawn.append((gap, tall, radius, int(rng.integers(2**31))))
        worlds = land.worlds(np.array(places).reshape(-1, 2)).tolist()
        for (gap, tall, radius, seed), (x, y, ground_m) in zip(drawn, worlds, strict=True):
            if gap or not land.area.contains(x, y):
                continue
            own = np.random.default_rng(seed)
            if tall:
                yield "trees", tree(own, x, y, ground_m - 0.1, 2.0 * radius, 4.6 * radius, Species.BROADLEAF)
            else:
                yield "shrubs", tree(own, x, y, ground_m - 0.1, radius, 1.5 * radius, Species.SHRUB)


def _roadside(rng: np.random.Generator, land: _Land, column: int, row: int) -> _Found:
    """Trees beside some tracks and roads."""
    here = _borders(land.seed, column, row)
    off_m = {TRACK: 3.6, ROAD: 5.4}.get(here.kind_u)
    lined = rng.random() < 0.45
    for k in range(int((here.v1 - here.v0) / _TREE_EVERY_M)):
        radius, present = float(rng.uniform(1.9, 3.4)), rng.random() < 0.7
        own = np.random.default_rng(int(rng.integers(2**31)))
        if off_m is None or not (lined and present):
            continue
        x, y, ground_m = land.world(here.u0 + off_m, here.v0 + (k + 0.5) * _TREE_EVERY_M)
        if land.area.contains(x, y):
            yield "trees", tree(own, x, y, ground_m - 0.1, radius, 2.5 * radius, Species.BROADLEAF)


@dataclass(frozen=True)
class _Borders:
    u0: float
    u1: float
    v0: float
    v1: float
    kind_u: int
    kind_v: int


def _borders(seed: int, column: int, row: int) -> _Borders:
    columns, rows = np.array([column, column + 1.0]), np.array([row, row + 1.0])
    u0, u1 = border_u_m(columns, seed).tolist()
    v0, v1 = border_v_m(np.full(2, float(column)), rows, seed).tolist()
    kind_u = int(border_u_kind(columns[:1], seed)[0])
    return _Borders(u0, u1, v0, v1, kind_u, int(border_v_kind(columns[:1], rows[:1], seed)[0]))


def _farm(rng: np.random.Generator, land: _Land, column: int, row: int) -> Iterator[list[Surface]]:
    """A dwelling, a barn and a shed around the yard in the corner of a field; a silo beside the barn."""
    here = _borders(land.seed, column, row)
    roof = (Material.TILED_ROOF, shade(rng, _ROOFS))
    sheet = (Material.SHEET, (0.27, 0.275, 0.28))
    wood = (Material.PLASTER, shade(rng, _SHEDS))
    own = np.random.default_rng(int(rng.integers(2**31)))
    turn, pitch = land.heading_deg + float(rng.uniform(-3.0, 3.0)), float(rng.uniform(0.45, 0.75))
    barn_m = (float(rng.uniform(18.0, 24.0)), float(rng.uniform(9.5, 12.0)))
    for part, du, dv, size in (
        ("house", 0.30 * FARM_U_M, 0.24 * FARM_V_M, (11.5, 8.5)),
        ("barn", 0.66 * FARM_U_M, 0.72 * FARM_V_M, barn_m),
        ("shed", 0.24 * FARM_U_M, 0.66 * FARM_V_M, (8.0, 5.5)),
        ("silo", 0.66 * FARM_U_M, 0.38 * FARM_V_M, (3.6, 3.6)),
    ):
        x, y, ground_m = land.world(here.u0 + du, here.v0 + dv)
        plan = Footprint(x, y, *size, turn)
        if not land.area.contains(x, y):
            continue
        if part == "house":
            yield house(own, plan, ground_m + 0.2, sunk_m=1.5)
        elif part == "silo":
            yield _silo(plan, ground_m)
        else:
            eaves = 4.6 if part == "barn" else 2.6
            yield roofed(
                plan, ground_m - 1.5, ground_m + eaves, pitch, False, (wood, roof if part == "barn" else sheet)
            )


def _silo(plan: Footprint, ground_m: float) -> list[Surface]:
    """Three tanks of sheet metal in a row, twelve sides each."""
    angle = np.arange(12) * (np.pi / 6.0)
    ring = 0.5 * plan.length_x_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    found: list[Surface] = []
    for k in (-1.0, 0.0, 1.0):
        corners = plan.at(ring + np.array([1.15 * k * plan.length_x_m, 0.0]))
        found += walls(corners, ground_m - 1.0, ground_m + 7.5, [Material.SHEET] * len(angle), _METAL)
        found.append(patch(raised(corners, ground_m + 7.5), Material.SHEET, _METAL))
    return found
