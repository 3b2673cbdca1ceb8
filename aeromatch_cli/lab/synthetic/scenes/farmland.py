"""Fields of several crops with rows, headlands and tramlines; between them tracks, roads, hedges and grass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.lab.synthetic.fields import random_waves, rolling_land, scene_heading_deg
from aeromatch_cli.lab.synthetic.noise import fading, hash01, octave, octaves, slopes, stripes
from aeromatch_cli.lab.synthetic.paint import Painted, Samples, mix, shades
from aeromatch_cli.lab.synthetic.scenes import Plan, SceneKind
from aeromatch_cli.lab.synthetic.scenes.borders import paint_borders
from aeromatch_cli.lab.synthetic.scenes.farmstead import farm_solids
from aeromatch_cli.lab.synthetic.scenes.parcels import Parcels, bent, parcels_at
from aeromatch_cli.lab.synthetic.terrain import Area

RELIEF_M = (2.0, 7.0)
_CELL_M = 4.0
_HEADLAND_M = 9.0


class Crop(NamedTuple):
    """How a field looks. share: of all fields. row_m: distance of rows. soil, plant: colours. cover: of the soil by
    plants. furrow: root mean square slope across the rows. rough: of clods or leaves. tramline_m: 0 for none."""

    share: float
    row_m: float
    soil: tuple[float, float, float]
    plant: tuple[float, float, float]
    cover: float
    furrow: float
    rough: float
    tramline_m: float


_SOIL, _DRY_SOIL = (0.155, 0.112, 0.078), (0.285, 0.222, 0.160)
CROPS = (
    Crop(0.22, 0.55, _SOIL, (0.20, 0.15, 0.105), 0.30, 0.34, 0.30, 0.0),  # ploughed
    Crop(0.20, 0.75, _DRY_SOIL, (0.070, 0.120, 0.030), 0.42, 0.12, 0.15, 27.0),  # beet, maize
    Crop(0.18, 0.25, _SOIL, (0.062, 0.112, 0.027), 0.90, 0.05, 0.22, 21.0),  # green corn
    Crop(0.14, 0.25, _DRY_SOIL, (0.375, 0.285, 0.130), 0.92, 0.05, 0.18, 24.0),  # ripe corn
    Crop(0.12, 0.38, _DRY_SOIL, (0.42, 0.345, 0.205), 0.62, 0.08, 0.16, 0.0),  # stubble
    Crop(0.14, 3.0, _SOIL, (0.090, 0.130, 0.034), 0.97, 0.01, 0.20, 0.0),  # meadow
)
_SHARES = np.cumsum([c.share for c in CROPS])[:-1]


def crop_index(parcels: Parcels, seed: int) -> IntArray:
    """Which of CROPS (N,) grows in the fields."""
    return np.searchsorted(_SHARES, parcels.own(seed, 51), side="right")


def row_coordinates(parcels: Parcels, seed: int) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Coordinates across and along the rows (N,), metres, and whether (N,) the former is u.

    Rows follow one side of a field, and at their ends, where the tractor turns, the border there. Both grow with u, v.
    """
    along_v = parcels.own(seed, 52) < 0.72
    end_v = np.minimum(parcels.from_v0, parcels.to_v1) < _HEADLAND_M
    end_u = np.minimum(parcels.from_u0, parcels.to_u1) < _HEADLAND_M
    across_u = np.where(along_v, ~end_v, end_u)
    nearest_v = np.where(parcels.from_v0 < parcels.to_v1, parcels.from_v0, -parcels.to_v1)
    across = np.where(across_u, parcels.from_u0, np.where(along_v, nearest_v, parcels.from_v0))
    return across, np.where(across_u, parcels.from_v0, parcels.from_u0), across_u


def _plan(seed: int, area: Area) -> Plan:
    relief_m = float(np.random.default_rng([seed, 32]).uniform(*RELIEF_M))
    terrain = rolling_land(random_waves((seed, 33), 130.0, 480.0, 14), relief_m, _CELL_M)
    heading_deg = scene_heading_deg(seed)
    surfaces, solids = farm_solids(seed, area, terrain, heading_deg)
    return Plan(terrain, heading_deg, surfaces, solids)


