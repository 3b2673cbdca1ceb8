"""Normal equations of a network, with the points eliminated (Triggs et al. 2000, Bundle adjustment: a modern synthesis,
section 6).

Unknowns other than points come in blocks of six: a turn (radians, about the camera's axes) and the centre of every
image, two blocks for every lens, one for every mount and one for every flight (`network`). Points have blocks of three.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.geometry.rotations import cross_matrices
from aeromatch_cli.sfm.bundle.network import SLOPES, Network, Unknowns
from aeromatch_cli.sfm.bundle.projection import project, project_with_derivatives

if TYPE_CHECKING:
    from scipy import sparse

# Derivatives (R, r, 6) by blocks of unknowns, with the numbers (R,) of these.
_Derivatives = list[tuple[IntArray, FloatArray]]
# Image points count less and less beyond so many standard deviations (Cauchy).
LOSS_SIGMAS = 3.0
# What a point behind its camera counts as, standard deviations: no step gains by moving one there.
_BEHIND_SIGMAS = 1e3


@dataclass(frozen=True)
class Layout:
    """States which blocks of six unknowns belong to images, lenses, mounts and flights, in this order."""

    images: int
    cameras: int
    flights: int

    @classmethod
    def of(cls, network: Network) -> Layout:
        return cls(network.images, network.cameras, network.flights)

    @property
    def blocks(self) -> int:
        return self.images + 3 * self.cameras + self.flights

    def lens(self, camera: IntArray) -> IntArray:
        """The first of a lens' two blocks."""
        return self.images + 2 * camera

    def mount(self, camera: IntArray) -> IntArray:
        return self.images + 2 * self.cameras + camera

    def flight(self, flight: IntArray) -> IntArray:
        return self.images + 3 * self.cameras + flight

    def parts(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(N, 6) of images, (K, 12) of lenses, (K, 6) of mounts, (F, 6) of flights."""
        ends = np.cumsum([self.images, 2 * self.cameras, self.cameras])
        images, lens, mount, flight = np.split(unknowns.reshape(-1, 6), ends)
        return images, lens.reshape(-1, 12), mount, flight


@dataclass(frozen=True, eq=False)
class Equations:
    """Residuals in standard deviations and their derivatives.

    rows: derivatives (2 M, 6 B) of image points, then those of positions, attitudes and of what was known before.
    residuals: of the same rows. by_point: (M, 2, 3) of image points by their object points. weights: (M,) of the loss.
    point_normals: (P, 3, 3), point_right: (P, 3). held: (6 B,) unknowns that stay as they are.
    """

    network: Network
    rows: list[sparse.bsr_matrix]
    residuals: list[FloatArray]
    by_point: FloatArray
    weights: FloatArray
    point_normals: FloatArray
    point_right: FloatArray
    held: BoolArray

    @cached_property
    def undamped(self) -> tuple[sparse.bsr_matrix, FloatArray, sparse.bsr_matrix]:
        """Return the parts that do not depend on the damping, points not eliminated: matrix (6 B, 6 B), right-hand side
        (6 B,) and coupling (6 B, 3 P)."""
        from scipy import sparse

        blocks, size = len(self.held), (2 * len(self.by_point), 3 * len(self.point_normals))
        if self.held.all():  # points alone are unknown: all derivatives by others are zero
            matrix = sparse.bsr_matrix((blocks, blocks), blocksize=(6, 6))
            return matrix, np.zeros(blocks), sparse.bsr_matrix((blocks, size[1]), blocksize=(6, 3))
        seen = (self.by_point, self.network.point, np.arange(len(self.by_point) + 1))
        turned = [part.T for part in self.rows]
        matrix = sum((t @ part for t, part in zip(turned[1:], self.rows[1:], strict=True)), turned[0] @ self.rows[0])
        right = sum(t @ off for t, off in zip(turned, self.residuals, strict=True))
        return matrix, right, turned[0] @ sparse.bsr_matrix(seen, shape=size)


@dataclass(frozen=True, eq=False)
class Reduced:
    """Normal equations without points.

    matrix: (6 B, 6 B), right: (6 B,); coupling: (6 B, 3 P); inverses: (P, 3, 3); point_right: (P, 3). others: rows of
    all observations but image points, by the unknowns. held: (6 B,) unknowns that stay as they are.
    """

    matrix: sparse.csr_matrix
    right: FloatArray
    coupling: sparse.bsr_matrix
    inverses: FloatArray
    point_right: FloatArray
    others: list[sparse.bsr_matrix]
    held: BoolArray


def residuals_in_sigmas(network: Network, state: Unknowns) -> FloatArray:
    """Return the distances (M,) of image points from where they were measured, in standard deviations."""
    return _apart(network, project(network, state))


def _apart(network: Network, xy_px: FloatArray) -> FloatArray:
    """Return the distances (M,) of image points from where they were measured, in standard deviations. xy_px: (M, 2)
    projected points, pixels."""
    off = (xy_px - network.xy_px) / network.sigma_px[:, None]
    apart = np.sqrt((off**2).sum(axis=1))
    return np.where(np.isfinite(apart), apart, _BEHIND_SIGMAS)


def cost(network: Network, state: Unknowns) -> float:
    """Return half the sum of squared residuals, those of image points through the loss."""
    apart = residuals_in_sigmas(network, state)
    images = LOSS_SIGMAS**2 * np.log1p((apart / LOSS_SIGMAS) ** 2).sum()
    control = (state.points_m[network.control] - network.control_m) / network.control_sigmas_m
    others = [(r**2).sum() for r in (_positions(network, state)[0], _attitudes(network, state)[0])]
    priors = sum((r**2).sum() for r, _ in _priors(network, state))
    return 0.5 * float(images + (control**2).sum() + sum(others) + priors)


def equations(network: Network, state: Unknowns) -> Equations:
    layout = Layout.of(network)
    seen = project_with_derivatives(network, state)
    apart = _apart(network, seen.xy_px)
    weights = np.where(np.isfinite(seen.xy_px).all(axis=1), 1.0 / (1.0 + (apart / LOSS_SIGMAS) ** 2), 0.0)
    scale = (np.sqrt(weights) / network.sigma_px)[:, None]
    residuals = np.nan_to_num((seen.xy_px - network.xy_px) * scale)
    by_turn, by_point, by_lens = (
        np.nan_to_num(part * scale[:, :, None]) for part in (seen.by_turn, seen.by_point, seen.by_lens)
    )
    camera = network.camera[network.image]
    by_lens = by_lens * (network.lens_sigmas[camera] > 0.0)[:, None, :]
    by_pose = np.concatenate([by_turn, -by_point], axis=2) * ~network.held[network.image, None, None]
    lens = layout.lens(camera)
    rows = [_rows([(network.image, by_pose), (lens, by_lens[:, :, :6]), (lens + 1, by_lens[:, :, 6:])], layout)]
    values: list[FloatArray] = [residuals.ravel()]
    for found, derivatives in (_positions(network, state, layout), _attitudes(network, state, layout)):
        if len(found):
            rows.append(_rows(derivatives, layout))
            values.append(found.ravel())
    priors = _priors(network, state)
    sigmas = np.concatenate([part.reshape(-1, 6) for _, part in priors])
    weight = np.where(sigmas > 0.0, 1.0 / np.where(sigmas > 0.0, sigmas, 1.0), 0.0)
    rows.append(_rows([(_prior_blocks(layout), weight[:, :, None] * np.eye(6))], layout))
    values.append(np.concatenate([found.ravel() for found, _ in priors]))
    normals, right = _of_points(network, state, by_point, residuals)
    return Equations(network, rows, values, by_point, weights, normals, right, _held(network))


def reduced(found: Equations, damping: float = 0.0) -> Reduced:
    """Return the normal equations with the points eliminated. damping: this share of the diagonal is added to it
    (Levenberg-Marquardt)."""
    from scipy import sparse

    matrix, right, coupling = found.undamped
    diagonal = np.diagonal(found.point_normals, axis1=1, axis2=2)
    damped = found.point_normals + (damping * np.maximum(diagonal, 1e-12))[:, :, None] * np.eye(3)
    inverses = np.linalg.pinv(damped, hermitian=True)
    by_points = coupling.data @ inverses[coupling.indices], coupling.indices, coupling.indptr
    eliminated = sparse.bsr_matrix(by_points, shape=coupling.shape) @ coupling.T
    added = damping * matrix.diagonal() + np.where(found.held, 1.0, 0.0)
    each = np.arange(len(added) + 1)
    reduced = (matrix - eliminated).tocsr() + sparse.csr_matrix((added, each[:-1], each), shape=matrix.shape)
    right = right - coupling @ np.einsum("pij,pj->pi", inverses, found.point_right).ravel()
    return Reduced(reduced, right, coupling, inverses, found.point_right, found.rows[1:], found.held)


def _of_points(
    network: Network, state: Unknowns, by_point: FloatArray, residuals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Normal equations of the points alone: (P, 3, 3) and (P, 3)."""
    points = len(state.points_m)
    normals = _summed(network.point, by_point.transpose(0, 2, 1) @ by_point, points)
    right = _summed(network.point, np.einsum("mij,mi->mj", by_point, residuals), points)
    information = 1.0 / network.control_sigmas_m**2
    normals[network.control] += information[:, :, None] * np.eye(3)
    right[network.control] += information * (state.points_m[network.control] - network.control_m)
    return normals, right


def _summed(rows: IntArray, values: FloatArray, count: int) -> FloatArray:
    """(count, ...) sums of values (M, ...) by their rows (M,)."""
    shape = values.shape[1:]
    parts = [np.bincount(rows, values[:, *place], count) for place in np.ndindex(*shape)]
    return np.asarray(np.stack(parts, axis=1).reshape(count, *shape), dtype=np.float64)


def _held(network: Network) -> BoolArray:
    """(6 B,) unknowns that stay as they are."""
    parts = [np.repeat(network.held, 6)]
    parts += [(part == 0.0).ravel() for part in (network.lens_sigmas, network.mount_sigmas, network.flight_sigmas)]
    return np.concatenate(parts)


def _rows(blocks: _Derivatives, layout: Layout) -> sparse.bsr_matrix:
    """(r R, 6 B) of derivatives (R, r, 6) by the blocks of these numbers (R,)."""
    from scipy import sparse

    order = np.stack([numbers for numbers, _ in blocks], axis=1)
    values = np.stack([part for _, part in blocks], axis=1)
    rows, each, height, _ = values.shape
    ends = np.arange(rows + 1) * each
    parts = values.reshape(-1, height, 6), order.ravel(), ends
    return sparse.bsr_matrix(parts, shape=(rows * height, 6 * layout.blocks))


def _positions(network: Network, state: Unknowns, layout: Layout | None = None) -> tuple[FloatArray, _Derivatives]:
    """(R, 3) residuals of measured positions in standard deviations, and with a layout their derivatives."""
    rows = np.flatnonzero(network.located)
    camera, flight = network.camera[rows], network.flight[rows]
    rotations, velocities = state.rotations[rows], network.velocities_m_s[rows]
    lever = state.mount[camera, 3:]
    antennas = state.centers_m[rows] + np.einsum("nji,nj->ni", rotations, lever)
    arms_m = network.arms_m[rows]
    off = antennas + off_by_flight_m(state.flight[flight], velocities, arms_m) - network.positions_m[rows]
    scale = 1.0 / network.position_sigmas_m[rows]
    if layout is None:
        return off * scale, []
    turned = rotations.transpose(0, 2, 1)
    unit = np.broadcast_to(np.eye(3), (len(rows), 3, 3))
    by_pose = np.concatenate([turned @ cross_matrices(lever), unit], axis=2) * ~network.held[rows, None, None]
    by_mount = np.concatenate([np.zeros_like(turned), turned], axis=2)
    rising = np.zeros((len(rows), 3, 2))
    rising[:, 2] = arms_m
    by_flight = np.concatenate([unit, velocities[:, :, None], rising], axis=2)
    by_mount = by_mount * (network.mount_sigmas[camera] > 0.0)[:, None, :]
    by_flight = by_flight * (network.flight_sigmas[flight] > 0.0)[:, None, :]
    numbers = rows, layout.mount(camera), layout.flight(flight)
    parts = by_pose, by_mount, by_flight
    return off * scale, [(n, part * scale[:, :, None]) for n, part in zip(numbers, parts, strict=True)]


def off_by_flight_m(flight: FloatArray, velocities_m_s: FloatArray, arms_m: FloatArray) -> FloatArray:
    """Return by how much (R, 3) positions are off by what was found of their flights (R, 6). arms_m: (R, 2),
    `arms_m`."""
    off_m = flight[:, :3] + velocities_m_s * flight[:, 3:4]
    off_m[:, 2] += (arms_m * flight[:, SLOPES]).sum(axis=1)
    return off_m


def _attitudes(network: Network, state: Unknowns, layout: Layout | None = None) -> tuple[FloatArray, _Derivatives]:
    """(R, 3) differences from measured attitudes about the world's axes in standard deviations, and derivatives."""
    from scipy.spatial.transform import Rotation

    rows = np.flatnonzero(network.levelled)
    if not len(rows):
        return np.zeros((0, 3)), []
    camera = network.camera[rows]
    boresight = Rotation.from_rotvec(state.mount[camera, :3]).as_matrix()
    off = Rotation.from_matrix(network.attitudes[rows].transpose(0, 2, 1) @ boresight @ state.rotations[rows])
    scale = 1.0 / network.attitude_sigmas[rows]
    if layout is None:
        return off.as_rotvec() * scale, []
    turned = state.rotations[rows].transpose(0, 2, 1) * scale[:, :, None]
    padded = np.concatenate([turned, np.zeros_like(turned)], axis=2)
    by_pose = padded * ~network.held[rows, None, None]
    by_mount = padded * (network.mount_sigmas[camera] > 0.0)[:, None, :]
    return off.as_rotvec() * scale, [(rows, by_pose), (layout.mount(camera), by_mount)]


def _priors(network: Network, state: Unknowns) -> list[tuple[FloatArray, FloatArray]]:
    """Residuals of lenses, mounts and flights against what was known of them, in standard deviations; and these."""
    parts = (
        (state.lens - network.lens_prior, network.lens_sigmas),
        (state.mount, network.mount_sigmas),
        (state.flight, network.flight_sigmas),
    )
    return [(np.where(sigmas > 0.0, off / np.where(sigmas > 0.0, sigmas, 1.0), 0.0), sigmas) for off, sigmas in parts]


def _prior_blocks(layout: Layout) -> IntArray:
    """(R,) numbers of blocks, in the order of `_priors`."""
    first = layout.lens(np.arange(layout.cameras))
    lens = np.stack([first, first + 1], axis=1).ravel()
    mounts, flights = layout.mount(np.arange(layout.cameras)), layout.flight(np.arange(layout.flights))
    return np.concatenate([lens, mounts, flights])
