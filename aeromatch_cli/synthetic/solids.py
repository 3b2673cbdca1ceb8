"""Triangle soups of simple solids: boxes, gabled houses, tree crowns. Closed except for the side on the ground."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from aeromatch_cli.data import FloatArray


class Material(IntEnum):
    """What a surface is made of; `texture.albedo` has one painter for each."""

    GROUND = 0
    FACADE = 1
    TILED_ROOF = 2
    FLAT_ROOF = 3
    PAINT = 4
    GLASS = 5
    LEAVES = 6


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
    tint: tuple[float, float, float]


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
        a = np.deg2rad(self.heading_deg)
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        return (half * [self.length_x_m, self.length_y_m]) @ turn.T + [self.x_m, self.y_m]


def _patch(corners_m: FloatArray, material: Material, tint: tuple[float, float, float]) -> Surface:
    """A planar convex patch (3 or 4 corners, counter-clockwise); u runs along the first edge from corner 0."""
    edge = corners_m[1] - corners_m[0]
    u_axis = edge / np.linalg.norm(edge)
    across = corners_m[2] - corners_m[0]
    v_axis = across - (across @ u_axis) * u_axis
    height = float(np.linalg.norm(v_axis))
    fan = np.stack([corners_m[[0, i, i + 1]] for i in range(1, len(corners_m) - 1)])
    size_m = (float(np.linalg.norm(edge)), height)
    return Surface(fan, corners_m[0], u_axis, v_axis / height, size_m, material, tint)


def _at(xy_m: FloatArray, z_m: float) -> FloatArray:
    return np.column_stack([xy_m, np.full(len(xy_m), z_m)])


def box(
    plan: Footprint,
    bottom_m: float,
    top_m: float,
    wall: tuple[Material, tuple[float, float, float]],
    roof: tuple[Material, tuple[float, float, float]],
) -> list[Surface]:
    """Four walls and a flat top."""
    low, high = _at(plan.corners_m(), bottom_m), _at(plan.corners_m(), top_m)
    walls = [_patch(np.stack([low[i], low[j], high[j], high[i]]), *wall) for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))]
    return [*walls, _patch(high, *roof)]


def gabled_house(
    plan: Footprint,
    eaves_m: float,
    ridge_m: float,
    wall: tuple[Material, tuple[float, float, float]],
    roof: tuple[Material, tuple[float, float, float]],
) -> list[Surface]:
    """Four walls, two gables and two slopes; the ridge runs along the plan's own x."""
    low, high = _at(plan.corners_m(), 0.0), _at(plan.corners_m(), eaves_m)
    ridge = 0.5 * (high[[0, 1]] + high[[3, 2]])
    ridge[:, 2] = ridge_m
    walls = [_patch(np.stack([low[i], low[j], high[j], high[i]]), *wall) for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))]
    gables = [
        _patch(np.stack([high[1], high[2], ridge[1]]), *wall),
        _patch(np.stack([high[3], high[0], ridge[0]]), *wall),
    ]
    slopes = [
        _patch(np.stack([high[0], high[1], ridge[1], ridge[0]]), *roof),
        _patch(np.stack([high[2], high[3], ridge[0], ridge[1]]), *roof),
    ]
    return [*walls, *gables, *slopes]


def crown(center_m: FloatArray, radius_m: float, rng: np.random.Generator, tint: tuple[float, float, float]) -> Surface:
    """A tree crown: an octahedron refined twice (128 triangles), its corners pushed in and out at random."""
    corners = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)
    faces = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]]
    triangles = corners[np.array(faces)]
    for _ in range(2):
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        ab, bc, ca = a + b, b + c, c + a
        triangles = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
        triangles /= np.linalg.norm(triangles, axis=2, keepdims=True)
    unique, index = np.unique(triangles.reshape(-1, 3).round(6), axis=0, return_inverse=True)
    bumpy = unique * (radius_m * rng.uniform(0.72, 1.12, size=(len(unique), 1))) * [1.0, 1.0, 0.85]
    shape = bumpy[index.reshape(-1)].reshape(-1, 3, 3) + center_m
    size_m = (2.0 * radius_m, 2.0 * radius_m)
    return Surface(shape, center_m, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), size_m, Material.LEAVES, tint)


def ground_square(half_extent_m: float, heading_deg: float) -> Surface:
    """The plane z = 0 as a square around the origin; texture coordinates are those of the turned street grid."""
    plan = Footprint(0.0, 0.0, 2.0 * half_extent_m, 2.0 * half_extent_m, heading_deg)
    flat = _patch(_at(plan.corners_m(), 0.0), Material.GROUND, (1.0, 1.0, 1.0))
    return Surface(flat.triangles_m, np.zeros(3), flat.u_axis, flat.v_axis, flat.size_m, flat.material, flat.tint)
