"""Where a short strip of images lies in the world: inexact positions along one line, roofs beside a narrow overlap."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from make_networks import given_positions
from scipy.spatial.transform import Rotation
from test_flips import built, centers_of

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.rotations import angle_between_deg, from_omega_phi_kappa, rotation_z
from aeromatch_cli.sfm.georeferencing import (
    Placement,
    _levelled,
    _Measured,
    _off_level,
    _terrain,
    _Vertical,
    _vertical,
    delay_s,
    place,
    similarity,
)
from aeromatch_cli.sfm.model_adjustment import believed_tilts

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


@pytest.mark.slow
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


@pytest.mark.slow
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


def in_space(seed: int, noise_m: float) -> tuple[_Measured, Placement]:
    """Eight positions spread in all directions, and the similarity that fits them best."""
    rng = np.random.default_rng(seed)
    centers_m = rng.uniform(-50.0, 50.0, (8, 3))
    positions_m = centers_m + rng.normal(0.0, noise_m, (8, 3))
    fit = similarity(in_model(centers_m), positions_m)
    found = Placement(*fit, "positions", np.ones(8, dtype=bool), trusted=True)
    return _Measured(in_model(centers_m), positions_m, noise_m), found


def test_positions_in_space_outweigh_a_ground_that_lies_overhead() -> None:
    """From a level start alone the search ends upside down there."""
    askew = Rotation.from_rotvec([150.0, 0.0, 0.0], degrees=True).apply([0.0, 0.0, 1.0])
    for seed in range(10):
        measured, found = in_space(seed, noise_m=1.0)
        levelled, _ = _levelled(found, measured, _Vertical(MODEL_FROM_WORLD @ askew, 3.0))
        assert angle_between_deg(levelled.rotation @ MODEL_FROM_WORLD, np.eye(3)) < 10.0


def test_a_strip_is_not_mirrored_where_that_fits_its_heights() -> None:
    """A negative scale and half a turn put a level strip where it was, but with its heights upside down."""
    positions_m = CENTERS_M * [1.0, 1.0, -1.0] + [0.0, 0.0, 400.0]
    measured = _Measured(in_model(CENTERS_M), positions_m, 2.0)
    half_turn = Rotation.from_rotvec([0.0, 0.0, 180.0], degrees=True).as_matrix()
    mirrored = Placement(-20.0, half_turn @ MODEL_FROM_WORLD.T, np.zeros(3), "positions", np.ones(3, dtype=bool), True)
    levelled, _ = _levelled(mirrored, measured, _Vertical(MODEL_FROM_WORLD[:, 2], 3.0))
    assert levelled.scale == pytest.approx(20.0, rel=0.01)
    assert angle_between_deg(levelled.rotation @ MODEL_FROM_WORLD, np.eye(3)) < 5.0


@pytest.mark.parametrize(("off_deg", "ground_sigma_deg", "used"), [
    (25.0, 3.0, True),  # a hillside may be as steep
    (40.0, 3.0, False),
    (40.0, 15.0, True),  # a narrow strip of rough ground tells no better
    (80.0, 40.0, True),
    (100.0, 40.0, False),  # the ground lies below in any case
])  # fmt: skip
def test_tilts_count_as_far_as_the_ground_can_be_off(off_deg: float, ground_sigma_deg: float, used: bool) -> None:
    by_terrain = _Vertical(Rotation.from_rotvec([off_deg, 0.0, 0.0], degrees=True).as_matrix()[:, 2], ground_sigma_deg)
    ups = Rotation.from_rotvec(np.random.default_rng(0).normal(0.0, 1.0, (5, 3)), degrees=True).as_matrix()[:, :, 2]
    chosen = _vertical(by_terrain, ups)
    assert (chosen is not by_terrain) == used
    assert not used or np.rad2deg(np.arccos(chosen.up[2])) < 2.0


def test_tilts_are_not_wrong_for_contradicting_rough_ground() -> None:
    """Positions along one line leave it to the ground, 40 degrees off and known to 20, whether right tilts are wrong:
    they are where the same is known to 3."""
    measured = _Measured(in_model(CENTERS_M), CENTERS_M, 1.0)
    fit = similarity(measured.centers, CENTERS_M)
    found = Placement(*fit, "positions", np.ones(3, dtype=bool), trusted=True)
    about_line = Rotation.from_rotvec(40.0 * (CENTERS_M[2] - CENTERS_M[0]) / 95.4, degrees=True)
    off = MODEL_FROM_WORLD @ about_line.apply([0.0, 0.0, 1.0])
    by_tilts = _Vertical(MODEL_FROM_WORLD[:, 2], 1.0)
    assert not _off_level(found, measured, _Vertical(off, 20.0), by_tilts)
    assert _off_level(found, measured, _Vertical(off, 3.0), by_tilts)


@pytest.mark.parametrize(("turned_deg", "sigma_m", "believed"), [
    (10.0, 1.0, True),
    (30.0, 1.0, False),
    (30.0, 200.0, True),  # positions that say so little of north contradict no heading
    (90.0, 200.0, False),
])  # fmt: skip
def test_headings_are_wrong_as_far_as_positions_tell_north(turned_deg: float, sigma_m: float, believed: bool) -> None:
    """Headings that are wrong together take the tilts with them that were given beside them."""
    model = built()
    positions_m = centers_of(model)
    true = np.array([model.images[number].cam_from_world().rotation.matrix() for number in sorted(model.images)])
    given = true @ rotation_z(turned_deg)
    ups = given[:, :, 2]
    known = given_positions(positions_m, np.full(len(positions_m), sigma_m), ups=ups, rotations=given)
    found = believed_tilts(pycolmap, model, known)
    assert np.isfinite(found).all() == believed
    assert not believed or np.array_equal(found, ups)


@pytest.mark.parametrize("late_s", [-0.4, 0.0, 0.5, 1.2])
def test_a_delay_of_positions_is_found_roughly(late_s: float) -> None:
    """Strips to and fro at 12 m/s: what a delay moves is no similarity."""
    rng = np.random.default_rng(1)
    centers_m = np.array([[20.0 * k, 30.0 * row, 100.0] for row in range(3) for k in range(6)])
    velocities_m_s = np.array([[12.0 * (-1.0) ** row, 0.0, 0.0] for row in range(3) for _ in range(6)])
    positions_m = centers_m + late_s * velocities_m_s + rng.normal(0.0, 0.02, centers_m.shape)
    found_s = delay_s(in_model(centers_m), positions_m, velocities_m_s)
    assert found_s == pytest.approx(late_s, abs=0.026)
    assert delay_s(in_model(centers_m), positions_m, np.zeros_like(velocities_m_s)) == 0.0


@pytest.mark.parametrize(
    ("stated_m", "rise_deg", "least_deg", "most_deg"),
    [(5.0, 6.0, 0.0, 1.5), (5.0, 17.0, 0.0, 3.0), (0.05, 6.0, 5.0, 7.0)],
)
def test_measured_tilts_outweigh_the_drift_of_a_receiver_without_corrections(
    stated_m: float, rise_deg: float, least_deg: float, most_deg: float
) -> None:
    """Heights that rise to the north over flat ground; with corrections they do not drift, and count."""
    rng = np.random.default_rng(2)
    centers_m = np.array([[20.0 * k, 25.0 * row, 100.0] for row in range(4) for k in range(4)])
    ground_m = np.column_stack([rng.uniform(-30, 90, 200), rng.uniform(-30, 100, 200), rng.normal(0.0, 1.0, 200)])
    positions_m = centers_m + rng.normal(0.0, 0.02, centers_m.shape)
    positions_m[:, 2] += np.tan(np.deg2rad(rise_deg)) * centers_m[:, 1]
    turns = Rotation.from_rotvec(rng.normal(0.0, 1.0, (16, 3)), degrees=True).as_matrix()
    ups = turns[:, :, 2] @ MODEL_FROM_WORLD.T
    found = place(in_model(centers_m), in_model(ground_m), positions_m, np.full(16, stated_m), ups)
    off_deg = np.rad2deg(np.arccos((found.rotation @ MODEL_FROM_WORLD)[2, 2]))
    assert least_deg <= off_deg <= most_deg
    assert found.by_tilts == (stated_m > 1.0)
