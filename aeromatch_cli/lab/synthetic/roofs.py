"""Roof coverings: tiles, felt and gravel on flat roofs, folded sheet metal."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.noise import hash01, inside, octaves, stripes
from aeromatch_cli.lab.synthetic.paint import Painted, Samples, mix, rgb, shades

_ROW_M, _TILE_M = 0.34, 0.25
_SEAM_M = 0.55
_FELT_M = 1.05


def _faded(wavelength_m: float, footprint_m: FloatArray) -> FloatArray:
    """Share (N,) of a pattern that is left: all at four samples per wavelength, nothing at two."""
    share: FloatArray = np.clip(0.5 * wavelength_m / footprint_m - 1.0, 0.0, 1.0)
    return share


def _building(s: Samples, number: int) -> FloatArray:
    """A random number (N,) that all surfaces of one tint share."""
    return hash01(np.rint(s.tint[:, 0] * 1e4), np.rint(s.tint[:, 2] * 1e4), number)


def paint_tiled_roof(s: Samples) -> Painted:
    """Rows of tiles, some newer than others, moss and streaks down the slope; u runs along the eaves."""
    row = np.floor(s.v_m / _ROW_M)
    column = np.floor(s.u_m / _TILE_M + 0.5 * (row % 2.0))
    tile = hash01(column, row, s.salt + 3) - 0.5
    streak = octaves(s.u_m + s.shift_m, 0.14 * s.v_m + s.shift_m, s.footprint_m, (0.45, 1.1, 2.6), s.seed, 44)
    old = 0.5 + 0.8 * _building(s, 50)
    factor = 1.0 + 0.30 * tile * _faded(_TILE_M, s.footprint_m) + 0.08 * s.grain
    factor += old * (0.08 * s.patch + 0.10 * streak) + 0.06 * s.broad
    colour = s.tint * factor[:, None]
    joint = stripes(s.v_m, _ROW_M, 0.05, s.footprint_m)
    colour = colour * (1.0 - 0.26 * joint)[:, None]
    moss = np.clip(0.4 * (0.6 * s.patch + 0.6 * s.broad + 0.5 * s.grain + 0.4 * streak - 1.4 + 0.6 * old), 0.0, 0.45)
    colour = mix(colour, rgb(0.11, 0.12, 0.065), moss)
    mended, which = _mended(s)
    colour = colour * (1.0 + (0.9 * which - 0.35) * mended)[:, None]
    ridge = inside(0.14 - np.abs(s.size_m[:, 1] - s.v_m), s.footprint_m)
    colour = mix(colour, 1.15 * s.tint, 0.8 * ridge)
    gutter = inside(0.10 - s.v_m, s.footprint_m)
    colour = mix(colour, rgb(0.20, 0.20, 0.20), 0.8 * gutter)
    # Tiles overlap like steps and roll across: rows throw fine shade down the slope.
    phase_v, phase_u = 2.0 * np.pi * s.v_m / _ROW_M, 2.0 * np.pi * s.u_m / _TILE_M
    relief_v = 0.20 * np.cos(phase_v) * _faded(_ROW_M, s.footprint_m)
    relief_u = 0.22 * np.cos(phase_u) * _faded(_TILE_M, s.footprint_m)
    return Painted(colour, relief=np.stack([relief_u, relief_v], axis=1).astype(np.float32))


def _mended(s: Samples) -> tuple[FloatArray, FloatArray]:
    """Rectangles of newer tiles, few: coverage (N,) and each one's own number."""
    ix, iy = np.floor(s.u_m / 2.1), np.floor(s.v_m / 1.7)
    x, y = np.abs(s.u_m / 2.1 - ix - 0.5) * 2.1, np.abs(s.v_m / 1.7 - iy - 0.5) * 1.7
    own = hash01(ix, iy, s.salt + 5)
    half = 0.25 + 0.7 * hash01(ix, iy, s.salt + 6)
    return inside(np.minimum(half - x, 0.75 * half - y), s.footprint_m) * (own < 0.06), own / 0.06


