"""One picture of a scene with its depth, surfaces and sunlight, from an exact camera and pose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Camera, FloatArray, IntArray
from aeromatch_cli.geometry.cameras import normalise
from aeromatch_cli.lab.synthetic.light import HORIZON
from aeromatch_cli.lab.synthetic.raycast import Hits
from aeromatch_cli.lab.synthetic.sensor import Development, develop
from aeromatch_cli.lab.synthetic.shade import Stage, radiance, sun_at, sun_share

# Colour is the mean of a 2 x 2 grid of samples in each pixel.
_SAMPLE_OFFSETS_PX = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
_SAMPLES_PER_PX = 2.0
_BAND_PX = 65_536  # pixels worked on at a time: bounds the memory at any image size and keeps it in the cache
# A slanted surface is sampled more coarsely along the slant; textures are filtered by the mean of both directions.
_FLATTEST_COSINE = 0.06


@dataclass(frozen=True, eq=False)
class View:
    """Where a picture is taken. world_rotation: (3, 3) of cam_from_world; center_m: (3,). moment: its number.

    sweep_m: (3,) by which the projection centre moves from the first row to the last, halfway through being at
    center_m; None where all rows are exposed at once.
    """

    camera: Camera
    world_rotation: FloatArray
    center_m: FloatArray
    moment: int
    sweep_m: FloatArray | None = None

    def at_row(self, row: int) -> View:
        """As that row is exposed."""
        if self.sweep_m is None:
            return self
        return replace(self, center_m=self.center_m + row_share(self.camera, row) * self.sweep_m)

    def directions(self, uv: FloatArray) -> FloatArray:
        """World directions (N, 3), one metre long along the optical axis, of normalised coordinates (N, 2)."""
        rotation = self.world_rotation.astype(uv.dtype)
        along: FloatArray = uv[:, :1] * rotation[0] + uv[:, 1:] * rotation[1] + rotation[2]
        return along


def row_share(camera: Camera, rows: FloatArray | float) -> Any:
    """How far a rolling shutter is at rows (N,) of a picture: -0.5 at the first, 0.5 at the last."""
    return rows / (camera.height_px - 1) - 0.5


@dataclass(frozen=True, eq=False)
class Rendered:
    """A picture and, at every pixel centre, the truth.

    pixels: (H, W, 3) uint8 RGB. depth_m: (H, W) float32 along the optical axis, NaN for sky.
    surface: (H, W) uint32, one more than the index of the triangle seen, 0 for sky. sun: (H, W) uint8, 255 times the
    share of the sun's disc in view, 0 for sky and where the surface faces away.
    """

    pixels: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    surface: NDArray[np.uint32]
    sun: NDArray[np.uint8]


def render_image(stage: Stage, view: View, settings: Development, rng: np.random.Generator) -> Rendered:
    """Take the picture."""
    width, height = view.camera.width_px, view.camera.height_px
    depth_m = np.empty((height, width), dtype=np.float32)
    surface = np.empty((height, width), dtype=np.uint32)
    sun = np.empty((height, width), dtype=np.uint8)
    linear = np.empty((height, width, 3), dtype=np.float32)
    radius2 = np.empty((height, width), dtype=np.float32)
    rows = max(1, _BAND_PX // width) if view.sweep_m is None else 1
    for top in range(0, height, rows):
        band = slice(top, min(top + rows, height))
        patch = _look(stage, view.at_row(top), top, band.stop)
        shape = (band.stop - top, width)
        depth_m[band], surface[band] = patch.depth_m.reshape(shape), patch.surface.reshape(shape)
        sun[band], radius2[band] = patch.sun.reshape(shape), patch.radius2.reshape(shape)
        linear[band] = patch.linear.reshape(*shape, 3)
    return Rendered(develop(linear, radius2, settings, rng), depth_m, surface, sun)


def look_at(stage: Stage, view: View) -> FloatArray:
    """Linear RGB (N, 3) of a picture without its truth and development: what a light meter sees."""
    height = view.camera.height_px
    return _look(stage, view, 0, height).linear


@dataclass(frozen=True, eq=False)
class _Patch:
    """Some rows of a picture, pixel by pixel: linear (P, 3), the others (P,)."""

    linear: FloatArray
    depth_m: FloatArray
    surface: IntArray
    sun: IntArray
    radius2: FloatArray


def _look(stage: Stage, view: View, top: int, bottom: int) -> _Patch:
    uv, per_column, per_row = _ray_grid(view.camera, top, bottom)
    centre = stage.caster.first_hits(view.center_m, view.directions(uv))
    samples_uv = np.stack(
        [uv + dx * per_column + dy * per_row for dx, dy in _SAMPLE_OFFSETS_PX]
    ).astype(np.float32)  # fmt: skip
    # Spacing of the samples at unit depth.
    spacing = np.sqrt(np.abs(per_column[:, 0] * per_row[:, 1] - per_column[:, 1] * per_row[:, 0])) / _SAMPLES_PER_PX
    directions = view.directions(samples_uv.reshape(-1, 2))
    # Colour does not need the float64 that depth does: 0.1 mm is far below the finest texture.
    hits = stage.caster.rough_hits(view.center_m, directions)
    shape = samples_uv.shape[:2]
    reach = np.where(hits.triangle_idx >= 0, hits.distances, np.float32(0.0)).astype(np.float32)
    points = (view.center_m.astype(np.float32) + reach[:, None] * directions).reshape(*shape, 3)
    direct = sun_share(stage, hits.triangle_idx.reshape(shape), points)
    light = _light(stage, view, hits, directions, points.reshape(-1, 3), np.tile(spacing, shape[0]), direct.ravel())
    return _Patch(
        linear=light.reshape(*shape, 3).mean(axis=0),
        depth_m=np.where(np.isfinite(centre.distances), centre.distances, np.nan),
        surface=(centre.triangle_idx.astype(np.int64) + 1).astype(np.uint32),
        sun=_sun_at_centres(stage, view, uv, centre, direct),
        radius2=(uv**2).sum(axis=1),
    )


def _ray_grid(camera: Camera, top: int, bottom: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Normalised coordinates (P, 2) float64 of the pixel centres of rows top to bottom, exact, and their change from
    column to column and from row to row, which only places the colour samples."""
    x, y = np.meshgrid(np.arange(camera.width_px + 1.0), np.arange(top, bottom + 1.0))
    uv = normalise(camera, np.stack([x.ravel(), y.ravel()], axis=1)).reshape(*x.shape, 2)
    middle = uv[:-1, :-1]
    return tuple(part.reshape(-1, 2) for part in (middle, uv[:-1, 1:] - middle, uv[1:, :-1] - middle))  # type: ignore[return-value]


