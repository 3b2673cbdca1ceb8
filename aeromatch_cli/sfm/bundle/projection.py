"""Image points of a network with their derivatives: the collinearity equations with Brown's model or a fisheye lens.

The models are those of `geometry.cameras`, which a test compares; here all images are projected at once and with
derivatives. A rolling shutter exposes row by row while the camera moves along: the centre of a row is
C + v * readout * (y / (rows - 1) - 1/2), with y as it was measured (Hedborg et al., CVPR 2012, for a camera that does
not turn meanwhile).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import cross_matrices
from aeromatch_cli.sfm.bundle.network import LENS, READOUT, Network, Unknowns

# Points nearer to the plane of the projection centre than this share of the median depth have no image.
_LEAST_DEPTH = 1e-3


@dataclass(frozen=True, eq=False)
class Projected:
    """Image points and how they move with the unknowns, pixels.

    xy_px: (M, 2), NaN where a point lies behind its camera. by_turn: (M, 2, 3) for a turn (radians) of the camera about
    its own axes; by_point: (M, 2, 3) for a metre in the world, of the centre the opposite; by_lens: (M, 2, 12) by LENS.
    """

    xy_px: FloatArray
    by_turn: FloatArray
    by_point: FloatArray
    by_lens: FloatArray


def local_points(network: Network, state: Unknowns) -> tuple[FloatArray, FloatArray]:
    """Return the observed points (M, 3) in the frames of their cameras, metres, and (M, 3) in the world how far a
    second of read-out moves each one's centre."""
    camera = network.camera[network.image]
    row = network.xy_px[:, 1] / np.maximum(network.rows_px[camera] - 1.0, 1.0) - 0.5
    path_m = network.velocities_m_s[network.image] * row[:, None]
    centers_m = state.centers_m[network.image] + path_m * state.lens[camera, READOUT, None]
    away_m = state.points_m[network.point] - centers_m
    return np.einsum("mij,mj->mi", state.rotations[network.image], away_m), path_m


def project(network: Network, state: Unknowns) -> FloatArray:
    """Return the image points (M, 2) alone, NaN behind the camera."""
    local, _ = local_points(network, state)
    lens = state.lens[network.camera[network.image]]
    u, v = _normalised(local)
    x, y = _distorted(network, lens, u, v)
    return _in_pixels(lens, x, y)


def project_with_derivatives(network: Network, state: Unknowns) -> Projected:
    camera = network.camera[network.image]
    lens = state.lens[camera]
    local, path_m = local_points(network, state)
    u, v = _normalised(local)
    x, y = _distorted(network, lens, u, v)
    slope, by_term = _distortion_derivatives(network, lens, u, v)
    of_xy = np.zeros((len(u), 2, 2))  # pixels by (xd, yd)
    f, b1, b2 = lens[:, LENS.index("f")], lens[:, LENS.index("b1")], lens[:, LENS.index("b2")]
    of_xy[:, 0, 0], of_xy[:, 0, 1], of_xy[:, 1, 1] = f + b1, b2, f
    of_local = np.zeros((len(u), 2, 3))  # (u, v) by local metres
    depth = local[:, 2]
    of_local[:, 0, 0] = of_local[:, 1, 1] = 1.0 / depth
    of_local[:, 0, 2], of_local[:, 1, 2] = -u / depth, -v / depth
    by_local = of_xy @ slope @ of_local
    by_point = by_local @ state.rotations[network.image]
    by_lens = np.zeros((len(u), 2, len(LENS)))
    by_lens[:, :, LENS.index("k1") : LENS.index("b1")] = of_xy @ by_term
    by_lens[:, 0, LENS.index("f")], by_lens[:, 1, LENS.index("f")] = x, y
    by_lens[:, 0, LENS.index("cx")] = by_lens[:, 1, LENS.index("cy")] = 1.0
    by_lens[:, 0, LENS.index("b1")], by_lens[:, 0, LENS.index("b2")] = x, y
    by_lens[:, :, READOUT] = -np.einsum("mij,mj->mi", by_point, path_m)
    return Projected(_in_pixels(lens, x, y), -by_local @ cross_matrices(local), by_point, by_lens)


