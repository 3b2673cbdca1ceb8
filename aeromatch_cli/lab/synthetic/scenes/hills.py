"""Steep meadows with scrub, rocks, bare soil and trodden paths; woods in groups on the slopes."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.fields import Rolling, random_waves, rolling_land, scene_heading_deg, turned
from aeromatch_cli.lab.synthetic.noise import fading, inside, octave, octaves, slopes
from aeromatch_cli.lab.synthetic.paint import Painted, Samples, mix, rgb, shades
from aeromatch_cli.lab.synthetic.scenes import Plan, SceneKind
from aeromatch_cli.lab.synthetic.scenes.growth import clumps, scattered, winding_path
from aeromatch_cli.lab.synthetic.solids import Surface
from aeromatch_cli.lab.synthetic.terrain import Area
from aeromatch_cli.lab.synthetic.trees import Species, tree

RELIEF_M = (36.0, 74.0)
_CELL_M = 3.0
_TREE_CELL_M, _SHRUB_CELL_M = 6.4, 9.0
_WOOD_M, _WOOD_NUMBER = 74.0, 91  # wavelength and number of the noise that says where woods stand


def hill_land(seed: int) -> Rolling:
    """Long hills with spurs and small knolls; the knolls' share makes slopes of 10 to 35 degrees."""
    relief_m = float(np.random.default_rng([seed, 42]).uniform(*RELIEF_M))
    long, spurs = random_waves((seed, 43), 260.0, 620.0, 9), random_waves((seed, 44), 70.0, 190.0, 14).scaled(0.22)
    knolls = random_waves((seed, 45), 18.0, 50.0, 14).scaled(0.022)
    return rolling_land(long.joined(spurs).joined(knolls), relief_m, _CELL_M)


def woodedness(u_m: FloatArray, v_m: FloatArray, seed: int) -> FloatArray:
    """About normal (N,); above 1 there is wood, around 0.6 its thinning edge."""
    return octave(u_m, v_m, _WOOD_M, seed, _WOOD_NUMBER) + 0.35 * octave(u_m, v_m, 21.0, seed, _WOOD_NUMBER + 1)


def _plan(seed: int, area: Area) -> Plan:
    terrain, heading_deg = hill_land(seed), scene_heading_deg(seed)

    def wooded(xy_m: FloatArray) -> FloatArray:
        u, v = np.moveaxis(turned(xy_m, heading_deg).astype(np.float32), -1, 0)
        return woodedness(u, v, seed)

    surfaces: list[Surface] = []
    solids = {"trees": 0, "shrubs": 0}
    for rng, x, y in scattered(
        (seed, 46), area, _TREE_CELL_M, lambda xy: np.clip(1.6 * (wooded(xy) - 0.5), 0.008, 0.93)
    ):
        kind = (Species.BROADLEAF, Species.CONIFER)[int(rng.random() < 0.3)]
        radius = float(rng.uniform(2.2, 4.9)) * (0.6 if kind is Species.CONIFER else 1.0)
        height = radius * float(rng.uniform(2.0, 2.7)) * (1.9 if kind is Species.CONIFER else 1.0)
        surfaces += tree(rng, x, y, _foot_m(terrain, x, y), radius, height, kind)
        solids["trees"] += 1
    for rng, x, y in scattered((seed, 47), area, _SHRUB_CELL_M, lambda xy: np.clip(0.5 * wooded(xy), 0.05, 0.5)):
        radius = float(rng.uniform(0.6, 1.7))
        surfaces += tree(
            rng, x, y, _foot_m(terrain, x, y), radius, radius * float(rng.uniform(1.0, 1.6)), Species.SHRUB
        )
        solids["shrubs"] += 1
    return Plan(terrain, heading_deg, surfaces, solids)


def _foot_m(terrain: Rolling, x_m: float, y_m: float) -> float:
    """Height of the ground below a stem, a little sunk, so that nothing floats on the slope."""
    return float(terrain.height_m(np.array([[x_m, y_m]]))[0]) - 0.15


