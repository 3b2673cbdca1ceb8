"""Dunes with slip faces and wind ripples, gravel and cracked clay between them, shrubs and stones here and there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.fields import Dunes, random_waves, scene_heading_deg
from aeromatch_cli.lab.synthetic.noise import fading, octave, octaves, slopes
from aeromatch_cli.lab.synthetic.paint import Painted, Samples, mix, shades
from aeromatch_cli.lab.synthetic.scenes import Plan, SceneKind
from aeromatch_cli.lab.synthetic.scenes.growth import clumps, scattered
from aeromatch_cli.lab.synthetic.solids import Surface
from aeromatch_cli.lab.synthetic.terrain import Area
from aeromatch_cli.lab.synthetic.trees import Species, tree

HEIGHT_M = (3.0, 7.5)  # of the highest dunes over the land below them
LENGTH_TO_HEIGHT = 17.0
_SKEW = 0.68
_CELL_M = 2.0
_SHRUB_CELL_M = 8.0
_TWO_PI = 2.0 * np.pi


def dunes(seed: int) -> Dunes:
    """The dunes of a seed; the wind blows along u."""
    height_m = float(np.random.default_rng([seed, 22]).uniform(*HEIGHT_M))
    length_m = LENGTH_TO_HEIGHT * height_m
    winding = random_waves((seed, 23), 2.2 * length_m, 6.0 * length_m, 8).scaled(0.16 * length_m)
    envelope = random_waves((seed, 24), 2.5 * length_m, 8.0 * length_m, 8).scaled(0.9)
    base = random_waves((seed, 25), 150.0, 500.0, 8).scaled(0.35)
    return Dunes(scene_heading_deg(seed), length_m, height_m, _SKEW, winding, envelope, base, _CELL_M)


def _plan(seed: int, area: Area) -> Plan:
    land = dunes(seed)
    surfaces: list[Surface] = []
    count = 0
    for rng, x, y in scattered((seed, 26), area, _SHRUB_CELL_M, lambda xy: _fit_for_shrubs(land, xy)):
        radius = float(rng.uniform(0.4, 1.3))
        foot_m = float(land.height_m(np.array([[x, y]]))[0]) - 0.1
        shrub = tree(rng, x, y, foot_m, radius, radius * float(rng.uniform(0.9, 1.4)), Species.SHRUB)
        # Dust and drought take the green out of leaves.
        dry = float(rng.uniform(0.8, 1.3))
        surfaces += [replace(part, tint=(0.185 * dry, 0.170 * dry, 0.105 * dry)) for part in shrub]
        count += 1
    return Plan(land, land.heading_deg, surfaces, {"shrubs": count})


def _fit_for_shrubs(land: Dunes, xy_m: FloatArray) -> FloatArray:
    """Shrubs keep to low and level ground."""
    here = land.height_m(xy_m)
    beside = [land.height_m(xy_m + np.array(step)) for step in ((1.0, 0.0), (0.0, 1.0))]
    steep = np.hypot(beside[0] - here, beside[1] - here)
    return 0.45 * np.clip((1.3 - here) / 0.8, 0.05, 1.0) * np.clip((0.22 - steep) / 0.1, 0.0, 1.0)


def _paint(s: Samples) -> Painted:
    steep, lee = np.hypot(s.slope[:, 0], s.slope[:, 1]), -s.slope[:, 0]
    mottle = octaves(s.u_m, s.v_m, s.footprint_m, (0.08, 0.3, 1.2), s.seed, 51)
    broad = octaves(s.u_m, s.v_m, s.footprint_m, (6.0, 21.0, 70.0), s.seed, 54)
    slip = np.clip((lee - 0.34) / 0.12, 0.0, 1.0)
    # Between the dunes, where it is low and flat, wind leaves gravel and rain leaves clay.
    low = np.clip((0.9 - s.z_m + 0.5 * broad) / 0.7, 0.0, 1.0) * np.clip((0.13 - steep) / 0.08, 0.0, 1.0)
    sand = shades((0.46, 0.325, 0.19), 1.0 + 0.035 * mottle + 0.04 * broad)
    sand = mix(sand, shades((0.50, 0.37, 0.225), 1.0 + 0.03 * mottle), np.clip(0.25 * broad + 0.6 * slip, 0.0, 1.0))
    colour = mix(sand, _gravel(s, mottle, broad), low)
    colour, relief = _shrubs(s, colour, np.clip(low + 0.10 - slip, 0.0, 1.0), broad)
    relief += _ripples(s, (1.0 - low) * (1.0 - slip), broad)
    relief += slopes(s.u_m, s.v_m, s.footprint_m, ((0.09, 0.10), (0.35, 0.07), (1.7, 0.035)), s.seed, 58)
    # Sand that slid down leaves faint tongues along the fall line.
    tongue = octaves(0.15 * s.u_m, s.v_m, s.footprint_m, (0.5, 1.3, 3.1), s.seed, 46)
    relief[:, 1] += 0.06 * slip * np.clip(0.5 + 0.5 * broad, 0.0, 1.0) * tongue
    return Painted(colour, relief=relief)


def _gravel(s: Samples, mottle: FloatArray, broad: FloatArray) -> FloatArray:
    """Gravel and pale clay; stones of two sizes."""
    # Dry puddles: low places of the flats, their rims drawn out by wind.
    pool = octaves(0.6 * s.u_m, s.v_m, s.footprint_m, (3.0, 8.0, 25.0, 60.0), s.seed, 73)
    clay = 0.8 * np.clip(2.2 * (pool + 0.12 * mottle - 0.55), 0.0, 1.0)
    colour = shades((0.32, 0.235, 0.155), 1.0 + 0.13 * mottle + 0.05 * broad)
    for cell_m, density, number in ((0.35, 0.55, 63), (1.3, 0.30, 64)):
        stone, own, _ = clumps(s, cell_m, density * (1.0 - clay), number, 0.3, mottle)
        colour = mix(colour, shades((0.30, 0.25, 0.20), 0.45 + 1.0 * own), 0.8 * stone)
    return mix(colour, shades((0.52, 0.44, 0.33), 1.0 + 0.05 * mottle + 0.04 * broad), clay)


def _shrubs(s: Samples, colour: FloatArray, where: FloatArray, broad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Colour (N, 3) and relief (N, 2) with dry, grey-green shrubs, each on a little mound of litter."""
    ragged = octaves(s.u_m, s.v_m, s.footprint_m, (0.12, 0.3), s.seed, 66)
    relief = np.zeros((len(s.u_m), 2), dtype=np.float32)
    for cell_m, share, number in ((2.4, 0.45, 71), (5.5, 0.30, 72)):
        density = share * where * np.clip(0.5 + 0.5 * broad, 0.0, 1.0)
        shrub, own, dome = clumps(s, cell_m, density, number, 0.45, ragged)
        colour = mix(colour, shades((0.125, 0.115, 0.068), 0.7 + 0.3 * ragged + 0.5 * own), 0.9 * shrub)
        relief += dome
    return colour, relief


def _ripples(s: Samples, strength: FloatArray, broad: FloatArray) -> FloatArray:
    """Slope of wind ripples of two sizes, crests across the wind, joining and splitting as they go."""
    relief = np.zeros((len(s.u_m), 2), dtype=np.float32)
    for wavelength_m, steepness, number in ((0.24, 0.30, 67), (2.6, 0.15, 69)):
        kept = fading(wavelength_m, s.footprint_m)
        if not kept.any():
            continue
        bend = octave(s.u_m, s.v_m, 9.0 * wavelength_m, s.seed, number)
        kinks = octave(s.u_m, 0.6 * s.v_m, 4.0 * wavelength_m, s.seed, number + 1)
        phase = np.float32(_TWO_PI / wavelength_m) * s.u_m + 2.2 * bend + 0.9 * kinks
        shape = np.cos(phase) + 0.35 * np.cos(2.0 * phase + 0.9)
        patchy = np.clip(0.65 + 0.45 * broad + 0.2 * bend, 0.1, 1.2)
        relief[:, 0] += np.float32(steepness) * kept * strength * patchy * shape
    return relief


SCENE = SceneKind(plan=_plan, paint_ground=_paint)
