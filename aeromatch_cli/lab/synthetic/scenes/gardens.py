"""What stands on the lots of a suburb: house, garage, shed, pool, hedges, fences, trees; cars along its street."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.cars import car
from aeromatch_cli.lab.synthetic.houses import house, pool, shed
from aeromatch_cli.lab.synthetic.scenes.lots import PATH_M, VERGE_M, Box, Lot, bent
from aeromatch_cli.lab.synthetic.solids import Footprint, Material, Surface, Tint, boxes, shade, soup
from aeromatch_cli.lab.synthetic.trees import Species, hedge, tree

_BUILD, _GREEN, _STREET = 51, 52, 53
_FENCES: tuple[Tint, ...] = ((0.20, 0.165, 0.125), (0.36, 0.355, 0.34), (0.12, 0.105, 0.09))

Standing = Iterator[tuple[str, list[Surface]]]


def _placed(seed: int, box: Box, facing: float) -> Footprint:
    """A rectangle of the straight plan as it lies in the bent one, its -y side away from the street."""
    p, q = 0.5 * (box.p0_m + box.p1_m), 0.5 * (box.q0_m + box.q1_m)
    at = bent(seed, np.array([[p, q], [p - 2.0, q], [p + 2.0, q]]))
    heading_deg = float(np.rad2deg(np.arctan2(*(at[2] - at[1])[::-1])))
    turn_deg = 180.0 if facing < 0.0 else 0.0
    return Footprint(float(at[0, 0]), float(at[0, 1]), box.p1_m - box.p0_m, box.q1_m - box.q0_m, heading_deg + turn_deg)


def furnish_lot(seed: int, lot: Lot) -> Standing:
    """Everything that stands on a lot: kind and surfaces, in the bent plan."""
    rng = lot.rng(seed, _BUILD)
    if not lot.park:
        yield "buildings", house(rng, _placed(seed, lot.house, lot.facing))
        if lot.garage is not None:
            yield "sheds", shed(rng, _placed(seed, lot.garage, lot.facing))
        if lot.shed is not None:
            yield "sheds", shed(rng, _placed(seed, lot.shed, lot.facing))
        if lot.pool is not None:
            yield "pools", pool(rng, _placed(seed, lot.pool, lot.facing))
        drive = lot.paved[0]
        for k in range(int(rng.choice([0, 1, 1, 2]))):
            length = drive.q1_m - drive.q0_m
            step = 2.9 + 5.2 * k
            if step + 2.0 < length:
                q = drive.q0_m + step if lot.facing < 0.0 else drive.q1_m - step
                p = 0.5 * (drive.p0_m + drive.p1_m)
                here = _placed(seed, Box(p - 1.0, q - 1.0, p + 1.0, q + 1.0), 1.0)
                turn = 90.0 if rng.random() < 0.5 else -90.0
                yield "cars", car(rng, here.x_m, here.y_m, here.heading_deg + turn + rng.uniform(-4.0, 4.0))
        yield from _borders(seed, rng, lot)
    yield from _plants(seed, lot.rng(seed, _GREEN), lot)


def _borders(seed: int, rng: np.random.Generator, lot: Lot) -> Standing:
    """Hedges or fences along the left and the rear border, which every lot keeps for itself."""
    land = lot.land
    street, rear = (land.q0_m, land.q1_m) if lot.facing < 0.0 else (land.q1_m, land.q0_m)
    back = rear - 0.25 * np.sign(rear - street)
    front = street + (5.0 + 3.0 * lot.own) * np.sign(rear - street)
    lines = [((land.p0_m + 0.3, front), (land.p0_m + 0.3, back))]
    if lot.facing < 0.0:
        lines.append(((land.p0_m + 0.3, back), (land.p1_m - 0.3, back)))
    for start, end in lines:
        draw = rng.random()
        if draw < 0.15:
            continue
        points = bent(seed, np.linspace(start, end, 5))
        if draw < 0.5:
            width, height = rng.uniform(0.6, 1.2), rng.uniform(1.1, 2.4)
            yield "hedges", hedge(rng, points, 0.0, width, height)
        else:
            yield "fences", [_fence(rng, points)]


def _fence(rng: np.random.Generator, points_m: FloatArray) -> Surface:
    height, parts = rng.uniform(1.2, 1.9), []
    for a, b in pairwise(points_m):
        along = b - a
        heading_deg = float(np.rad2deg(np.arctan2(along[1], along[0])))
        length = np.array([[float(np.hypot(*along)) + 0.05, 0.07]])
        parts.append(boxes(0.5 * (a + b)[None], length, heading_deg, np.zeros(1), np.full(1, height)))
    return soup(np.concatenate(parts), Material.PLASTER, shade(rng, _FENCES))


def _plants(seed: int, rng: np.random.Generator, lot: Lot) -> Standing:
    """Trees and shrubs, most of them in the back garden; some gardens are full, some are bare."""
    land = lot.land
    area = (land.p1_m - land.p0_m) * (land.q1_m - land.q0_m)
    density = 0.012 if lot.park else 0.042 * rng.uniform(0.15, 1.0) ** 1.4
    count = int(rng.poisson(density * area))
    keep_off = [b for b in (lot.house, lot.garage, lot.shed, lot.pool, *lot.paved) if b is not None and not lot.park]
    for _ in range(count):
        p = rng.uniform(land.p0_m + 0.6, land.p1_m - 0.6)
        deep = rng.random() ** 0.7
        q = (
            land.q0_m + deep * (land.q1_m - land.q0_m)
            if lot.facing < 0.0
            else land.q1_m - deep * (land.q1_m - land.q0_m)
        )
        draw = rng.random()
        radius_m = (
            rng.uniform(0.4, 1.1) if draw < 0.5 else rng.uniform(1.3, 3.0) if draw < 0.85 else rng.uniform(3.0, 5.2)
        )
        if any(_near(box, p, q, 0.55 * radius_m + 0.2) for box in keep_off):
            continue
        u, v = bent(seed, np.array([[p, q]]))[0]
        yield "trees", _plant(rng, float(u), float(v), radius_m)


def _plant(rng: np.random.Generator, u_m: float, v_m: float, radius_m: float) -> list[Surface]:
    if radius_m < 1.2:
        return tree(rng, u_m, v_m, 0.0, radius_m, radius_m * rng.uniform(0.9, 1.7), Species.SHRUB)
    draw = rng.random()
    if draw < 0.14:
        return tree(rng, u_m, v_m, 0.0, 0.6 * radius_m, radius_m * rng.uniform(2.6, 3.8), Species.CONIFER)
    if draw < 0.24:
        return tree(rng, u_m, v_m, 0.0, 0.5 * radius_m, radius_m * rng.uniform(2.2, 3.0), Species.COLUMN)
    return tree(rng, u_m, v_m, 0.0, radius_m, radius_m * rng.uniform(1.6, 2.4) + 0.8, Species.BROADLEAF)


def _near(box: Box, p: float, q: float, distance_m: float) -> bool:
    return box.p0_m - distance_m < p < box.p1_m + distance_m and box.q0_m - distance_m < q < box.q1_m + distance_m


def furnish_street(seed: int, lot: Lot) -> Standing:
    """A tree on the verge, a car at the kerb."""
    rng = lot.rng(seed, _STREET)
    land = lot.land
    outward = -1.0 if lot.facing < 0.0 else 1.0
    edge = land.q0_m if lot.facing < 0.0 else land.q1_m
    drive = lot.paved[0] if lot.paved else Box(0.0, 0.0, 0.0, 0.0)
    for p in np.arange(land.p0_m + 3.5, land.p1_m - 3.5, 8.0):
        clear = not drive.p0_m - 1.6 < p < drive.p1_m + 1.6
        if rng.random() < 0.3 and clear:
            u, v = bent(seed, np.array([[p, edge + outward * (PATH_M + 0.6 * VERGE_M)]]))[0]
            radius_m = rng.uniform(1.4, 3.6)
            yield "trees", tree(rng, float(u), float(v), 0.0, radius_m, radius_m * 2.0 + 1.5, Species.BROADLEAF)
        if rng.random() < 0.2 and not drive.p0_m - 2.6 < p < drive.p1_m + 2.6:
            box = Box(
                p - 1.0,
                edge + outward * (PATH_M + VERGE_M + 1.05) - 1.0,
                p + 1.0,
                edge + outward * (PATH_M + VERGE_M + 1.05) + 1.0,
            )
            here = _placed(seed, box, lot.facing)
            yield "cars", car(rng, here.x_m, here.y_m, here.heading_deg + rng.uniform(-2.0, 2.0))
