"""Detached houses and what stands beside them: gabled, hipped, angled or flat-roofed, sheds, pools."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.solids import (
    Footprint,
    Material,
    Surface,
    Tint,
    box,
    boxes,
    hexahedra,
    patch,
    raised,
    shade,
    soup,
    walls,
)

_WALLS: tuple[Tint, ...] = (
    (0.52, 0.50, 0.46), (0.46, 0.42, 0.34), (0.26, 0.15, 0.11), (0.22, 0.13, 0.10), (0.40, 0.37, 0.33),
    (0.55, 0.54, 0.52), (0.36, 0.30, 0.23), (0.30, 0.28, 0.26),
)  # fmt: skip
_TILES: tuple[Tint, ...] = (
    (0.170, 0.088, 0.064), (0.135, 0.078, 0.060), (0.105, 0.090, 0.082), (0.185, 0.110, 0.082), (0.072, 0.074, 0.080),
    (0.120, 0.116, 0.112), (0.155, 0.138, 0.118), (0.190, 0.180, 0.165),
)  # fmt: skip
_SHEETS: tuple[Tint, ...] = ((0.21, 0.215, 0.22), (0.12, 0.13, 0.14), (0.30, 0.30, 0.295), (0.14, 0.085, 0.07))
_FLATS: tuple[Tint, ...] = ((0.145, 0.145, 0.15), (0.10, 0.10, 0.105), (0.22, 0.215, 0.20), (0.30, 0.295, 0.285))
_BRICK: Tint = (0.20, 0.12, 0.09)
_SOLAR: Tint = (0.018, 0.022, 0.038)
_PANES: Tint = (0.035, 0.04, 0.046)
_WOODS: tuple[Tint, ...] = ((0.16, 0.115, 0.08), (0.11, 0.10, 0.09), (0.22, 0.18, 0.13), (0.10, 0.12, 0.09))
_OVERHANG_M = 0.45

# Wall and roof of a house: material and tint of each.
_Look = tuple[tuple[Material, Tint], tuple[Material, Tint]]


def house(rng: np.random.Generator, plan: Footprint, ground_m: float = 0.0, sunk_m: float = 0.0) -> list[Surface]:
    """A dwelling house on a footprint whose longer side is its own x, one or two storeys high.

    ground_m: height of its floor; sunk_m: how far its walls go on below, for ground that falls away. What stands out
    (wing, porch) stays within 4 m of the footprint, on its -y side.
    """
    look: _Look = ((Material.FACADE, shade(rng, _WALLS, 0.12)), _covering(rng))
    storeys = 1 if rng.random() < 0.45 else 2
    eaves = ground_m + 2.75 * storeys + rng.uniform(0.0, 0.4)
    found = _plinth(plan, ground_m, sunk_m)
    if rng.random() < 0.07:
        flat = (Material.FLAT_ROOF, shade(rng, _FLATS))
        x, y = plan.at(np.array([[0.0, -0.5 * plan.length_y_m - 1.4]]))[0]
        lower = Footprint(float(x), float(y), 0.5 * plan.length_x_m, 3.0, plan.heading_deg)
        return [
            *found, *box(plan, ground_m, eaves, look[0], flat), *box(lower, ground_m, ground_m + 2.9, look[0], flat),
        ]  # fmt: skip
    pitch = rng.uniform(0.42, 0.62) if rng.random() < 0.5 else rng.uniform(0.62, 0.95)
    hipped = rng.random() < 0.38
    found += roofed(plan, ground_m, eaves, pitch, hipped, look)
    if rng.random() < 0.45:
        found += _wing(rng, plan, ground_m, eaves, pitch, hipped, look)
    elif rng.random() < 0.5:
        found += _porch(rng, plan, ground_m, look)
    return [*found, *_on_roof(rng, plan, eaves, pitch, hipped, look)]


def _covering(rng: np.random.Generator) -> tuple[Material, Tint]:
    if rng.random() < 0.12:
        return Material.SHEET, shade(rng, _SHEETS)
    return Material.TILED_ROOF, shade(rng, _TILES, 0.25)


def _plinth(plan: Footprint, ground_m: float, sunk_m: float) -> list[Surface]:
    if sunk_m <= 0.0:
        return []
    wider = Footprint(plan.x_m, plan.y_m, plan.length_x_m + 0.1, plan.length_y_m + 0.1, plan.heading_deg)
    grey = (Material.PLASTER, (0.22, 0.215, 0.21))
    return box(wider, ground_m - sunk_m, ground_m + 0.15, grey, grey)


def roofed(plan: Footprint, bottom_m: float, eaves_m: float, pitch: float, hipped: bool, look: _Look) -> list[Surface]:
    """Walls under a roof with overhanging eaves; the ridge runs along the plan's own x. pitch: rise over run."""
    wall, roof = look
    found = walls(plan.corners_m(), bottom_m, eaves_m, [wall[0]] * 4, wall[1])
    half_x, half_y = 0.5 * plan.length_x_m + _OVERHANG_M, 0.5 * plan.length_y_m + _OVERHANG_M
    back_m = min(half_y, half_x - 0.3) if hipped else 0.0
    corners = raised(
        plan.at(np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])), eaves_m
    )
    ridge = raised(plan.at(np.array([[-half_x + back_m, 0.0], [half_x - back_m, 0.0]])), eaves_m + pitch * half_y)
    ends = roof if hipped else (Material.PLASTER, wall[1])
    return [
        *found,
        patch(np.stack([corners[0], corners[1], ridge[1], ridge[0]]), *roof),
        patch(np.stack([corners[2], corners[3], ridge[0], ridge[1]]), *roof),
        patch(np.stack([corners[1], corners[2], ridge[1]]), *ends),
        patch(np.stack([corners[3], corners[0], ridge[0]]), *ends),
        patch(corners[::-1], Material.PAINT, (0.35, 0.34, 0.32)),
    ]


