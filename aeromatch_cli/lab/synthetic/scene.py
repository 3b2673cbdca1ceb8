"""A scene as arrays: rebuilt, triangle for triangle, from its name, its seed and its area.

World: x east, y north, z up, metres, origin at the middle of the block. Surface 0 is the ground.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.lab.synthetic.paint import Painter
from aeromatch_cli.lab.synthetic.scenes import Plan
from aeromatch_cli.lab.synthetic.scenes.table import SCENES
from aeromatch_cli.lab.synthetic.solids import Material, Surface
from aeromatch_cli.lab.synthetic.terrain import Area, GroundGrid, sample_terrain

# Raised whenever the same scene and seed give other triangles: truth of an older version is then refused, not misread.
SCENE_VERSION = 2


@dataclass(frozen=True, eq=False)
class Scene:
    """Triangles and the surfaces they belong to.

    triangles_m: (T, 3, 3) float64 world; normals: (T, 3) unit, outwards; surface_idx: (T,) into the arrays below.
    origins_m, u_axes, v_axes: (S, 3); sizes_m: (S, 2); materials: (S,); tints: (S, 3) linear RGB albedo.
    ground: the heights that the first triangles stand for. solids: how many of each kind, by name.
    """

    name: str
    seed: int
    area: Area
    triangles_m: FloatArray
    normals: FloatArray
    surface_idx: IntArray
    origins_m: FloatArray
    u_axes: FloatArray
    v_axes: FloatArray
    sizes_m: FloatArray
    materials: IntArray
    tints: FloatArray
    ground: GroundGrid
    paint_ground: Painter
    solids: Mapping[str, int]


def build_scene(name: str, seed: int, area: Area) -> Scene:
    """The scene of a name, solids inside the area. Equal arguments give equal arrays.

    What stands at a place depends on the seed and the place only: a larger area adds and changes nothing inside.
    Raises ConfigError on an unknown scene or a negative seed.
    """
    if name not in SCENES:
        raise ConfigError(f"unknown scene {name!r} for a rendered block; use one of: {', '.join(SCENES)}")
    if seed < 0:
        raise ConfigError(f"the seed of a rendered block must be 0 or larger, got {seed}")
    kind = SCENES[name]
    return assemble(name, seed, area, kind.plan(seed, area), kind.paint_ground)


def assemble(name: str, seed: int, area: Area, plan: Plan, paint_ground: Painter) -> Scene:
    """The scene of a plan: its terrain as surface 0, then its solids."""
    ground = sample_terrain(plan.terrain, area)
    a = np.deg2rad(plan.heading_deg)
    u_axis, v_axis = np.array([np.cos(a), np.sin(a), 0.0]), np.array([-np.sin(a), np.cos(a), 0.0])
    soil = Surface(ground.triangles_m(), np.zeros(3), u_axis, v_axis, (1.0, 1.0), Material.GROUND, (1.0, 1.0, 1.0))
    surfaces = [soil, *plan.surfaces]
    triangles = np.concatenate([s.triangles_m for s in surfaces])
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return Scene(
        name=name,
        seed=seed,
        area=area,
        triangles_m=triangles,
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        surface_idx=np.repeat(np.arange(len(surfaces)), [len(s.triangles_m) for s in surfaces]),
        origins_m=np.stack([s.origin_m for s in surfaces]),
        u_axes=np.stack([s.u_axis for s in surfaces]),
        v_axes=np.stack([s.v_axis for s in surfaces]),
        sizes_m=np.array([s.size_m for s in surfaces]),
        materials=np.array([int(s.material) for s in surfaces]),
        tints=np.array([s.tint for s in surfaces]),
        ground=ground,
        paint_ground=paint_ground,
        solids=plan.solids,
    )


def scene_digest(scene: Scene) -> str:
    """SHA-256 of the triangles in whole millimetres: whether a rebuilt scene is the one that was rendered."""
    millimetres = np.rint(scene.triangles_m * 1000.0).astype("<i4")
    return hashlib.sha256(millimetres.tobytes()).hexdigest()
