"""Which surfaces a keypoint may mean: rays through a rendered scene.

A corner of a roof is found within a pixel of it, on the roof or on the street beside it. So a keypoint stands for every
surface visible within 1 px of it, each met by the keypoint's own exact ray.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.geometry.cameras import focal_px, normalise

if TYPE_CHECKING:
    from aeromatch_cli.lab.synthetic.truth import Truth

# The centre ray and 8 around it.
_REACH_PX = 1.0
_ANGLES = np.arange(8) * (np.pi / 4.0)
_RING_PX = np.concatenate([[[0.0, 0.0]], _REACH_PX * np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])])
# A surface may be extended along the ray by this many pixel footprints.
_FOOTPRINTS = 3.0


def view(truth: Truth, image: str, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions (N, 3) in the world with depth 1, NaN where the lens has no ray, and projection centres (N, 3)."""
    pose = truth.poses[image]
    assert pose.world_rotation is not None
    uv = normalise(truth.cameras[image], points_px)
    return np.column_stack([uv, np.ones(len(uv))]) @ pose.world_rotation, truth.centers_m(image, points_px)


def first_hits(truth: Truth, centers_m: FloatArray, directions: FloatArray) -> tuple[IntArray, FloatArray]:
    """Triangle index (N,), -1 for none, and distance (N,) in units of the direction, infinite for none."""
    triangle_idx, distances = np.full(len(directions), -1), np.full(len(directions), np.inf)
    usable = np.flatnonzero(np.isfinite(directions).all(axis=1))
    if len(usable):
        hits = truth.caster.first_hits(centers_m[usable], directions[usable])
        triangle_idx[usable], distances[usable] = hits.triangle_idx, hits.distances
    return triangle_idx, distances


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What N keypoints may mean, world points (N, 9, 3), straight ahead first; NaN for sky and repetitions.

    meant_m: on the keypoint's own ray. met_m: where the surface was met, within 1 px of the keypoint; straight ahead
    both are the same.
    """

    meant_m: FloatArray
    met_m: FloatArray


def surfaces(truth: Truth, image: str, points_px: FloatArray) -> Surfaces:
    """What stored pixels (N, 2) may show: every surface visible within 1 px.

    For every distinct triangle that the centre ray or one of 8 rays around it meets: the place where the keypoint's
    exact ray meets the triangle's plane, or, where that lies more than 3 pixel footprints nearer or farther than the
    triangle was met, the place on the exact ray at the depth where it was met.
    """
    count, rays = len(points_px), len(_RING_PX)
    around = (np.asarray(points_px, dtype=np.float64)[:, None] + _RING_PX).reshape(-1, 2)
    directions, centers_m = view(truth, image, around)
    hits = first_hits(truth, centers_m, directions)
    centers_m = centers_m.reshape(count, rays, 3)
    triangle_idx, depth_m = hits[0].reshape(count, rays), hits[1].reshape(count, rays)
    exact = directions.reshape(count, rays, 3)[:, 0]
    has_ray = np.asarray(np.isfinite(exact).all(axis=1))
    candidate = (triangle_idx >= 0) & has_ray[:, None]
    for j in range(1, rays):
        candidate[:, j] &= (triangle_idx[:, :j] != triangle_idx[:, j : j + 1]).all(axis=1)
    k, ring = np.nonzero(candidate)
    met_m, met_idx = depth_m[k, ring], triangle_idx[k, ring]
    normals, corners_m = truth.scene.normals[met_idx], truth.scene.triangles_m[met_idx, 0]
    along = (normals * exact[k]).sum(axis=1)
    height = (normals * (corners_m - centers_m[k, 0])).sum(axis=1)
    extended_m = np.divide(height, along, out=np.full(len(k), np.inf), where=np.abs(along) > 1e-9)
    footprint_m = met_m / focal_px(truth.cameras[image])
    reached_m = np.where(np.abs(extended_m - met_m) <= _FOOTPRINTS * footprint_m, extended_m, met_m)
    meant_m, seen_m = np.full((2, count, rays, 3), np.nan)
    meant_m[k, ring] = centers_m[k, 0] + reached_m[:, None] * exact[k]
    seen_m[k, ring] = centers_m[k, ring] + met_m[:, None] * directions.reshape(count, rays, 3)[k, ring]
    return Surfaces(meant_m, seen_m)