def _paint(s: Samples) -> Painted:
    u, v = bent(s.u_m, s.v_m, s.seed)
    parcels = parcels_at(u, v, s.seed)
    across, along, across_u = row_coordinates(parcels, s.seed)
    crops = crop_index(parcels, s.seed)
    fine = octaves(s.u_m, s.v_m, s.footprint_m, (0.09, 0.21, 0.5), s.seed, 71)
    broad = octaves(s.u_m, s.v_m, s.footprint_m, (12.0, 37.0), s.seed, 75)
    shade, ripe = 0.8 + 0.4 * parcels.own(s.seed, 53), parcels.own(s.seed, 55)
    colour = np.empty((len(u), 3), dtype=np.float32)
    furrow = np.empty(len(u), dtype=np.float32)
    rough = np.empty(len(u), dtype=np.float32)
    for k, crop in enumerate(CROPS):
        at = np.flatnonzero(crops == k)
        if len(at):
            rows = _Rows(across[at], along[at], fine[at], broad[at], shade[at], ripe[at])
            colour[at], furrow[at] = _field(s.part(at), crop, rows)
            rough[at] = crop.rough
    colour, bare = paint_borders(s, parcels, colour, fine, broad)
    furrow *= 1.0 - bare
    relief = slopes(s.u_m, s.v_m, s.footprint_m, ((0.10, 0.9), (0.26, 0.6), (0.8, 0.2)), s.seed, 82)
    relief *= (rough + (0.12 - rough) * bare)[:, None]
    relief[:, 0] += np.where(across_u, furrow, 0.0)
    relief[:, 1] += np.where(across_u, 0.0, furrow)
    return Painted(colour, relief=relief)


class _Rows(NamedTuple):
    across: FloatArray
    along: FloatArray
    fine: FloatArray
    broad: FloatArray
    shade: FloatArray
    ripe: FloatArray


def _field(s: Samples, crop: Crop, rows: _Rows) -> tuple[FloatArray, FloatArray]:
    """Colour (N, 3) and slope across the rows (N,) of fields of one crop."""
    turns = np.float32(2.0 * np.pi / crop.row_m) * rows.across
    kept = fading(crop.row_m, s.footprint_m)
    # Long streaks: every pass of the machine left the soil a little different.
    streak = octave(rows.across, 0.05 * rows.along, 1.6, s.seed, 78) * fading(1.6, s.footprint_m)
    number = np.floor(rows.across / 6.0)
    passing = (hash01(number, np.zeros_like(number), s.seed * 101 + 54) - 0.5) * fading(12.0, s.footprint_m)
    drawn = octave(0.7 * rows.across, 0.16 * rows.along, 4.6, s.seed, 80)
    uneven = 0.10 * rows.fine + 0.05 * rows.broad + 0.05 * drawn
    # Fields of one crop are sown on other days, on other soils.
    hue = np.float32(1.0) + (rows.ripe[:, None] - 0.5) * np.array([0.5, 0.12, -0.1], dtype=np.float32)
    soil = shades(crop.soil, rows.shade * (1.0 + uneven + 0.07 * streak + 0.10 * passing))
    plant = hue * shades(crop.plant, rows.shade * (1.0 + 2.0 * uneven + 0.03 * streak + 0.06 * passing))
    ridge = 0.5 + 0.5 * np.cos(turns) * kept
    missing = octave(rows.across, 0.3 * rows.along, 0.7, s.seed, 79) * fading(0.7, s.footprint_m)
    full = crop.cover + 1.2 * min(crop.cover, 1.0 - crop.cover) * (2.0 * ridge - 1.0)
    cover = np.clip(full * (0.7 + 0.45 * rows.shade) + 0.10 * missing + 0.06 * rows.fine + 0.05 * rows.broad, 0.0, 1.0)
    colour = mix(soil, plant, cover)
    if crop.tramline_m:
        middle = rows.across - 0.5 * crop.tramline_m
        wheel = np.maximum(*(stripes(middle + side, crop.tramline_m, 0.5, s.footprint_m) for side in (-0.9, 0.9)))
        colour = mix(colour, soil, 0.8 * wheel)
    return colour, np.float32(-np.sqrt(2.0) * crop.furrow) * np.sin(turns) * kept


SCENE = SceneKind(plan=_plan, paint_ground=_paint)
