"""Walls with windows: storeys and columns that fit the wall, shop fronts below high buildings, dirt of the street."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.lab.synthetic.noise import hash01, inside, octaves
from aeromatch_cli.lab.synthetic.paint import Painted, Samples, mix, rgb, shades

STOREY_M, SHOP_M = 3.1, 3.9
_SHOPS_FROM_M = 11.0  # walls this high have a shop floor


def paint_facade(s: Samples) -> Painted:
    """Plaster or panels with a window in most cells of a grid; the style is the building's, told by its tint."""
    own = [hash01(np.rint(s.tint[:, 0] * 1e4), np.rint(s.tint[:, 1] * 1e4), 70 + k) for k in range(6)]
    streak = octaves(s.u_m + s.shift_m, 0.15 * s.v_m, s.footprint_m, (0.6, 1.5), s.seed, 42)
    dirt = 0.04 * s.grain + 0.05 * s.patch + 0.06 * streak - 0.18 * np.exp(-0.7 * np.clip(s.v_m, 0.0, None))
    colour = s.tint * (1.0 + dirt)[:, None]
    shop = (s.size_m[:, 1] > _SHOPS_FROM_M) & (own[0] < 0.6)
    base_m = np.where(shop, SHOP_M, 0.35).astype(np.float32)
    colour, glazed = _storeys(s, colour, own, base_m)
    if shop.any():
        colour, glazed = _shop_front(s, colour, glazed, shop)
    plinth = inside(0.35 - s.v_m, s.footprint_m) * (s.v_m > -0.5)
    colour = mix(colour, rgb(0.16, 0.155, 0.15), 0.7 * plinth)
    return Painted(colour, gloss=glazed.astype(np.float32))


def _storeys(
    s: Samples, colour: FloatArray, own: list[FloatArray], base_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Colour (N, 3) with windows in it, and how much of each sample is glass (N,)."""
    width, height = s.size_m[:, 0], np.maximum(s.size_m[:, 1] - base_m, 1.0)
    rows = np.maximum(np.floor(height / 2.65), 1.0)
    pitch = 1.7 + 1.7 * own[1]
    columns = np.maximum(np.floor((width - 0.5) / pitch), 1.0)
    cell_u, cell_v = (width - 0.5) / columns, height / rows
    x, y = (s.u_m - 0.25) / cell_u, (s.v_m - base_m) / cell_v
    ix, iy = np.floor(x), np.floor(y)
    ribbon = own[2] < 0.12
    half_u = np.where(ribbon, 0.47 * cell_u, np.minimum(0.42 + 0.45 * own[3], 0.36 * cell_u))
    half_v = np.where(ribbon, 0.65, 0.6 + 0.22 * own[4])
    u, v = (x - ix - 0.5) * cell_u, (y - iy - 0.52) * cell_v
    within = (ix >= 0) & (ix < columns) & (iy >= 0) & (iy < rows) & (width > 1.6)
    present = (within & (hash01(ix, iy, s.salt + 1) < 0.94)).astype(np.float32)
    # A band between the storeys, as cornices or the joints of panels.
    band = inside(0.09 - np.abs(v + 0.5 * cell_v), s.footprint_m) * (own[5] < 0.55) * within
    colour = mix(colour, 1.18 * s.tint, 0.7 * band)
    colour = colour * (1.0 - 0.12 * _panel_joints(s, u, cell_u) * (own[5] > 0.75))[:, None]
    frame_tint = np.where((own[4] < 0.7)[:, None], rgb(0.58, 0.57, 0.55), rgb(0.16, 0.11, 0.08))
    across, up = half_u - np.abs(u), half_v - np.abs(v)
    # Windows sit back in the wall: the upper edge and one side lie in their own shadow.
    reveal = inside(np.minimum(across + 0.1, up + 0.1), s.footprint_m) * present
    colour = colour * (1.0 - 0.25 * reveal)[:, None]
    frame = inside(np.minimum(across, up), s.footprint_m) * present
    pane = inside(np.minimum(across, up) - 0.07, s.footprint_m) * present
    bar = inside(0.035 - np.abs(u), s.footprint_m) * (half_u > 0.55)
    number = hash01(ix, iy, s.salt + 2)
    glass = shades((0.032, 0.036, 0.042), 0.6 + 1.3 * number)
    curtain = (number > 0.70) & (v > half_v * (4.6 * (number - 0.70) / 0.3 - 1.6))
    glass = np.where(curtain[:, None], rgb(0.30, 0.28, 0.25) * (0.6 + 0.4 * number[:, None]), glass)
    shadow = inside(v - half_v + 0.28, s.footprint_m)
    glass = glass * (1.0 - 0.45 * shadow)[:, None]
    colour = mix(mix(colour, frame_tint, 0.9 * frame), glass, pane * (1.0 - bar))
    sill = inside(np.minimum(0.05 - np.abs(v + half_v + 0.05), across + 0.08), s.footprint_m) * present
    return mix(colour, rgb(0.42, 0.42, 0.42), 0.7 * sill), pane * (1.0 - bar)


def _panel_joints(s: Samples, u_m: FloatArray, cell_m: FloatArray) -> FloatArray:
    return inside(0.03 - np.abs(np.abs(u_m) - 0.5 * cell_m), s.footprint_m)


def _shop_front(s: Samples, colour: FloatArray, glazed: FloatArray, shop: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Wide panes between pillars, and a sign over some of them."""
    bays = np.maximum(np.round(s.size_m[:, 0] / 4.2), 1.0)
    cell = s.size_m[:, 0] / bays
    ix = np.floor(s.u_m / cell)
    u = (s.u_m / cell - ix - 0.5) * cell
    number, hue = hash01(ix, ix, s.salt + 3), hash01(ix, ix, s.salt + 4)
    level = shop & (s.v_m < SHOP_M) & (s.v_m > 0.0)
    pane = inside(np.minimum(0.5 * cell - 0.45 - np.abs(u), 1.35 - np.abs(s.v_m - 1.65)), s.footprint_m) * level
    pane = pane * (number < 0.85)
    glass = shades((0.05, 0.05, 0.05), 0.5 + 1.6 * number)
    colour = mix(colour, glass, pane)
    sign = inside(np.minimum(0.5 * cell - 0.3 - np.abs(u), 0.24 - np.abs(s.v_m - 3.35)), s.footprint_m) * level
    tint = rgb(0.45, 0.43, 0.40) + (hue[:, None] - 0.5) * np.array([[0.6, -0.3, -0.5]], dtype=np.float32)
    colour = mix(colour, np.clip(tint, 0.03, 0.7), 0.85 * sign * (number > 0.4))
    return colour, np.where(level, pane, glazed)
