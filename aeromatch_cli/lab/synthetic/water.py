"""Open water and the bed below it: one shore function for the terrain, the land's painter and the water's."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.fields import Waves, random_waves, scene_heading_deg, turned
from aeromatch_cli.lab.synthetic.noise import hash01, octave, octaves, slopes
from aeromatch_cli.lab.synthetic.paint import Painted, Samples, mix, rgb, shades

LEVEL_M = 0.0
_CELL_M = 2.0
DEEPEST_M, BANK_M = -3.5, 3.2


@dataclass(frozen=True, eq=False)
class Shore:
    """Land that rises from a lake, whose bank runs along u: inland is where v grows.

    winding: metres by which the shore line is shifted. land: bumps above the water. Both over u, v.
    """

    heading_deg: float
    winding: Waves
    land: Waves
    cell_m: float = _CELL_M

    def inland_m(self, u_m: FloatArray, v_m: FloatArray) -> FloatArray:
        """About the distance (N,) from the water's edge, negative in the water."""
        return v_m + self.winding.at(u_m, v_m)

    def profile_m(self, inland_m: FloatArray) -> FloatArray:
        """Heights (N,): a beach of 1 in 11, a bank behind it, a bed that levels out. Smooth, zero at the edge."""
        beach = 0.09 * inland_m
        bed = DEEPEST_M * np.tanh(beach / DEEPEST_M)
        rise = 1.0 / (1.0 + np.exp(np.clip(-(inland_m - 27.0) / 4.5, -60.0, 60.0)))
        low = 1.0 / (1.0 + np.exp(27.0 / 4.5))
        upper = 1.1 * np.tanh(beach / 1.1) + (BANK_M - 1.1) * (rise - low)
        return np.where(inland_m < 0.0, bed, upper)

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        u, v = np.moveaxis(turned(xy_m, self.heading_deg), -1, 0)
        return self.height_uv_m(u, v)

    def height_uv_m(self, u_m: FloatArray, v_m: FloatArray) -> FloatArray:
        inland = self.inland_m(u_m, v_m)
        # Bumps grow from nothing at the edge, so that the bank never dips below the water again.
        share = np.clip((inland - 12.0) / 30.0, 0.0, 1.0)
        return self.profile_m(inland) + share * share * (3.0 - 2.0 * share) * self.land.at(u_m, v_m)


@lru_cache(maxsize=8)
def shore(seed: int) -> Shore:
    """The shore of a seed; it passes within some metres of the origin."""
    winding = random_waves((seed, 53), 55.0, 300.0, 7)
    here = float(winding.at(np.zeros(1), np.zeros(1))[0])
    bay_m = float(np.random.default_rng([seed, 52]).uniform(5.0, 9.0))
    # A constant wave keeps the edge close to the origin.
    still = Waves(np.zeros((1, 2)), np.array([np.pi / 2.0]), np.array([-here]))
    land = random_waves((seed, 54), 45.0, 260.0, 8).scaled(0.55)
    return Shore(scene_heading_deg(seed), winding.joined(still).scaled(bay_m), land)


def paint_water(s: Samples) -> Painted:
    """A lake under wind: dark where deep, the bed shows near the edge; waves are others in every picture."""
    # Waves are drawn from another part of the noise at every moment.
    move_u, move_v = (float(hash01(np.array([s.moment]), np.array([k]), s.seed)[0]) * 500.0 for k in (1, 2))
    u, v = s.u_m + np.float32(move_u), s.v_m + np.float32(move_v)
    gusts = octaves(u, v, s.footprint_m, (17.0, 60.0), s.seed, 121)
    waves = slopes(u, v, s.footprint_m, ((0.25, 0.09), (0.7, 0.09), (1.9, 0.07), (5.0, 0.04)), s.seed, 123)
    # Crests lie across the wind, which blows along u and v alike.
    waves *= np.clip(1.0 + 0.35 * gusts, 0.3, 1.8)[:, None]
    depth = -shore(s.seed).height_uv_m(s.u_m, s.v_m)
    clear = np.exp(-np.clip(depth, 0.0, None)[:, None] * np.array([3.0, 1.9, 2.3], dtype=np.float32))
    bed = shades((0.20, 0.165, 0.105), 1.0 + 0.12 * octaves(s.u_m, s.v_m, s.footprint_m, (0.6, 2.1, 6.0), s.seed, 132))
    # The water itself, and the sky that ripples finer than a sample send up.
    colour = rgb(0.014, 0.024, 0.024) + (0.004 * gusts)[:, None] + bed * clear
    lap = np.float32(0.05) * octave(u, v, 4.0, s.seed, 128) + np.float32(0.025) * octave(u, v, 0.9, s.seed, 129)
    torn = np.clip(0.5 + 0.5 * octave(u, v, 1.5, s.seed, 130), 0.0, 1.0)
    foam = np.clip(1.0 - np.abs(depth - 0.05 - lap) / 0.035, 0.0, 1.0) * torn
    colour = mix(colour, rgb(0.6, 0.62, 0.62), 0.55 * foam)
    return Painted(np.clip(colour, 0.005, 0.95), relief=waves, gloss=np.ones(len(s.u_m), dtype=np.float32))
