"""Which surface a ray meets first: embree finds the triangle in float32, the exact distance is computed in float64."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.lab.synthetic.scene import Scene


@dataclass(frozen=True, eq=False)
class Hits:
    """First surfaces along N rays: triangle_idx (N,), -1 for none; distances (N,) in units of the direction's
    length, infinite for none."""

    triangle_idx: IntArray
    distances: FloatArray


def check_installed() -> None:
    """Raises ConfigError where the library that casts rays is missing."""
    if find_spec("embreex") is None:
        raise ConfigError(
            "rendering a block, and judging matches by a rendered block's exact geometry, needs embreex: "
            "pip install 'aeromatch[lab]'"
        )


class RayCaster:
    """The triangles of a scene, ready to be asked."""

    def __init__(self, scene: Scene) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = scene
        self._offsets = np.einsum("ij,ij->i", scene.normals, scene.triangles_m[:, 0])
        # robust: no ray slips between two triangles that share an edge.
        self._embree = EmbreeScene(robust=True)
        TriangleMesh(self._embree, np.ascontiguousarray(scene.triangles_m, dtype=np.float32))

    def rough_hits(self, origin_m: FloatArray, directions: FloatArray) -> Hits:
        """First surface of each ray from one place (3,), or from one each (N, 3), along directions (N, 3).

        Distances are float32, good to 0.1 mm.
        """
        found = self._embree.run(
            np.ascontiguousarray(np.broadcast_to(np.asarray(origin_m, dtype=np.float32), directions.shape)),
            np.ascontiguousarray(directions, dtype=np.float32),
            query="INTERSECT",
            output=1,
        )
        triangle_idx = np.asarray(found["primID"])
        return Hits(triangle_idx, np.where(triangle_idx >= 0, np.asarray(found["tfar"]), np.float32(np.inf)))

    def first_hits(self, origin_m: FloatArray, directions: FloatArray) -> Hits:
        """First surface of each ray from one place (3,), or from one each (N, 3), along directions (N, 3).

        Directions may have any length. Exact to rounding: embree's float32 distance only chooses the triangle; the ray
        then meets its plane in float64.
        """
        rough = self.rough_hits(origin_m, directions)
        triangle_idx = rough.triangle_idx
        hit = triangle_idx >= 0
        normals = self._scene.normals[triangle_idx]
        along = np.einsum("ij,ij->i", normals, directions)
        height = self._offsets[triangle_idx] - np.einsum("ij,ij->i", normals, np.broadcast_to(origin_m, normals.shape))
        # A ray that grazes its triangle has no stable plane intersection; embree's own distance is the better one.
        steep = np.abs(along) > 1e-6 * np.linalg.norm(directions, axis=1)
        exact = np.divide(height, along, out=rough.distances.astype(np.float64), where=hit & steep)
        return Hits(triangle_idx, np.where(hit, exact, np.inf))

    def is_free(self, points_m: FloatArray, normals: FloatArray, direction: FloatArray) -> BoolArray:
        """Whether nothing stands between surface points (N, 3) and infinity along one direction (3,)."""
        # Start a millimetre above the surface, or float32 finds the surface itself.
        starts = points_m + np.float32(1e-3) * normals
        rays = np.broadcast_to(direction, starts.shape)
        blocked = self._embree.run(
            np.ascontiguousarray(starts, dtype=np.float32),
            np.ascontiguousarray(rays, dtype=np.float32),
            query="OCCLUDED",
        )
        return np.asarray(blocked) == -1
