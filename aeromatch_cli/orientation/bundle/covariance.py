"""Standard deviations of what a bundle adjustment has found: the inverse of its reduced normal equations.

They rest on all unknowns together, calibration included. What no observation determines (place, heading and scale of a
block without positions) is left out by inner constraints on the projection centres: errors count from the shape that
fits best then (Meissl 1969; Triggs et al. 2000, section 9). Where positions hold the frame, what they leave open, such
as the turn about a line of images, counts as open by half a turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.geometry.rotations import to_omega_phi_kappa
from aeromatch_cli.orientation.bundle.network import LENS, Network, Unknowns
from aeromatch_cli.orientation.bundle.normal_equations import Layout, Reduced, equations, reduced
from aeromatch_cli.orientation.bundle.solve import factorised

if TYPE_CHECKING:
    from scipy import sparse

# More unknowns than this would need too much memory for a full inverse: each image is taken by itself then, its
# neighbours as known, which gives too small deviations; calibrations are exact all the same.
_MAX_TOGETHER = 9600
# Where poses are not wanted, fewer unknowns than this are inverted as a whole.
_MAX_SMALL = 1200
# A movement of the whole block by its extent, or by a radian, that observations other than image points know to less
# than this is free.
_FREE_INFORMATION = 1e-2
# An angle with a larger standard deviation, degrees, is not determined: about the line of a single strip, say.
_UNDETERMINED_DEG = 45.0


@dataclass(frozen=True, eq=False)
class Covariance:
    """images: (N, 6, 6) of a turn about the camera's axes, radians, and of the centre, metres. lens: (K, 12, 12),
    mount: (K, 6, 6), flight: (F, 6, 6); what is held has zeros. whole: (6 B, 6 B) of all unknowns but points, None for
    large blocks. normals: what they come from.
    """

    images: FloatArray
    lens: FloatArray
    mount: FloatArray
    flight: FloatArray
    whole: FloatArray | None
    normals: Reduced

    @property
    def lens_sigmas(self) -> FloatArray:
        """(K, 12)."""
        return np.sqrt(np.maximum(np.diagonal(self.lens, axis1=1, axis2=2), 0.0))

    def of_points(self, rows: IntArray) -> FloatArray:
        """(3 R, 3 R) of some points together; of large blocks with all images as they are."""
        from scipy import linalg

        own = np.asarray(linalg.block_diag(*self.normals.inverses[rows]))
        if self.whole is None:
            return own
        columns = (3 * rows[:, None] + np.arange(3)).ravel()
        moved = self.normals.coupling.tocsc()[:, columns].toarray() @ own
        return np.asarray(own + moved.T @ self.whole @ moved)


def covariance(network: Network, state: Unknowns, *, of_poses: bool = True) -> Covariance:
    """Of the unknowns at a solution, for residuals as large as the standard deviations of the network.

    of_poses: whether those of images are wanted; without them a block of many images takes far less time, and those of
    lenses, mounts and flights are the same.
    """
    layout = Layout.of(network)
    normals = reduced(equations(network, state))
    size, held = 6 * layout.blocks, normals.held
    first = 6 * layout.images
    if size <= (_MAX_TOGETHER if of_poses else _MAX_SMALL):
        whole = _inverse(normals.matrix.toarray(), _free_movements(network, state, normals), _in_world(network))
        whole *= ~(held[:, None] | held)
        blocks = np.array([whole[k : k + 6, k : k + 6] for k in range(0, size, 6)])
        rest = whole[first:, first:]
    else:
        whole, rows = None, normals.matrix.tocsr()
        blocks = np.array([np.linalg.pinv(rows[k : k + 6, k : k + 6].toarray()) for k in range(0, size, 6)])
        rest = _of_last(rows, first) * ~(held[first:, None] | held[first:])
    cameras = layout.cameras
    lens = _diagonal(rest[: 12 * cameras], 12)
    mount = _diagonal(rest[12 * cameras : 18 * cameras, 12 * cameras :], 6)
    flight = _diagonal(rest[18 * cameras :, 18 * cameras :], 6)
    return Covariance(blocks[: layout.images], lens, mount, flight, whole, normals)


def pose_sigmas(network: Network, state: Unknowns, found: Covariance) -> tuple[FloatArray, FloatArray]:
    """Standard deviations (N, 3) of x, y, z in metres and (N, 3) of omega, phi, kappa in degrees.

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
    """Camera, two of its unknowns and their correlation, the strongest first."""
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


def _of_last(matrix: sparse.csr_matrix, first: int) -> FloatArray:
    """The inverse's last rows and columns, from `first` on."""
    from scipy import sparse

    scale = 1.0 / np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    scaled = sparse.diags(scale) @ matrix @ sparse.diags(scale) + 1e-12 * sparse.identity(len(scale))
    columns = np.zeros((len(scale), len(scale) - first))
    columns[first:] = np.diag(scale[first:])
    return np.asarray(scale[first:, None] * factorised(scaled).solve(columns)[first:])


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


def _inverse(normal: FloatArray, free: FloatArray, in_world: bool) -> FloatArray:
    """Covariance of normal equations; with movements that they leave free, that of a free network, or of one whose
    frame is known as far as it is."""
    from scipy import linalg

    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))  # radians, metres and pixels alike
    basis = np.linalg.qr(free / scale[:, None])[0]
    scaled = scale[:, None] * normal * scale + basis @ basis.T
    try:
        factor = linalg.cho_factor(scaled, lower=True, check_finite=False)
        inverse = linalg.cho_solve(factor, np.eye(len(normal)), check_finite=False)
    except linalg.LinAlgError:  # an image that its points do not determine
        inverse = np.linalg.pinv(scaled, hermitian=True)
    covariance = scale[:, None] * (inverse - basis @ basis.T) * scale
    if not free.shape[1]:
        return np.asarray(covariance)
    if in_world:
        return np.asarray(covariance + (np.pi * free) @ (np.pi * free).T)
    # From the shape that fits best in the scaled unknowns to that in the projection centres.
    at_centers = np.zeros(len(normal))
    at_centers.reshape(-1, 6)[:, 3:] = free.reshape(-1, 6, free.shape[1])[:, 3:].any(axis=2)
    onto = np.linalg.pinv(free * at_centers[:, None]) * at_centers
    half = covariance - free @ (onto @ covariance)
    return np.asarray(half - (half @ onto.T) @ free.T)


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
