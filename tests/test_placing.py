"""Where a short strip of images lies in the world: inexact positions along one line, roofs beside a narrow overlap."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import angle_between_deg, from_omega_phi_kappa
from aeromatch_cli.orientation.placing import Placement, _terrain, place

# Three images in a row, 200 m above the ground.
CENTERS_M = np.array([[-46.0, -11.0, 200.0], [0.0, -2.0, 201.0], [47.0, 10.0, 198.0]])
MODEL_FROM_WORLD = from_omega_phi_kappa(50.0, -20.0, 110.0)
STATED_M, POSITION_NOISE_M, ATTITUDE_NOISE_DEG = 5.0, 10.0, 3.0


def ground(rng: np.random.Generator) -> FloatArray:
    """(P, 3) what all three images show: a strip across, with houses at one side of it; metres."""
    low = np.column_stack([rng.uniform(-22, 22, 75), rng.uniform(-95, 95, 75), rng.normal(0.0, 0.7, 75)])
    houses = np.column_stack([rng.uniform(12, 24, 20), rng.uniform(-60, 90, 20), rng.uniform(12, 30, 20)])
    return np.concatenate([low, houses])


def in_model(points_m: FloatArray) -> FloatArray:
    return np.asarray(0.05 * points_m @ MODEL_FROM_WORLD.T + 2.0)


def placed(seed: int, *, tilts: bool) -> Placement:
    """By positions with errors larger than stated, with or without measured tilts."""
    rng = np.random.default_rng(seed)
    points_m = ground(rng)
    positions_m = CENTERS_M + rng.normal(0.0, POSITION_NOISE_M, CENTERS_M.shape)
    turns = Rotation.from_rotvec(rng.normal(0.0, ATTITUDE_NOISE_DEG, (3, 3)), degrees=True).as_matrix()
    ups = (turns[:, :, 2] @ MODEL_FROM_WORLD.T) if tilts else None
    return place(in_model(CENTERS_M), in_model(points_m), positions_m, np.full(3, STATED_M), ups)


@pytest.mark.parametrize("tilts", [False, True])
def test_positions_along_a_line_do_not_tilt_a_strip(tilts: bool) -> None:
    """Of 40 strips: how far up is from true up, and the whole attitude from the true one, degrees."""
    found = [placed(seed, tilts=tilts) for seed in range(40)]
    ups = [one.rotation @ MODEL_FROM_WORLD @ [0.0, 0.0, 1.0] for one in found]
    off_deg = np.rad2deg([np.arccos(up[2]) for up in ups])
    whole_deg = [angle_between_deg(one.rotation @ MODEL_FROM_WORLD, np.eye(3)) for one in found]
    assert {one.kind for one in found} == {"positions"}
    assert np.median(off_deg) < 3.0
    assert max(off_deg) < 8.0
    # Positions with errors of 10 m tell the heading of a line of 95 m to 9 degrees, one standard deviation.
    assert np.median(whole_deg) < 9.0
    assert max(whole_deg) < 30.0


def test_north_is_known_as_exactly_as_positions_tell_it() -> None:
    """Positions whose errors are those stated: root mean square of the headings' errors beside what is said of them."""
    errors, said = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        positions_m = CENTERS_M + rng.normal(0.0, STATED_M, CENTERS_M.shape)
        found = place(in_model(CENTERS_M), in_model(ground(rng)), positions_m, np.full(3, STATED_M))
        turn = found.rotation @ MODEL_FROM_WORLD
        errors.append(np.rad2deg(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])))
        said.append(found.north_sigma_deg)
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) / np.sqrt(np.mean(np.square(said))) < 1.6
    assert min(said) > 0.6 * np.median(said)


def test_houses_at_one_side_of_a_narrow_overlap_do_not_tilt_the_ground() -> None:
    off_deg, sigmas_deg = [], []
    for seed in range(40):
        terrain = _terrain(in_model(CENTERS_M), in_model(ground(np.random.default_rng(seed))))
        off_deg.append(np.rad2deg(np.arccos(np.clip(terrain.up @ MODEL_FROM_WORLD[:, 2], -1.0, 1.0))))
        sigmas_deg.append(terrain.sigma_deg)
    assert max(off_deg) < 3.0
    assert max(sigmas_deg) < 6.0


@pytest.mark.parametrize("slope", [0.18, -0.18])
def test_in_a_valley_and_on_a_ridge_both_sides_count(slope: float) -> None:
    """Sides of ten degrees, one of which most planes through three points fit best."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        across, along = rng.uniform(-50, 50, (2, 800))
        points_m = np.column_stack([across, along, slope * np.abs(across) + rng.normal(0.0, 0.3, 800)])
        terrain = _terrain(in_model(CENTERS_M), in_model(points_m))
        assert np.rad2deg(np.arccos(np.clip(terrain.up @ MODEL_FROM_WORLD[:, 2], -1.0, 1.0))) < 2.0


def test_rough_ground_says_less_of_where_up_is_the_narrower_it_is() -> None:
    rng = np.random.default_rng(0)
    rough = rng.normal(0.0, 6.0, 300)
    sigmas_deg = []
    for width_m in (8.0, 30.0, 200.0):
        points_m = np.column_stack([rng.uniform(-width_m, width_m, 300), rng.uniform(-200, 200, 300), rough])
        sigmas_deg.append(_terrain(in_model(CENTERS_M), in_model(points_m)).sigma_deg)
    assert sigmas_deg[0] > 15.0 > sigmas_deg[1] > sigmas_deg[2]
    assert sigmas_deg[2] < 4.0
