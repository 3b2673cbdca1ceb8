"""What stands on the ground: a scene is rebuilt, triangle for triangle, from its preset, its seed and its extent.

World: x east, y north, z up, metres, origin at the middle of the block; the ground is the plane z = 0.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.synthetic.noise import hash01
from aeromatch_cli.synthetic.solids import Footprint, Material, Surface, box, crown, gabled_house, ground_square

# Raised whenever the same preset and seed give another scene: truth of an older version is then refused, not misread.
SCENE_VERSION = 1

# The street plan of `town`, in the turned frame of its streets: one street axis at every multiple of the pitches.
PITCH_U_M, PITCH_V_M = 66.0, 50.0
ROAD_HALF_M, PAVEMENT_M = 3.4, 1.9
LOTS_U, LOTS_V = 4, 2
_BUILT_M = ROAD_HALF_M + PAVEMENT_M
LOT_U_M = (PITCH_U_M - 2.0 * _BUILT_M) / LOTS_U
LOT_V_M = (PITCH_V_M - 2.0 * _BUILT_M) / LOTS_V
YARD_SHARE = 0.25  # street blocks that hold large flat buildings on a paved yard instead of houses in gardens
YARD_SALT = 77
# Ground beyond the last house, so that tilted views never look over the edge of the world.
_MARGIN_M = 400.0

_WALLS = ((0.50, 0.44, 0.34), (0.58, 0.55, 0.50), (0.36, 0.22, 0.16), (0.45, 0.42, 0.40), (0.55, 0.40, 0.26))
_TILES = ((0.30, 0.11, 0.07), (0.24, 0.10, 0.07), (0.15, 0.12, 0.11), (0.34, 0.16, 0.09), (0.12, 0.13, 0.15))
_FLATS = ((0.26, 0.26, 0.27), (0.38, 0.37, 0.35), (0.17, 0.17, 0.18), (0.30, 0.28, 0.24))
_PAINTS = ((0.55, 0.55, 0.56), (0.04, 0.04, 0.05), (0.30, 0.03, 0.03), (0.05, 0.09, 0.25), (0.22, 0.23, 0.24))
_Tint = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Scene:
    """Triangles and the surfaces they belong to.

    triangles_m: (T, 3, 3) float64 world; normals: (T, 3) unit, outwards; surface_idx: (T,) into the arrays below.
    origins_m, u_axes, v_axes: (S, 3); sizes_m: (S, 2); materials: (S,); tints: (S, 3) linear RGB albedo.
    to_sun: (3,) unit vector. solids: how many of each kind, by name.
    """

    preset: str
    seed: int
    half_extent_m: float
    triangles_m: FloatArray
    normals: FloatArray
    surface_idx: IntArray
    origins_m: FloatArray
    u_axes: FloatArray
    v_axes: FloatArray
    sizes_m: FloatArray
    materials: IntArray
    tints: FloatArray
    to_sun: FloatArray
    solids: Mapping[str, int]


def build_scene(preset: str, seed: int, half_extent_m: float) -> Scene:
    """The scene of a preset, solids within half_extent_m of the origin. Equal arguments give equal arrays.

    A street block depends on the seed and its own place only: a larger extent adds blocks and changes none.
    Raises ConfigError on an unknown preset or a negative seed.
    """
    if preset not in PRESETS:
        raise ConfigError(f"unknown preset {preset!r} for a rendered block; use one of: {', '.join(PRESETS)}")
    if seed < 0:
        raise ConfigError(f"the seed of a rendered block must be 0 or larger, got {seed}")
    rng = np.random.default_rng([seed, 1])
    heading_deg = float(rng.uniform(5.0, 40.0))
    surfaces, solids = PRESETS[preset](seed, half_extent_m, heading_deg)
    to_sun = sun_direction(float(rng.uniform(120.0, 240.0)), float(rng.uniform(38.0, 55.0)))
    ground = ground_square(half_extent_m + _MARGIN_M, heading_deg)
    return assemble(preset, seed, half_extent_m, [ground, *surfaces], to_sun, solids)


def assemble(
    preset: str,
    seed: int,
    half_extent_m: float,
    surfaces: list[Surface],
    to_sun: FloatArray,
    solids: Mapping[str, int],
) -> Scene:
    """The scene of a list of surfaces; the first is the ground."""
    triangles = np.concatenate([s.triangles_m for s in surfaces])
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return Scene(
        preset=preset,
        seed=seed,
        half_extent_m=half_extent_m,
        triangles_m=triangles,
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        surface_idx=np.repeat(np.arange(len(surfaces)), [len(s.triangles_m) for s in surfaces]),
        origins_m=np.stack([s.origin_m for s in surfaces]),
        u_axes=np.stack([s.u_axis for s in surfaces]),
        v_axes=np.stack([s.v_axis for s in surfaces]),
        sizes_m=np.array([s.size_m for s in surfaces]),
        materials=np.array([int(s.material) for s in surfaces]),
        tints=np.array([s.tint for s in surfaces]),
        to_sun=to_sun,
        solids=solids,
    )


def scene_digest(scene: Scene) -> str:
    """SHA-256 of the triangles in whole millimetres: whether a rebuilt scene is the one that was rendered."""
    millimetres = np.rint(scene.triangles_m * 1000.0).astype("<i4")
    return hashlib.sha256(millimetres.tobytes()).hexdigest()


def sun_direction(azimuth_deg: float, elevation_deg: float) -> FloatArray:
    """Unit vector (3,) towards the sun; azimuth clockwise from north (y), elevation above the horizon."""
    azimuth, elevation = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    return np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])


def _town(seed: int, half_extent_m: float, heading_deg: float) -> tuple[list[Surface], dict[str, int]]:
    """Houses in gardens, some large flat buildings, parked cars and trees on a turned street grid."""
    surfaces: list[Surface] = []
    solids = {"buildings": 0, "roof_boxes": 0, "cars": 0, "trees": 0}
    reach = int(np.ceil(half_extent_m / min(PITCH_U_M, PITCH_V_M))) + 1
    for i in range(-reach, reach):
        for j in range(-reach, reach):
            middle = _turned((i + 0.5) * PITCH_U_M, (j + 0.5) * PITCH_V_M, heading_deg)
            if max(abs(middle[0]), abs(middle[1])) > half_extent_m + PITCH_U_M:
                continue
            # The generator takes no negative numbers; blocks are counted from far outside any scene.
            rng = np.random.default_rng([seed, 2, i + 100_000, j + 100_000])
            is_yard = hash01(np.array([i]), np.array([j]), seed * 101 + YARD_SALT)[0] < YARD_SHARE
            for kind, plan_uv, solid in (_yard if is_yard else _gardens)(rng, i * PITCH_U_M, j * PITCH_V_M):
                x, y = _turned(plan_uv.x_m, plan_uv.y_m, heading_deg)
                heading = plan_uv.heading_deg + heading_deg
                surfaces += solid(Footprint(x, y, plan_uv.length_x_m, plan_uv.length_y_m, heading))
                solids[kind] += 1
    return surfaces, solids


PRESETS: Mapping[str, Callable[[int, float, float], tuple[list[Surface], dict[str, int]]]] = {"town": _town}

# Kind, footprint in the frame of the streets, and what to build on the footprint in the world.
_Solid = tuple[str, Footprint, Callable[[Footprint], list[Surface]]]


def _turned(u_m: float, v_m: float, heading_deg: float) -> tuple[float, float]:
    a = np.deg2rad(heading_deg)
    return float(np.cos(a) * u_m - np.sin(a) * v_m), float(np.sin(a) * u_m + np.cos(a) * v_m)


def _shade(rng: np.random.Generator, tints: tuple[_Tint, ...]) -> _Tint:
    r, g, b = np.array(tints[int(rng.integers(len(tints)))]) * rng.uniform(0.8, 1.2) * rng.uniform(0.97, 1.03, size=3)
    return float(r), float(g), float(b)


def _gardens(rng: np.random.Generator, u0_m: float, v0_m: float) -> list[_Solid]:
    """One house, sometimes a shed, and a few trees to each lot; cars along the street."""
    found: list[_Solid] = []
    for a in range(LOTS_U):
        for b in range(LOTS_V):
            u = u0_m + _BUILT_M + (a + 0.5) * LOT_U_M
            v = v0_m + _BUILT_M + (b + 0.5) * LOT_V_M
            to_street = -1.0 if b == 0 else 1.0
            length, depth = rng.uniform(7.0, 10.5), rng.uniform(7.0, 10.0)
            front = v + to_street * (0.5 * LOT_V_M - rng.uniform(2.5, 4.0) - 0.5 * depth)
            plan = Footprint(u + rng.uniform(-1.0, 1.0), front, length, depth, rng.uniform(-1.5, 1.5))
            found.append(("buildings", plan, _house(rng, depth)))
            garden = v - to_street * 0.5 * LOT_V_M
            for _ in range(int(rng.integers(0, 4))):
                du, dv = rng.uniform(-0.42, 0.42) * LOT_U_M, rng.uniform(1.5, 5.0)
                found.append(_tree(rng, u + du, garden + to_street * dv))
    return [*found, *_cars(rng, u0_m, v0_m)]


def _house(rng: np.random.Generator, depth_m: float) -> Callable[[Footprint], list[Surface]]:
    eaves = 2.9 * float(rng.integers(1, 4)) + rng.uniform(0.0, 0.5)
    wall = (Material.FACADE, _shade(rng, _WALLS))
    if rng.random() < 0.3:
        roof = (Material.FLAT_ROOF, _shade(rng, _FLATS))
        return lambda plan: box(plan, 0.0, eaves, wall, roof)
    ridge = eaves + 0.5 * depth_m * float(np.tan(np.deg2rad(rng.uniform(25.0, 42.0))))
    tiles = (Material.TILED_ROOF, _shade(rng, _TILES))
    brick = (Material.PAINT, (0.28, 0.16, 0.12))
    along, across = rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2)

    def build(plan: Footprint) -> list[Surface]:
        x, y = _turned(along * plan.length_x_m, across * plan.length_y_m, plan.heading_deg)
        stack = Footprint(plan.x_m + x, plan.y_m + y, 0.7, 0.5, plan.heading_deg)
        chimney = box(stack, eaves, ridge + 0.6, brick, (Material.PAINT, (0.06, 0.06, 0.06)))
        return [*gabled_house(plan, eaves, ridge, wall, tiles), *chimney]

    return build


def _yard(rng: np.random.Generator, u0_m: float, v0_m: float) -> list[_Solid]:
    """Two or three large flat-roofed buildings with boxes on their roofs, cars parked between them."""
    found: list[_Solid] = []
    width = (PITCH_U_M - 2.0 * _BUILT_M) / 2.0
    for a in range(2):
        u = u0_m + _BUILT_M + (a + 0.5) * width
        length, depth = rng.uniform(13.0, 21.0), rng.uniform(15.0, 30.0)
        top = 3.1 * float(rng.integers(2, 6))
        wall, roof = (Material.FACADE, _shade(rng, _WALLS)), (Material.FLAT_ROOF, _shade(rng, _FLATS))
        v = v0_m + 0.5 * PITCH_V_M + rng.uniform(-3.0, 3.0)
        found.append(("buildings", Footprint(u, v, length, depth, 0.0), _block(wall, roof, top)))
        for _ in range(int(rng.integers(2, 6))):
            du, dv = rng.uniform(-0.38, 0.38) * length, rng.uniform(-0.38, 0.38) * depth
            plan = Footprint(u + du, v + dv, rng.uniform(1.0, 3.5), rng.uniform(1.0, 2.5), 0.0)
            tint = _shade(rng, _FLATS)
            found.append(("roof_boxes", plan, _roof_box(tint, top, top + rng.uniform(0.7, 2.2))))
    for k in range(int(rng.integers(3, 9))):
        u = u0_m + _BUILT_M + 2.5 + 2.8 * k
        found.append(_car(rng, u, v0_m + _BUILT_M + 2.8, 90.0))
    return [*found, *_cars(rng, u0_m, v0_m)]


def _block(
    wall: tuple[Material, _Tint], roof: tuple[Material, _Tint], top_m: float
) -> Callable[[Footprint], list[Surface]]:
    return lambda plan: box(plan, 0.0, top_m, wall, roof)


def _roof_box(tint: _Tint, bottom_m: float, top_m: float) -> Callable[[Footprint], list[Surface]]:
    return lambda plan: box(plan, bottom_m, top_m, (Material.PAINT, tint), (Material.PAINT, tint))


def _cars(rng: np.random.Generator, u0_m: float, v0_m: float) -> list[_Solid]:
    """Cars along the two streets that bound a block below and on the left."""
    kerb_m = ROAD_HALF_M - 1.1
    below = [_car(rng, u0_m + 9.0 + 7.5 * k, v0_m + kerb_m, 0.0) for k in range(7) if rng.random() < 0.5]
    left = [_car(rng, u0_m + kerb_m, v0_m + 9.0 + 7.5 * k, 90.0) for k in range(5) if rng.random() < 0.4]
    return below + left


def _car(rng: np.random.Generator, u_m: float, v_m: float, heading_deg: float) -> _Solid:
    tint = _shade(rng, _PAINTS)
    length, turn = rng.uniform(3.8, 4.8), rng.uniform(-3.0, 3.0)
    body = (Material.PAINT, tint)
    front = 1.0 if rng.random() < 0.5 else -1.0

    def build(plan: Footprint) -> list[Surface]:
        x, y = _turned(-0.35 * front, 0.0, plan.heading_deg)
        cabin = Footprint(plan.x_m + x, plan.y_m + y, 0.52 * length, 1.5, plan.heading_deg)
        roof = Footprint(plan.x_m + x, plan.y_m + y, 0.40 * length, 1.4, plan.heading_deg)
        shell = [
            *box(plan, 0.15, 0.8, body, body),
            *box(cabin, 0.8, 1.25, (Material.GLASS, tint), (Material.GLASS, tint)),
        ]
        return [*shell, *box(roof, 1.25, 1.42, body, body)]

    plan = Footprint(u_m + rng.uniform(-0.8, 0.8) * (heading_deg == 0.0), v_m, length, 1.75, heading_deg + turn)
    return ("cars", plan, build)


def _tree(rng: np.random.Generator, u_m: float, v_m: float) -> _Solid:
    radius = float(rng.uniform(1.0, 2.8))
    height = radius * rng.uniform(0.9, 1.5)
    tint = _shade(rng, ((0.055, 0.10, 0.03), (0.075, 0.115, 0.03), (0.045, 0.085, 0.035)))
    shape = np.random.default_rng(int(rng.integers(2**31)))

    def build(plan: Footprint) -> list[Surface]:
        return [crown(np.array([plan.x_m, plan.y_m, height]), radius, shape, tint)]

    return ("trees", Footprint(u_m, v_m, 2.0 * radius, 2.0 * radius, 0.0), build)
