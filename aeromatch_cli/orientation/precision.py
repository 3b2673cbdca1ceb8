"""Standard deviations of adjusted poses: the inverse of the reduced normal equations of a bundle adjustment.

Unknowns are the rotation and centre of every image, one focal length per camera and the points, which are eliminated
(Triggs et al. 2000, Bundle adjustment: a modern synthesis, section 6). Distortion counts as known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.geometry.rotations import to_omega_phi_kappa

if TYPE_CHECKING:
    from scipy import sparse

# More images than this would need too much memory: each is taken by itself then, its neighbours as known.
_MAX_TOGETHER = 1500
# Two centres are the whole frame where nothing else holds it: they have no errors in it.
_LEAST_IMAGES = 3
# An angle with a larger standard deviation, degrees, is not determined: about the line of a single strip, say.
_UNDETERMINED_DEG = 45.0


@dataclass(frozen=True, eq=False)
class Observations:
    """Points as images see them.

    image, point: (M,) rows of the arrays below. camera: (N,) row of each image's camera. rotations: (N, 3, 3)
    cam_from_world, centers_m: (N, 3), focal_px: (K,), points_m: (P, 3). error_px: standard deviation of a
    measured coordinate.
    """

    image: IntArray
    point: IntArray
    camera: IntArray
    rotations: FloatArray
    centers_m: FloatArray
    focal_px: FloatArray
    points_m: FloatArray
    error_px: float


def pose_sigmas(
    seen: Observations,
    sigmas_position_m: FloatArray,
    sigmas_angle_deg: FloatArray,
    sigmas_focal: FloatArray,
    level_sigma_deg: float = np.inf,
) -> tuple[FloatArray, FloatArray]:
    """Standard deviations (N, 3) of x, y, z in metres and (N, 3) of omega, phi, kappa in degrees.

    NaN stands for unknown: an image without points, an angle that nothing determines. Of more than 1,500 images each
    is taken with the others as known, which gives too small ones.

    sigmas_position_m, sigmas_angle_deg: (N,) of the observed positions and attitudes, inf where there is none.
    sigmas_focal: (K,) of the focal lengths before the adjustment, as a share. level_sigma_deg: of the tilt of the
    whole block, where something else than positions levels it. Without any position they are those of
    the block's shape, whatever its place and scale.
    """
    from scipy import sparse

    seen = _in_front(seen)
    normal = _reduced(seen)
    images = len(seen.centers_m)
    size = 6 * images
    weights = 1.0 / np.where(np.isfinite(sigmas_position_m), sigmas_position_m, np.inf) ** 2
    diagonal = np.zeros(normal.shape[0])
    for axis in range(3):
        diagonal[axis:size:6] = 1.0 / np.deg2rad(sigmas_angle_deg) ** 2
        diagonal[3 + axis : size : 6] = weights
    diagonal[size:] = 1.0 / (seen.focal_px * sigmas_focal) ** 2
    normal = normal + sparse.diags(diagonal)
    normal = normal + _levelling(seen, level_sigma_deg) if weights.any() else normal
    if images <= _MAX_TOGETHER:
        inverse = _inverse(normal.toarray(), None if weights.any() else _free_movements(seen))
        blocks = np.array([inverse[k : k + 6, k : k + 6] for k in range(0, size, 6)])
    else:
        rows = normal.tocsr()
        blocks = np.array([np.linalg.pinv(rows[k : k + 6, k : k + 6].toarray()) for k in range(0, size, 6)])
    turns = np.array([_angles_of_turns(rotation) for rotation in seen.rotations])
    angles = np.einsum("nij,njk,nlk->nil", turns, blocks[:, :3, :3], turns)
    sigmas_m = np.sqrt(np.maximum(np.diagonal(blocks[:, 3:, 3:], axis1=1, axis2=2), 0.0))
    sigmas_deg = np.sqrt(np.maximum(np.diagonal(angles, axis1=1, axis2=2), 0.0))
    if images < _LEAST_IMAGES and not weights.any():
        sigmas_m[:] = np.nan
    unseen = np.bincount(seen.image, minlength=images) == 0
    sigmas_m[unseen], sigmas_deg[unseen] = np.nan, np.nan
    sigmas_deg[sigmas_deg > _UNDETERMINED_DEG] = np.nan
    return sigmas_m, sigmas_deg


def _in_front(seen: Observations) -> Observations:
    """Without those of points that lie behind the image or nowhere: they say nothing, and one spoils all equations."""
    away_m = seen.points_m[seen.point] - seen.centers_m[seen.image]
    local = np.einsum("mij,mj->mi", seen.rotations[seen.image], away_m)
    front = np.isfinite(local).all(axis=1) & (local[:, 2] > 0.0)
    return seen if front.all() else replace(seen, image=seen.image[front], point=seen.point[front])


def _levelling(seen: Observations, sigma_deg: float) -> sparse.csr_matrix:
    """What is known of the block's tilt, as observations of every image that together are as exact as that."""
    from scipy import sparse

    images, cameras = len(seen.centers_m), len(seen.focal_px)
    # Nothing is open by more than half a turn: what nothing else determines keeps the equations regular by that.
    sigmas = np.deg2rad([min(sigma_deg, 180.0), min(sigma_deg, 180.0), 180.0])
    across = np.einsum("nij,j,nkj->nik", seen.rotations, 1.0 / (images * sigmas**2), seen.rotations)
    blocks = np.zeros((images, 6, 6))
    blocks[:, :3, :3] = across
    return sparse.csr_matrix(sparse.block_diag([*blocks, np.zeros((cameras, cameras))]))


