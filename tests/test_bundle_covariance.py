"""Standard deviations of an adjustment: against repeated measurement, with positions, control and as a free network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from make_networks import PLAIN, cross_strips, moved, simulated, strips, with_lens_prior, with_positions
from scipy.spatial.transform import Rotation

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.sfm.bundle import covariance as deviations
from aeromatch_cli.sfm.bundle.covariance import _free_movements, covariance, lens_correlations, pose_sigmas
from aeromatch_cli.sfm.bundle.network import LENS, Network, Unknowns
from aeromatch_cli.sfm.bundle.normal_equations import equations, reduced
from aeromatch_cli.sfm.bundle.projection import project
from aeromatch_cli.sfm.bundle.solve import solve

SIGMA_PX, REPEATED = 0.5, 40


def network(seed: int = 0) -> tuple[Network, Unknowns]:
    """Image points without errors, which count as SIGMA_PX; nothing else is known, all of the lens is held."""
    exact, truth = simulated(strips(2, 4).and_then(cross_strips(2, 4)), seed=seed, points=60)
    return replace(exact, sigma_px=np.full(len(exact.point), SIGMA_PX)), truth


def measured(given: Network, rng: np.random.Generator) -> Network:
    """All observations with errors as large as they are said to be."""
    off_px = rng.normal(0.0, 1.0, given.xy_px.shape) * given.sigma_px[:, None]
    sigmas_m = np.where(np.isfinite(given.position_sigmas_m), given.position_sigmas_m, 0.0)
    sigmas = np.where(np.isfinite(given.lens_sigmas), given.lens_sigmas, 0.0)
    return replace(
        given,
        xy_px=given.xy_px + off_px,
        positions_m=given.positions_m + rng.normal(0.0, 1.0, sigmas_m.shape) * sigmas_m,
        lens_prior=given.lens_prior + rng.normal(0.0, 1.0, sigmas.shape) * sigmas,
        control_m=given.control_m + rng.normal(0.0, 1.0, given.control_m.shape) * given.control_sigmas_m,
    )


def repeated(given: Network, truth: Unknowns, error: Callable[[Unknowns], FloatArray]) -> FloatArray:
    """Root mean squares of the errors of REPEATED adjustments."""
    rng = np.random.default_rng(1)
    errors = [error(solve(measured(given, rng), truth, 1e-8).state) for _ in range(REPEATED)]
    return np.asarray(np.sqrt(np.mean(np.square(errors), axis=0)))


def all_errors(truth: Unknowns) -> Callable[[Unknowns], FloatArray]:
    """Centres, turns in radians, lens and points one after the other."""

    def of(found: Unknowns) -> FloatArray:
        turns = Rotation.from_matrix(found.rotations @ truth.rotations.transpose(0, 2, 1)).as_rotvec()
        parts = found.centers_m - truth.centers_m, turns, found.lens - truth.lens, found.points_m - truth.points_m
        return np.concatenate([part.ravel() for part in parts])

    return of


def stated(given: Network, truth: Unknowns) -> tuple[FloatArray, ...]:
    found = covariance(given, truth)
    images = np.sqrt(np.diagonal(found.images, axis1=1, axis2=2))
    points = found.of_points(np.arange(len(truth.points_m)))
    return images[:, 3:].ravel(), images[:, :3].ravel(), found.lens_sigmas.ravel(), np.sqrt(np.diag(points))


def compare(given: Network, truth: Unknowns) -> None:
    said = stated(given, truth)
    seen = np.split(repeated(given, truth, all_errors(truth)), np.cumsum([len(part) for part in said])[:-1])
    for one, other in zip(seen, said, strict=True):
        free = other > 0.0
        ratios = one[free] / other[free]
        assert ((ratios > 0.6) & (ratios < 1.5)).all()  # each of 40 measurements
        if free.any():
            assert 0.85 < np.sqrt((ratios**2).mean()) < 1.15
        np.testing.assert_allclose(one[~free], 0.0, atol=1e-12)


@pytest.mark.slow
def test_with_positions_deviations_are_those_of_repeated_measurement() -> None:
    exact, truth = network()
    given = with_positions(exact, truth, np.random.default_rng(0), 0.1, noise_m=0.0)
    compare(given, truth)


@pytest.mark.slow
def test_with_calibration_deviations_are_those_of_repeated_measurement() -> None:
    exact, truth = network()
    given = with_positions(exact, truth, np.random.default_rng(0), 0.1, noise_m=0.0)
    given = with_lens_prior(given, PLAIN, f=10.0, cx=20.0, cy=20.0, k1=0.05, k2=0.1, p1=0.001, p2=0.001)
    compare(given, truth)
    found = covariance(given, truth)
    assert (found.lens_sigmas[0, :5] < given.lens_sigmas[0, :5]).all()
    np.testing.assert_array_equal(found.lens_sigmas[0, [5, 8, 9, 10, 11]], 0.0)


@pytest.mark.slow
def test_with_control_points_alone_deviations_are_those_of_repeated_measurement() -> None:
    exact, truth = network()
    known = np.argsort(-np.bincount(exact.point))[[0, 5, 10, 15, 20, 25]]
    given = replace(exact, control=known, control_m=truth.points_m[known], control_sigmas_m=np.full((6, 3), 0.02))
    compare(given, truth)


@pytest.mark.slow
def test_a_free_networks_deviations_are_those_of_repeated_measurement() -> None:
    """Errors count from where the true centres lie best: moved, turned and scaled."""
    given, truth = network()
    given = with_lens_prior(given, PLAIN, f=10.0)
    found = covariance(given, truth)
    sigmas_m, sigmas_deg = pose_sigmas(given, truth, found)
    free = _free_movements(given, truth, reduced(equations(given, truth)))[: 6 * given.images].reshape(-1, 6, 7)

    def error(state: Unknowns) -> FloatArray:
        turns = Rotation.from_matrix(state.rotations @ truth.rotations.transpose(0, 2, 1)).as_rotvec()
        poses = np.concatenate([turns, state.centers_m - truth.centers_m], axis=1)
        moves = np.linalg.lstsq(free[:, 3:].reshape(-1, 7), poses[:, 3:].ravel(), rcond=None)[0]
        return np.asarray(poses - free @ moves)

    rms = repeated(given, truth, error)
    assert np.sqrt((rms[:, 3:] ** 2).mean(axis=0)) == pytest.approx(np.sqrt((sigmas_m**2).mean(axis=0)), rel=0.2)
    turned_deg = np.rad2deg(np.sqrt((rms[:, :3] ** 2).sum(axis=1).mean()))
    assert turned_deg == pytest.approx(np.sqrt((sigmas_deg**2).sum(axis=1).mean()), rel=0.2)
    assert sigmas_m.max() < 0.5


def test_no_movement_of_the_whole_changes_the_normal_equations() -> None:
    given, truth = network()
    normals = reduced(equations(given, truth))
    free = _free_movements(given, truth, normals)
    assert free.shape[1] == 7
    full = normals.matrix.toarray() - np.diag(normals.held.astype(float))
    usual = np.abs(full).max(axis=0) @ np.abs(free)
    assert (np.abs(full @ free).max(axis=0) < 1e-8 * usual).all()


@pytest.mark.parametrize("place", [(20.0, 20.0, 300.0), (np.nan, 0.0, 0.0), (20.0, np.inf, 0.0)])
def test_a_point_behind_the_images_or_nowhere_changes_nothing(place: tuple[float, float, float]) -> None:
    exact, truth = network()
    given = with_positions(exact, truth, np.random.default_rng(0), 0.1, noise_m=0.0)
    images, points = given.images, len(truth.points_m)
    more = replace(
        given,
        image=np.append(given.image, np.arange(images)),
        point=np.append(given.point, np.full(images, points)),
        xy_px=np.vstack([given.xy_px, np.full((images, 2), 500.0)]),
        sigma_px=np.append(given.sigma_px, np.full(images, SIGMA_PX)),
    )
    state = replace(truth, points_m=np.vstack([truth.points_m, place]))
    found = pose_sigmas(more, state, covariance(more, state))
    for one, other in zip(found, pose_sigmas(given, truth, covariance(given, truth)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)


def test_positions_hold_the_frame() -> None:
    exact, truth = network()
    given = with_positions(exact, truth, np.random.default_rng(0), 0.02, noise_m=0.0)
    sigmas_m, _ = pose_sigmas(given, truth, covariance(given, truth))
    assert (sigmas_m < 0.0201).all()
    turned = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    elsewhere = replace(given, positions_m=given.positions_m @ turned.T)
    state = replace(
        truth,
        rotations=truth.rotations @ turned.T,
        centers_m=truth.centers_m @ turned.T,
        points_m=truth.points_m @ turned.T,
    )
    again, _ = pose_sigmas(elsewhere, state, covariance(elsewhere, state))
    np.testing.assert_allclose(np.linalg.norm(again, axis=1), np.linalg.norm(sigmas_m, axis=1), rtol=1e-6)


def strip(sigma_m: float) -> tuple[Network, Unknowns]:
    """Nine images exactly in a line, with positions."""
    exact, truth = simulated(strips(1, 9), points=150)
    centers_m = np.array([[10.0 * n, 0.0, 100.0] for n in range(9)])
    rng = np.random.default_rng(0)
    rotations = np.array([from_omega_phi_kappa(*rng.normal(0, 3, 3)) for _ in range(9)])
    truth = replace(truth, centers_m=centers_m, rotations=rotations)
    image, point = (grid.ravel() for grid in np.meshgrid(np.arange(9), np.arange(len(truth.points_m)), indexing="ij"))
    exact = replace(exact, image=image, point=point, xy_px=np.zeros((len(image), 2)), sigma_px=np.full(len(image), 0.5))
    given = with_positions(exact, truth, np.random.default_rng(0), sigma_m, noise_m=0.0)
    return replace(given, xy_px=project(given, truth)), truth


def test_a_strip_alone_leaves_its_roll_unknown_unless_something_levels_it() -> None:
    """Positions to 2 m: heading 2 m over the strip's spread, omega by the level alone."""
    given, truth = strip(2.0)
    _, alone = pose_sigmas(given, truth, covariance(given, truth))
    assert np.isnan(alone[:, 0]).all()
    # The tilt of the whole block to 1.5 degrees, as observations of nine images that together are as exact.
    sigmas = np.column_stack([np.full((9, 2), np.deg2rad(1.5) * 3.0), np.full(9, np.inf)])
    level = replace(given, attitudes=truth.rotations, attitude_sigmas=sigmas)
    _, levelled = pose_sigmas(level, truth, covariance(level, truth))
    expected_deg = np.rad2deg(2.0 / np.sqrt((truth.centers_m[:, 0] - 40.0) @ (truth.centers_m[:, 0] - 40.0)))
    np.testing.assert_allclose(levelled[:, 0], 1.5, rtol=0.05)
    np.testing.assert_allclose(levelled[:, 2], expected_deg, rtol=0.1)
    assert (levelled[:, 1] < min(1.5, expected_deg)).all()


