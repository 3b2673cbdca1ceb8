"""A large mown meadow: fine noise, faint tracks of the mower, hardly any relief. Little for a matcher to hold on to."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.lab.synthetic.fields import random_waves, rolling_land, scene_heading_deg
from aeromatch_cli.lab.synthetic.noise import fading, hash01, octave, octaves, slopes, stripes
from aeromatch_cli.lab.synthetic.paint import Painted, Samples, mix, rgb, shades
from aeromatch_cli.lab.synthetic.scenes import Plan, SceneKind
from aeromatch_cli.lab.synthetic.terrain import Area

RELIEF_M = (0.4, 2.0)
_CELL_M = 4.0
SWATH_M = 2.4  # width of the mower
_TUFTS = ((0.07, 0.34), (0.16, 0.22), (0.4, 0.09), (1.1, 0.03))


def _plan(seed: int, area: Area) -> Plan:
    relief_m = float(np.random.default_rng([seed, 12]).uniform(*RELIEF_M))
    terrain = rolling_land(random_waves((seed, 13), 60.0, 320.0, 14), relief_m, _CELL_M)
    return Plan(terrain, scene_heading_deg(seed))


def _paint(s: Samples) -> Painted:
    # The mower's lanes wander by some decimetres; lanes driven there and back lean the blades two ways.
    across = s.u_m + 0.35 * octave(s.u_m, s.v_m, 45.0, s.seed, 31)
    lane = np.floor(across / SWATH_M)
    own = hash01(lane, np.zeros_like(lane), s.seed * 101 + 1)
    lean = np.where(lane % 2.0 == 0.0, 1.0, -1.0).astype(np.float32) * fading(2.0 * SWATH_M, s.footprint_m)
    blades = octaves(s.u_m, s.v_m, s.footprint_m, (0.08, 0.17), s.seed, 32)
    fine = 0.8 * blades + 0.35 * octave(s.u_m, s.v_m, 0.42, s.seed, 34) * fading(0.42, s.footprint_m)
    faint = octaves(s.u_m, s.v_m, s.footprint_m, (1.3, 4.1, 13.0, 38.0), s.seed, 35)
    broad = octave(s.u_m, s.v_m, 70.0, s.seed, 39)
    factor = 1.0 + 0.20 * fine + 0.045 * faint + 0.05 * broad + 0.028 * lean + 0.03 * (own - 0.5)
    dry = np.clip(0.22 + 0.08 * faint + 0.11 * broad + 0.08 * fine, 0.0, 1.0)
    colour = shades((0.082, 0.132, 0.030), factor)
    colour = mix(colour, shades((0.175, 0.165, 0.062), factor), dry)
    # Two wheels press the grass down along each lane, here more, there less.
    wheel = stripes(across - 0.5 * SWATH_M - 0.75, SWATH_M, 0.22, s.footprint_m)
    colour = mix(colour, rgb(0.13, 0.15, 0.05), wheel * np.clip(0.10 + 0.10 * faint + 0.16 * (own - 0.5), 0.0, 0.35))
    return Painted(colour, relief=slopes(s.u_m, s.v_m, s.footprint_m, _TUFTS, s.seed, 40))


SCENE = SceneKind(plan=_plan, paint_ground=_paint)
