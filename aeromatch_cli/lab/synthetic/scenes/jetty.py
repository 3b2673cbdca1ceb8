"""Piers of planks on piles, and rowing boats moored at them."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.fields import unturned
from aeromatch_cli.lab.synthetic.solids import Footprint, Material, Surface, Tint, boxes, shade, soup
from aeromatch_cli.lab.synthetic.terrain import Area
from aeromatch_cli.lab.synthetic.water import LEVEL_M, Shore

PIER_EVERY_M, _SHARE = 75.0, 0.55
_DECK_M, _PLANK_M = 0.9, 0.16
_WOOD: tuple[Tint, ...] = ((0.235, 0.195, 0.150), (0.200, 0.170, 0.135), (0.270, 0.235, 0.190))
_HULLS: tuple[Tint, ...] = (
    (0.55, 0.55, 0.52),
    (0.10, 0.16, 0.30),
    (0.33, 0.07, 0.05),
    (0.30, 0.19, 0.09),
    (0.12, 0.22, 0.13),
)


def boats_and_piers(seed: int, area: Area, land: Shore) -> tuple[list[Surface], dict[str, int]]:
    """The piers whose feet lie inside an area, with their boats; the one nearest to the origin is always there."""
    surfaces: list[Surface] = []
    counts = {"piers": 0, "boats": 0}
    reach = max(abs(area.x0_m), abs(area.x1_m), abs(area.y0_m), abs(area.y1_m)) * np.sqrt(2.0)
    last = int(np.ceil(reach / PIER_EVERY_M))
    for k in range(-last, last + 1):
        rng = np.random.default_rng([seed, 57, k + 100_000])
        u = (k + float(rng.uniform(-0.25, 0.25))) * PIER_EVERY_M
        v = edge_v_m(land, u)
        foot = unturned(np.array([u, v]), land.heading_deg)
        if (k and rng.random() > _SHARE) or not area.contains(*foot.tolist()):
            continue
        length = float(rng.uniform(11.0, 22.0))
        pier = Footprint(u, v + 3.0 - 0.5 * (length + 3.0), 1.8, length + 3.0, float(rng.uniform(-8.0, 8.0)))
        surfaces += _pier(rng, pier, land.heading_deg)
        counts["piers"] += 1
        for side in (-1.0, 1.0):
            for slot in range(int(rng.integers(0, 4))):
                along = -0.5 * pier.length_y_m + 2.2 + 3.0 * slot
                center = pier.at(np.array([[side * (0.9 + 2.4), along]]))[0]
                heading = pier.heading_deg + (0.0 if side > 0 else 180.0) + float(rng.uniform(-14.0, 14.0))
                surfaces += _boat(rng, center, heading, land.heading_deg)
                counts["boats"] += 1
    return surfaces, counts


def edge_v_m(land: Shore, u_m: float) -> float:
    """Where the water's edge is at one u, by fixed-point steps: the shore line is never steep enough to defeat them."""
    v: FloatArray = np.zeros(1)
    for _ in range(40):
        v = -land.winding.at(np.array([u_m]), v)
    return float(v[0])


def _pier(rng: np.random.Generator, pier_uv: Footprint, heading_deg: float) -> list[Surface]:
    """Planks across, some replaced, on two rows of piles."""
    length = pier_uv.length_y_m
    pier = _placed(pier_uv, heading_deg)
    count = int(length / _PLANK_M)
    along = (np.arange(count) + 0.5) * _PLANK_M - 0.5 * length
    shift = rng.uniform(-0.05, 0.05, size=count)
    centers = pier.at(np.column_stack([shift, along]))
    sizes = np.column_stack([np.full(count, pier.length_x_m), np.full(count, _PLANK_M - 0.02)])
    top = np.full(count, LEVEL_M + _DECK_M) + rng.uniform(-0.01, 0.01, size=count)
    kind = rng.choice(len(_WOOD), size=count, p=(0.6, 0.28, 0.12))
    surfaces = []
    for k, tint in enumerate(_WOOD):
        which = np.flatnonzero(kind == k)
        if len(which):
            planks = boxes(centers[which], sizes[which], pier.heading_deg, top[which] - 0.05, top[which])
            surfaces.append(soup(planks, Material.PLASTER, tint))
    stand = np.arange(-0.5 * length + 0.4, 0.5 * length, 2.6)
    piles = pier.at(np.concatenate([np.column_stack([np.full(len(stand), x), stand]) for x in (-0.95, 0.95)]))
    tall = LEVEL_M + _DECK_M + rng.uniform(0.05, 0.55, size=len(piles))
    posts = boxes(piles, np.full((len(piles), 2), 0.22), pier.heading_deg, np.full(len(piles), LEVEL_M - 4.0), tall)
    return [*surfaces, soup(posts, Material.PLASTER, (0.13, 0.10, 0.075))]


