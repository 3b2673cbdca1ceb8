"""Standard deviations of poses: movements that pictures do not see, and a free network against repeated measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.orientation.precision import Observations, _free_movements, _reduced, pose_sigmas

FOCAL_PX = 1000.0


def network(seed: int = 0, error_px: float = 0.5) -> Observations:
    """Nine images 100 m above 200 points that all of them see."""
    rng = np.random.default_rng(seed)
    centers = np.array([[20.0 * (n % 3), 20.0 * (n // 3), 100.0] for n in range(9)]) + rng.normal(0, 1, (9, 3))
    rotations = np.array([from_omega_phi_kappa(*rng.normal(0, 3, 3)) for _ in range(9)])
    points = np.column_stack([rng.uniform(-20, 60, (200, 2)), rng.uniform(0, 20, 200)])
    image, point = (grid.ravel() for grid in np.meshgrid(np.arange(9), np.arange(200), indexing="ij"))
    return Observations(image, point, np.zeros(9, int), rotations, centers, np.array([FOCAL_PX]), points, error_px)


def test_no_movement_of_the_whole_changes_the_normal_equations() -> None:
    seen = network()
    normal, free = _reduced(seen).toarray(), _free_movements(seen)
    moved = np.abs(normal @ free).max(axis=0)
    usual = np.abs(normal).max(axis=0) @ np.abs(free)
    assert (moved < 1e-8 * usual).all()


@pytest.mark.parametrize("place", [(20.0, 20.0, 300.0), (np.nan, 0.0, 0.0), (20.0, np.inf, 0.0)])
def test_a_point_behind_the_images_or_nowhere_changes_nothing(place: tuple[float, float, float]) -> None:
    seen = network()
    more = replace(
        seen,
        image=np.append(seen.image, np.arange(9)),
        point=np.append(seen.point, np.full(9, 200)),
        points_m=np.vstack([seen.points_m, place]),
    )
    known = np.full(9, 0.1), np.full(9, np.inf), np.array([0.01])
    for found, expected in zip(pose_sigmas(more, *known), pose_sigmas(seen, *known), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def adjusted(seen: Observations, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Errors of centres (N, 3) in metres and of attitudes (N, 3) in radians, the frame as the true centres have it:
    one linear adjustment, measured once more with noise."""
    rotations = seen.rotations[seen.image]
    local = np.einsum("mij,mj->mi", rotations, seen.points_m[seen.point] - seen.centers_m[seen.image])
    x, y, z = local.T
    count = len(seen.image)
    jacobian = np.zeros((2 * count, 6 * 9 + 1 + 3 * 200))
    for row in range(count):
        of_local = FOCAL_PX / z[row] * np.array([[1, 0, -x[row] / z[row]], [0, 1, -y[row] / z[row]]])
        turn = np.array([[0, z[row], -y[row]], [-z[row], 0, x[row]], [y[row], -x[row], 0]])
        place = 6 * seen.image[row]
        jacobian[2 * row : 2 * row + 2, place : place + 3] = of_local @ turn
        jacobian[2 * row : 2 * row + 2, place + 3 : place + 6] = -of_local @ rotations[row]
        jacobian[2 * row : 2 * row + 2, 54] = [x[row] / z[row], y[row] / z[row]]
        first = 55 + 3 * seen.point[row]
        jacobian[2 * row : 2 * row + 2, first : first + 3] = of_local @ rotations[row]
    noise = rng.normal(0.0, seen.error_px, (2 * count, 40))
    prior = np.zeros((1, jacobian.shape[1]))
    prior[0, 54] = seen.error_px / 10.0  # the focal length is known to 10 px
    found = np.linalg.lstsq(np.concatenate([jacobian, prior]), np.concatenate([noise, np.zeros((1, 40))]), rcond=1e-9)[
        0
    ]
    poses = found[:54].reshape(9, 6, 40).transpose(2, 0, 1)
    centers, turns = [], []
    for pose in poses:
        free = _free_movements(seen)[:54].reshape(9, 6, 7)
        moved, *_ = np.linalg.lstsq(free[:, 3:].reshape(27, 7), pose[:, 3:].ravel(), rcond=None)
        rest = pose - free @ moved
        centers.append(rest[:, 3:])
        turns.append(rest[:, :3])
    return np.array(centers), np.array(turns)


def test_a_free_networks_deviations_are_those_of_repeated_measurement() -> None:
    seen = network()
    none = np.full(9, np.inf)
    sigmas_m, sigmas_deg = pose_sigmas(seen, none, none, np.array([10.0 / FOCAL_PX]))
    centers, turns = adjusted(seen, np.random.default_rng(1))
    measured_m = np.sqrt((centers**2).mean(axis=(0, 1)))
    assert measured_m == pytest.approx(np.sqrt((sigmas_m**2).mean(axis=0)), rel=0.2)
    measured_deg = np.rad2deg(np.sqrt((turns**2).sum(axis=2).mean()))
    assert measured_deg == pytest.approx(np.sqrt((sigmas_deg**2).sum(axis=1).mean()), rel=0.2)
    assert sigmas_m.max() < 0.5


def test_positions_hold_the_frame() -> None:
    seen = network()
    known = np.full(9, 0.02)
    sigmas_m, _ = pose_sigmas(seen, known, np.full(9, np.inf), np.array([0.01]))
    assert (sigmas_m < 0.0201).all()
    turned = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    moved = Observations(
        seen.image, seen.point, seen.camera, seen.rotations @ turned.T, seen.centers_m @ turned.T, seen.focal_px,
        seen.points_m @ turned.T, seen.error_px,
    )  # fmt: skip
    again, _ = pose_sigmas(moved, known, np.full(9, np.inf), np.array([0.01]))
    np.testing.assert_allclose(np.linalg.norm(again, axis=1), np.linalg.norm(sigmas_m, axis=1), rtol=1e-6)


def test_a_strip_alone_leaves_its_roll_unknown_unless_something_levels_it() -> None:
    """Nine images along x with positions to 2 m: heading 2 m over the strip's spread, omega by the level alone."""
    seen = network()
    centers = np.array([[10.0 * (n - 4), 20.0, 100.0] for n in range(9)])
    strip = replace(seen, centers_m=centers)
    known = np.full(9, 2.0), np.full(9, np.inf), np.array([1e-6])
    _, alone = pose_sigmas(strip, *known)
    assert np.isnan(alone[:, 0]).all()
    _, levelled = pose_sigmas(strip, *known, level_sigma_deg=1.5)
    expected_deg = np.rad2deg(2.0 / np.sqrt((centers[:, 0] ** 2).sum()))
    np.testing.assert_allclose(levelled[:, 0], 1.5, rtol=0.05)
    np.testing.assert_allclose(levelled[:, 2], expected_deg, rtol=0.1)
    assert (levelled[:, 1] < min(1.5, expected_deg)).all()
