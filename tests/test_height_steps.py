"""Steps of height between flights: found where tilts of the cameras tell them, and only there."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.sfm.georeferencing import height_steps_m

STEP_M, SPACING_M = 15.0, 60.0
MODEL_FROM_WORLD = from_omega_phi_kappa(40.0, -25.0, 110.0)


def steps_m(
    seed: int,
    *,
    step_m: float = STEP_M,
    tilts: bool = True,
    wrong_deg: float = 0.0,
    of_second: bool = False,
    sigma_m: float = 2.0,
) -> tuple[FloatArray, BoolArray]:
    """What is found of two parallel strips of 8 and 6 images 100 m above ground, and which images are in the second
    flight.

    step_m: by how much its positions are too high. wrong_deg: by how much measured tilts are wrong, about the line of
    flight, of_second: only those of the second flight.
    """
    rng = np.random.default_rng(seed)
    first = np.column_stack([30.0 * np.arange(8), np.zeros(8), np.full(8, 100.0)])
    second = np.column_stack([30.0 * np.arange(6), np.full(6, SPACING_M), np.full(6, 100.0)])
    centers_m = np.concatenate([first, second]) + rng.normal(0.0, 1.0, (14, 3))
    late = np.arange(14) >= 8
    points_m = np.column_stack([
        rng.uniform(-40, 250, 400), rng.uniform(-40, SPACING_M + 40, 400), rng.normal(0.0, 2.0, 400),
    ])  # fmt: skip
    positions_m = centers_m + rng.normal(0.0, sigma_m, (14, 3)) * [1.0, 1.0, 0.2]
    positions_m[late, 2] += step_m
    noise = Rotation.from_rotvec(rng.normal(0.0, 0.5, (14, 3)), degrees=True).as_matrix()[:, :, 2]
    turn = Rotation.from_rotvec([wrong_deg, 0.0, 0.0], degrees=True).as_matrix()
    ups = np.where((late | (not of_second))[:, None], noise @ turn.T, noise)
    in_model = 0.02 * centers_m @ MODEL_FROM_WORLD.T + 3.0, 0.02 * points_m @ MODEL_FROM_WORLD.T + 3.0
    seen = ups @ MODEL_FROM_WORLD.T if tilts else np.full((14, 3), np.nan)
    return height_steps_m(*in_model, positions_m, np.full(14, sigma_m), seen, late.astype(int)), late


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("step_m", [STEP_M, -STEP_M])
def test_a_step_between_two_strips_is_found(seed: int, step_m: float) -> None:
    found, late = steps_m(seed, step_m=step_m)
    np.testing.assert_array_equal(found[~late], 0.0)
    assert found[late] == pytest.approx(np.full(6, step_m), abs=1.0)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("without", [
    {"tilts": False},
    {"step_m": 0.0},
    {"step_m": 0.0, "wrong_deg": 15.0, "of_second": True},
])  # fmt: skip
def test_none_is_found_without_tilts_without_a_step_or_by_wrong_tilts(seed: int, without: dict[str, float]) -> None:
    found, _ = steps_m(seed, **without)  # type: ignore[arg-type]
    np.testing.assert_array_equal(found, 0.0)


def test_an_image_whose_flight_has_no_position_has_no_step() -> None:
    rng = np.random.default_rng(0)
    centers_m = np.column_stack([rng.uniform(0, 200, (12, 2)), np.full(12, 100.0)])
    points_m = np.column_stack([rng.uniform(-40, 240, (300, 2)), rng.normal(0.0, 2.0, 300)])
    positions_m = centers_m.copy()
    positions_m[6:] = np.nan
    ups = np.tile([0.0, 0.0, 1.0], (12, 1))
    flights = np.repeat([0, 1], 6)
    found = height_steps_m(centers_m, points_m, positions_m, np.full(12, 2.0), ups, flights)
    np.testing.assert_array_equal(found, 0.0)