def paint_flat_roof(s: Samples) -> Painted:
    """Bitumen felt in lanes, gravel or a light membrane; pools that dried, patches, dirt along the edges."""
    kind = _building(s, 51)
    gravel = kind > 0.75
    mottle = np.where(gravel, 0.16 * s.grain + 0.06 * s.patch, 0.05 * s.grain + 0.09 * s.patch)
    colour = s.tint * (1.0 + mottle + 0.08 * s.broad)[:, None]
    lane = np.floor(s.u_m / _FELT_M)
    sheet = hash01(lane, np.floor(s.v_m / 6.5 + hash01(lane, lane, 3)), s.salt + 6) - 0.5
    seam = stripes(s.u_m, _FELT_M, 0.07, s.footprint_m)
    felt = (~gravel) * (0.10 * sheet * _faded(_FELT_M, s.footprint_m) - 0.13 * seam)
    colour = colour * (1.0 + felt)[:, None]
    dried = s.patch + 1.2 * s.broad - 1.0
    colour = colour * (1.0 - 0.20 * np.clip(1.2 * dried, 0.0, 1.0))[:, None]
    patched, own = _repairs(s)
    colour = mix(colour, shades((0.11, 0.11, 0.115), 0.7 + 1.2 * own), 0.75 * patched)
    edge = np.minimum(np.minimum(s.u_m, s.size_m[:, 0] - s.u_m), np.minimum(s.v_m, s.size_m[:, 1] - s.v_m))
    return Painted(colour * (1.0 - 0.22 * np.exp(-1.6 * np.clip(edge, 0.0, None)))[:, None])


def _repairs(s: Samples) -> tuple[FloatArray, FloatArray]:
    """Patches of new felt: coverage (N,) and each one's own number."""
    ix, iy = np.floor(s.u_m / 4.7), np.floor(s.v_m / 3.9)
    own = hash01(ix, iy, s.salt + 11)
    x = np.abs(s.u_m / 4.7 - ix - 0.35 - 0.3 * own) * 4.7
    y = np.abs(s.v_m / 3.9 - iy - 0.5) * 3.9
    wide, deep = 0.3 + 1.2 * hash01(ix, iy, s.salt + 12), 0.3 + 1.1 * hash01(ix, iy, s.salt + 13)
    return inside(np.minimum(wide - x, deep - y), s.footprint_m) * (own < 0.16), own / 0.16


def paint_sheet(s: Samples) -> Painted:
    """Folded sheet metal: raised seams from eaves to ridge, panels that differ a little, rust where it is old."""
    seam = stripes(s.u_m, _SEAM_M, 0.05, s.footprint_m)
    panel = hash01(np.floor(s.u_m / _SEAM_M + 0.5), np.floor(s.v_m / 4.0), s.salt + 14) - 0.5
    streak = octaves(s.u_m + s.shift_m, 0.1 * s.v_m + s.shift_m, s.footprint_m, (0.5, 1.3, 3.0), s.seed, 47)
    factor = 1.0 + 0.10 * panel * _faded(_SEAM_M, s.footprint_m) + 0.03 * s.grain + 0.05 * s.patch + 0.07 * streak
    colour = s.tint * (factor - 0.2 * seam)[:, None]
    rust = np.clip(0.3 * (streak + 0.5 * s.patch + 0.3 * s.grain - 1.4 + 1.2 * _building(s, 52)), 0.0, 0.4)
    colour = mix(colour, rgb(0.20, 0.10, 0.055), rust)
    offset = s.u_m / _SEAM_M - np.round(s.u_m / _SEAM_M)
    fold = np.clip(offset / 0.05, -1.0, 1.0) * np.exp(-((offset / 0.08) ** 2)) * _faded(_SEAM_M, s.footprint_m)
    relief = np.stack([0.6 * fold, np.zeros_like(fold)], axis=1)
    return Painted(colour, relief=relief.astype(np.float32), gloss=np.full(len(colour), 0.4, dtype=np.float32))
