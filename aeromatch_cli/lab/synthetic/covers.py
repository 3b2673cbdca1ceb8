"""What built-up ground is covered with: asphalt, slabs, gravel, lawn, soil. Albedo (N, 3) from ground samples."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.noise import hash01, inside, spots, stripes
from aeromatch_cli.lab.synthetic.paint import Samples, mix, rgb, shades

MARKING = (0.46, 0.46, 0.44)


def asphalt(s: Samples, tone: FloatArray) -> FloatArray:
    """Worn asphalt, from dark and new (tone 0) to pale and old (tone 1): patches, stains of oil."""
    base = 0.085 + 0.085 * tone
    colour = shades((1.0, 0.985, 0.97), base)
    colour = colour * (1.0 + 0.07 * s.grain + 0.07 * s.patch + 0.10 * s.broad)[:, None]
    patched, own = _repairs(s)
    colour = mix(colour, shades((0.09, 0.09, 0.092), 0.75 + 0.8 * own), 0.7 * patched)
    oil = np.clip(0.6 * (s.patch + 0.4 * s.grain - 1.5), 0.0, 0.3)
    return colour * (1.0 - oil)[:, None]


def _repairs(s: Samples) -> tuple[FloatArray, FloatArray]:
    """Where the street was dug up: coverage (N,) of rectangles and each one's own number."""
    ix, iy = np.floor(s.u_m / 7.3), np.floor(s.v_m / 6.1)
    own = hash01(ix, iy, 5)
    x = np.abs(s.u_m / 7.3 - ix - 0.35 - 0.3 * own) * 7.3
    y = np.abs(s.v_m / 6.1 - iy - 0.5) * 6.1
    wide, deep = 0.4 + 1.7 * hash01(ix, iy, 6), 0.4 + 1.6 * hash01(ix, iy, 7)
    return inside(np.minimum(wide - x, deep - y), s.footprint_m) * (own < 0.15), own / 0.15


def slabs(s: Samples, tone: FloatArray) -> FloatArray:
    """Concrete slabs of half a metre, grey to reddish (tone 0 to 1), with dark joints."""
    calm = np.clip(0.25 / s.footprint_m - 1.0, 0.0, 1.0)
    slab = hash01(np.floor(s.u_m / 0.5), np.floor(s.v_m / 0.5), 11) - 0.5
    base = mix(np.broadcast_to(rgb(0.25, 0.24, 0.225), (len(tone), 3)), rgb(0.24, 0.15, 0.12), np.clip(tone, 0.0, 1.0))
    stained = 0.10 * slab * calm + 0.07 * s.grain + 0.09 * s.patch + 0.08 * s.broad
    joint = np.maximum(stripes(s.u_m, 0.5, 0.02, s.footprint_m), stripes(s.v_m, 0.5, 0.02, s.footprint_m))
    return base * ((1.0 + stained) * (1.0 - 0.28 * joint))[:, None]


def gravel(s: Samples) -> FloatArray:
    """Trodden gravel and dust, with puddles and weeds."""
    colour = shades((0.25, 0.225, 0.185), 1.0 + 0.15 * s.grain + 0.10 * s.patch + 0.10 * s.broad)
    wet = np.clip(1.5 * (s.patch + 1.1 * s.broad - 1.3), 0.0, 0.6)
    colour = colour * (1.0 - wet)[:, None]
    weeds = np.clip(1.3 * (0.6 * s.grain + s.patch - 0.7 * s.broad - 1.3), 0.0, 0.8)
    return mix(colour, shades((0.085, 0.105, 0.04), 1.0 + 0.25 * s.grain), weeds)


def lawn(s: Samples, own: FloatArray) -> FloatArray:
    """Mown grass; `own` (N,) in 0-1 says how a piece of lawn differs: lush to dry and mossy, well kept to bare."""
    green = mix(np.broadcast_to(rgb(0.066, 0.096, 0.032), (len(own), 3)), rgb(0.128, 0.122, 0.056), own)
    dry = np.clip(0.5 * s.patch + 0.8 * s.broad - 0.5 + 0.9 * own, 0.0, 1.0)
    green = mix(green, rgb(0.165, 0.150, 0.075), 0.55 * dry)
    clover = np.clip(0.8 * s.patch - 0.7 * s.broad - 0.6, 0.0, 1.0)
    green = mix(green, rgb(0.048, 0.080, 0.028), 0.6 * clover)
    colour = green * (1.0 + 0.17 * s.grain + 0.10 * s.patch + 0.08 * s.broad)[:, None]
    bare = np.clip(1.5 * (s.patch + 0.7 * s.broad + 0.4 * s.grain - 2.3 + 0.9 * own), 0.0, 0.85)
    colour = mix(colour, soil(s), bare)
    tuft, kind = spots(s.u_m + 0.1 * s.patch, s.v_m, 0.45, 0.4, 31, s.footprint_m)
    return colour * (1.0 + (0.75 * kind - 0.45) * tuft)[:, None]


def soil(s: Samples) -> FloatArray:
    return shades((0.175, 0.135, 0.092), 1.0 + 0.22 * s.grain + 0.14 * s.patch)


def bed(s: Samples) -> FloatArray:
    """Dug soil full of plants of all sizes."""
    plants, own = spots(s.u_m + 0.15 * s.patch, s.v_m + 0.1 * s.grain, 0.48, 0.95, 35, s.footprint_m)
    leaves = mix(
        shades((0.05, 0.085, 0.025), 0.6 + 0.8 * own + 0.25 * s.grain), rgb(0.22, 0.10, 0.09), 0.7 * (own > 0.93)
    )
    ground = mix(soil(s), leaves, np.clip(0.45 + 0.5 * s.patch + 0.3 * s.grain, 0.0, 0.9))
    return mix(ground, leaves, plants)


def worn(s: Samples) -> FloatArray:
    """What is left (N,) of road paint, 0.15-1."""
    left: FloatArray = np.clip(0.72 + 0.16 * s.grain + 0.16 * s.patch + 0.12 * s.broad, 0.15, 1.0)
    return left