def _sun_at_centres(stage: Stage, view: View, uv: FloatArray, centre: Hits, direct: FloatArray) -> IntArray:
    """Where all samples around a pixel's centre agree, so does the centre; elsewhere it is asked itself."""
    facing = stage.scene.normals[centre.triangle_idx] @ stage.light.to_sun > 0.0
    share = np.where((centre.triangle_idx >= 0) & facing, direct[0], 0.0)
    unsure = np.flatnonzero((direct.min(axis=0) != direct.max(axis=0)) & (centre.triangle_idx >= 0))
    points = view.center_m + centre.distances[unsure, None] * view.directions(uv[unsure])
    share[unsure] = sun_at(stage, centre.triangle_idx[unsure], points.astype(np.float32))
    return np.rint(255.0 * share).astype(np.uint8)


def _light(
    stage: Stage,
    view: View,
    hits: Hits,
    directions: FloatArray,
    points_m: FloatArray,
    spacing: FloatArray,
    direct: FloatArray,
) -> FloatArray:
    """Linear RGB (N, 3) float32 that arrives along directions (N, 3)."""
    sky = HORIZON * np.float32(stage.light.sky)
    light = np.broadcast_to(sky, (len(directions), 3)).copy()
    seen = np.flatnonzero(hits.triangle_idx >= 0)
    if not len(seen):
        return light
    triangle_idx, along, distances = hits.triangle_idx[seen], directions[seen], hits.distances[seen]
    lengths = np.sqrt(np.einsum("ij,ij->i", along, along))
    to_camera = along / -lengths[:, None]
    normals = stage.normals32[triangle_idx]
    cosine = np.maximum(np.abs(np.einsum("ij,ij->i", normals, to_camera)), _FLATTEST_COSINE)
    footprint = spacing[seen].astype(np.float32) * distances / np.sqrt(cosine)
    leaving = radiance(stage, triangle_idx, points_m[seen], to_camera, footprint, direct[seen], view.moment)
    light[seen] = stage.light.through_air(leaving, distances * lengths)
    return light