def _normalised(local: FloatArray) -> tuple[FloatArray, FloatArray]:
    depth, somewhere = local[:, 2], np.isfinite(local).all(axis=1)
    near = _LEAST_DEPTH * float(np.median(np.abs(depth[somewhere]))) if somewhere.any() else 0.0
    depth = np.where(somewhere & (depth > near), depth, np.nan)
    return local[:, 0] / depth, local[:, 1] / depth


def _in_pixels(lens: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    f, cx, cy = lens[:, 0], lens[:, 1], lens[:, 2]
    b1, b2 = lens[:, LENS.index("b1")], lens[:, LENS.index("b2")]
    return np.stack([cx + (f + b1) * x + b2 * y, cy + f * y], axis=1)


def _distorted(network: Network, lens: FloatArray, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    k1, k2, k3, p1, p2 = lens[:, 3:8].T
    r2 = u * u + v * v
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x = u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
    y = v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v
    bent = network.fisheye[network.camera[network.image]]
    if bent.any():
        factor = _fisheye_factor(lens[bent], np.sqrt(r2[bent]))[0]
        x[bent], y[bent] = u[bent] * factor, v[bent] * factor
    return x, y


def _fisheye_factor(lens: FloatArray, radius: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distorted over undistorted radius (M,), its derivative by the radius (M,), and by k1 to k4 (M, 4)."""
    radius = np.maximum(radius, 1e-9)  # on the axis, the limit
    angle = np.arctan(radius)
    terms = lens[:, 3:7]
    powers = angle[:, None] ** (2 * np.arange(1, 5))
    bent = angle * (1.0 + (terms * powers).sum(axis=1))
    slope = (1.0 + (terms * powers * (2 * np.arange(1, 5) + 1)).sum(axis=1)) / (1.0 + radius**2)
    return bent / radius, (slope - bent / radius) / radius, powers * (angle / radius)[:, None]


def _distortion_derivatives(
    network: Network, lens: FloatArray, u: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(M, 2, 2) of (xd, yd) by (u, v), and (M, 2, 5) by k1, k2, k3, p1, p2."""
    k1, k2, k3, p1, p2 = lens[:, 3:8].T
    r2 = u * u + v * v
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    rise = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    slope = np.empty((len(u), 2, 2))
    slope[:, 0, 0] = radial + rise * u * u + 2.0 * p1 * v + 6.0 * p2 * u
    slope[:, 1, 1] = radial + rise * v * v + 6.0 * p1 * v + 2.0 * p2 * u
    slope[:, 0, 1] = slope[:, 1, 0] = rise * u * v + 2.0 * p1 * u + 2.0 * p2 * v
    by_term = np.empty((len(u), 2, 5))
    for term, power in enumerate((r2, r2**2, r2**3)):
        by_term[:, 0, term], by_term[:, 1, term] = u * power, v * power
    by_term[:, 0, 3], by_term[:, 1, 3] = 2.0 * u * v, r2 + 2.0 * v * v
    by_term[:, 0, 4], by_term[:, 1, 4] = r2 + 2.0 * u * u, 2.0 * u * v
    bent = network.fisheye[network.camera[network.image]]
    if bent.any():
        radius = np.sqrt(r2[bent])
        factor, rising, by_k = _fisheye_factor(lens[bent], radius)
        uv = np.stack([u[bent], v[bent]], axis=1)
        outer = np.einsum("mi,mj->mij", uv, uv) * (rising / np.maximum(radius, 1e-9))[:, None, None]
        slope[bent] = outer + factor[:, None, None] * np.eye(2)
        by_term[bent, :, :4] = uv[:, :, None] * by_k[:, None, :]
        by_term[bent, :, 4] = 0.0
    return slope, by_term
