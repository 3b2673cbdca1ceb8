"""Cars, vans and lorries, standing."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.solids import Footprint, Material, Surface, Tint, boxes, hexahedra, shade, soup

CAR_LENGTH_M, CAR_WIDTH_M = 4.4, 1.8

_VARNISH: tuple[Tint, ...] = (
    (0.55, 0.55, 0.56), (0.62, 0.62, 0.61), (0.30, 0.31, 0.32), (0.035, 0.035, 0.04), (0.05, 0.05, 0.055),
    (0.13, 0.135, 0.14), (0.19, 0.028, 0.024), (0.035, 0.06, 0.13), (0.20, 0.19, 0.16), (0.05, 0.09, 0.11),
)  # fmt: skip
_PANES: Tint = (0.022, 0.025, 0.028)
_RUBBER: Tint = (0.02, 0.02, 0.02)
_TARPAULINS: tuple[Tint, ...] = ((0.50, 0.50, 0.48), (0.12, 0.18, 0.30), (0.55, 0.53, 0.46), (0.30, 0.06, 0.05))
_BUSES: tuple[Tint, ...] = ((0.45, 0.28, 0.03), (0.35, 0.04, 0.03), (0.50, 0.50, 0.48))


def car(rng: np.random.Generator, x_m: float, y_m: float, heading_deg: float, ground_m: float = 0.0) -> list[Surface]:
    """One car at a plan point, its nose towards heading_deg (counter-clockwise from x)."""
    if rng.random() < 0.08:
        return _van(rng, x_m, y_m, heading_deg, ground_m)
    length, width = rng.uniform(3.7, 4.8), rng.uniform(1.68, 1.85)
    plan = Footprint(x_m, y_m, length, width, heading_deg)
    estate = rng.random() < 0.4
    rear = -0.47 if estate else -0.40
    body = np.concatenate(
        [
            _wedge(plan, (-0.5, 0.5), 0.5, 0.24, (-0.492, 0.485), 0.46, (0.86, 0.72), ground_m),
            _wedge(plan, (rear + 0.08, 0.02), 0.37, 1.36, (rear + 0.10, -0.01), 0.36, (1.45, 1.45), ground_m),
        ]
    )
    cabin = _wedge(plan, (rear, 0.20), 0.45, 0.74, (rear + 0.07, 0.04), 0.365, (1.40, 1.40), ground_m)
    wheels = _wedge(plan, (-0.40, 0.40), 0.505, 0.02, (-0.40, 0.40), 0.505, (0.42, 0.42), ground_m)
    tint = shade(rng, _VARNISH, 0.15)
    return [
        soup(body, Material.PAINT, tint), soup(cabin, Material.GLASS, _PANES), soup(wheels, Material.PAINT, _RUBBER),
    ]  # fmt: skip


def _wedge(
    plan: Footprint,
    low: tuple[float, float],
    low_half: float,
    bottom_m: float,
    high: tuple[float, float],
    high_half: float,
    top_m: tuple[float, float],
    ground_m: float,
) -> FloatArray:
    """A solid of six faces along the car: ranges along the length and half widths as shares, heights at rear, front."""

    def ring(ends: tuple[float, float], half: float) -> FloatArray:
        own = np.array([[ends[0], -half], [ends[1], -half], [ends[1], half], [ends[0], half]])
        return plan.at(own * [plan.length_x_m, plan.length_y_m])

    corners = np.empty((1, 8, 3))
    corners[0, :4, :2], corners[0, 4:, :2] = ring(low, low_half), ring(high, high_half)
    corners[0, :, 2] = ground_m + np.array([bottom_m] * 4 + [top_m[0], top_m[1], top_m[1], top_m[0]])
    return hexahedra(corners)


def _van(rng: np.random.Generator, x_m: float, y_m: float, heading_deg: float, ground_m: float) -> list[Surface]:
    plan = Footprint(x_m, y_m, rng.uniform(5.0, 5.9), 1.95, heading_deg)
    top = rng.uniform(2.0, 2.6)
    body = np.concatenate(
        [
            _wedge(plan, (-0.5, 0.30), 0.5, 0.3, (-0.495, 0.26), 0.46, (top, top), ground_m),
            _wedge(plan, (0.28, 0.5), 0.5, 0.3, (0.26, 0.485), 0.46, (1.15, 0.95), ground_m),
        ]
    )
    screen = _wedge(plan, (0.25, 0.38), 0.46, 1.0, (0.20, 0.27), 0.44, (top - 0.1, top - 0.2), ground_m)
    tint = shade(rng, ((0.6, 0.6, 0.59), (0.55, 0.54, 0.5), (0.2, 0.2, 0.21)), 0.1)
    return [soup(body, Material.PAINT, tint), soup(screen, Material.GLASS, _PANES)]


def lorry(rng: np.random.Generator, x_m: float, y_m: float, heading_deg: float, ground_m: float = 0.0) -> list[Surface]:
    """A lorry with its load covered, or a bus."""
    is_bus = rng.random() < 0.4
    length = 11.8 if is_bus else rng.uniform(7.5, 10.5)
    plan = Footprint(x_m, y_m, length, 2.5, heading_deg)
    tint = shade(rng, _BUSES if is_bus else _TARPAULINS, 0.15)
    rear = 0.5 if is_bus else 0.26
    high = 3.0 if is_bus else 3.5
    load = boxes(
        plan.at(np.array([[0.5 * (rear - 0.5) * length, 0.0]])), np.array([[(rear + 0.5) * length, 2.5]]), heading_deg,
        np.array([ground_m + 0.5]), np.array([ground_m + high]),
    )  # fmt: skip
    if is_bus:
        hatch_at = plan.at(np.array([[-0.25 * length, 0.0], [0.2 * length, 0.0]]))
        hatches = boxes(hatch_at, np.array([[1.8, 1.4], [0.8, 0.8]]), heading_deg, np.full(2, ground_m + 3.0),
                        np.full(2, ground_m + 3.25))  # fmt: skip
        return [soup(load, Material.PAINT, tint), soup(hatches, Material.PAINT, (0.3, 0.3, 0.3))]
    cab = _wedge(plan, (0.29, 0.5), 0.48, 0.5, (0.29, 0.47), 0.45, (2.7, 2.4), ground_m)
    return [soup(load, Material.PAINT, tint), soup(cab, Material.PAINT, shade(rng, _VARNISH))]
