"""The bundle adjustment: least squares of a network by Levenberg and Marquardt's method, and its covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.orientation.bundle.network import Network, Unknowns
from aeromatch_cli.orientation.bundle.normal_equations import Layout, Reduced, cost, equations, reduced

if TYPE_CHECKING:
    from scipy import sparse
    from scipy.sparse.linalg import SuperLU

# The damping of the first step, the bounds, and by how much it changes from step to step.
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-9, 1e6
_EASED, _RAISED = 0.2, 6.0
# Near the solution steps begin with less; only with less than this does a small step mean that it is reached: damping
# holds back what the observations hardly tell apart, such as affinity and rolling shutter, or focal length and height.
_NEAR_DAMPING, _FREE_DAMPING = 1e-7, 1e-6
_MAX_STEPS = 60
# Up to so many unknowns the reduced equations are solved as a full matrix, beyond as a sparse one.
_FULL_SIZE = 4000


@dataclass(frozen=True, eq=False)
class Solved:
    """state: values of the unknowns; cost: half the sum of squares; steps: that were taken."""

    state: Unknowns
    cost: float
    steps: int


def solve(network: Network, state: Unknowns, tolerance: float, *, near: bool = False) -> Solved:
    """The unknowns nearest to all observations, from where `state` puts them.

    tolerance: it ends when a step lowers the cost by a smaller share. near: whether `state` is a solution but for some
    unknowns or weights.
    """
    best, damping, step = cost(network, state), _NEAR_DAMPING if near else _DAMPING, 0
    while step < _MAX_STEPS:
        made = equations(network, state)
        while damping <= _MOST_DAMPING:
            tried = _moved(network, state, reduced(made, damping))
            found = np.inf if tried is None else cost(network, tried)
            if tried is not None and found < best:
                break
            damping *= _RAISED
        else:
            break
        assert tried is not None
        step += 1
        gain, best, state = 1.0 - found / best, found, tried
        settled = gain < tolerance
        if settled and damping <= _FREE_DAMPING:
            break
        damping = max((_EASED**2 if settled else _EASED) * damping, _LEAST_DAMPING)
    return Solved(state, best, step)


def _moved(network: Network, state: Unknowns, normals: Reduced) -> Unknowns | None:
    """The unknowns after one step, None where the equations have no solution."""
    from scipy.spatial.transform import Rotation

    change = _solution(normals)
    if not np.isfinite(change).all():
        return None
    turned, lens, mount, flight = Layout.of(network).parts(change)
    by_images = normals.point_right + (normals.coupling.T @ change).reshape(-1, 3)
    points_m = state.points_m - np.einsum("pij,pj->pi", normals.inverses, by_images)
    rotations = Rotation.from_rotvec(turned[:, :3]).as_matrix() @ state.rotations
    parts = state.centers_m + turned[:, 3:], points_m, state.lens + lens, state.mount + mount, state.flight + flight
    return Unknowns(rotations, *parts)


def _solution(normals: Reduced) -> FloatArray:
    """The change (6 B,) of all unknowns but points."""
    from scipy import linalg, sparse

    scale = 1.0 / np.sqrt(np.maximum(normals.matrix.diagonal(), 1e-300))
    right = -normals.right * scale
    try:
        if len(right) <= _FULL_SIZE:
            full = scale[:, None] * normals.matrix.toarray() * scale
            factor = linalg.cho_factor(full, lower=True, overwrite_a=True, check_finite=False)
            return np.asarray(scale * linalg.cho_solve(factor, right, check_finite=False))
        scaled = sparse.diags(scale) @ normals.matrix @ sparse.diags(scale)
        return np.asarray(scale * factorised(scaled).solve(right))
    except (linalg.LinAlgError, RuntimeError):  # not positive definite, singular
        return np.full(len(right), np.nan)


def factorised(matrix: sparse.csr_matrix) -> SuperLU:
    """The factors of a symmetric, positive definite matrix, ordered for few of them."""
    from scipy import sparse

    return sparse.linalg.splu(
        matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