def _wing(
    rng: np.random.Generator, plan: Footprint, ground_m: float, eaves_m: float, pitch: float, hipped: bool, look: _Look
) -> list[Surface]:
    """A lower part across the house, its ridge at right angles to the main one."""
    width = min(rng.uniform(0.38, 0.55) * plan.length_x_m, 0.9 * plan.length_y_m)
    out, x = rng.uniform(1.2, 3.6), rng.choice([-1.0, 1.0]) * 0.5 * (plan.length_x_m - width) * rng.uniform(0.5, 1.0)
    length = 0.5 * plan.length_y_m + out
    at = plan.at(np.array([[x, -0.5 * length]]))[0]
    turned = Footprint(float(at[0]), float(at[1]), length, width, plan.heading_deg + 90.0)
    return roofed(turned, ground_m, eaves_m - 0.05, pitch, hipped, look)


def _porch(rng: np.random.Generator, plan: Footprint, ground_m: float, look: _Look) -> list[Surface]:
    """A conservatory or a flat-roofed extension."""
    width, depth = rng.uniform(2.5, max(2.5, 0.5 * plan.length_x_m)), rng.uniform(1.8, 3.4)
    x = rng.uniform(-0.5, 0.5) * (plan.length_x_m - width)
    at = plan.at(np.array([[x, -0.5 * (plan.length_y_m + depth) + 0.05]]))[0]
    part = Footprint(float(at[0]), float(at[1]), width, depth, plan.heading_deg)
    glass = (Material.GLASS, (0.16, 0.17, 0.175))
    top = glass if rng.random() < 0.4 else (Material.FLAT_ROOF, shade(rng, _FLATS))
    return box(part, ground_m, ground_m + 2.6, glass if top is glass else look[0], top)


def _on_roof(
    rng: np.random.Generator, plan: Footprint, eaves_m: float, pitch: float, hipped: bool, look: _Look
) -> list[Surface]:
    """Chimney, roof windows, solar panels, a dormer."""
    found = []
    half_y = 0.5 * plan.length_y_m + _OVERHANG_M
    ridge_m = eaves_m + pitch * half_y
    room = max(0.5 * plan.length_x_m - (half_y if hipped else 0.0), 0.5)
    if rng.random() < 0.7:
        at = plan.at(np.array([[rng.uniform(-0.9, 0.9) * room, rng.uniform(-0.8, 0.8)]]))
        stack = boxes(at, np.array([[rng.uniform(0.6, 1.0), 0.55]]), plan.heading_deg, np.array([eaves_m]),
                      np.array([ridge_m + rng.uniform(0.3, 0.9)]))  # fmt: skip
        found.append(soup(stack, Material.PLASTER, _BRICK if rng.random() < 0.7 else look[0][1]))
    if rng.random() < 0.18:
        found += _panels(plan, eaves_m, pitch, rng.uniform(0.7, 1.0) * room, rng.choice([-1.0, 1.0]))
    elif rng.random() < 0.5 and pitch > 0.55:
        found += _dormer(rng, plan, eaves_m, pitch, room, look)
    return found


