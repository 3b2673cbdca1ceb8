"""Standard deviations of what a bundle adjustment has found: the inverse of its reduced normal equations.

They rest on all unknowns together, calibration included. What no observation determines (place, heading and scale of a
block without positions) is left out by inner constraints on the projection centres: errors count from the shape that
fits best then (Meissl 1969; Triggs et al. 2000, section 9). Where positions hold the frame, what they leave open, such
as the turn about a line of images, counts as open by half a turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.geometry.rotations import to_omega_phi_kappa
from aeromatch_cli.sfm.bundle.factors import Factors
from aeromatch_cli.sfm.bundle.network import LENS, Network, Unknowns
from aeromatch_cli.sfm.bundle.normal_equations import Layout, Reduced, equations, reduced

# Up to so many images all are eliminated together.
_TOGETHER = 60
# So many images, all over the block, hold what observations leave free while others are eliminated.
_HOLDING = 12
# A movement of the whole block by its extent, or by a radian, that observations other than image points know to less
# than this is free.
_FREE_INFORMATION = 1e-2
# An angle with a larger standard deviation, degrees, is not determined: about the line of a single strip, say.
_UNDETERMINED_DEG = 45.0


@dataclass(frozen=True, eq=False)
class _Frame:
    """Describes the frame in which errors count. free: (6 B, D) movements of the whole block that no observation sees;
    onto: (D, 6 B) how much of each a change of the unknowns has; known: whether the movements are known as far as they
    can be."""

    free: FloatArray
    onto: FloatArray
    known: bool


@dataclass(frozen=True, eq=False)
class Covariance:
    """images: (N, 6, 6) of a turn about the camera's axes, radians, and of the centre, metres. lens: (K, 12, 12),
    mount: (K, 6, 6), flight: (F, 6, 6); what is held has zeros.
    """

    images: FloatArray
    lens: FloatArray
    mount: FloatArray
    flight: FloatArray
    _normals: Reduced
    _factors: Factors
    _frame: _Frame

    @property
    def lens_sigmas(self) -> FloatArray:
        """(K, 12)."""
        return np.sqrt(np.maximum(np.diagonal(self.lens, axis1=1, axis2=2), 0.0))

    def of_points(self, rows: IntArray) -> FloatArray:
        """(3 R, 3 R) of some points together."""
        from scipy import linalg

        normals, frame = self._normals, self._frame
        own = np.asarray(linalg.block_diag(*normals.inverses[rows]))
        columns = (3 * rows[:, None] + np.arange(3)).ravel()
        moved = (normals.coupling.tocsc()[:, columns].toarray() @ own) * ~normals.held[:, None]
        free = frame.free.T @ moved
        moved -= frame.onto.T @ free
        by_images = moved.T @ self._factors.solve(moved)
        return np.asarray(own + by_images + (np.pi**2 * free.T @ free if frame.known else 0.0))


def covariance(network: Network, state: Unknowns) -> Covariance:
    """Return the covariance of the unknowns at a solution, for residuals as large as the standard deviations of the
    network."""
    layout = Layout.of(network)
    normals = reduced(equations(network, state))
    frame = _frame(network, state, normals)
    factors = _factors(state, normals, frame)
    images, rest = factors.inverse_blocks(layout.images)
    # Of all inverses that the free movements leave, that in the frame.
    by_frame = factors.solve(frame.onto.T)
    among = frame.onto @ by_frame + (np.pi**2 if frame.known else 0.0) * np.eye(frame.free.shape[1])
    first = 6 * layout.images
    shape = layout.images, 6, -1
    if frame.free.size:
        images += _moved(frame.free[:first].reshape(shape), by_frame[:first].reshape(shape), among)
        rest += _moved(frame.free[first:], by_frame[first:], among)
    held = normals.held
    rest *= ~(held[first:, None] | held[first:])
    images *= ~(held[:first].reshape(-1, 6, 1) | held[:first].reshape(-1, 1, 6))
    cameras = layout.cameras
    lens = _diagonal(rest[: 12 * cameras], 12)
    mount = _diagonal(rest[12 * cameras : 18 * cameras, 12 * cameras :], 6)
    flight = _diagonal(rest[18 * cameras :, 18 * cameras :], 6)
    return Covariance(images, lens, mount, flight, normals, factors, frame)


def pose_sigmas(network: Network, state: Unknowns, found: Covariance) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviations (N, 3) of x, y, z in metres and (N, 3) of omega, phi, kappa in degrees.

    NaN stands for unknown: an image without points, an angle that nothing determines.
    """
    turns = np.array([_angles_of_turns(rotation) for rotation in state.rotations])
    angles = np.einsum("nij,njk,nlk->nil", turns, found.images[:, :3, :3], turns)
    sigmas_m = np.sqrt(np.maximum(np.diagonal(found.images[:, 3:, 3:], axis1=1, axis2=2), 0.0))
    sigmas_deg = np.sqrt(np.maximum(np.diagonal(angles, axis1=1, axis2=2), 0.0))
    unseen = np.bincount(network.image, minlength=network.images) == 0
    sigmas_m[unseen], sigmas_deg[unseen] = np.nan, np.nan
    sigmas_deg[sigmas_deg > _UNDETERMINED_DEG] = np.nan
    return sigmas_m, sigmas_deg


