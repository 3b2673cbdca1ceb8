"""The adjustment of a network: exact observations, its derivatives, and what is held."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from make_networks import (
    BENT,
    UNKNOWN_LENS,
    cross_strips,
    disturbed,
    flight,
    lens,
    mount,
    moved,
    simulated,
    strips,
    with_lens_prior,
    with_positions,
)
from scipy import linalg, sparse

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import angle_between_deg
from aeromatch_cli.sfm.bundle.network import FLIGHT, LENS, MOUNT, Network, Unknowns
from aeromatch_cli.sfm.bundle.normal_equations import (
    Equations,
    Layout,
    cost,
    equations,
    reduced,
    residuals_in_sigmas,
)
from aeromatch_cli.sfm.bundle.solve import _solution, solve

EXACT = 1e-14


def attitudes_of(network: Network, truth: Unknowns, sigma_deg: float) -> Network:
    """Measured attitudes without errors but the boresight of the truth."""
    from scipy.spatial.transform import Rotation

    boresight = Rotation.from_rotvec(truth.mount[network.camera, :3]).as_matrix()
    sigmas = np.full((network.images, 3), np.deg2rad(sigma_deg))
    return replace(network, attitudes=boresight @ truth.rotations, attitude_sigmas=sigmas)


def everything(seed: int = 0, points: int = 90) -> tuple[Network, Unknowns]:
    """Two flights with all kinds of observations and unknowns, all exact."""
    levers = mount(boresight_x=0.004, boresight_y=-0.003, boresight_z=0.006, lever_x=0.3, lever_y=-0.2, lever_z=0.1)
    flights = np.array([flight(), flight(shift_x=0.6, shift_y=-0.4, shift_z=1.1, lag_s=0.15)])
    crossing = cross_strips(2, 4)  # a delay along one line alone would be a shift as well
    crossing = replace(crossing, flights=crossing.flights + 1)
    plan = strips(2, 4, flights=True).and_then(crossing)
    bent = BENT + lens(f=0.0, cx=0.0, cy=0.0, readout_s=0.02)
    network, truth = simulated(plan, seed=seed, points=points, true_lens=bent, true_mount=levers, true_flights=flights)
    network = with_positions(network, truth, np.random.default_rng(seed), 0.02, noise_m=0.0)
    network = with_lens_prior(attitudes_of(network, truth, 0.1), lens(), **UNKNOWN_LENS, readout_s=0.03)
    loose = replace(network, lens_sigmas=network.lens_sigmas * 1e6)
    free_lever = np.array([[1e3] * 3 + [1e4] * 3])
    shifts = np.array([[0.0] * 6, [1e4, 1e4, 1e4, 1e4, 0.0, 0.0]])
    return replace(loose, mount_sigmas=free_lever, flight_sigmas=shifts), truth


def test_exact_observations_are_recovered() -> None:
    network, truth = everything()
    found = solve(network, disturbed(network, truth, np.random.default_rng(1)), EXACT)
    assert found.cost < 1e-6
    np.testing.assert_allclose(found.state.centers_m, truth.centers_m, atol=1e-6)
    np.testing.assert_allclose(found.state.points_m, truth.points_m, atol=1e-5)
    np.testing.assert_allclose(found.state.rotations, truth.rotations, atol=1e-6)
    np.testing.assert_allclose(found.state.lens, truth.lens, atol=1e-4)
    np.testing.assert_allclose(found.state.mount, truth.mount, atol=1e-6)
    np.testing.assert_allclose(found.state.flight, truth.flight, atol=1e-6)


@pytest.mark.parametrize("fisheye", [False, True])
def test_positions_and_image_points_alone_give_the_poses(fisheye: bool) -> None:
    true_lens = lens(f=900.0, k1=0.03, k2=-0.01) if fisheye else lens()
    network, truth = simulated(strips(2, 4), points=80, fisheye=fisheye, true_lens=true_lens)
    network = with_positions(network, truth, np.random.default_rng(0), 0.05, noise_m=0.0)
    found = solve(network, disturbed(network, truth, np.random.default_rng(1), metres=3.0, degrees=2.0), EXACT).state
    np.testing.assert_allclose(found.centers_m, truth.centers_m, atol=1e-6)
    np.testing.assert_allclose(found.points_m, truth.points_m, atol=1e-6)
    assert max(angle_between_deg(a, b) for a, b in zip(found.rotations, truth.rotations, strict=True)) < 1e-5


def test_a_turn_that_positions_hardly_hold_takes_a_few_steps() -> None:
    """One strip whose positions are exact to 5 m tells hardly how it lies about its own line."""
    from scipy.spatial.transform import Rotation

    network, truth = simulated(strips(1, 8), points=200)
    network = with_positions(network, truth, np.random.default_rng(0), 5.0, noise_m=3.0)
    settled = solve(network, truth, 1e-9)
    along = truth.centers_m[-1] - truth.centers_m[0]
    turn, middle_m = Rotation.from_rotvec(np.deg2rad(8.0) * along / np.linalg.norm(along)), truth.centers_m.mean(axis=0)
    turned = replace(
        settled.state,
        rotations=settled.state.rotations @ turn.as_matrix().T,
        centers_m=middle_m + turn.apply(settled.state.centers_m - middle_m),
        points_m=middle_m + turn.apply(settled.state.points_m - middle_m),
    )
    found = solve(network, turned, 1e-9)
    assert max(settled.steps, found.steps) < 30
    assert found.cost == pytest.approx(settled.cost, abs=1e-6)


def test_derivatives_of_all_observations_are_those_of_differences() -> None:
    """At the truth, where residuals are zero and the loss weighs nothing; the boresight is small."""
    network, truth = everything(points=25)
    made = equations(network, truth)
    analytic = dense(network, made)
    size = analytic.shape[1]
    differences = np.empty_like(analytic)
    free = np.concatenate([~made.held, np.ones(size - len(made.held), dtype=bool)])
    for column in range(size):
        step = 1e-6 * np.eye(size)[column]
        ends = [np.concatenate(equations(network, moved(truth, sign * step)).residuals) for sign in (1.0, -1.0)]
        differences[:, column] = (ends[0] - ends[1]) / 2e-6 * free[column]
    scale = np.maximum(np.abs(differences).max(axis=0), 1e-12)
    off = np.abs(analytic[: len(differences)] - differences) / scale
    images = 2 * len(network.image)
    assert off[:images].max() < 1e-4
    assert off[images:].max() < 0.01  # attitudes: to the first order of the boresight
    first = 6 * network.images + 12
    positions = slice(images, images + 3 * network.images)
    assert off[positions].max() < 1e-6
    assert np.abs(differences[positions, first + MOUNT.index("lever_x")]).max() > 1.0
    assert np.abs(differences[positions, first + 6 + 6 + FLIGHT.index("lag_s")]).max() > 100.0


def dense(network: Network, made: Equations) -> FloatArray:
    """The whole Jacobian, points included."""
    parts = [part.toarray() for part in made.rows]
    by_poses = np.concatenate(parts)
    by_points = np.zeros((len(by_poses), 3 * len(made.point_normals)))
    for row, point in enumerate(network.point):
        by_points[2 * row : 2 * row + 2, 3 * point : 3 * point + 3] = made.by_point[row]
    return np.concatenate([by_poses, by_points], axis=1)


def test_the_reduced_solution_is_that_of_the_whole_system() -> None:
    network, truth = everything(seed=4)
    known = np.array([3, 7])
    control_m = truth.points_m[known] + 0.1
    network = replace(network, control=known, control_m=control_m, control_sigmas_m=np.full((2, 3), 0.05))
    start = disturbed(network, truth, np.random.default_rng(2), metres=0.05, degrees=0.02)
    made = equations(network, start)
    whole, residuals = dense(network, made), np.concatenate(made.residuals)
    control = np.zeros((6, whole.shape[1]))
    control[np.arange(6), 6 * Layout.of(network).blocks + (3 * known[:, None] + np.arange(3)).ravel()] = 20.0
    whole = np.concatenate([whole, control])
    residuals = np.concatenate([residuals, ((start.points_m[known] - network.control_m) / 0.05).ravel()])
    scale = np.linalg.norm(whole, axis=0)
    free = scale > 0.0
    expected = np.zeros(len(scale))
    expected[free] = -np.linalg.lstsq(whole[:, free] / scale[free], residuals, rcond=1e-13)[0] / scale[free]
    normals = reduced(made)
    change = _solution(normals, start.centers_m[:, :2])
    poses = len(change)
    np.testing.assert_array_equal(~free[:poses], made.held)
    tolerance = 1e-6 * np.abs(expected[:poses]).max()
    np.testing.assert_allclose(change, expected[:poses], atol=tolerance, rtol=1e-4)
    by_images = normals.point_right + (normals.coupling.T @ change).reshape(-1, 3)
    points = -np.einsum("pij,pj->pi", normals.inverses, by_images)
    np.testing.assert_allclose(points.ravel(), expected[poses:], atol=1e-6, rtol=1e-4)


def test_control_points_put_a_block_in_its_place() -> None:
    """Five points known to a centimetre move a block that starts 2 m off, without any position."""
    network, truth = simulated(strips(2, 4), points=80)
    seen = np.argsort(-np.bincount(network.point))[:30]
    known = seen[[0, 7, 14, 21, 28]]
    control = {"control": known, "control_m": truth.points_m[known], "control_sigmas_m": np.full((5, 3), 0.01)}
    network = replace(network, **control)
    start = disturbed(network, truth, np.random.default_rng(1))
    start = replace(start, centers_m=start.centers_m + 2.0, points_m=start.points_m + 2.0)
    found = solve(network, start, EXACT).state
    np.testing.assert_allclose(found.points_m, truth.points_m, atol=1e-5)
    np.testing.assert_allclose(found.centers_m, truth.centers_m, atol=1e-5)
    assert network.tie_points.sum() == len(network.point) - np.isin(network.point, known).sum()


def test_what_is_held_stays_bit_for_bit() -> None:
    network, truth = simulated(strips(3, 4), points=80, noise_px=0.5)
    network = with_positions(network, truth, np.random.default_rng(0), 0.5)
    network = with_lens_prior(network, lens(f=1003.0), f=20.0, k1=0.05)
    held = np.arange(network.images) % 3 == 0
    network = replace(network, held=held, flight_sigmas=np.array([[1.0, 0.0, 1.0, 0.0, 0.0, 0.0]]))
    start = disturbed(network, truth, np.random.default_rng(1))
    found = solve(network, start, 1e-10).state
    np.testing.assert_array_equal(found.rotations[held], start.rotations[held])
    np.testing.assert_array_equal(found.centers_m[held], start.centers_m[held])
    assert (np.abs(found.centers_m[~held] - start.centers_m[~held]).max(axis=1) > 1e-4).all()
    free = np.isin(LENS, ["f", "k1"])
    np.testing.assert_array_equal(found.lens[:, ~free], start.lens[:, ~free])
    assert (found.lens[:, free] != start.lens[:, free]).all()
    np.testing.assert_array_equal(found.mount, start.mount)
    np.testing.assert_array_equal(found.flight[:, [1, 3, 4, 5]], 0.0)
    assert abs(found.flight[0, 0]) > 0.0


def test_priors_weigh_by_their_standard_deviations() -> None:
    """Image points that say nothing of the lens: the mean of two priors, weighed."""
    network, truth = simulated(strips(1, 3), points=60)
    network = replace(with_lens_prior(network, lens(f=1010.0), f=5.0), sigma_px=np.full(len(network.point), 1e7))
    network = with_positions(network, truth, np.random.default_rng(0), 0.01, noise_m=0.0)
    network = attitudes_of(network, truth, 0.01)
    found = solve(network, replace(truth, lens=network.lens_prior - 7.0 * (np.arange(12) == 0)), EXACT).state
    assert found.lens[0, 0] == pytest.approx(1010.0, abs=1e-3)


def test_the_cost_is_half_the_sum_of_squares_with_far_points_weighed_down() -> None:
    network, truth = simulated(strips(1, 3), points=40)
    assert cost(network, truth) == pytest.approx(0.0, abs=1e-12)
    off = network.xy_px.copy()
    off[0, 0] += 0.1 * network.sigma_px[0]
    off[1, 1] += 1000.0 * network.sigma_px[1]
    assert residuals_in_sigmas(replace(network, xy_px=off), truth)[:2] == pytest.approx([0.1, 1000.0])
    expected = 0.5 * 9.0 * (np.log1p((0.1 / 3.0) ** 2) + np.log1p((1000.0 / 3.0) ** 2))
    assert cost(replace(network, xy_px=off), truth) == pytest.approx(expected, rel=1e-6)


def test_one_wrong_image_point_moves_nothing_by_much() -> None:
    network, truth = simulated(strips(2, 4), points=80)
    network = with_positions(network, truth, np.random.default_rng(0), 0.02, noise_m=0.0)
    off = network.xy_px.copy()
    off[5] += 300.0
    found = solve(replace(network, xy_px=off), disturbed(network, truth, np.random.default_rng(1)), 1e-12).state
    others = np.arange(len(truth.points_m)) != network.point[5]
    np.testing.assert_allclose(found.points_m[others], truth.points_m[others], atol=0.01)


def test_normal_equations_are_symmetric_and_positive() -> None:
    network, truth = everything(seed=7)
    matrix = reduced(equations(network, truth), 1e-6).matrix
    assert sparse.issparse(matrix)
    full = matrix.toarray()
    np.testing.assert_allclose(full, full.T, atol=1e-9 * np.abs(full).max())
    scale = 1.0 / np.sqrt(np.diag(full))
    assert linalg.eigvalsh(scale[:, None] * full * scale).min() > 0.0
