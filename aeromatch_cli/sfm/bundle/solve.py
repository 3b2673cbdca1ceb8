"""The bundle adjustment: least squares of a network by Levenberg and Marquardt's method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.sfm.bundle.factors import Factors
from aeromatch_cli.sfm.bundle.network import Network, Unknowns
from aeromatch_cli.sfm.bundle.normal_equations import Layout, Reduced, cost, equations, reduced

# The damping of the first step, the bounds, and by how much it changes from step to step.
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-13, 1e6
_EASED, _RAISED = 0.2, 6.0
# Near the solution steps begin with less; only with less than this does a small step mean that it is reached: damping
# holds back what the observations hardly tell apart, such as affinity and rolling shutter, or focal length and height.
_NEAR_DAMPING, _FREE_DAMPING, _STILL_DAMPING = 1e-8, 1e-6, 1e-8
_MAX_STEPS = 60


@dataclass(frozen=True, eq=False)
class Solved:
    """state: values of the unknowns; cost: half the sum of squares; steps: that were taken."""

    state: Unknowns
    cost: float
    steps: int


def solve(
    network: Network, state: Unknowns, tolerance: float, *, near: bool = False, still_sigmas: float = 0.0
) -> Solved:
    """Return the unknowns nearest to all observations, from where `state` puts them.

    tolerance: it ends when a step lowers the cost by a smaller share. near: whether `state` is a solution but for some
    unknowns or weights. still_sigmas: it also ends when a step moves poses and calibration by less than so many of
    their standard deviations together. Points that outliers hold may move on then, which takes many steps.
    """
    best, damping, step = cost(network, state), _NEAR_DAMPING if near else _DAMPING, 0
    while step < _MAX_STEPS:
        made = equations(network, state)
        while damping <= _MOST_DAMPING:
            tried, moved_sigmas = _moved(network, state, reduced(made, damping))
            found = np.inf if tried is None else cost(network, tried)
            if tried is not None and found < best:
                break
            damping *= _RAISED
        else:
            break
        assert tried is not None
        step += 1
        gain, best, state = 1.0 - found / best, found, tried
        still = moved_sigmas < still_sigmas
        settled = gain < tolerance or still
        if settled and damping <= (_STILL_DAMPING if still else _FREE_DAMPING):
            break
        damping = max((_EASED**2 if settled else _EASED) * damping, _LEAST_DAMPING)
    return Solved(state, best, step)


def _moved(network: Network, state: Unknowns, normals: Reduced) -> tuple[Unknowns | None, float]:
    """The unknowns after one step, None where the equations have no solution; and how far those other than points move,
    in standard deviations of all together."""
    from scipy.spatial.transform import Rotation

    change = _solution(normals, state.centers_m[:, :2])
    if not np.isfinite(change).all():
        return None, np.inf
    turned, lens, mount, flight = Layout.of(network).parts(change)
    by_images = normals.point_right + (normals.coupling.T @ change).reshape(-1, 3)
    to_points_m = -np.einsum("pij,pj->pi", normals.inverses, by_images)
    turn, middle_m = _turn_of_all(network, state, turned), state.centers_m.mean(axis=0)
    rotations = Rotation.from_rotvec(turned[:, :3] + state.rotations @ turn).as_matrix() @ state.rotations
    rotations = rotations @ Rotation.from_rotvec(turn).as_matrix().T
    centers_m = state.centers_m + _along_arc(state.centers_m - middle_m, turned[:, 3:], turn)
    points_m = state.points_m + _along_arc(state.points_m - middle_m, to_points_m, turn)
    parts = centers_m, points_m, state.lens + lens, state.mount + mount, state.flight + flight
    return Unknowns(rotations, *parts), float(np.sqrt(max(change @ (normals.matrix @ change), 0.0)))


def _turn_of_all(network: Network, state: Unknowns, turned: FloatArray) -> FloatArray:
    """(3,) rotation vector about the world's axes by which a step (N, 6) turns the whole block, none where images are
    held.

    Inexact positions, and those of one strip, hardly hold such a turn, so that it may be large. Straight on it would
    move points off their rays by the square of its angle, and only small steps would lower the cost.
    """
    if network.held.any():
        return np.zeros(3)
    return np.asarray(-np.einsum("nji,nj->ni", state.rotations, turned[:, :3]).mean(axis=0))


def _along_arc(places_m: FloatArray, moves_m: FloatArray, turn: FloatArray) -> FloatArray:
    """(K, 3) the moves (K, 3) of places (K, 3), with that part of them which is `turn` (3,) about the origin along its
    arc instead of straight on."""
    from scipy.spatial.transform import Rotation

    rest_m = moves_m - np.cross(turn, places_m)
    ends_m = places_m + rest_m
    return np.asarray(rest_m + Rotation.from_rotvec(turn).apply(ends_m) - ends_m)


def _solution(normals: Reduced, places: FloatArray) -> FloatArray:
    """The change (6 B,) of all unknowns but points; places: (N, 2) of images."""
    try:
        return -Factors(normals.matrix, places).solve(normals.right[:, None])[:, 0]
    except np.linalg.LinAlgError:
        return np.full(len(normals.right), np.nan)
