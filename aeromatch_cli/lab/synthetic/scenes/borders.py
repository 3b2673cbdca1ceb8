"""What runs along the borders of fields, painted: grass, tracks with two ruts, roads; and the yards of farms."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.lab.synthetic.noise import inside, octaves, stripes
from aeromatch_cli.lab.synthetic.paint import Samples, mix, rgb, shades
from aeromatch_cli.lab.synthetic.scenes.growth import clumps
from aeromatch_cli.lab.synthetic.scenes.parcels import (
    FARM_U_M,
    FARM_V_M,
    HALF_WIDTH_M,
    ROAD,
    TRACK,
    Parcels,
    is_farm,
)

# Beyond half the width of a border: a strip of grass, and how far its ragged edge can reach.
_VERGE_M, _RAGGED_M = 0.9, 2.5


class _Place(NamedTuple):
    """Rows near a border or in a yard. kind, off_m: the nearest border across u. into_m: depth into any border.
    along_m: along the former. yard_m: depth into a yard, negative elsewhere. from_middle_m: of the yard."""

    kind: IntArray
    off_m: FloatArray
    into_m: FloatArray
    along_m: FloatArray
    yard_m: FloatArray
    from_middle_m: FloatArray

    def part(self, rows: IntArray) -> _Place:
        return _Place(
            self.kind[rows], self.off_m[rows], self.into_m[rows],
            self.along_m[rows], self.yard_m[rows], self.from_middle_m[rows],
        )  # fmt: skip


def paint_borders(
    s: Samples, parcels: Parcels, colour: FloatArray, fine: FloatArray, broad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The fields' colour (N, 3) with their borders, and how far (N,), 0-1, those hide the fields.

    fine, broad: noise (N,) of unit variance, finer than a metre and coarser than ten.
    """
    place = _place(s, parcels)
    near = np.flatnonzero(np.maximum(place.into_m + _VERGE_M, place.yard_m) > -_RAGGED_M - s.footprint_m)
    hidden = np.zeros(len(colour), dtype=np.float32)
    if len(near):
        chosen = place.part(near)
        colour[near], hidden[near] = _painted(s.part(near), chosen, colour[near], fine[near], broad[near])
    return colour, hidden


def _place(s: Samples, parcels: Parcels) -> _Place:
    first_u, first_v = parcels.from_u0 < parcels.to_u1, parcels.from_v0 < parcels.to_v1
    kind = np.where(first_u, parcels.kind_u0, parcels.kind_u1)
    off_u = np.where(first_u, parcels.from_u0, parcels.to_u1)
    kind_v = np.where(first_v, parcels.kind_v0, parcels.kind_v1)
    off_v = np.where(first_v, parcels.from_v0, parcels.to_v1)
    yard = np.minimum(FARM_U_M - parcels.from_u0, FARM_V_M - parcels.from_v0)
    return _Place(
        kind=kind,
        off_m=off_u,
        into_m=np.maximum(HALF_WIDTH_M[kind] - off_u, HALF_WIDTH_M[kind_v] - off_v),
        along_m=parcels.from_v0,
        yard_m=np.where(is_farm(parcels.column, parcels.row, s.seed), yard, np.float32(-1e3)),
        from_middle_m=np.hypot(parcels.from_u0 - 0.42 * FARM_U_M, parcels.from_v0 - 0.45 * FARM_V_M),
    )


def _painted(
    s: Samples, place: _Place, colour: FloatArray, fine: FloatArray, broad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    ragged = 0.16 * octaves(s.u_m, s.v_m, s.footprint_m, (0.4, 1.1, 2.9), s.seed, 86) + 0.2 * broad
    verge = inside(place.into_m + _VERGE_M + ragged, s.footprint_m)
    yard = inside(place.yard_m + ragged, s.footprint_m)
    grass = shades((0.095, 0.125, 0.042), 1.0 + 0.26 * fine + 0.14 * broad)
    tuft, own, _ = clumps(s, 0.8, 0.6, 87, 0.5, fine)
    grass = mix(grass, shades((0.17, 0.165, 0.08), 0.5 + 0.8 * own), 0.55 * tuft)
    colour = mix(colour, grass, np.maximum(verge, yard))
    worn = np.clip(0.75 + 0.5 * broad, 0.0, 1.0) * inside(15.0 + 7.0 * broad - place.from_middle_m, s.footprint_m)
    colour = mix(colour, shades((0.27, 0.225, 0.165), 1.0 + 0.12 * fine + 0.10 * broad), worn * yard)
    on_track, on_road = place.kind == TRACK, place.kind == ROAD
    gravel = shades((0.30, 0.25, 0.185), 1.0 + 0.12 * fine + 0.08 * broad)
    middle = inside(1.5 + 0.5 * ragged - place.off_m, s.footprint_m) * on_track
    rut = inside(0.40 + 0.4 * ragged - np.abs(place.off_m - 0.95), s.footprint_m) * on_track
    shoulder = inside(3.2 + ragged - place.off_m, s.footprint_m) * on_road
    colour = mix(colour, gravel, np.maximum(0.40 * middle + 0.55 * rut, 0.6 * shoulder))
    paved = inside(2.75 + 0.06 * ragged - place.off_m, s.footprint_m) * on_road
    colour = mix(colour, shades((0.150, 0.150, 0.155), 1.0 + 0.10 * fine + 0.06 * broad), paved)
    lane = inside(0.06 - place.off_m, s.footprint_m) * stripes(place.along_m, 9.0, 3.0, s.footprint_m) * on_road
    return mix(colour, rgb(0.5, 0.5, 0.48), 0.7 * lane), np.maximum(verge, yard)
