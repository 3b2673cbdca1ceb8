"""Trees, shrubs and hedges: crowns of several rough lobes on a trunk, conifers of ragged tiers."""

from __future__ import annotations

from enum import Enum
from functools import lru_cache
from itertools import pairwise

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.lab.synthetic.solids import Material, Surface, Tint, boxes, shade, soup

_BARK: Tint = (0.075, 0.058, 0.043)
_GREENS: tuple[Tint, ...] = ((0.062, 0.094, 0.034), (0.076, 0.106, 0.036), (0.050, 0.078, 0.032), (0.084, 0.108, 0.042))
_NEEDLES: tuple[Tint, ...] = ((0.034, 0.054, 0.028), (0.042, 0.062, 0.034))
_SHRUBS: tuple[Tint, ...] = (*_GREENS, (0.075, 0.085, 0.040), (0.095, 0.075, 0.030))


class Species(Enum):
    """What grows: a round crown, a tall narrow one, a conifer, a shrub without a trunk."""

    BROADLEAF = "broadleaf"
    COLUMN = "column"
    CONIFER = "conifer"
    SHRUB = "shrub"


def tree(
    rng: np.random.Generator,
    x_m: float,
    y_m: float,
    ground_m: float,
    radius_m: float,
    height_m: float,
    species: Species,
) -> list[Surface]:
    """One tree of at most 500 triangles, its foot a little below the ground.

    x_m, y_m, ground_m: foot of the trunk, world metres. radius_m: of the crown. height_m: top above the foot. Equal
    states of rng give equal trees.
    """
    foot = np.array([x_m, y_m, ground_m])
    if species is Species.CONIFER:
        return [*_leaves(_tiers(rng, radius_m, height_m) + foot, shade(rng, _NEEDLES)), _trunk(foot, 0.2 * height_m)]
    if species is Species.SHRUB:
        crown = _lobed(rng, radius_m, 0.55 * height_m, 0.45 * height_m, lobes=3, clumps=14)
        return _leaves(crown + foot, shade(rng, _SHRUBS, 0.3))
    share = 0.46 if species is Species.COLUMN else 0.40
    half_m = min(share * height_m, 2.2 * radius_m)
    crown = _lobed(rng, radius_m, half_m, height_m - half_m, lobes=6, clumps=38)
    return [*_leaves(crown + foot, shade(rng, _GREENS, 0.25)), _trunk(foot, height_m - 1.2 * half_m)]


def hedge(
    rng: np.random.Generator, points_m: FloatArray, ground_m: float, width_m: float, height_m: float
) -> list[Surface]:
    """A clipped hedge along plan points (K, 2): a run of rough boxes, about one to a metre and a half."""
    parts = []
    for start, end in pairwise(points_m):
        along = end - start
        length_m = float(np.hypot(*along))
        count = max(1, round(length_m / 1.5))
        t = (np.arange(count) + 0.5) / count
        centers = start + t[:, None] * along + rng.uniform(-0.06, 0.06, size=(count, 2))
        heading_deg = float(np.rad2deg(np.arctan2(along[1], along[0])))
        widths = width_m * rng.uniform(0.85, 1.15, size=count)
        lengths = np.column_stack([np.full(count, 1.04 * length_m / count), widths])
        top = ground_m + height_m * rng.uniform(0.9, 1.1, size=count)
        parts.append(boxes(centers, lengths, heading_deg, np.full(count, ground_m), top))
    return _leaves(np.concatenate(parts), shade(rng, _GREENS))


def _leaves(triangles_m: FloatArray, tint: Tint) -> list[Surface]:
    """Leaf surfaces, one for each world axis that the triangles face most, so that no texture is stretched."""
    normals = np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0])
    facing = np.argmax(np.abs(normals), axis=1)
    found = []
    for axis, (u, v) in enumerate(((1, 2), (0, 2), (0, 1))):
        part = triangles_m[facing == axis]
        if len(part):
            lo, hi = part.min(axis=(0, 1)), part.max(axis=(0, 1))
            size_m = (float(hi[u] - lo[u]), float(hi[v] - lo[v]))
            found.append(Surface(part, lo, _AXES[u], _AXES[v], size_m, Material.LEAVES, tint))
    return found


_AXES = np.eye(3)


def _trunk(foot_m: FloatArray, height_m: float) -> Surface:
    width = 0.08 + 0.03 * height_m
    trunk = boxes(foot_m[None, :2], np.full((1, 2), width), 20.0, foot_m[2:] - 0.3, foot_m[2:] + max(height_m, 0.3))
    return soup(trunk, Material.PAINT, _BARK)


