"""What the surfaces look like: linear RGB albedo from texture coordinates, one painter for each material.

Detail runs from a few centimetres to tens of metres, so that pictures at 5 cm and at 50 cm per pixel both have some.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.synthetic import scene as plan
from aeromatch_cli.synthetic.noise import hash01, inside, octaves, spots, stripes
from aeromatch_cli.synthetic.scene import Scene
from aeromatch_cli.synthetic.solids import Material

_GRAIN_M = (0.06, 0.12, 0.24, 0.48)
_PATCH_M = (0.96, 1.9, 3.8)
_BROAD_M = (7.7, 15.0, 31.0)


@dataclass(frozen=True, eq=False)
class Samples:
    """Colour samples on surfaces of one material; every array has N rows, float32 where not stated.

    u_m, v_m: texture coordinates. footprint_m: spacing of neighbouring samples. size_m: (N, 2) extent of the surface.
    tint: (N, 3). salt: (N,) int64, one number for each surface. grain, patch, broad: noise of about unit variance
    at 0.06-0.5 m, 1-4 m and 8-31 m.
    """

    u_m: FloatArray
    v_m: FloatArray
    footprint_m: FloatArray
    size_m: FloatArray
    tint: FloatArray
    salt: IntArray
    grain: FloatArray
    patch: FloatArray
    broad: FloatArray


def albedo(scene: Scene, surface_idx: IntArray, points_m: FloatArray, footprint_m: FloatArray) -> FloatArray:
    """Linear RGB albedo (N, 3) float32 in 0-1 of surface points.

    surface_idx: (N,). points_m: (N, 3) float32 world. footprint_m: (N,) spacing of the samples on the surface.
    """
    colour = np.zeros((len(points_m), 3), dtype=np.float32)
    materials = scene.materials[surface_idx]
    for material, paint in _PAINTERS.items():
        chosen = np.flatnonzero(materials == material)
        if len(chosen):
            colour[chosen] = paint(_samples(scene, surface_idx[chosen], points_m[chosen], footprint_m[chosen]))
    return np.clip(colour, 0.005, 0.95)


def _samples(scene: Scene, surface_idx: IntArray, points_m: FloatArray, footprint_m: FloatArray) -> Samples:
    offset = points_m - scene.origins_m.astype(np.float32)[surface_idx]
    u_m = np.einsum("ij,ij->i", offset, scene.u_axes.astype(np.float32)[surface_idx])
    v_m = np.einsum("ij,ij->i", offset, scene.v_axes.astype(np.float32)[surface_idx])
    # Every surface cuts its own piece out of the noise; the ground (surface 0) starts at its origin.
    shift = 40.0 * hash01(surface_idx, surface_idx, scene.seed)
    footprint = np.maximum(footprint_m, 1e-4).astype(np.float32)
    grain, patch, broad = (
        octaves(u_m + shift, v_m + shift, footprint, waves, scene.seed, first)
        for waves, first in ((_GRAIN_M, 0), (_PATCH_M, 4), (_BROAD_M, 7))
    )
    size_m = scene.sizes_m[surface_idx].astype(np.float32)
    salt = scene.seed * 101 + 7 * surface_idx.astype(np.int64)
    tint = scene.tints[surface_idx].astype(np.float32)
    return Samples(u_m, v_m, footprint, size_m, tint, salt, grain, patch, broad)


def _mix(under: FloatArray, over: FloatArray | tuple[float, float, float], coverage: FloatArray) -> FloatArray:
    return under + (np.asarray(over, dtype=np.float32) - under) * coverage[:, None]


def _rgb(r: float, g: float, b: float) -> FloatArray:
    return np.array([r, g, b], dtype=np.float32)


def _gray(tint: tuple[float, float, float], factor: FloatArray) -> FloatArray:
    return np.asarray(tint, dtype=np.float32) * factor[:, None]


def _ground(s: Samples) -> FloatArray:
    """Streets with markings, pavements, and behind them gardens or paved yards."""
    du = np.abs(s.u_m - np.round(s.u_m / plan.PITCH_U_M) * plan.PITCH_U_M)
    dv = np.abs(s.v_m - np.round(s.v_m / plan.PITCH_V_M) * plan.PITCH_V_M)
    nearest = np.minimum(du, dv)
    built_m = plan.ROAD_HALF_M + plan.PAVEMENT_M
    colour = np.zeros((len(s.u_m), 3), dtype=np.float32)
    for region, painter in (
        (nearest < plan.ROAD_HALF_M + 0.3, lambda part, where: _street(part, du[where], dv[where])),
        (nearest >= plan.ROAD_HALF_M + 0.3, lambda part, where: _pavement(part)),
        (nearest >= built_m, lambda part, where: _lots(part)),
    ):
        where = np.flatnonzero(region)
        if len(where):
            colour[where] = painter(_part(s, where), where)
    kerb = inside(0.1 - np.abs(nearest - plan.ROAD_HALF_M), s.footprint_m)
    edge = inside(0.06 - np.abs(nearest - built_m), s.footprint_m)
    return _mix(_mix(colour, (0.42, 0.41, 0.39), 0.8 * kerb), (0.14, 0.13, 0.11), 0.6 * edge)


def _part(s: Samples, where: IntArray) -> Samples:
    return Samples(
        s.u_m[where], s.v_m[where], s.footprint_m[where], s.size_m[where], s.tint[where], s.salt[where],
        s.grain[where], s.patch[where], s.broad[where],
    )  # fmt: skip


def _street(s: Samples, du_m: FloatArray, dv_m: FloatArray) -> FloatArray:
    colour = _gray((0.165, 0.165, 0.175), 1.0 + 0.16 * s.grain + 0.10 * s.patch + 0.08 * s.broad)
    # Repaired rectangles and dark spots of oil.
    repaired = (hash01(np.floor(s.u_m / 2.6), np.floor(s.v_m / 3.4), 5) < 0.07).astype(np.float32)
    colour = _mix(colour, _gray((0.10, 0.10, 0.105), 1.0 + 0.15 * s.grain), 0.7 * repaired)
    oil, _ = spots(s.u_m, s.v_m, 1.7, 0.25, 3, s.footprint_m)
    colour = colour * (1.0 - 0.4 * oil)[:, None]
    crack = inside(0.035 - np.abs(s.patch) * 0.25, s.footprint_m) * (s.broad > 0.6)
    colour = colour * (1.0 - 0.3 * crack)[:, None]
    crossing = (du_m < plan.ROAD_HALF_M + 4.0) & (dv_m < plan.ROAD_HALF_M + 4.0)
    dash_v = stripes(s.v_m, 4.0, 2.0, s.footprint_m) * inside(0.08 - du_m, s.footprint_m)
    dash_u = stripes(s.u_m, 4.0, 2.0, s.footprint_m) * inside(0.08 - dv_m, s.footprint_m)
    zebra_u = stripes(s.v_m, 1.0, 0.5, s.footprint_m) * inside(
        1.3 - np.abs(du_m - plan.ROAD_HALF_M - 2.0), s.footprint_m
    )
    zebra_v = stripes(s.u_m, 1.0, 0.5, s.footprint_m) * inside(
        1.3 - np.abs(dv_m - plan.ROAD_HALF_M - 2.0), s.footprint_m
    )
    on_u, on_v = dv_m < plan.ROAD_HALF_M - 0.4, du_m < plan.ROAD_HALF_M - 0.4
    zebra = np.where(on_u & ~on_v, zebra_u, 0.0) + np.where(on_v & ~on_u, zebra_v, 0.0)
    paint = np.where(crossing, zebra, np.maximum(dash_u, dash_v))
    worn = np.clip(0.8 + 0.25 * s.grain + 0.15 * s.patch, 0.2, 1.0)
    return _mix(colour, (0.62, 0.62, 0.60), np.clip(paint * worn, 0.0, 1.0))


def _pavement(s: Samples) -> FloatArray:
    slab = hash01(np.floor(s.u_m / 0.6), np.floor(s.v_m / 0.6), 11)
    calm = np.clip(0.6 / (4.0 * s.footprint_m) - 1.0, 0.0, 1.0)
    colour = _gray((0.33, 0.31, 0.29), 1.0 + 0.22 * (slab - 0.5) * calm + 0.10 * s.grain + 0.10 * s.patch)
    joint = np.maximum(stripes(s.u_m, 0.6, 0.03, s.footprint_m), stripes(s.v_m, 0.6, 0.03, s.footprint_m))
    return colour * (1.0 - 0.5 * joint)[:, None]


def _lots(s: Samples) -> FloatArray:
    block_u, block_v = np.floor(s.u_m / plan.PITCH_U_M), np.floor(s.v_m / plan.PITCH_V_M)
    yard = hash01(block_u, block_v, s.salt[:1] + plan.YARD_SALT) < plan.YARD_SHARE
    colour = _garden(s, block_u, block_v)
    return np.where(yard[:, None], _paved_yard(s), colour)


def _garden(s: Samples, block_u: FloatArray, block_v: FloatArray) -> FloatArray:
    """Lawn, bare soil and shrubs; every lot has its own mixture, and a hedge or fence around it."""
    built_m = plan.ROAD_HALF_M + plan.PAVEMENT_M
    lot_u = (s.u_m - block_u * plan.PITCH_U_M - built_m) / plan.LOT_U_M
    lot_v = (s.v_m - block_v * plan.PITCH_V_M - built_m) / plan.LOT_V_M
    iu, iv = block_u * plan.LOTS_U + np.floor(lot_u), block_v * plan.LOTS_V + np.floor(lot_v)
    own, dry = hash01(iu, iv, s.salt[:1] + 21), hash01(iu, iv, s.salt[:1] + 22)
    green = _rgb(0.085, 0.135, 0.035) + dry[:, None] * _rgb(0.10, 0.045, 0.035)
    lawn = green * (0.85 + 0.3 * own + 0.24 * s.grain + 0.16 * s.patch + 0.10 * s.broad)[:, None]
    soil = _gray((0.27, 0.20, 0.135), 1.0 + 0.25 * s.grain + 0.12 * s.patch)
    bare = np.clip(1.6 * (s.patch + 0.8 * s.broad + 0.35 * s.grain - 1.4 + 0.9 * dry), 0.0, 1.0)
    colour = _mix(lawn, soil, bare)
    tufts, kind = spots(s.u_m, s.v_m, 0.55, 0.35, 31, s.footprint_m)
    dark = (kind < 0.6)[:, None]
    tuft = np.where(dark, _rgb(0.05, 0.075, 0.02), _rgb(0.25, 0.24, 0.12))
    colour = _mix(colour, tuft, 0.65 * tufts)
    shrub, own_shrub = spots(s.u_m, s.v_m, 2.3, 0.30, 33, s.footprint_m)
    leaves = _gray((0.05, 0.08, 0.025), 1.0 + 0.4 * s.grain + 0.5 * own_shrub)
    colour = _mix(colour, leaves, shrub)
    stone, tone = spots(s.u_m, s.v_m, 0.9, 0.05, 35, s.footprint_m)
    colour = _mix(colour, _gray((0.30, 0.28, 0.25), 0.6 + 0.8 * tone + 0.2 * s.grain), stone)
    # Terrace: a strip of slabs across the lot on its inner side.
    inner = np.where(np.floor(lot_v) == 0, lot_v, plan.LOTS_V - lot_v)
    terrace = inside(1.0 - np.abs(inner * plan.LOT_V_M - 13.5), s.footprint_m) * (own > 0.45)
    path = inside(0.6 - np.abs((lot_u - np.floor(lot_u) - 0.12) * plan.LOT_U_M), s.footprint_m)
    colour = _mix(colour, _pavement(s), np.maximum(terrace, path))
    border = np.abs(lot_u - np.round(lot_u)) * plan.LOT_U_M
    border = np.minimum(border, np.where(np.round(lot_v) == 1.0, np.abs(lot_v - 1.0) * plan.LOT_V_M, np.inf))
    hedge = inside(0.35 + 0.12 * s.patch - border, s.footprint_m)
    return _mix(colour, _gray((0.055, 0.085, 0.03), 1.0 + 0.4 * s.grain), hedge)


def _paved_yard(s: Samples) -> FloatArray:
    colour = _gray((0.23, 0.22, 0.21), 1.0 + 0.14 * s.grain + 0.16 * s.patch + 0.12 * s.broad)
    u = s.u_m - np.floor(s.u_m / plan.PITCH_U_M) * plan.PITCH_U_M
    v = s.v_m - np.floor(s.v_m / plan.PITCH_V_M) * plan.PITCH_V_M
    built_m = plan.ROAD_HALF_M + plan.PAVEMENT_M
    bays = stripes(u - built_m - 1.1, 2.8, 0.1, s.footprint_m) * inside(2.5 - np.abs(v - built_m - 2.8), s.footprint_m)
    colour = _mix(colour, (0.55, 0.55, 0.52), 0.8 * bays)
    stains, own = spots(s.u_m, s.v_m, 1.3, 0.35, 41, s.footprint_m)
    colour = colour * (1.0 + (own - 0.7) * stains)[:, None]
    weeds = np.clip(1.5 * (s.patch + s.broad + 0.4 * s.grain - 1.9), 0.0, 1.0)
    return _mix(colour, _gray((0.12, 0.14, 0.05), 1.0 + 0.25 * s.grain), weeds)


def _facade(s: Samples) -> FloatArray:
    """Plaster with a window in most cells of a grid that fits the wall, and a darker base."""
    colour: FloatArray = s.tint * (1.0 + 0.07 * s.grain + 0.07 * s.patch - 0.10 * np.exp(-s.v_m))[:, None]
    columns = np.maximum(np.round(s.size_m[:, 0] / 2.6), 1.0)
    storeys = np.maximum(np.round(s.size_m[:, 1] / 3.0), 1.0)
    x, y = s.u_m / s.size_m[:, 0] * columns, s.v_m / s.size_m[:, 1] * storeys
    ix, iy = np.floor(x), np.floor(y)
    cell_u, cell_v = s.size_m[:, 0] / columns, s.size_m[:, 1] / storeys
    present = hash01(ix, iy, s.salt + 1) < 0.85
    across, up = np.abs(x - ix - 0.5) * cell_u, np.abs(y - iy - 0.55) * cell_v
    pane = inside(np.minimum(0.55 - across, 0.68 - up), s.footprint_m) * present
    frame = inside(np.minimum(0.68 - across, 0.82 - up), s.footprint_m) * present
    bright = hash01(ix, iy, s.salt + 2)
    glass = _gray((0.05, 0.06, 0.075), 0.6 + 1.6 * bright)
    curtain = np.where((bright > 0.75)[:, None], _rgb(0.35, 0.33, 0.29), glass)
    colour = _mix(_mix(colour, (0.62, 0.61, 0.58), frame), curtain, pane)
    bar = inside(0.04 - across, s.footprint_m) * pane
    return _mix(colour, (0.5, 0.49, 0.46), bar)


def _tiled_roof(s: Samples) -> FloatArray:
    row, column = np.floor(s.v_m / 0.34), np.floor(s.u_m / 0.26)
    tile = hash01(column, row, s.salt + 3) - 0.5
    calm = np.clip(0.3 / (4.0 * s.footprint_m) - 1.0, 0.0, 1.0)
    colour = s.tint * (1.0 + 0.5 * tile * calm + 0.14 * s.grain + 0.14 * s.patch + 0.08 * s.broad)[:, None]
    joint = stripes(s.v_m, 0.34, 0.05, s.footprint_m)
    colour = colour * (1.0 - 0.45 * joint)[:, None]
    moss, _ = spots(s.u_m, s.v_m, 0.8, 0.18, s.salt + 4, s.footprint_m)
    colour = _mix(colour, (0.13, 0.14, 0.07), 0.6 * moss)
    # Roof windows, few and at random, and a light ridge.
    ix, iy = np.floor(s.u_m / 2.2), np.floor(s.v_m / 2.4)
    x, y = np.abs(s.u_m / 2.2 - ix - 0.5) * 2.2, np.abs(s.v_m / 2.4 - iy - 0.5) * 2.4
    window = (
        (hash01(ix, iy, s.salt + 5) < 0.18) & ((iy + 1.0) * 2.4 < s.size_m[:, 1]) & ((ix + 1.0) * 2.2 < s.size_m[:, 0])
    )
    colour = _mix(colour, (0.45, 0.46, 0.48), inside(np.minimum(0.50 - x, 0.68 - y), s.footprint_m) * window)
    colour = _mix(colour, (0.05, 0.06, 0.08), inside(np.minimum(0.40 - x, 0.58 - y), s.footprint_m) * window)
    ridge = inside(0.15 - np.abs(s.size_m[:, 1] - s.v_m), s.footprint_m)
    return _mix(colour, 1.25 * s.tint, ridge)


def _flat_roof(s: Samples) -> FloatArray:
    colour = s.tint * (1.0 + 0.14 * s.grain + 0.14 * s.patch + 0.12 * s.broad)[:, None]
    seam = stripes(s.u_m, 1.1, 0.05, s.footprint_m)
    sheet = hash01(np.floor(s.u_m / 1.1 + 0.5), np.floor(s.v_m / 7.0), s.salt + 6) - 0.5
    colour = colour * (1.0 + 0.12 * sheet - 0.25 * seam)[:, None]
    puddle = np.clip(2.0 * (s.patch + s.broad - 1.3), 0.0, 1.0)
    colour = colour * (1.0 - 0.35 * puddle)[:, None]
    vent, own = spots(s.u_m, s.v_m, 2.4, 0.22, s.salt + 7, s.footprint_m)
    colour = _mix(colour, _gray((0.5, 0.5, 0.5), 0.15 + 1.1 * own), vent * (own < 0.8))
    debris, tone = spots(s.u_m, s.v_m, 0.7, 0.18, s.salt + 8, s.footprint_m)
    colour = colour * (1.0 + (1.2 * tone - 0.7) * debris)[:, None]
    rim = np.minimum(np.minimum(s.u_m, s.size_m[:, 0] - s.u_m), np.minimum(s.v_m, s.size_m[:, 1] - s.v_m))
    colour = _mix(colour, (0.5, 0.49, 0.47), inside(0.35 - rim, s.footprint_m))
    return colour * (1.0 - 0.3 * inside(0.12 - np.abs(rim - 0.45), s.footprint_m))[:, None]


def _paint(s: Samples) -> FloatArray:
    return s.tint * (1.0 + 0.05 * s.grain + 0.05 * s.patch)[:, None]


def _glass(s: Samples) -> FloatArray:
    return _gray((0.035, 0.04, 0.05), 1.0 + 0.1 * s.patch)


def _leaves(s: Samples) -> FloatArray:
    clump, own = spots(s.u_m, s.v_m, 0.42, 0.75, s.salt + 9, s.footprint_m)
    colour = s.tint * (1.0 + 0.40 * s.grain + 0.15 * s.patch)[:, None]
    return colour * (1.0 + (1.5 * own - 0.55) * clump)[:, None]


_PAINTERS = {
    Material.GROUND: _ground,
    Material.FACADE: _facade,
    Material.TILED_ROOF: _tiled_roof,
    Material.FLAT_ROOF: _flat_roof,
    Material.PAINT: _paint,
    Material.GLASS: _glass,
    Material.LEAVES: _leaves,
}
