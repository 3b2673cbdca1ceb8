"""Light that surfaces send towards the camera: every material's painter, the sun's disc, the sky, the air."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.lab.synthetic.imagery import GroundImagery
from aeromatch_cli.lab.synthetic.light import HORIZON, Light, seasonal
from aeromatch_cli.lab.synthetic.materials import PAINTERS
from aeromatch_cli.lab.synthetic.noise import hash01
from aeromatch_cli.lab.synthetic.paint import Painted, Samples
from aeromatch_cli.lab.synthetic.rasters import interpolated
from aeromatch_cli.lab.synthetic.raycast import RayCaster
from aeromatch_cli.lab.synthetic.scene import Scene
from aeromatch_cli.lab.synthetic.solids import Material
from aeromatch_cli.lab.synthetic.water import paint_water

# Rays to the sun: one for each colour sample of a pixel, these many more where they disagree.
FIRST_SUN_RAYS, MORE_SUN_RAYS = 4, 12


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene under one light, ready to be looked at. imagery: pictures laid over the ground instead of its painter."""

    scene: Scene
    caster: RayCaster
    light: Light
    imagery: GroundImagery | None = None

    @cached_property
    def normals32(self) -> FloatArray:
        """(T, 3) float32, as colour needs them."""
        return self.scene.normals.astype(np.float32)

    @cached_property
    def frames32(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Origins, u axes and v axes (S, 3) float32 of the surfaces."""
        scene = self.scene
        return scene.origins_m.astype(np.float32), scene.u_axes.astype(np.float32), scene.v_axes.astype(np.float32)

    @cached_property
    def surface_numbers(self) -> IntArray:
        """(S,) int64 below 2^24, drawn from each surface's place and direction: the same whatever else is built."""
        scene = self.scene
        x, y, z = np.rint(scene.origins_m * 1000.0).astype(np.int64).T
        turned = np.rint(scene.v_axes @ [1000.0, 3000.0, 7000.0]).astype(np.int64)
        return (hash01(x, y, z * 31 + turned + scene.seed) * 2.0**24).astype(np.int64)

    @cached_property
    def triangle_materials(self) -> IntArray:
        """(T,) uint8."""
        return self.scene.materials[self.scene.surface_idx].astype(np.uint8)

    @cached_property
    def sun_rays(self) -> FloatArray:
        """(FIRST + MORE, 3) directions to the sun's disc; the first lie on its rim, where a penumbra begins."""
        rays = self.light.disc(FIRST_SUN_RAYS + MORE_SUN_RAYS)
        return np.concatenate([rays[MORE_SUN_RAYS:], rays[:MORE_SUN_RAYS]])

    @cached_property
    def ground_slopes(self) -> tuple[float, float, float, FloatArray] | None:
        """x, y of the first crossing, cell, and smooth terrain gradients (h, w, 2) float32; None for a plane."""
        x_m, y_m, z_m = self.scene.ground.even_part()
        if not z_m.any() or min(z_m.shape) < 2:
            return None
        per_y, per_x = np.gradient(z_m, self.scene.ground.cell_m)
        return x_m, y_m, self.scene.ground.cell_m, np.stack([per_x, per_y], axis=2).astype(np.float32)

    def slopes_at(self, points_m: FloatArray) -> FloatArray:
        """Smooth terrain gradient (N, 2) along x and y below points (N, 3)."""
        import cv2

        known = self.ground_slopes
        if known is None:
            return np.zeros((len(points_m), 2), dtype=np.float32)
        x0, y0, cell_m, slopes = known
        x, y = ((points_m[:, k] - first) / cell_m for k, first in ((0, x0), (1, y0)))
        return interpolated(slopes, x, y, cv2.BORDER_CONSTANT)


def radiance(
    stage: Stage, triangle_idx: IntArray, points_m: FloatArray, to_camera: FloatArray, footprint_m: FloatArray,
    direct: FloatArray, moment: int,
) -> FloatArray:  # fmt: skip
    """Linear RGB (N, 3) float32 that leaves surface points towards the camera.

    points_m: (N, 3) float32. to_camera: (N, 3) unit. footprint_m: (N,) spacing of samples on the surface.
    direct: (N,) share of the sun's disc in view. moment: the picture's number.
    """
    surface_idx = stage.scene.surface_idx[triangle_idx]
    materials = stage.triangle_materials[triangle_idx]
    leaving = np.empty((len(points_m), 3), dtype=np.float32)
    for material in map(Material, np.flatnonzero(np.bincount(materials)).tolist()):
        chosen = np.flatnonzero(materials == material)
        surfaces, normals = surface_idx[chosen], stage.normals32[triangle_idx[chosen]]
        samples = _samples(stage, material, surfaces, points_m[chosen], footprint_m[chosen], moment)
        painted = _paint(stage, material, samples)
        facing = _facing(stage, material, surfaces, normals, samples, painted)
        leaving[chosen] = _reflected(stage.light, painted, facing, to_camera[chosen], direct[chosen])
    return leaving


def _samples(
    stage: Stage, material: Material, surface_idx: IntArray, points_m: FloatArray, footprint_m: FloatArray, moment: int
) -> Samples:
    scene = stage.scene
    origins, u_axes, v_axes = (rows[surface_idx] for rows in stage.frames32)
    offset, numbers = points_m - origins, stage.surface_numbers[surface_idx]
    slope = np.zeros((len(points_m), 2), dtype=np.float32)
    if material == Material.GROUND:
        along = stage.slopes_at(points_m)
        slope = np.stack([np.einsum("ij,ij->i", along, axes[:, :2]) for axes in (u_axes, v_axes)], axis=1)
    return Samples(
        u_m=np.einsum("ij,ij->i", offset, u_axes),
        v_m=np.einsum("ij,ij->i", offset, v_axes),
        z_m=points_m[:, 2],
        footprint_m=np.maximum(footprint_m, 1e-4).astype(np.float32),
        # Every surface cuts its own piece out of the noise.
        shift_m=numbers.astype(np.float32) * np.float32(40.0 * 2.0**-24),
        size_m=scene.sizes_m[surface_idx].astype(np.float32),
        tint=scene.tints[surface_idx].astype(np.float32),
        salt=scene.seed * 101 + 7 * numbers,
        slope=slope,
        seed=scene.seed,
        moment=moment,
    )


def _paint(stage: Stage, material: Material, samples: Samples) -> Painted:
    if material == Material.WATER:
        return paint_water(samples)
    if material != Material.GROUND:
        return PAINTERS[material](samples)
    if stage.imagery is not None:
        return Painted(stage.imagery.albedo(samples.u_m, samples.v_m, samples.footprint_m))
    return stage.scene.paint_ground(samples)


def _facing(
    stage: Stage, material: Material, surface_idx: IntArray, normals: FloatArray, samples: Samples, painted: Painted
) -> FloatArray:
    """Shading normals (N, 3) unit: the triangles' own, smoothed over the terrain and turned by the micro-relief."""
    turn = samples.slope if material == Material.GROUND else None
    if painted.relief is not None:
        turn = painted.relief if turn is None else turn + painted.relief
    if turn is None:
        return normals
    if material == Material.GROUND:  # slopes say it all
        normals = np.broadcast_to(np.array([0.0, 0.0, 1.0], dtype=np.float32), normals.shape)
    _, u_axes, v_axes = (rows[surface_idx] for rows in stage.frames32)
    turned = normals - turn[:, :1] * u_axes - turn[:, 1:] * v_axes
    turned /= np.sqrt(np.einsum("ij,ij->i", turned, turned))[:, None]
    return np.asarray(turned, dtype=np.float32)


def _reflected(
    light: Light, painted: Painted, normals: FloatArray, to_camera: FloatArray, direct: FloatArray
) -> FloatArray:
    albedo = np.clip(seasonal(painted.albedo, light.season), 0.005, 0.95)
    cosine = np.clip(normals @ light.to_sun.astype(np.float32), 0.0, None)
    arriving = (direct * cosine)[:, None] * light.sun + light.indirect(0.5 + 0.5 * normals[:, 2:3])
    leaving: FloatArray = albedo * arriving
    if painted.gloss is not None:
        # Schlick's approximation (1994) of Fresnel's reflection, around the normal of the surface.
        upright = np.clip(np.einsum("ij,ij->i", normals, to_camera), 0.0, 1.0)
        mirrored = painted.gloss * (0.03 + 0.97 * (1.0 - upright) ** 5)
        leaving = leaving + mirrored[:, None] * (HORIZON * np.float32(light.sky))
    return leaving


def sun_share(stage: Stage, triangle_idx: IntArray, points_m: FloatArray) -> FloatArray:
    """Share of the sun's disc in view of the samples of P pixels, (G, P) float32; zero where a surface faces away.

    triangle_idx: (G, P), -1 for sky; points_m: (G, P, 3). Every sample sends one ray, each of a pixel's samples to
    another part of the disc; where those of a pixel disagree, all its samples send as many more as there are groups.
    """
    groups = len(triangle_idx)
    lit = np.stack([_free(stage, triangle_idx[g], points_m[g], stage.sun_rays[g : g + 1]) for g in range(groups)])
    mixed = np.flatnonzero(lit.min(axis=0) != lit.max(axis=0))
    if len(mixed):
        for g in range(groups):
            # Another sample's rays, so that the sixteen rays of a pixel are sixteen parts of the disc.
            rays = stage.sun_rays[FIRST_SUN_RAYS:][g::groups]
            more = _free(stage, triangle_idx[g][mixed], points_m[g][mixed], rays)
            lit[g][mixed] = (lit[g][mixed] + len(rays) * more) / (1 + len(rays))
    return lit


def sun_at(stage: Stage, triangle_idx: IntArray, points_m: FloatArray) -> FloatArray:
    """Share (N,) float32 of the sun's disc in view of surface points (N, 3), in sixteenths; -1 in triangle_idx: sky."""
    return _free(stage, triangle_idx, points_m, stage.sun_rays)


def _free(stage: Stage, triangle_idx: IntArray, points_m: FloatArray, rays: FloatArray) -> FloatArray:
    """Share (N,) of the rays (R, 3) that leave points (N, 3) freely; zero for sky and surfaces that face away."""
    normals = stage.normals32[triangle_idx]
    facing = np.flatnonzero((triangle_idx >= 0) & (normals @ stage.light.to_sun.astype(np.float32) > 0.0))
    share = np.zeros(len(points_m), dtype=np.float32)
    for ray in rays:
        share[facing] += stage.caster.is_free(points_m[facing], normals[facing], ray)
    return share / np.float32(len(rays))
