"""The bank of a lake: water, wet and dry sand, reeds, rocks, meadow with trees; a pier and boats."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.fields import turned
from aeromatch_cli.lab.synthetic.noise import octave, octaves, slopes
from aeromatch_cli.lab.synthetic.paint import Painted, Samples, mix, rgb, shades
from aeromatch_cli.lab.synthetic.scenes import Plan, SceneKind
from aeromatch_cli.lab.synthetic.scenes.growth import clumps, scattered, winding_path
from aeromatch_cli.lab.synthetic.scenes.jetty import boats_and_piers
from aeromatch_cli.lab.synthetic.solids import Footprint, Material, Surface
from aeromatch_cli.lab.synthetic.terrain import Area
from aeromatch_cli.lab.synthetic.trees import Species, tree
from aeromatch_cli.lab.synthetic.water import LEVEL_M, Shore, shore

# The sheet of water ends here: below the land on one side, beyond every horizon on the other.
_INLAND_M, _HORIZON_M = 80.0, 9000.0
_TREE_CELL_M = 8.0


def _plan(seed: int, area: Area) -> Plan:
    land = shore(seed)
    surfaces = [_sheet(land)]
    solids = {"trees": 0, "shrubs": 0}

    def grown(xy_m: FloatArray) -> FloatArray:
        u, v = np.moveaxis(turned(xy_m, land.heading_deg).astype(np.float32), -1, 0)
        grove = np.clip(0.25 + 0.5 * octave(u, v, 55.0, seed, 140), 0.02, 0.9)
        return grove * np.clip((land.inland_m(u, v) - 20.0) / 12.0, 0.0, 1.0)

    for rng, x, y in scattered((seed, 56), area, _TREE_CELL_M, grown):
        foot_m = float(land.height_m(np.array([[x, y]]))[0]) - 0.1
        shrub = rng.random() < 0.35
        radius = float(rng.uniform(0.8, 1.6) if shrub else rng.uniform(2.0, 4.4))
        kind = Species.SHRUB if shrub else Species.BROADLEAF
        surfaces += tree(rng, x, y, foot_m, radius, radius * float(rng.uniform(1.3, 2.4)), kind)
        solids["shrubs" if shrub else "trees"] += 1
    built, counts = boats_and_piers(seed, area, land)
    return Plan(land, land.heading_deg, surfaces + built, {**solids, **counts})


def _sheet(land: Shore) -> Surface:
    """The water's surface; the same for every area, since what a place shows must not depend on the area."""
    middle_v = 0.5 * (_INLAND_M - _HORIZON_M)
    a = np.deg2rad(land.heading_deg)
    u_axis, v_axis = np.array([np.cos(a), np.sin(a), 0.0]), np.array([-np.sin(a), np.cos(a), 0.0])
    x, y = (middle_v * v_axis)[:2]
    plan = Footprint(float(x), float(y), 2.0 * _HORIZON_M, _INLAND_M + _HORIZON_M, land.heading_deg)
    corners = np.column_stack([plan.corners_m(), np.full(4, LEVEL_M)])
    triangles = corners[np.array([[0, 1, 2], [0, 2, 3]])]
    size_m = (plan.length_x_m, plan.length_y_m)
    return Surface(triangles, np.zeros(3), u_axis, v_axis, size_m, Material.WATER, (0.03, 0.05, 0.05))


def reediness(u_m: FloatArray, v_m: FloatArray, seed: int) -> FloatArray:
    """About normal (N,); above 0.4 reeds stand in the water's edge."""
    return octave(u_m, 0.3 * v_m, 62.0, seed, 141)


def _paint(s: Samples) -> Painted:
    inland = shore(s.seed).inland_m(s.u_m, s.v_m)
    fine = octaves(s.u_m, s.v_m, s.footprint_m, (0.08, 0.2, 0.5), s.seed, 142)
    patch = octaves(s.u_m, s.v_m, s.footprint_m, (1.6, 4.3), s.seed, 145)
    broad = octaves(s.u_m, s.v_m, s.footprint_m, (14.0, 45.0), s.seed, 147)
    height = s.z_m - LEVEL_M + 0.025 * patch + 0.008 * fine
    sand = shades((0.40, 0.335, 0.235), 1.0 + 0.07 * fine + 0.05 * patch + 0.05 * broad)
    # The last waves' drift lies in lines along the shore; below them the sand is wet.
    line = np.abs(s.z_m - LEVEL_M - 0.42 - 0.07 * broad)
    width = np.maximum(0.035 + 0.02 * fine, 0.005)
    drift = np.clip(1.0 - line / width, 0.0, 1.0) * np.clip(0.3 + 0.6 * patch, 0.0, 1.0)
    wet = np.clip((0.30 + 0.06 * broad - height) / 0.16, 0.0, 1.0)
    colour = mix(sand, (0.12, 0.095, 0.06), 0.6 * drift) * (1.0 - 0.52 * wet)[:, None]
    relief = slopes(s.u_m, s.v_m, s.footprint_m, ((0.11, 0.10), (0.4, 0.10), (1.3, 0.07)), s.seed, 149)
    pebble, own, dome = clumps(s, 0.5, np.clip(0.25 + 0.3 * broad, 0.0, 0.7), 153, 0.4, fine)
    beach = np.clip((14.0 - inland) / 3.0, 0.0, 1.0)
    colour = mix(colour, shades((0.30, 0.28, 0.25), 0.4 + own), 0.85 * pebble * beach)
    relief += dome * beach[:, None]
    edge = np.clip((inland - 13.0 + 3.0 * broad + 1.3 * patch + 1.0 * fine) / 2.5, 0.0, 1.0)
    colour = mix(colour, _meadow(s, fine, patch, broad), edge)
    relief += edge[:, None] * slopes(s.u_m, s.v_m, s.footprint_m, ((0.15, 0.24), (0.5, 0.15)), s.seed, 155)
    reeds = np.clip(2.5 * (reediness(s.u_m, s.v_m, s.seed) - 0.45 + 0.12 * patch), 0.0, 1.0)
    reeds = reeds * np.clip((6.5 + 1.5 * patch - np.abs(inland - 2.0)) / 1.5, 0.0, 1.0)
    stalks = octaves(s.u_m, s.v_m, s.footprint_m, (0.18, 0.45), s.seed, 157)
    colour = mix(colour, shades((0.115, 0.125, 0.045), 1.0 + 0.38 * stalks + 0.14 * patch), reeds)
    relief += reeds[:, None] * slopes(s.u_m, s.v_m, s.footprint_m, ((0.2, 0.35), (0.6, 0.2)), s.seed, 159)
    return Painted(colour, relief=relief, gloss=0.5 * np.clip((0.10 - height) / 0.1, 0.0, 1.0))


def _meadow(s: Samples, fine: FloatArray, patch: FloatArray, broad: FloatArray) -> FloatArray:
    dry = np.clip(0.32 + 0.2 * broad + 0.12 * patch, 0.0, 1.0)
    colour = mix(shades((0.078, 0.125, 0.032), 1.0 + 0.24 * fine + 0.10 * patch), rgb(0.185, 0.170, 0.072), dry)
    tuft, own, _ = clumps(s, 0.9, 0.4 + 0.2 * broad, 161, 0.5, fine)
    colour = mix(colour, shades((0.13, 0.135, 0.05), 0.5 + own), 0.7 * tuft)
    path, _ = winding_path(s, 260.0, 1.2, 163)
    return mix(colour, shades((0.33, 0.27, 0.195), 1.0 + 0.12 * fine), 0.85 * path)


SCENE = SceneKind(plan=_plan, paint_ground=_paint)
