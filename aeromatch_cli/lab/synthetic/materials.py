"""What solids look like: one painter for each material except the ground and the water.

Detail runs from a few centimetres to the size of a house, so that pictures at 5 cm and at 50 cm per pixel both have it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.facades import paint_facade
from aeromatch_cli.lab.synthetic.noise import hash01, octaves, spots
from aeromatch_cli.lab.synthetic.paint import Painted, Painter, Samples
from aeromatch_cli.lab.synthetic.roofs import paint_flat_roof, paint_sheet, paint_tiled_roof
from aeromatch_cli.lab.synthetic.solids import Material


def paint_plaster(s: Samples) -> Painted:
    """Blind walls, chimneys, parapets: rendered or bare brick, with streaks that rain has left."""
    streak = octaves(s.u_m + s.shift_m, 0.12 * s.v_m + s.shift_m, s.footprint_m, (0.7, 1.7), s.seed, 40)
    weathered = 0.05 * s.grain + 0.07 * s.patch + 0.08 * streak
    return Painted(s.tint * (1.0 + weathered - 0.12 * np.exp(-np.abs(s.v_m)))[:, None])


def paint_paint(s: Samples) -> Painted:
    """Varnish on cars and metal, somewhat dusty."""
    colour = s.tint * (1.0 + 0.03 * s.grain + 0.05 * s.patch)[:, None]
    return Painted(colour, gloss=np.full(len(colour), 0.5, dtype=np.float32))


def paint_glass(s: Samples) -> Painted:
    return Painted(s.tint * (1.0 + 0.1 * s.patch)[:, None], gloss=np.full(len(s.u_m), 1.0, dtype=np.float32))


def paint_leaves(s: Samples) -> Painted:
    """Clumps of leaves at several sizes: sunlit tips, dark gaps between twigs."""
    clump, own = spots(s.u_m + 0.13 * s.patch, s.v_m + 0.13 * s.grain, 0.34, 0.85, s.salt + 9, s.footprint_m)
    bough, tone = spots(s.u_m + 0.3 * s.patch, s.v_m, 0.95, 0.8, s.salt + 10, s.footprint_m)
    factor = 1.0 + 0.27 * s.grain + 0.15 * s.patch + (0.9 * own - 0.36) * clump + (0.5 * tone - 0.2) * bough
    gap = np.clip(-1.0 * s.grain - 0.7 * s.patch - 1.0, 0.0, 0.65)
    colour = s.tint * (np.clip(factor, 0.35, 2.4) * (1.0 - gap))[:, None]
    # Young leaves are yellower, old ones bluer, and no two trees are alike.
    age = 0.16 * s.patch + 0.35 * (hash01(_key(s.tint[:, 0]), _key(s.tint[:, 1]), 61) - 0.5)
    colour = colour * (1.0 + age[:, None] * _YELLOWER)
    relief = np.stack(
        [0.8 * s.grain + 0.3 * s.patch, 0.4 * s.patch + 2.0 * (own - 0.5) * clump - 0.4 * s.grain], axis=1
    )
    return Painted(colour, relief=relief.astype(np.float32))


_YELLOWER = np.array([0.9, 0.25, -0.3], dtype=np.float32)


def _key(channel: FloatArray) -> FloatArray:
    """A whole number from a colour: what belongs to one tree or house shares its tint."""
    return np.rint(channel * np.float32(1e4))


PAINTERS: Mapping[Material, Painter] = {
    Material.FACADE: paint_facade,
    Material.TILED_ROOF: paint_tiled_roof,
    Material.FLAT_ROOF: paint_flat_roof,
    Material.PAINT: paint_paint,
    Material.GLASS: paint_glass,
    Material.LEAVES: paint_leaves,
    Material.PLASTER: paint_plaster,
    Material.SHEET: paint_sheet,
}