def lens_correlations(found: Covariance) -> list[tuple[int, str, str, float]]:
    """Return the camera, two of its unknowns and their correlation, the strongest first."""
    listed: list[tuple[int, str, str, float]] = []
    for camera, matrix in enumerate(found.lens):
        free = np.flatnonzero(np.diag(matrix) > 0.0)
        sigmas = np.sqrt(np.diag(matrix)[free])
        related = matrix[np.ix_(free, free)] / np.outer(sigmas, sigmas)
        pairs = combinations(range(len(free)), 2)
        listed += [(camera, LENS[free[i]], LENS[free[j]], float(related[i, j])) for i, j in pairs]
    return sorted(listed, key=lambda one: -abs(one[3]))


def _diagonal(matrix: FloatArray, size: int) -> FloatArray:
    """(B, size, size) blocks on the diagonal of a matrix that may be wider than it is high."""
    count = len(matrix) // size
    parts = [matrix[k : k + size, k : k + size] for k in range(0, count * size, size)]
    return np.array(parts).reshape(-1, size, size)


def _in_world(network: Network) -> bool:
    """Whether something holds the frame of the world: deviations are those in it, not those of the shape."""
    return bool(network.located.any() or len(network.control))


def _free_movements(network: Network, state: Unknowns, normals: Reduced) -> FloatArray:
    """(6 B, D) movements of the whole block that no observation sees: of three shifts, three turns and the scale."""
    layout, centers_m = Layout.of(network), state.centers_m
    away_m = centers_m - centers_m.mean(axis=0)
    extent_m = float(np.sqrt((away_m**2).sum(axis=1).mean())) or 1.0
    columns = np.zeros((len(away_m), 6, 7))
    columns[:, 3:, :3] = extent_m * np.eye(3)
    columns[:, :3, 3:6] = -state.rotations
    for axis in range(3):
        columns[:, 3:, 3 + axis] = np.cross(np.eye(3)[axis], away_m)
    columns[:, 3:, 6] = away_m
    movements = np.zeros((6 * layout.blocks, 7))
    movements[: 6 * layout.images] = columns.reshape(-1, 7)
    if network.held.any():
        return movements[:, :0]
    others = sum((part.T @ (part @ movements) for part in normals.others), start=np.zeros_like(movements))
    strengths, axes = np.linalg.eigh(movements.T @ others + _of_control(network, state, extent_m))
    return np.asarray(movements @ axes[:, strengths < _FREE_INFORMATION])


def _of_control(network: Network, state: Unknowns, extent_m: float) -> FloatArray:
    """(7, 7) what control points say of the movements."""
    away_m = state.points_m[network.control] - state.centers_m.mean(axis=0)
    moved = np.zeros((len(away_m), 3, 7))
    moved[:, :, :3] = extent_m * np.eye(3)
    for axis in range(3):
        moved[:, :, 3 + axis] = np.cross(np.eye(3)[axis], away_m)
    moved[:, :, 6] = away_m
    observed = (moved / network.control_sigmas_m[:, :, None]).reshape(-1, 7)
    return np.asarray(observed.T @ observed)


def _frame(network: Network, state: Unknowns, normals: Reduced) -> _Frame:
    """Return the frame of a free network, or that of the world, which counts as known as far as observations determine
    it."""
    free = _free_movements(network, state, normals)
    if _in_world(network):
        # Apart from the free movements, as unknowns in units of what observations know of each.
        diagonal = normals.matrix.diagonal()
        scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))[:, None]
        return _Frame(free, np.asarray(np.linalg.pinv(scale * free) * scale.T), known=True)
    at_centers = np.zeros((len(free), 1))
    at_centers.reshape(-1, 6)[: network.images, 3:] = 1.0
    return _Frame(free, np.asarray(np.linalg.pinv(at_centers * free)), known=False)


def _factors(state: Unknowns, normals: Reduced, frame: _Frame) -> Factors:
    """Factorise the normal equations with the free movements held at some images; this gives one of the inverses that
    they leave."""
    from scipy import sparse

    images, diagonal = len(state.centers_m), normals.matrix.diagonal()
    seen = np.flatnonzero(diagonal[: 6 * images].reshape(-1, 6).all(axis=1))
    some = np.linspace(0, len(seen) - 1, min(len(seen), _HOLDING)).astype(int)
    holding = seen[some] if images > _TOGETHER else np.arange(images)
    scale = np.zeros((len(diagonal), 1))
    scale.reshape(-1, 6)[holding] = np.sqrt(diagonal.reshape(-1, 6)[holding])
    held = sparse.csr_matrix(scale * np.linalg.qr(scale * frame.free)[0])
    return Factors((normals.matrix + held @ held.T).tocsr(), state.centers_m[:, :2], holding)


def _moved(free: FloatArray, by_frame: FloatArray, among: FloatArray) -> FloatArray:
    """Return what the frame adds to blocks (..., r, r) of the inverse on its diagonal, from rows (..., r, D) of the
    free movements and of the inverse by the frame, and from the inverse among the movements (D, D)."""
    crossed = free @ by_frame.swapaxes(-1, -2)
    return np.asarray(free @ among @ free.swapaxes(-1, -2) - crossed - crossed.swapaxes(-1, -2))


def _angles_of_turns(rotation: FloatArray) -> FloatArray:
    """(3, 3) change of omega, phi, kappa in degrees for a small turn, in radians, in the camera's frame."""
    from scipy.spatial.transform import Rotation

    step = 1e-5
    columns = []
    for turn in np.eye(3) * step:
        ends = [to_omega_phi_kappa(Rotation.from_rotvec(s * turn).as_matrix() @ rotation) for s in (1.0, -1.0)]
        change = (np.array(ends[0]) - np.array(ends[1]) + 180.0) % 360.0 - 180.0
        columns.append(change / (2.0 * step))
    return np.array(columns).T
