"""Surfaces and the primitives they are made of: patches, boxes, soups. Closed except for the side on the ground."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray

Tint = tuple[float, float, float]


class Material(IntEnum):
    """What a surface is made of; there is one painter for each (`materials.py`, the scene's own for the ground)."""

    GROUND = 0
    FACADE = 1
    TILED_ROOF = 2
    FLAT_ROOF = 3
    PAINT = 4
    GLASS = 5
    LEAVES = 6
    WATER = 7
    PLASTER = 8
    SHEET = 9


@dataclass(frozen=True, eq=False)
class Surface:
    """One textured patch. triangles_m: (T, 3, 3) corners, counter-clockwise seen from outside.

    origin_m (3,), u_axis, v_axis (3,) unit: texture coordinates are the dot products of (point - origin) with them.
    size_m: extent along u and v. tint: linear RGB albedo.
    """

    triangles_m: FloatArray
    origin_m: FloatArray
    u_axis: FloatArray
    v_axis: FloatArray
    size_m: tuple[float, float]
    material: Material
    tint: Tint


@dataclass(frozen=True)
class Footprint:
    """A rectangle on the ground plan: centre, full lengths along its own x and y, heading counter-clockwise."""

    x_m: float
    y_m: float
    length_x_m: float
    length_y_m: float
    heading_deg: float

    def corners_m(self) -> FloatArray:
        """(4, 2) corners, counter-clockwise from the one at (-x, -y) of its own frame."""
        half = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * 0.5
        return self.at(half * [self.length_x_m, self.length_y_m])

    def at(self, own_m: FloatArray) -> FloatArray:
        """Plan points (N, 2) of points (N, 2) in the rectangle's own frame, whose origin is its centre."""
        a = np.deg2rad(self.heading_deg)
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        moved: FloatArray = np.asarray(own_m) @ turn.T + [self.x_m, self.y_m]
        return moved


def patch(corners_m: FloatArray, material: Material, tint: Tint) -> Surface:
    """A planar convex patch of corners (K, 3), counter-clockwise; u runs along the first edge, from corner 0."""
    edge, across = corners_m[1] - corners_m[0], corners_m[2] - corners_m[0]
    length = float(np.sqrt(edge @ edge))
    u_axis = edge / length
    v_axis = across - (across @ u_axis) * u_axis
    height = float(np.sqrt(v_axis @ v_axis))
    fan = np.stack([corners_m[[0, i, i + 1]] for i in range(1, len(corners_m) - 1)])
    return Surface(fan, corners_m[0], u_axis, v_axis / height, (length, height), material, tint)


def soup(triangles_m: FloatArray, material: Material, tint: Tint) -> Surface:
    """Triangles (T, 3, 3) of any direction as one surface, for materials whose pattern has no direction.

    The texture is projected along a slanted line, so that neither level nor upright faces are stretched.
    """
    lo, hi = triangles_m.min(axis=(0, 1)), triangles_m.max(axis=(0, 1))
    size_m = (float(hi[0] - lo[0]), float(hi[1] - lo[1]))
    return Surface(triangles_m, lo, _SLANT_U, _SLANT_V, size_m, material, tint)


_SLANT_U = np.array([0.80, -0.25, 0.545])
_SLANT_V = np.array([0.15, 0.85, 0.505])
_SLANT_U, _SLANT_V = _SLANT_U / np.linalg.norm(_SLANT_U), _SLANT_V / np.linalg.norm(_SLANT_V)


def shrunk(corners_m: FloatArray, by_m: list[float]) -> FloatArray:
    """(K, 2) corners of a convex polygon (K, 2), counter-clockwise, each side moved inwards by its own distance."""
    start, end = corners_m, np.roll(corners_m, -1, axis=0)
    along = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    inward = np.column_stack([-along[:, 1], along[:, 0]])
    offset = np.einsum("ij,ij->i", inward, start) + by_m
    before = np.roll(np.arange(len(start)), 1)
    return np.stack([np.linalg.solve(inward[[k, p]], offset[[k, p]]) for k, p in enumerate(before.tolist())])


def raised(xy_m: FloatArray, z_m: float) -> FloatArray:
    """(N, 3): plan points (N, 2) at one height."""
    return np.column_stack([xy_m, np.full(len(xy_m), z_m)])


def walls(corners_m: FloatArray, bottom_m: float, top_m: float, materials: list[Material], tint: Tint) -> list[Surface]:
    """The upright sides over a plan polygon (K, 2), counter-clockwise; one material for each side."""
    low, high = raised(corners_m, bottom_m), raised(corners_m, top_m)
    sides = [(k, (k + 1) % len(corners_m)) for k in range(len(corners_m))]
    return [
        patch(np.stack([low[i], low[j], high[j], high[i]]), m, tint) for (i, j), m in zip(sides, materials, strict=True)
    ]


def box(
    plan: Footprint, bottom_m: float, top_m: float, wall: tuple[Material, Tint], roof: tuple[Material, Tint]
) -> list[Surface]:
    """Four walls and a flat top."""
    corners = plan.corners_m()
    return [*walls(corners, bottom_m, top_m, [wall[0]] * 4, wall[1]), patch(raised(corners, top_m), *roof)]


# A unit box, counter-clockwise seen from outside: four sides and the top, then the bottom.
_BOX_FACES = np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 6, 7], [3, 2, 1, 0]])
BOX_TRIANGLES: IntArray = np.concatenate([_BOX_FACES[:, [0, 1, 2]], _BOX_FACES[:, [0, 2, 3]]])


