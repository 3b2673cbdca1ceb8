"""One picture of a scene and its depth, from an exact camera and pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.cameras import normalise
from aeromatch_cli.synthetic.raycast import RayCaster
from aeromatch_cli.synthetic.scene import Scene
from aeromatch_cli.synthetic.texture import albedo

# Colour is the mean of a 2 x 2 grid of samples in each pixel.
_SAMPLE_OFFSETS_PX = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
_SAMPLES_PER_PX = 2.0
_BAND_PX = 65_536  # pixels worked on at a time: bounds the memory at any image size and keeps it in the cache

_SUN = np.array([1.00, 0.95, 0.86], dtype=np.float32) * np.float32(2.3)
_SKY = np.array([0.62, 0.74, 0.95], dtype=np.float32) * np.float32(0.55)
_BOUNCED = np.array([0.14, 0.13, 0.11], dtype=np.float32)
_SKY_BEYOND = np.array([0.55, 0.68, 0.85], dtype=np.float32)
_VIGNETTING = 0.16


@dataclass(frozen=True, eq=False)
class RayGrid:
    """Normalised coordinates of every pixel centre of a camera and their change from pixel to pixel.

    uv: (H, W, 2) float64, exact. per_column, per_row: (H, W, 2), only used to place the colour samples.
    """

    uv: FloatArray
    per_column: FloatArray
    per_row: FloatArray


def ray_grid(camera: Camera) -> RayGrid:
    """The rays of a camera, once for all its pictures."""
    x, y = np.meshgrid(np.arange(camera.width_px, dtype=np.float64), np.arange(camera.height_px, dtype=np.float64))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    uv = np.concatenate([normalise(camera, part) for part in np.array_split(pixels, max(1, len(pixels) // _BAND_PX))])
    grid = uv.reshape(camera.height_px, camera.width_px, 2)
    return RayGrid(grid, np.gradient(grid, axis=1).astype(np.float32), np.gradient(grid, axis=0).astype(np.float32))


@dataclass(frozen=True, eq=False)
class Rendered:
    """pixels: (H, W, 3) uint8 RGB. depth_m: (H, W) float32 along the optical axis at pixel centres, NaN for sky."""

    pixels: NDArray[np.uint8]
    depth_m: NDArray[np.float32]


def render_image(
    scene: Scene,
    caster: RayCaster,
    rays: RayGrid,
    world_rotation: FloatArray,
    center_m: FloatArray,
    *,
    exposure: float,
    noise_sigma: float,
    rng: np.random.Generator,
) -> Rendered:
    """Take the picture. world_rotation, center_m: the pose; noise_sigma: Gaussian, in grey levels of 0-255."""
    height, width = rays.uv.shape[:2]
    depth_m = np.empty((height, width), dtype=np.float32)
    linear = np.empty((height, width, 3), dtype=np.float32)
    rows = max(1, _BAND_PX // width)
    for top in range(0, height, rows):
        band = slice(top, min(top + rows, height))
        uv = rays.uv[band].reshape(-1, 2)
        depth_m[band] = _depth(caster, uv, world_rotation, center_m).reshape(-1, width)
        per_column, per_row = rays.per_column[band].reshape(-1, 2), rays.per_row[band].reshape(-1, 2)
        uv32 = uv.astype(np.float32)
        samples = np.concatenate([uv32 + dx * per_column + dy * per_row for dx, dy in _SAMPLE_OFFSETS_PX])
        # Spacing of the samples at unit depth.
        spacing = np.sqrt(np.abs(per_column[:, 0] * per_row[:, 1] - per_column[:, 1] * per_row[:, 0])) / _SAMPLES_PER_PX
        light = _light(scene, caster, samples, np.tile(spacing, len(_SAMPLE_OFFSETS_PX)), world_rotation, center_m)
        linear[band] = light.reshape(len(_SAMPLE_OFFSETS_PX), -1, width, 3).mean(axis=0)
    return Rendered(_develop(linear, rays, exposure, noise_sigma, rng), depth_m)


def _depth(caster: RayCaster, uv: FloatArray, world_rotation: FloatArray, center_m: FloatArray) -> FloatArray:
    directions = _directions(uv, world_rotation)
    # In units of such a direction the distance is the depth.
    distances = caster.first_hits(center_m, directions).distances
    return np.where(np.isfinite(distances), distances, np.nan)


def _directions(uv: FloatArray, world_rotation: FloatArray) -> FloatArray:
    """World directions (N, 3), one metre long along the optical axis, of normalised coordinates (N, 2)."""
    return uv[:, :1] * world_rotation[0] + uv[:, 1:] * world_rotation[1] + world_rotation[2]


def _light(
    scene: Scene,
    caster: RayCaster,
    uv: FloatArray,
    spacing: FloatArray,
    world_rotation: FloatArray,
    center_m: FloatArray,
) -> FloatArray:
    """Linear RGB (N, 3) float32 that arrives along normalised image coordinates uv (N, 2)."""
    # Colour does not need the float64 that depth does: 0.1 mm is far below the finest texture.
    directions = _directions(uv, world_rotation.astype(np.float32))
    hits = caster.rough_hits(center_m, directions)
    light = np.broadcast_to(_SKY_BEYOND, (len(uv), 3)).copy()
    seen = np.flatnonzero(hits.triangle_idx >= 0)
    if not len(seen):
        return light
    triangle_idx, distances, directions = hits.triangle_idx[seen], hits.distances[seen], directions[seen]
    points = center_m.astype(np.float32) + distances[:, None] * directions
    normals = scene.normals.astype(np.float32)[triangle_idx]
    cosine = np.abs(np.einsum("ij,ij->i", normals, directions)) / np.sqrt(np.einsum("ij,ij->i", directions, directions))
    # A slanted surface is sampled more coarsely along the slant; the cap keeps grazing facades from going blank.
    footprint = spacing[seen] * distances / np.maximum(cosine, 0.2)
    to_sun = normals @ scene.to_sun.astype(np.float32)
    facing = np.flatnonzero(to_sun > 0.0)
    direct = np.zeros(len(seen), dtype=np.float32)
    direct[facing] = to_sun[facing] * caster.is_free(points[facing], normals[facing], scene.to_sun)
    open_sky = 0.5 + 0.5 * normals[:, 2:3]
    arriving = direct[:, None] * _SUN + open_sky * _SKY + (1.0 - open_sky) * _BOUNCED
    light[seen] = albedo(scene, scene.surface_idx[triangle_idx], points, footprint) * arriving
    return light


def _develop(
    linear: FloatArray, rays: RayGrid, exposure: float, noise_sigma: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Vignetting, exposure, the tone curve of sRGB (IEC 61966-2-1), noise, 8 bits."""
    radius2 = (rays.uv**2).sum(axis=2).astype(np.float32)
    vignetting = 1.0 - _VIGNETTING * radius2 / radius2.max(initial=1e-9)
    exposed = np.clip(linear * (exposure * vignetting)[..., None], 0.0, 1.0)
    toned = np.where(exposed <= 0.0031308, 12.92 * exposed, 1.055 * np.power(exposed, np.float32(1.0 / 2.4)) - 0.055)
    noisy = 255.0 * toned + noise_sigma * rng.standard_normal(toned.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