def test_an_image_without_points_has_no_deviations() -> None:
    exact, truth = network()
    given = with_positions(exact, truth, np.random.default_rng(0), 0.1, noise_m=0.0)
    keep = given.image != 2
    parts = {name: getattr(given, name)[keep] for name in ("image", "point", "xy_px", "sigma_px")}
    given = replace(given, **parts)
    sigmas_m, sigmas_deg = pose_sigmas(given, truth, covariance(given, truth))
    assert np.isnan(sigmas_m[2]).all()
    assert np.isnan(sigmas_deg[2]).all()
    assert np.isfinite(np.delete(sigmas_m, 2, axis=0)).all()


@pytest.mark.parametrize("positions", [0.1, None])
def test_a_large_blocks_deviations_are_those_of_a_small_one(
    positions: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Movements that are free are held at twelve images meanwhile: the frame of the result is the same."""
    given, truth = simulated(strips(8, 9), points=300)
    given = with_lens_prior(replace(given, sigma_px=np.full(len(given.point), SIGMA_PX)), PLAIN, f=10.0, k1=0.05)
    if positions is not None:
        given = with_positions(given, truth, np.random.default_rng(0), positions, noise_m=0.0)
    large = covariance(given, truth)
    monkeypatch.setattr(deviations, "_TOGETHER", 100)
    small = covariance(given, truth)
    some = np.array([0, 3, 60])
    np.testing.assert_allclose(large.lens_sigmas, small.lens_sigmas, rtol=1e-8)
    np.testing.assert_allclose(large.images, small.images, rtol=1e-6, atol=1e-8 * np.abs(small.images).max())
    np.testing.assert_allclose(np.diag(large.of_points(some)), np.diag(small.of_points(some)), rtol=1e-8)


def test_correlations_are_listed_the_strongest_first() -> None:
    exact, truth = network()
    found = covariance(with_positions(exact, truth, np.random.default_rng(0), 0.1), truth)
    matrix = np.zeros((1, 12, 12))
    f, k1, k2 = (LENS.index(name) for name in ("f", "k1", "k2"))
    matrix[0, [f, k1, k2], [f, k1, k2]] = [4.0, 9.0, 1.0]
    matrix[0, [f, k1], [k1, f]] = 3.0
    matrix[0, [k1, k2], [k2, k1]] = -2.7
    listed = lens_correlations(replace(found, lens=matrix))
    assert [one[:3] for one in listed] == [(0, "k1", "k2"), (0, "f", "k1"), (0, "f", "k2")]
    assert [one[3] for one in listed] == pytest.approx([-0.9, 0.5, 0.0])


def test_a_small_change_is_one_of_the_unknowns() -> None:
    """The frame of the deviations of poses is that of the changes which a step makes."""
    _, truth = network()
    change = np.zeros(6 * len(truth.centers_m) + 24 + 3 * len(truth.points_m))
    change[:6] = [1e-3, 0.0, 0.0, 0.0, 0.5, 0.0]
    found = moved(truth, change)
    np.testing.assert_allclose(found.centers_m[0] - truth.centers_m[0], [0.0, 0.5, 0.0], atol=1e-12)
    turn = Rotation.from_matrix(found.rotations[0] @ truth.rotations[0].T).as_rotvec()
    np.testing.assert_allclose(turn, [1e-3, 0.0, 0.0], atol=1e-12)