def hexahedra(corners_m: FloatArray) -> FloatArray:
    """Triangles (12 N, 3, 3) of N solids with eight corners (N, 8, 3): four below, four above, counter-clockwise."""
    return corners_m[:, BOX_TRIANGLES].reshape(-1, 3, 3)


def boxes(
    centers_m: FloatArray, lengths_m: FloatArray, heading_deg: float, bottom_m: FloatArray, top_m: FloatArray
) -> FloatArray:
    """Triangles (12 N, 3, 3) of N closed boxes: plan centres and lengths (N, 2), one heading, heights (N,)."""
    plan = Footprint(0.0, 0.0, 1.0, 1.0, 0.0).corners_m()
    own = plan[None] * np.asarray(lengths_m)[:, None]
    flat = Footprint(0.0, 0.0, 1.0, 1.0, heading_deg).at(own.reshape(-1, 2)).reshape(-1, 4, 2)
    flat = flat + np.asarray(centers_m)[:, None]
    heights = np.stack([np.broadcast_to(bottom_m, len(flat)), np.broadcast_to(top_m, len(flat))], axis=1)
    corners = np.empty((len(flat), 8, 3))
    corners[:, :4, :2], corners[:, 4:, :2] = flat, flat
    corners[:, :4, 2], corners[:, 4:, 2] = heights[:, :1], heights[:, 1:]
    return hexahedra(corners)


def turned(surfaces: list[Surface], heading_deg: float) -> list[Surface]:
    """The same solids, turned around the world's z axis, counter-clockwise."""
    a = np.deg2rad(heading_deg)
    turn = np.array([[np.cos(a), np.sin(a), 0.0], [-np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    if not surfaces:
        return []
    triangles = np.concatenate([s.triangles_m for s in surfaces]) @ turn
    frames = np.stack([np.stack([s.origin_m, s.u_axis, s.v_axis]) for s in surfaces]) @ turn
    parts = np.split(triangles, np.cumsum([len(s.triangles_m) for s in surfaces])[:-1])
    return [
        replace(s, triangles_m=part, origin_m=frame[0], u_axis=frame[1], v_axis=frame[2])
        for s, part, frame in zip(surfaces, parts, frames, strict=True)
    ]


def shade(rng: np.random.Generator, tints: tuple[Tint, ...], spread: float = 0.2) -> Tint:
    """One of the tints, somewhat brighter or darker and a little off in hue."""
    factor = rng.uniform(1.0 - spread, 1.0 + spread) * rng.uniform(0.97, 1.03, size=3)
    r, g, b = np.array(tints[int(rng.integers(len(tints)))]) * factor
    return float(r), float(g), float(b)
