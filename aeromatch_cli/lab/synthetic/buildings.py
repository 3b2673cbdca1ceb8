"""Town houses, slabs, towers and halls: walls with windows, flat roofs with what stands on them, tiled roofs.

A plan is a convex quadrilateral (4, 2), counter-clockwise, world metres; its first side is the one on the street.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.facades import SHOP_M, STOREY_M
from aeromatch_cli.lab.synthetic.solids import (
    Footprint,
    Material,
    Surface,
    Tint,
    box,
    boxes,
    hexahedra,
    patch,
    raised,
    shade,
    shrunk,
    soup,
    walls,
)  # fmt: skip

_WALLS: tuple[Tint, ...] = (
    (0.46, 0.42, 0.34), (0.50, 0.48, 0.45), (0.40, 0.36, 0.30), (0.34, 0.33, 0.32), (0.42, 0.35, 0.27),
    (0.27, 0.16, 0.12), (0.55, 0.53, 0.49), (0.38, 0.40, 0.40), (0.48, 0.38, 0.32),
)  # fmt: skip
_TILES: tuple[Tint, ...] = (
    (0.185, 0.090, 0.065), (0.155, 0.082, 0.062), (0.105, 0.09, 0.085), (0.195, 0.115, 0.085), (0.085, 0.09, 0.098),
    (0.16, 0.08, 0.06),
)  # fmt: skip
_SHEETS: tuple[Tint, ...] = ((0.20, 0.21, 0.215), (0.13, 0.14, 0.15), (0.17, 0.09, 0.07), (0.17, 0.21, 0.185))
_FLATS: tuple[Tint, ...] = (
    (0.145, 0.145, 0.15), (0.20, 0.20, 0.20), (0.095, 0.095, 0.10), (0.25, 0.24, 0.225), (0.33, 0.325, 0.315),
    (0.17, 0.155, 0.14),
)  # fmt: skip
_LIGHT: Tint = (0.42, 0.42, 0.41)
_DARK: Tint = (0.10, 0.10, 0.105)
_BRICK: Tint = (0.20, 0.11, 0.08)
_PANES: Tint = (0.035, 0.04, 0.046)
_PARAPET_M, _PARAPET_WIDTH_M = 0.55, 0.32


@dataclass(frozen=True)
class Style:
    """How a building looks. tiles: what covers a pitched roof, None for a flat one. rise: height of the ridge over
    half the depth."""

    eaves_m: float
    wall: Tint
    roof: Tint
    tiles: Material | None
    rise: float
    dormers: bool


def draw_style(rng: np.random.Generator, storeys: int, pitched: float) -> Style:
    """pitched: how probable a pitched roof is."""
    tiles = None
    roof = shade(rng, _FLATS)
    if rng.random() < pitched:
        tiles = Material.TILED_ROOF if rng.random() < 0.72 else Material.SHEET
        roof = shade(rng, _TILES if tiles is Material.TILED_ROOF else _SHEETS)
    eaves = SHOP_M + STOREY_M * (storeys - 1) + rng.uniform(0.2, 0.9)
    rise = rng.uniform(0.55, 0.9) if tiles is Material.TILED_ROOF else rng.uniform(0.25, 0.6)
    return Style(eaves, shade(rng, _WALLS, 0.15), roof, tiles, rise, rng.random() < 0.6)


def town_house(
    rng: np.random.Generator, plan_m: FloatArray, style: Style, continued: tuple[int, ...] = ()
) -> list[Surface]:
    """A house in a row: windows to the street (side 0) and the yard (side 2), blind walls to its neighbours.

    continued: sides beyond which the same house goes on, around a corner.
    """
    sides = [Material.FACADE, Material.PLASTER, Material.FACADE, Material.PLASTER]
    found = walls(plan_m, 0.0, style.eaves_m, sides, style.wall)
    if style.tiles is None:
        return [*found, *_flat_top(rng, plan_m, style, continued)]
    return [*found, *_pitched_top(rng, plan_m, style)]


def _pitched_top(rng: np.random.Generator, plan_m: FloatArray, style: Style) -> list[Surface]:
    """Two slopes whose ridge runs along the street, blind gables, chimneys, dormers or roof windows."""
    a, b, c, d = raised(plan_m, style.eaves_m)
    left, right = 0.5 * (a + d), 0.5 * (b + c)
    along = (b - a) / np.linalg.norm(b - a)
    into = np.array([-along[1], along[0], 0.0])
    half_m = 0.5 * float((c - b) @ into)
    left[2] = right[2] = style.eaves_m + style.rise * half_m
    material = style.tiles or Material.TILED_ROOF
    found = [
        patch(np.stack([a, b, right, left]), material, style.roof),
        patch(np.stack([c, d, left, right]), material, style.roof),
        patch(np.stack([b, c, right]), Material.PLASTER, style.wall),
        patch(np.stack([d, a, left]), Material.PLASTER, style.wall),
    ]
    # Only between the cross walls, where corner houses have their full depth.
    first = max(float((d - a) @ along), 0.0) + 1.2
    last = min(float((b - a) @ along), float((c - a) @ along)) - 1.2
    if last - first < 3.0:
        return found
    heading_deg = float(np.rad2deg(np.arctan2(along[1], along[0])))
    ridge_m = left[2]
    stacks = int(rng.integers(1, 4))
    at = a + rng.uniform(first, last, size=(stacks, 1)) * along + (half_m + rng.uniform(-1.6, 1.6, (stacks, 1))) * into
    lengths = np.column_stack([rng.uniform(0.5, 1.6, stacks), np.full(stacks, 0.55)])
    chimneys = boxes(
        at[:, :2], lengths, heading_deg, np.full(stacks, style.eaves_m), ridge_m + rng.uniform(0.3, 1.1, stacks)
    )
    found.append(soup(chimneys, Material.PLASTER, _BRICK if rng.random() < 0.6 else _LIGHT))
    for edge, direction, inward in ((a, along, into), (a + 2.0 * half_m * into, along, -into)):
        where = np.arange(first + rng.uniform(0.3, 1.2), last - 0.8, rng.uniform(2.4, 4.2))
        if style.dormers and half_m * style.rise > 2.6:
            found += _dormers(edge + where[:, None] * direction, direction, inward, style)
        elif len(where):
            chosen = where[rng.random(len(where)) < 0.5]
            found += _roof_windows(
                edge + chosen[:, None] * direction, direction, inward, style, rng.uniform(0.35, 0.6) * half_m
            )
    return found


def _dormers(feet_m: FloatArray, along: FloatArray, inward: FloatArray, style: Style) -> list[Surface]:
    """Dormers 1.4 m wide behind points (N, 3) of the eaves, with a pane in front."""
    if not len(feet_m):
        return []
    front, half, high = 1.0, 0.7, 1.55
    floor_m, back = style.rise * front - 0.1, (style.rise * front + high) / style.rise
    up = np.array([0.0, 0.0, 1.0])

    def at(across: float, depth: float, height: float) -> FloatArray:
        moved: FloatArray = feet_m + across * along + depth * inward + height * up
        return moved

    # Seen from the street the two eaves run in opposite directions; the corners stay counter-clockwise.
    s = half if np.cross(along, inward)[2] > 0 else -half
    low = [at(-s, front, floor_m), at(s, front, floor_m), at(s, back, floor_m), at(-s, back, floor_m)]
    top = floor_m + high
    high_ring = [at(-s, front, top), at(s, front, top), at(s, back, top + 0.1), at(-s, back, top + 0.1)]
    body = hexahedra(np.stack([*low, *high_ring], axis=1))
    pane = np.stack(
        [at(-0.8 * s, front - 0.03, floor_m + 0.4), at(0.8 * s, front - 0.03, floor_m + 0.4),
         at(0.8 * s, front - 0.03, top - 0.15), at(-0.8 * s, front - 0.03, top - 0.15)], axis=1,
    )  # fmt: skip
    panes = pane[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    return [soup(body, Material.PLASTER, _mixed(style.roof, style.wall, 0.35)), soup(panes, Material.GLASS, _PANES)]


def _roof_windows(
    feet_m: FloatArray, along: FloatArray, inward: FloatArray, style: Style, depth_m: float
) -> list[Surface]:
    """Windows lying in the slope, a hand above it."""
    if not len(feet_m):
        return []
    rising = np.array([0.0, 0.0, style.rise])
    slope = (inward + rising) / np.hypot(1.0, style.rise)
    normal = np.cross(along, slope)
    sign = 1.0 if normal[2] > 0 else -1.0
    middle = feet_m + depth_m * (inward + rising)
    corners = [(-0.4, -0.6), (0.4, -0.6), (0.4, 0.6), (-0.4, 0.6)]
    ring = [middle + sign * x * along + y * slope for x, y in corners]
    body = hexahedra(np.stack([*(p - 0.1 * sign * normal for p in ring), *(p + 0.08 * sign * normal for p in ring)], 1))
    panes = np.stack([middle + 0.85 * (p - middle) + 0.1 * sign * normal for p in ring], axis=1)
    return [
        soup(body, Material.PAINT, (0.13, 0.13, 0.135)),
        soup(panes[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3), Material.GLASS, _PANES),
    ]


def _mixed(first: Tint, second: Tint, share: float) -> Tint:
    r, g, b = (1.0 - share) * np.array(first) + share * np.array(second)
    return float(r), float(g), float(b)


def _flat_top(
    rng: np.random.Generator, plan_m: FloatArray, style: Style, continued: tuple[int, ...] = ()
) -> list[Surface]:
    """Roof, parapet, and what stands on the roof: stair heads, rows of vents, machines, skylights."""
    center = plan_m.mean(axis=0)
    outer = plan_m
    inner = shrunk(plan_m, [0.0 if k in continued else _PARAPET_WIDTH_M for k in range(4)])
    ring = np.empty((4, 8, 3))
    for k in range(4):
        j = (k + 1) % 4
        ring[k, :4, :2] = ring[k, 4:, :2] = np.stack([outer[k], outer[j], inner[j], inner[k]])
    ring[:, :4, 2], ring[:, 4:, 2] = style.eaves_m, style.eaves_m + _PARAPET_M
    ring = ring[[k for k in range(4) if k not in continued]]
    rim = _LIGHT if rng.random() < 0.35 else _mixed(style.roof, _LIGHT, 0.3)
    found = [
        patch(raised(plan_m, style.eaves_m), Material.FLAT_ROOF, style.roof),
        soup(hexahedra(ring), Material.PLASTER, rim),
    ]
    along = (plan_m[1] - plan_m[0]) / np.linalg.norm(plan_m[1] - plan_m[0])
    into = np.array([-along[1], along[0]])
    half = 0.5 * np.array([min(np.ptp(plan_m[[0, 1, 2, 3]] @ along), 1e3), np.ptp(plan_m @ into)]) - 1.2
    # A corner house is askew: things keep to what is inside for sure.
    half[0] = max(half[0] - 0.25 * half[1], 1.0) if abs((plan_m[3] - plan_m[0]) @ along) > 1.0 else half[0]
    return [*found, *_roof_things(rng, center, along, into, half, style)]


def _roof_things(
    rng: np.random.Generator, center: FloatArray, along: FloatArray, into: FloatArray, half_m: FloatArray, style: Style
) -> list[Surface]:
    if half_m.min() < 1.5:
        return []
    heading_deg = float(np.rad2deg(np.arctan2(along[1], along[0])))
    area = 4.0 * half_m[0] * half_m[1]
    frame = np.stack([along, into])
    found = []

    def stand(own: FloatArray, lengths: FloatArray, heights: FloatArray, material: Material, tint: Tint) -> None:
        own = np.clip(own, -half_m + 0.5 * lengths, half_m - 0.5 * lengths)
        solid = boxes(
            center + own @ frame, lengths, heading_deg, np.full(len(own), style.eaves_m), style.eaves_m + heights
        )
        found.append(soup(solid, material, tint))

    heads = 1 + int(area > 350.0 and rng.random() < 0.7)
    lengths = np.minimum(rng.uniform(2.2, 4.2, size=(heads, 2)), half_m)
    stand(rng.uniform(-0.8, 0.8, (heads, 2)) * half_m, lengths, rng.uniform(1.8, 2.9, heads), Material.PLASTER,
          _mixed(style.wall, style.roof, 0.3))  # fmt: skip
    for _ in range(int(rng.integers(1, 3 + int(area / 250.0)))):
        # Vents stand in rows, above the shafts of the flats.
        count = int(rng.integers(2, 7))
        start = rng.uniform(-0.85, 0.6, 2) * half_m
        step = np.array([rng.uniform(0.9, 2.6), 0.0]) if rng.random() < 0.7 else np.array([0.0, rng.uniform(0.9, 1.8)])
        row = start + np.arange(count)[:, None] * step
        row = row[(np.abs(row) < half_m).all(axis=1)]
        size = np.tile(rng.uniform(0.35, 1.1, 2), (len(row), 1))
        if len(row):
            stand(
                row,
                size,
                rng.uniform(0.35, 1.0) * np.ones(len(row)),
                Material.PAINT,
                shade(rng, (_LIGHT, _DARK, _LIGHT, (0.24, 0.23, 0.22)), 0.3),
            )
    if rng.random() < 0.55:
        count = int(rng.integers(1, 5))
        tint = shade(rng, ((0.33, 0.34, 0.34), (0.22, 0.22, 0.22)))
        at, lengths = rng.uniform(-0.9, 0.9, (count, 2)) * half_m, rng.uniform(0.8, 2.4, (count, 2))
        stand(at, lengths, rng.uniform(0.6, 1.7, count), Material.PAINT, tint)
    if rng.random() < 0.4:
        count = int(rng.integers(2, 6))
        row = rng.uniform(-0.7, 0.4, 2) * half_m + np.arange(count)[:, None] * [2.2, 0.0]
        row = row[(np.abs(row) < half_m).all(axis=1)]
        if len(row):
            stand(row, np.tile([1.3, 1.3], (len(row), 1)), np.full(len(row), 0.35), Material.GLASS, (0.12, 0.14, 0.15))
    return found


def slab(rng: np.random.Generator, plan: Footprint, storeys: int) -> list[Surface]:
    """A free-standing block of flats: windows on the long sides, balconies on one of them, a flat roof."""
    style = draw_style(rng, storeys, pitched=0.0)
    corners = plan.corners_m()
    ends = Material.PLASTER if rng.random() < 0.6 else Material.FACADE
    found = walls(corners, 0.0, style.eaves_m, [Material.FACADE, ends, Material.FACADE, ends], style.wall)
    found += _flat_top(rng, corners, style)
    if rng.random() < 0.75:
        found.append(_balconies(rng, plan, style, storeys))
    return found


def _balconies(rng: np.random.Generator, plan: Footprint, style: Style, storeys: int) -> Surface:
    side = -1.0 if rng.random() < 0.5 else 1.0
    depth, width = rng.uniform(1.1, 1.5), rng.uniform(2.6, 4.0)
    columns = np.arange(-0.5 * plan.length_x_m + 3.0, 0.5 * plan.length_x_m - 2.0, width + rng.uniform(2.0, 4.5))
    floors = SHOP_M + STOREY_M * np.arange(storeys - 1)
    x, z = (grid.ravel() for grid in np.meshgrid(columns, floors))
    at = plan.at(np.column_stack([x, np.full(len(x), side * (0.5 * plan.length_y_m + 0.5 * depth))]))
    solid = boxes(at, np.tile([width, depth], (len(x), 1)), plan.heading_deg, z, z + 1.05)
    tint = shade(rng, ((0.5, 0.49, 0.46), style.wall, (0.34, 0.22, 0.15), (0.20, 0.25, 0.28)))
    return soup(solid, Material.PLASTER, tint)


def tower(rng: np.random.Generator, plan: Footprint, storeys: int) -> list[Surface]:
    """A high-rise with windows on all sides."""
    style = draw_style(rng, storeys, pitched=0.0)
    corners = plan.corners_m()
    return [*walls(corners, 0.0, style.eaves_m, [Material.FACADE] * 4, style.wall), *_flat_top(rng, corners, style)]


def garages(rng: np.random.Generator, plan: Footprint) -> list[Surface]:
    """A low row of garages or a workshop in a yard."""
    top, wall = rng.uniform(2.5, 3.6), shade(rng, (*_WALLS, _LIGHT))
    return box(plan, 0.0, top, (Material.PLASTER, wall), (Material.FLAT_ROOF, shade(rng, _FLATS)))


def hall(rng: np.random.Generator, plan: Footprint) -> list[Surface]:
    """A shop, school or workshop of one or two storeys under a wide flat roof or low metal slopes."""
    eaves = rng.uniform(4.2, 8.0)
    style = Style(eaves, shade(rng, _WALLS), shade(rng, _FLATS), None, 0.0, False)
    corners = plan.corners_m()
    sides = [Material.FACADE if rng.random() < 0.6 else Material.PLASTER for _ in range(4)]
    found = walls(corners, 0.0, eaves, sides, style.wall)
    if rng.random() < 0.35:
        style = Style(eaves, style.wall, shade(rng, _SHEETS), Material.SHEET, rng.uniform(0.12, 0.25), False)
        return [*found, *_pitched_top(rng, corners, style)]
    return [*found, *_flat_top(rng, corners, style)]