def _panels(plan: Footprint, eaves_m: float, pitch: float, half_length_m: float, side: float) -> list[Surface]:
    """Solar panels in rows, a hand above the slope."""
    half_y = 0.5 * plan.length_y_m + _OVERHANG_M
    rows, columns = max(1, int((np.hypot(1.0, pitch) * half_y - 1.2) / 1.7)), max(1, int(2.0 * half_length_m / 1.05))
    x, y = (
        g.ravel() for g in np.meshgrid((np.arange(columns) - 0.5 * (columns - 1)) * 1.05, np.arange(rows) * 1.7 + 1.5)
    )
    corner = np.array([[-0.49, -0.8], [0.49, -0.8], [0.49, 0.8], [-0.49, 0.8]])
    up = np.hypot(1.0, pitch)
    own_x = x[:, None] + side * corner[:, 0]
    run = (y[:, None] + corner[:, 1]) / up
    xy = plan.at(np.column_stack([own_x.ravel(), (-side * -1.0 * (run - half_y)).ravel()])).reshape(*run.shape, 2)
    top = np.concatenate([xy, (eaves_m + pitch * run + 0.16)[..., None]], axis=2)
    return [soup(top[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3), Material.GLASS, _SOLAR)]


def _dormer(
    rng: np.random.Generator, plan: Footprint, eaves_m: float, pitch: float, room_m: float, look: _Look
) -> list[Surface]:
    """One wide dormer, flat on top, with a band of panes."""
    half_y = 0.5 * plan.length_y_m + _OVERHANG_M
    side = rng.choice([-1.0, 1.0])
    wide, front = min(rng.uniform(0.5, 0.8) * room_m, 3.5), 1.1
    x = rng.uniform(-0.5, 0.5) * max(room_m - wide, 0.0)
    floor_m, top_m = eaves_m + pitch * front - 0.15, eaves_m + min(pitch * half_y - 0.15, pitch * front + 1.5)
    back = (top_m - eaves_m) / pitch + 0.1

    def ring(half: float, near: float, far: float, low: float, high: float) -> FloatArray:
        own = np.array(
            [[x - half, near - half_y], [x + half, near - half_y], [x + half, far - half_y], [x - half, far - half_y]]
        )
        if side < 0.0:
            own = -own
        return np.concatenate([raised(plan.at(own), low), raised(plan.at(own), high)])

    body = hexahedra(np.stack([ring(wide, front, back, floor_m, top_m)]))
    pane = ring(wide - 0.25, front - 0.03, front + 0.1, floor_m + 0.45, top_m - 0.2)
    return [soup(body, Material.PLASTER, look[1][1]), soup(hexahedra(pane[None]), Material.GLASS, _PANES)]


def shed(rng: np.random.Generator, plan: Footprint, ground_m: float = 0.0) -> list[Surface]:
    """A garden shed, garage or carport."""
    wood = (Material.PLASTER, shade(rng, _WOODS))
    if rng.random() < 0.5:
        roof = (Material.FLAT_ROOF if rng.random() < 0.7 else Material.SHEET, shade(rng, _FLATS))
        return box(plan, ground_m, ground_m + rng.uniform(2.2, 2.7), wood, roof)
    return roofed(plan, ground_m, ground_m + 2.0, rng.uniform(0.3, 0.6), False, (wood, _covering(rng)))


def pool(rng: np.random.Generator, plan: Footprint, ground_m: float = 0.0) -> list[Surface]:
    """A swimming pool in a pale rim: round above the ground, or let into it."""
    if rng.random() < 0.35:
        angle = 2.0 * np.pi * np.arange(16) / 16
        ring = plan.at(0.5 * plan.length_y_m * np.column_stack([np.cos(angle), np.sin(angle)]))
        sides = walls(ring, ground_m, ground_m + 0.9, [Material.PAINT] * 16, (0.42, 0.43, 0.44))
        return [*sides, patch(raised(ring, ground_m + 0.9), Material.GLASS, (0.10, 0.28, 0.33))]
    rim = Footprint(plan.x_m, plan.y_m, plan.length_x_m + 1.2, plan.length_y_m + 1.2, plan.heading_deg)
    pale = (Material.PLASTER, (0.40, 0.38, 0.34))
    water = patch(
        raised(plan.corners_m(), ground_m + 0.09),
        Material.GLASS,
        shade(rng, ((0.09, 0.27, 0.33), (0.06, 0.20, 0.26)), 0.1),
    )
    return [*box(rim, ground_m, ground_m + 0.06, pale, pale), water]