def _reduced(seen: Observations) -> sparse.csr_matrix:
    """Normal equations (6 N + K, 6 N + K) without the points: of each image a turn in its frame, radians, and its
    centre.
    """
    from scipy import sparse

    images, cameras, points = len(seen.centers_m), len(seen.focal_px), len(seen.points_m)
    rotations = seen.rotations[seen.image]
    local = np.einsum("mij,mj->mi", rotations, seen.points_m[seen.point] - seen.centers_m[seen.image])
    x, y, z = local.T
    focal = seen.focal_px[seen.camera[seen.image]]
    zero = np.zeros_like(x)
    of_local = (focal / z)[:, None, None] * np.stack(
        [np.stack([zero + 1, zero, -x / z], axis=1), np.stack([zero, zero + 1, -y / z], axis=1)], axis=1
    )
    cross = np.stack(
        [np.stack([zero, z, -y], axis=1), np.stack([-z, zero, x], axis=1), np.stack([y, -x, zero], axis=1)], axis=1
    )
    of_point = of_local @ rotations
    of_pose = np.concatenate([of_local @ cross, -of_point], axis=2) / seen.error_px
    of_focal = np.stack([x / z, y / z], axis=1)[:, :, None] / seen.error_px
    columns = 6 * seen.image[:, None] + np.arange(6)
    first = _stacked(of_pose, columns, 6 * images + cameras)
    first = first + _stacked(of_focal, 6 * images + seen.camera[seen.image][:, None], 6 * images + cameras)
    second = _stacked(of_point / seen.error_px, 3 * seen.point[:, None] + np.arange(3), 3 * points)
    normals = np.zeros((points, 3, 3))
    np.add.at(normals, seen.point, np.einsum("mki,mkj->mij", of_point, of_point) / seen.error_px**2)
    inverses = np.linalg.pinv(normals, hermitian=True)
    blocks = sparse.bsr_matrix((inverses, np.arange(points), np.arange(points + 1)), shape=(3 * points, 3 * points))
    coupling = first.T @ second
    return sparse.csr_matrix(first.T @ first - coupling @ blocks @ coupling.T)


def _free_movements(seen: Observations) -> FloatArray:
    """(6 N + K, 7) changes of poses that no picture sees: three shifts, three turns and the scale of the world."""
    away_m = seen.centers_m - seen.centers_m.mean(axis=0)
    columns = np.zeros((len(away_m), 6, 7))
    columns[:, 3:, :3] = np.eye(3)
    columns[:, :3, 3:6] = -seen.rotations
    for axis in range(3):
        columns[:, 3:, 3 + axis] = np.cross(np.eye(3)[axis], away_m)
    columns[:, 3:, 6] = away_m
    return np.concatenate([columns.reshape(-1, 7), np.zeros((len(seen.focal_px), 7))])


def _inverse(normal: FloatArray, free: FloatArray | None) -> FloatArray:
    """Covariance of normal equations; with movements that they leave free, that of a free network.

    Errors count from the shape that fits best then, which no movement of the whole changes (inner constraints: Meissl
    1969; Triggs et al. 2000, section 9).
    """
    if free is None:
        return np.asarray(np.linalg.pinv(normal, hermitian=True))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))  # radians, metres and pixels alike
    basis, _ = np.linalg.qr(free / scale[:, None])
    scaled = scale[:, None] * normal * scale
    covariance = np.linalg.inv(scaled + basis @ basis.T) - basis @ basis.T
    covariance = scale[:, None] * covariance * scale
    # From the shape that fits best in the scaled unknowns to that in the projection centres.
    at_centers = np.zeros(len(normal))
    at_centers[: 6 * (len(normal) // 6)].reshape(-1, 6)[:, 3:] = 1.0
    onto = np.eye(len(normal)) - free @ np.linalg.pinv(free * at_centers[:, None]) * at_centers
    return np.asarray(onto @ covariance @ onto.T)


def _stacked(values: FloatArray, columns: IntArray, width: int) -> sparse.csr_matrix:
    """(2 M, width) of values (M, 2, C) in the given columns (M, C)."""
    from scipy import sparse

    count, _, across = values.shape
    rows = np.repeat(np.arange(2 * count), across)
    places = np.repeat(columns[:, None, :], 2, axis=1).ravel()
    return sparse.csr_matrix((values.ravel(), (rows, places)), shape=(2 * count, width))


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
