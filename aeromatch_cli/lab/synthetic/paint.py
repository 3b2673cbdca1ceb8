"""What painters take and give: colour samples on surfaces in, albedo, micro-relief and gloss out.

A painter is a pure function of texture coordinates, so that a place looks the same in every picture that samples it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.lab.synthetic.noise import octaves

_GRAIN_M = (0.06, 0.12, 0.24, 0.48)
_PATCH_M = (0.96, 1.9, 3.8)
_BROAD_M = (7.7, 15.0, 31.0)


@dataclass(frozen=True, eq=False)
class Samples:
    """Colour samples on surfaces of one material; every array has N rows, float32 where not stated.

    u_m, v_m: texture coordinates (on the ground: the plan turned by the scene's heading). z_m: world height.
    footprint_m: spacing of neighbouring samples. shift_m: what makes noise differ from surface to surface.
    size_m: (N, 2) extent of the surface. tint: (N, 3). salt: (N,) int64, one number for each surface.
    slope: (N, 2) gradient of the terrain along u and v (zero on solids). seed: the scene's. moment: the picture's
    number, for what does not stand still between two pictures (water).
    """

    u_m: FloatArray
    v_m: FloatArray
    z_m: FloatArray
    footprint_m: FloatArray
    shift_m: FloatArray
    size_m: FloatArray
    tint: FloatArray
    salt: IntArray
    slope: FloatArray
    seed: int
    moment: int

    @cached_property
    def grain(self) -> FloatArray:
        """Noise (N,) of about unit variance, wavelengths 0.06-0.5 m."""
        return self._octaves(_GRAIN_M, 0)

    @cached_property
    def patch(self) -> FloatArray:
        """Noise (N,) of about unit variance, wavelengths 1-4 m."""
        return self._octaves(_PATCH_M, 4)

    @cached_property
    def broad(self) -> FloatArray:
        """Noise (N,) of about unit variance, wavelengths 8-31 m."""
        return self._octaves(_BROAD_M, 7)

    def _octaves(self, wavelengths_m: tuple[float, ...], first: int) -> FloatArray:
        u_m, v_m = self.u_m + self.shift_m, self.v_m + self.shift_m
        return octaves(u_m, v_m, self.footprint_m, wavelengths_m, self.seed, first)

    def part(self, where: IntArray | BoolArray) -> Samples:
        """Some of the samples, by index or mask; noise that is already known is not made again."""
        rows = {name: getattr(self, name)[where] for name in _ROWS}
        chosen = replace(self, **rows)
        chosen.__dict__.update({name: self.__dict__[name][where] for name in _NOISES if name in self.__dict__})
        return chosen


_ROWS = ("u_m", "v_m", "z_m", "footprint_m", "shift_m", "size_m", "tint", "salt", "slope")
_NOISES = ("grain", "patch", "broad")


@dataclass(frozen=True, eq=False)
class Painted:
    """What a painter gives for N samples.

    albedo: (N, 3) linear RGB, 0-1. relief: (N, 2) slope of the micro-relief along u and v (rise over run: ripples,
    furrows, tufts), which only turns the shading normal, or None. gloss: (N,) share of the sky mirrored, 0-1, or None.
    """

    albedo: FloatArray
    relief: FloatArray | None = None
    gloss: FloatArray | None = None


Painter = Callable[[Samples], Painted]


def mix(under: FloatArray, over: FloatArray | tuple[float, float, float], coverage: FloatArray) -> FloatArray:
    """Colours (N, 3), `over` covering `under` by a share (N,)."""
    mixed: FloatArray = under + (np.asarray(over, dtype=np.float32) - under) * coverage[:, None]
    return mixed


def rgb(r: float, g: float, b: float) -> FloatArray:
    return np.array([r, g, b], dtype=np.float32)


def shades(tint: tuple[float, float, float] | FloatArray, factor: FloatArray) -> FloatArray:
    """(N, 3): one colour, brighter and darker by factor (N,)."""
    shaded: FloatArray = np.asarray(tint, dtype=np.float32) * factor[:, None]
    return shaded