def _paint(s: Samples) -> Painted:
    steep = np.hypot(s.slope[:, 0], s.slope[:, 1])
    fine = octaves(s.u_m, s.v_m, s.footprint_m, (0.10, 0.24, 0.6), s.seed, 93)
    patch = octaves(s.u_m, s.v_m, s.footprint_m, (1.7, 4.6), s.seed, 96)
    broad = octaves(s.u_m, s.v_m, s.footprint_m, (13.0, 33.0, 95.0), s.seed, 98)
    # Sunny, steep and high ground is drier.
    dry = np.clip(0.35 + 0.20 * broad + 0.14 * patch + 0.6 * (steep - 0.25), 0.0, 1.0)
    colour = mix(shades((0.078, 0.122, 0.032), 1.0 + 0.24 * fine + 0.10 * patch), rgb(0.205, 0.180, 0.082), dry)
    colour = colour * (1.0 + 0.12 * fine)[:, None]
    relief = slopes(s.u_m, s.v_m, s.footprint_m, ((0.13, 0.24), (0.36, 0.17), (1.2, 0.10), (4.2, 0.05)), s.seed, 102)
    colour = _trodden(s, colour, steep, fine)
    bare = np.clip(3.0 * (steep - 0.42 + 0.10 * broad + 0.07 * patch), 0.0, 1.0)
    colour = mix(colour, shades((0.175, 0.130, 0.088), 1.0 + 0.16 * fine + 0.10 * patch), bare)
    rock = np.clip(5.0 * (steep - 0.56 + 0.10 * patch + 0.06 * broad), 0.0, 1.0)
    # Joints are where noise is zero; where they cannot be told apart, rock has its mean tone.
    kept = fading(1.9, s.footprint_m)
    joint = 1.0 - np.clip(3.0 * np.abs(octave(s.u_m, s.v_m, 1.9, s.seed, 107)), 0.0, 1.0)
    tone = 1.0 - 0.45 * (0.13 + kept * (joint - 0.13)) + 0.16 * fine + 0.14 * patch
    stone = shades((0.165, 0.152, 0.132), tone)
    colour = mix(colour, stone, rock)
    relief *= (1.0 + 0.7 * rock)[:, None]
    for cell_m, density, number, tall, tint in (
        (0.9, 0.30 + 0.2 * dry, 108, 0.3, (0.15, 0.14, 0.06)),  # tussocks
        (3.1, np.clip(0.22 + 0.22 * broad, 0.0, 0.6), 110, 0.35, (0.062, 0.078, 0.026)),  # scrub
        (2.3, 0.10 + 0.5 * bare, 112, 0.35, (0.155, 0.144, 0.126)),  # stones
    ):
        cover, own, dome = clumps(s, cell_m, density, number, tall, fine)
        colour = mix(colour, shades(tint, (0.7 + 0.6 * own) * (1.0 + 0.3 * fine)), 0.9 * cover)
        relief += dome
    litter = np.clip(2.0 * (woodedness(s.u_m, s.v_m, s.seed) - 0.75), 0.0, 0.75)
    colour = mix(colour, shades((0.085, 0.075, 0.040), 1.0 + 0.3 * fine + 0.15 * patch), litter)
    return Painted(colour, relief=relief)


def _trodden(s: Samples, colour: FloatArray, steep: FloatArray, fine: FloatArray) -> FloatArray:
    """Paths, and on steep meadows the level tracks of cattle, one above the other."""
    soil = shades((0.27, 0.215, 0.15), 1.0 + 0.12 * fine)
    path, distance = winding_path(s, 330.0, 0.9, 104)
    colour = mix(colour, soil, 0.85 * path)
    colour = mix(colour, rgb(0.19, 0.175, 0.085), 0.4 * np.clip(1.0 - distance / 3.0, 0.0, 1.0) * (1.0 - path))
    level = s.z_m + 0.35 * octave(s.u_m, s.v_m, 9.0, s.seed, 106)
    off = np.abs(level / 0.55 - np.round(level / 0.55)) * np.float32(0.55)
    tread = inside(0.25 - off / np.maximum(steep, 0.15), s.footprint_m) * fading(1.4, s.footprint_m)
    return mix(colour, soil, 0.32 * tread * np.clip(5.0 * (steep - 0.28), 0.0, 1.0))


SCENE = SceneKind(plan=_plan, paint_ground=_paint)
