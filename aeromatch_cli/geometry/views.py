"""Parallel views of level ground, and in which of them two cameras see it alike.

A camera that looks at the ground at `tilt` from the vertical resolves it more coarsely by the stretch 1 / cos(tilt)
along the azimuth of its look than across. A parallel view along that direction gives both axes the same blur again.
Source: the affine camera, H&Z section 6.3; tilts and their steps, Morel and Yu, ASIFT, SIAM J. Imaging Sciences 2(2),
2009.
"""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.footprints import clip_half_plane

# ASIFT's steps: tilts by the square root of 2, azimuths 72 degrees over the tilt.
TILT_STEP = float(np.sqrt(2.0))
_AZIMUTH_STEP_DEG = 72.0


def tilt_azimuths_rad(level: int) -> FloatArray:
    """Azimuths (A,) in [0, pi) that sample the tilt of sqrt(2)^level, evenly, the first 0; one for level 0."""
    if level == 0:
        return np.zeros(1)
    count = int(np.ceil(180.0 * TILT_STEP**level / _AZIMUTH_STEP_DEG - 1e-9))
    return np.pi * np.arange(count) / count


def direction_of(level: int, azimuth_rad: float) -> FloatArray:
    """Unit vector (3,) that looks down at ground stretched by sqrt(2)^level, azimuth counted from east to north."""
    down = TILT_STEP**-level
    across = np.sqrt(max(0.0, 1.0 - down * down))
    return np.array([across * np.cos(azimuth_rad), across * np.sin(azimuth_rad), -down])


def view_from_ground(direction: FloatArray) -> FloatArray:
    """(2, 2) world x, y on the ground to x, y of the parallel view along a downward unit `direction`, both in metres.

    Ground shrinks by the cosine of the tilt along the direction's azimuth and keeps its scale across: a symmetric
    matrix, so that nothing turns, before y is counted southwards. Opposite azimuths have the same view.
    """
    length = float(np.hypot(direction[0], direction[1]))
    axis = direction[:2] / length if length > 0.0 else np.zeros(2)
    return np.diag([1.0, -1.0]) @ (np.eye(2) - (1.0 + float(direction[2])) * np.outer(axis, axis))


def common_stretch(ray0: FloatArray, ray1: FloatArray) -> tuple[float, float]:
    """How unequally two cameras together resolve ground that they see along the downward rays (3,).

    Returns the stretch, >= 1, and the azimuth in radians, in [0, pi), of the coarser axis. A camera's blur on the
    ground has the covariance I + tan(tilt)^2 a a^T, a being the azimuth of its look; what both can agree on has the
    sum. Looks of crossed azimuths blur each other's sharp axis: then the stretch is near 1.
    """
    terms = [np.outer(ray[:2], ray[:2]) / float(ray[2]) ** 2 for ray in (ray0, ray1)]
    blur = 2.0 * np.eye(2) + (terms[0] + terms[1])
    values, vectors = np.linalg.eigh(blur)
    azimuth = float(np.arctan2(vectors[1, 1], vectors[0, 1])) % np.pi
    return float(np.sqrt(values[1] / values[0])), azimuth if azimuth < np.pi else 0.0


def nearest_sample(stretch: float, azimuth_rad: float) -> tuple[int, int]:
    """Level of the tilt and number of the azimuth, among `tilt_azimuths_rad`, nearest to a stretch and its azimuth.

    Both are fixed to the world: two cameras get the same view of the same direction.
    """
    level = max(0, round(float(np.log(stretch) / np.log(TILT_STEP))))
    count = len(tilt_azimuths_rad(level))
    return level, round(azimuth_rad * count / np.pi) % count


def intersection(polygon_m: FloatArray, convex_m: FloatArray, margin_m: float = 0.0) -> FloatArray:
    """The part (M, 2) of a polygon (N, 2) that lies within margin_m of a convex one, whose corners stay sharp."""
    if len(convex_m) < 3:
        return polygon_m[:0]
    edges = np.roll(convex_m, -1, axis=0) - convex_m
    lengths = np.hypot(edges[:, 0], edges[:, 1])
    starts, edges = convex_m[lengths > 0.0], edges[lengths > 0.0]
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / lengths[lengths > 0.0][:, None]
    outward = ((convex_m.mean(axis=0) - starts) * normals).sum(axis=1) <= 0.0
    normals[~outward] *= -1.0
    limits = (starts * normals).sum(axis=1) + margin_m
    for normal, limit in zip(normals, limits, strict=True):
        beyond = polygon_m @ normal - limit
        if (beyond > 0.0).any():
            polygon_m = clip_half_plane(polygon_m, beyond)
            if len(polygon_m) < 3:
                return polygon_m[:0]
    return polygon_m