@lru_cache(maxsize=1)
def _icosahedron() -> tuple[FloatArray, IntArray]:
    """Corners (12, 3) of unit length and faces (20, 3)."""
    g = (1.0 + np.sqrt(5.0)) / 2.0
    corners = [[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g]]
    corners += [[0, -1, -g], [0, 1, -g], [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]]
    faces = [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2]]
    faces += [[10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5]]
    faces += [[2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]]
    return np.array(corners) / np.hypot(1.0, g), np.array(faces)


_OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)])
_OCTAHEDRON_FACES = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])


def _lobed(
    rng: np.random.Generator, radius_m: float, half_m: float, middle_m: float, lobes: int, clumps: int
) -> FloatArray:
    """Triangles (20 (lobes + 1) + 8 clumps, 3, 3) of a crown around its axis: a core, lobes that bulge out of it, and
    clumps of leaves that stand out of those and make its outline and its shade ragged."""
    corners, faces = _icosahedron()
    # Lobes spread by the golden angle; most sit in the upper half, as they do where there is light.
    turn = rng.uniform(0.0, 6.28) + 2.4 * np.arange(lobes)
    up = np.linspace(-0.5, 0.8, lobes) + rng.uniform(-0.12, 0.12, size=lobes)
    out = np.sqrt(np.clip(1.0 - up**2, 0.0, 1.0)) * rng.uniform(0.40, 0.56, size=lobes)
    centers = np.concatenate(
        [[[0.0, 0.0, -0.02]], np.column_stack([out * np.cos(turn), out * np.sin(turn), 0.55 * up])]
    )
    sizes = np.concatenate([[0.66], rng.uniform(0.36, 0.50, size=lobes)])
    rough = rng.uniform(0.86, 1.14, size=(lobes + 1, len(corners), 1))
    body = centers[:, None] + sizes[:, None, None] * rough * corners
    # Clumps sit on the outer side of the lobes.
    lobe = 1 + np.arange(clumps) % lobes
    toward = 1.1 * centers[lobe] + [0.0, 0.0, 0.15] + 0.75 * rng.standard_normal((clumps, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    at = centers[lobe] + 0.88 * sizes[lobe, None] * toward
    reach = rng.uniform(0.13, 0.23, size=(clumps, 1, 1)) * rng.uniform(0.8, 1.2, size=(clumps, 6, 1))
    clump = at[:, None] + reach * np.einsum("ij,kjl->kil", _OCTAHEDRON, _rotations(rng, clumps))
    parts = [body[:, faces].reshape(-1, 3, 3), clump[:, _OCTAHEDRON_FACES].reshape(-1, 3, 3)]
    shape = np.concatenate(parts)
    shape[..., 2] = np.clip(shape[..., 2], -1.0, 1.0)
    return shape * [radius_m, radius_m, half_m] + [0.0, 0.0, middle_m]


def _rotations(rng: np.random.Generator, count: int) -> FloatArray:
    """Random rotations (N, 3, 3), from quaternions."""
    q = rng.standard_normal((count, 4))
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]
    rows += [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]
    rows += [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


def _tiers(rng: np.random.Generator, radius_m: float, height_m: float) -> FloatArray:
    """Triangles (T, 3, 3) of a conifer: stacked cones with ragged rims, each closed by its underside."""
    tiers, spokes = 6, 14
    found = []
    for k in range(tiers):
        low = height_m * (0.12 + 0.80 * k / tiers)
        tip = height_m * min(1.0, 0.12 + 0.80 * (k + 2.3) / tiers) if k < tiers - 1 else height_m
        angle = 2.0 * np.pi * (np.arange(spokes) + rng.uniform(0.0, 1.0)) / spokes
        reach = radius_m * (1.0 - 0.86 * k / tiers) * np.where(np.arange(spokes) % 2, 1.0, 0.72)
        reach = reach * rng.uniform(0.8, 1.15, size=spokes)
        droop = low - 0.06 * height_m * rng.uniform(0.0, 1.0, size=spokes)
        rim = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), droop])
        top, under = np.array([0.0, 0.0, tip]), np.array([0.0, 0.0, low + 0.03 * height_m])
        after = np.roll(rim, -1, axis=0)
        for apex, first, second in ((top, rim, after), (under, after, rim)):
            found.append(np.stack([first, second, np.broadcast_to(apex, rim.shape)], axis=1))
    return np.concatenate(found)