def _placed(plan_uv: Footprint, heading_deg: float) -> Footprint:
    x, y = unturned(np.array([plan_uv.x_m, plan_uv.y_m]), heading_deg).tolist()
    return Footprint(x, y, plan_uv.length_x_m, plan_uv.length_y_m, plan_uv.heading_deg + heading_deg)


# A rowing boat's outline, bow along +x, as shares of its half length and half width; counter-clockwise.
_OUTLINE = np.array(
    [
        [-1.0, -0.72],
        [-0.3, -1.0],
        [0.35, -0.85],
        [0.78, -0.45],
        [1.0, 0.0],
        [0.78, 0.45],
        [0.35, 0.85],
        [-0.3, 1.0],
        [-1.0, 0.72],
    ]
)


def _boat(rng: np.random.Generator, center_uv: FloatArray, heading_uv_deg: float, heading_deg: float) -> list[Surface]:
    """An open boat: hull, gunwale, floor and two benches."""
    half = np.array([float(rng.uniform(1.7, 2.4)), float(rng.uniform(0.62, 0.85))])
    place = _placed(Footprint(float(center_uv[0]), float(center_uv[1]), 1.0, 1.0, heading_uv_deg), heading_deg)
    outer, inner = place.at(_OUTLINE * half), place.at(_OUTLINE * (half - 0.12))
    rim = LEVEL_M + 0.42 + 0.14 * np.clip(_OUTLINE[:, :1], 0.0, 1.0) ** 2
    hull = _band(
        np.column_stack([0.8 * outer + 0.2 * place.at(np.zeros((1, 2))), rim - 0.62]), np.column_stack([outer, rim])
    )
    gunwale = _band(np.column_stack([outer, rim]), np.column_stack([inner, rim]))
    side = _band(np.column_stack([inner, rim]), np.column_stack([inner, np.full(len(rim), LEVEL_M + 0.08)]))
    floor = np.column_stack([inner, np.full(len(rim), LEVEL_M + 0.08)])
    fan = np.stack([floor[[0, k, k + 1]] for k in range(1, len(floor) - 1)])
    seats = place.at(np.array([[-0.55, 0.0], [0.25, 0.0]]) * half)
    sizes = np.array([[0.28, 1.70], [0.28, 1.62]]) * [1.0, float(half[1])]
    benches = boxes(seats, sizes, place.heading_deg, np.full(2, LEVEL_M + 0.30), np.full(2, LEVEL_M + 0.34))
    tint, wood = shade(rng, _HULLS), shade(rng, _WOOD)
    return [
        soup(np.concatenate([hull, gunwale]), Material.PAINT, tint),
        soup(np.concatenate([side, fan, benches]), Material.PLASTER, wood),
    ]


def _band(low_m: FloatArray, high_m: FloatArray) -> FloatArray:
    """Triangles (2 K, 3, 3) between two closed rings (K, 3)."""
    low_next, high_next = np.roll(low_m, -1, axis=0), np.roll(high_m, -1, axis=0)
    return np.concatenate(
        [np.stack([low_m, low_next, high_next], axis=1), np.stack([low_m, high_next, high_m], axis=1)]
    )
