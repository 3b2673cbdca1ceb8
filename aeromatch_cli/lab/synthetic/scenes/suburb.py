"""A suburb: detached houses in gardens along bent streets, driveways, hedges, sheds, pools, trees of all sizes."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.covers import MARKING, asphalt, bed, lawn, slabs, worn
from aeromatch_cli.lab.synthetic.noise import inside, stripes
from aeromatch_cli.lab.synthetic.paint import Painted, Samples, mix, rgb
from aeromatch_cli.lab.synthetic.rasters import look_up
from aeromatch_cli.lab.synthetic.scenes import Plan, SceneKind
from aeromatch_cli.lab.synthetic.scenes.gardens import furnish_lot, furnish_street
from aeromatch_cli.lab.synthetic.scenes.lots import (
    BEND_M,
    PATH_M,
    VERGE_M,
    Box,
    Lot,
    bent,
    block_lots,
    cross_p,
    rows_near,
    straight,
    street_q,
)
from aeromatch_cli.lab.synthetic.solids import Footprint, Surface, turned
from aeromatch_cli.lab.synthetic.terrain import Area, Flat

# Layers of the ground map, metres where not stated. kerb: distance from the kerb, negative on the carriageway. side,
# along: from and along the street's axis. land: distance inside the lots. paved, bed, worn: distance inside what is
# paved, dug or trodden bare. own: 0-1, how the lot is kept.
_KERB, _SIDE, _ALONG, _LAND, _PAVED, _BED, _OWN, _EDGE = range(8)
_CORNER_M = 5.0


def plan_suburb(seed: int, area: Area) -> Plan:
    """All lots whose middle is in the area, and the streets along them."""
    heading_deg = float(np.random.default_rng([seed, 1]).uniform(5.0, 85.0))
    reach = np.array([[area.x0_m, area.y0_m], [area.x1_m, area.y0_m], [area.x1_m, area.y1_m], [area.x0_m, area.y1_m]])
    uv = Footprint(0.0, 0.0, 1.0, 1.0, -heading_deg).at(reach)
    lo, hi = uv.min(axis=0) - BEND_M, uv.max(axis=0) + BEND_M
    frame = Footprint(0.0, 0.0, 1.0, 1.0, heading_deg)
    surfaces: list[Surface] = []
    counts: Counter[str] = Counter()
    for row, k in rows_near(seed, *lo, *hi):
        for lot in block_lots(seed, row, k):
            middle = np.array([[0.5 * (lot.land.p0_m + lot.land.p1_m), 0.5 * (lot.land.q0_m + lot.land.q1_m)]])
            x, y = frame.at(bent(seed, middle))[0]
            if area.contains(float(x), float(y)):
                for furnish in (furnish_lot, furnish_street):
                    for kind, solid in furnish(seed, lot):
                        surfaces += solid
                        counts[kind] += 1
    return Plan(Flat(), heading_deg, turned(surfaces, heading_deg), dict(counts))


def draw_ground(seed: int, u_m: FloatArray, v_m: FloatArray) -> NDArray[np.float32]:
    """Layers (H, W, 8) at points (H, W) of the plan."""
    pq = straight(seed, np.column_stack([u_m.ravel(), v_m.ravel()]))
    layers = np.zeros((len(pq), 8), dtype=np.float32)
    layers[:, _KERB], layers[:, _LAND], layers[:, _PAVED], layers[:, _BED] = -9.0, -9.0, -9.0, -9.0
    lo, hi = pq.min(axis=0), pq.max(axis=0)
    for row, k in rows_near(seed, *lo, *hi):
        (q0, half0), (q1, half1) = street_q(seed, row), street_q(seed, row + 1)
        (p0, left), (p1, right) = cross_p(seed, row, k), cross_p(seed, row, k + 1)
        rows = np.flatnonzero((pq[:, 0] >= p0) & (pq[:, 0] < p1) & (pq[:, 1] >= q0) & (pq[:, 1] < q1))
        if not len(rows):
            continue
        p, q = pq[rows].T
        beyond = np.stack([q - q0 - half0, q1 - q - half1, p - p0 - left, p1 - p - right], axis=1)
        layers[rows, _KERB] = _rounded(beyond)
        layers[rows, _LAND] = beyond.min(axis=1) - VERGE_M - PATH_M
        below = beyond[:, 0] < beyond[:, 1]
        layers[rows, _SIDE] = np.where(below, q - q0, q - q1)
        layers[rows, _ALONG] = p
        layers[rows, _EDGE] = np.where(beyond[:, 2] < beyond[:, 3], beyond[:, 2], beyond[:, 3])
        for lot in block_lots(seed, row, k):
            _draw_lot(layers, rows, p, q, lot)
    return layers.reshape(*u_m.shape, 8)


def _rounded(beyond_m: FloatArray) -> FloatArray:
    """Smooth minimum (N,) of distances (N, K) (polynomial, Quilez): kerbs turn corners in an arc."""
    least = beyond_m[:, 0]
    for k in range(1, beyond_m.shape[1]):
        blend = np.clip(1.0 - np.abs(least - beyond_m[:, k]) / _CORNER_M, 0.0, None)
        least = np.minimum(least, beyond_m[:, k]) - 0.25 * _CORNER_M * blend**2
    return least


def _draw_lot(layers: NDArray[np.float32], rows: NDArray[np.int64], p: FloatArray, q: FloatArray, lot: Lot) -> None:
    # Driveways and garden paths run on over the footpath and the verge to the kerb.
    reach = VERGE_M + PATH_M + 0.6
    near = np.flatnonzero(
        _within(Box(lot.land.p0_m, lot.land.q0_m - reach, lot.land.p1_m, lot.land.q1_m + reach), p, q) >= 0.0
    )
    if not len(near):
        return
    at, p, q = rows[near], p[near], q[near]
    own_land = _within(lot.land, p, q) >= 0.0
    paved = np.full(len(at), -9.0)
    for k, part in enumerate(lot.paved):
        if k == 0:
            part = Box(part.p0_m, part.q0_m - reach * (lot.facing < 0), part.p1_m, part.q1_m + reach * (lot.facing > 0))
        paved = np.maximum(paved, _within(part, p, q))
    beds = np.full(len(at), -9.0)
    for part in lot.beds:
        beds = np.maximum(beds, _within(part, p, q))
    layers[at, _PAVED] = np.where(own_land, paved, np.maximum(layers[at, _PAVED], paved))
    layers[at, _BED] = np.where(own_land, beds, layers[at, _BED])
    layers[at, _OWN] = np.where(own_land, lot.own, np.where(layers[at, _OWN] > 0.0, layers[at, _OWN], lot.own))


def _within(part: Box, p: FloatArray, q: FloatArray) -> FloatArray:
    """Distance (N,) inside a rectangle, negative outside."""
    inner: FloatArray = np.minimum(np.minimum(p - part.p0_m, part.p1_m - p), np.minimum(q - part.q0_m, part.q1_m - q))
    return inner


def paint_suburb_ground(s: Samples) -> Painted:
    """Streets, verges, footpaths, and the gardens of the lots."""
    layers = look_up(draw_ground, s)
    kerb, land = layers[:, _KERB], layers[:, _LAND]
    colour = np.zeros((len(kerb), 3), dtype=np.float32)
    reach = 2.0 * s.footprint_m + 0.2
    for region, paint in ((kerb < reach, _street), (kerb >= reach, _grounds)):
        rows = np.flatnonzero(region)
        if len(rows):
            colour[rows] = paint(s.part(rows), layers[rows])
    fence = inside(0.05 - np.abs(land), s.footprint_m) * (layers[:, _PAVED] < 0.0)
    return Painted(mix(colour, rgb(0.10, 0.095, 0.07), 0.5 * fence))


def _street(s: Samples, layers: FloatArray) -> FloatArray:
    kerb = layers[:, _KERB]
    colour = asphalt(s, np.clip(0.65 + 0.3 * s.broad, 0.0, 1.0))
    side = layers[:, _SIDE]
    track = np.cos(2.0 * np.pi * (np.abs(side) - 0.75) / 1.5) * (kerb < -0.6)
    gutter = np.exp(-np.clip(-kerb, 0.0, None) / 0.3)
    colour = colour * (1.0 + 0.05 * track - 0.16 * gutter)[:, None]
    dashes = stripes(layers[:, _ALONG], 9.0, 3.0, s.footprint_m) * inside(0.05 - np.abs(side), s.footprint_m)
    clear = layers[:, _EDGE] > 6.0
    colour = mix(colour, rgb(*MARKING), np.clip(0.8 * dashes * clear * worn(s), 0.0, 1.0))
    colour = mix(colour, _grounds(s, layers), inside(kerb, s.footprint_m))
    stone = inside(0.07 - np.abs(kerb - 0.07), s.footprint_m)
    return mix(colour, rgb(0.31, 0.305, 0.29), 0.75 * stone)


def _grounds(s: Samples, layers: FloatArray) -> FloatArray:
    """Lawns with ragged edges, beds, what is paved; one lot keeps it all differently from the next."""
    own, land = layers[:, _OWN], layers[:, _LAND]
    ragged = 0.05 * s.patch + 0.04 * s.grain
    path = inside(0.5 * PATH_M - np.abs(land + 0.5 * PATH_M), s.footprint_m)
    solid = np.maximum(path, inside(layers[:, _PAVED] + 0.4 * ragged, s.footprint_m))
    dug = np.clip((layers[:, _BED] + 2.0 * ragged) / (2.0 * s.footprint_m + 0.1) + 0.5, 0.0, 1.0)
    colour = lawn(s, np.clip(0.75 * own + 0.1, 0.0, 1.0))
    # The mower leaves lanes where it was run last.
    lanes = np.sin(2.0 * np.pi * (s.u_m * np.cos(9.0 * own) + s.v_m * np.sin(9.0 * own)) / 1.1)
    fresh = (np.mod(own * 7.3, 1.0) < 0.3) * np.clip(0.55 / (2.0 * s.footprint_m) - 1.0, 0.0, 1.0)
    colour = colour * (1.0 + 0.05 * lanes * fresh)[:, None]
    rows = np.flatnonzero(dug > 0.0)
    if len(rows):
        colour[rows] = mix(colour[rows], bed(s.part(rows)), dug[rows])
    rows = np.flatnonzero(solid > 0.0)
    if len(rows):
        part, kind = s.part(rows), np.mod(own[rows] * 5.7, 1.0)
        laid = slabs(part, np.clip(3.0 * kind - 1.6, 0.0, 1.0))
        tarred = asphalt(part, np.clip(2.0 * kind, 0.0, 1.0))
        poured = rgb(0.30, 0.29, 0.27) * (1.0 + 0.05 * part.grain + 0.07 * part.patch + 0.06 * part.broad)[:, None]
        solid_colour = np.where((kind < 0.25)[:, None], tarred, np.where((kind < 0.6)[:, None], poured, laid))
        on_path = (land[rows] < 0.0) & (layers[rows, _PAVED] < 0.0)
        solid_colour = np.where(on_path[:, None], poured * 0.92, solid_colour)
        colour[rows] = mix(colour[rows], solid_colour, solid[rows])
    return colour


SCENE = SceneKind(plan=plan_suburb, paint_ground=paint_suburb_ground)
