"""What an adjustment estimates of its observations and of lenses: weights, wrong positions, calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from make_networks import (
    PLAIN,
    UNKNOWN_LENS,
    cross_strips,
    disturbed,
    lens,
    seeds,
    simulated,
    strips,
    with_lens_prior,
    with_positions,
)

from aeromatch_cli.data import FloatArray
from aeromatch_cli.sfm.bundle.adjust import Options, adjust
from aeromatch_cli.sfm.bundle.covariance import pose_sigmas
from aeromatch_cli.sfm.bundle.network import LENS, Network, Unknowns
from aeromatch_cli.sfm.bundle.projection import project
from aeromatch_cli.sfm.bundle.shared import lenses_if_freed

FINAL, ROUGH = Options(1e-6, final=True), Options(1e-4, final=False)
SEEDS = seeds(3)


def block(seed: int, *, noise_px: float = 0.5, true_lens: FloatArray = PLAIN) -> tuple[Network, Unknowns]:
    """Three strips of five and two across, 150 points."""
    plan = strips(3, 5).and_then(cross_strips(3, 5))
    return simulated(plan, seed=seed, points=150, noise_px=noise_px, true_lens=true_lens)


def start_of(network: Network, truth: Unknowns, seed: int) -> Unknowns:
    return disturbed(network, truth, np.random.default_rng(seed + 100), metres=0.5, degrees=0.3)


@SEEDS
@pytest.mark.parametrize("noise_px", [0.3, 2.0])
@pytest.mark.parametrize("options", [FINAL, ROUGH])
def test_the_accuracy_of_image_points_is_found(seed: int, noise_px: float, options: Options) -> None:
    """Among two wrong ones of a hundred, tens of pixels off."""
    network, truth = block(seed, noise_px=noise_px)
    rng = np.random.default_rng(seed + 50)
    network = with_positions(network, truth, rng, 0.5)
    wrong = rng.random(len(network.point)) < 0.02
    xy_px = network.xy_px + wrong[:, None] * rng.choice([-1.0, 1.0], (len(wrong), 2)) * rng.uniform(
        20, 80, (len(wrong), 2)
    )
    network = replace(network, xy_px=xy_px, sigma_px=np.full(len(wrong), 1.0))
    found = adjust(network, start_of(network, truth, seed), options)
    assert found.sigma_px == pytest.approx(noise_px, rel=0.1)
    np.testing.assert_allclose(found.network.sigma_px, found.sigma_px)


@SEEDS
def test_positions_as_exact_as_stated_keep_their_weight(seed: int) -> None:
    network, truth = block(seed)
    network = with_positions(network, truth, np.random.default_rng(seed + 50), 0.3)
    found = adjust(network, start_of(network, truth, seed), FINAL)
    assert ((found.position_factors > 0.75) & (found.position_factors < 1.3)).all()
    assert found.network.located.all()


@pytest.mark.slow
def test_positions_stated_three_times_too_exact_are_found() -> None:
    """21 positions and what was stated, which counts as three more: 2.8 on average."""
    factors = []
    for seed in range(6):
        network, truth = block(seed)
        network = with_positions(network, truth, np.random.default_rng(seed + 50), 0.1, noise_m=0.3)
        found = adjust(network, start_of(network, truth, seed), FINAL)
        assert found.network.located.all()  # none is wrong
        expected = 0.1 * found.position_factors[[0, 0, 1]]
        np.testing.assert_allclose(found.network.position_sigmas_m, np.tile(expected, (network.images, 1)))
        factors.append(found.position_factors)
    assert np.mean(factors, axis=0) == pytest.approx([2.8, 2.7], abs=0.4)
    assert ((np.array(factors) > 1.9) & (np.array(factors) < 3.9)).all()


@pytest.mark.slow
def test_positions_that_are_less_exact_in_height_alone_are_so_in_height_alone() -> None:
    factors = []
    for seed in range(6):
        network, truth = block(seed)
        rng = np.random.default_rng(seed + 50)
        network = with_positions(network, truth, rng, 0.1)
        network.positions_m[:, 2] = truth.centers_m[:, 2] + rng.normal(0.0, 0.3, network.images)
        factors.append(adjust(network, start_of(network, truth, seed), FINAL).position_factors)
    assert np.mean(factors, axis=0) == pytest.approx([1.0, 2.7], abs=0.4)


@SEEDS
@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("sigma_m", [0.02, 2.0])
def test_a_wrong_position_is_left_out_and_named(seed: int, axis: int, sigma_m: float) -> None:
    network, truth = block(seed)
    network = with_positions(network, truth, np.random.default_rng(seed + 50), sigma_m)
    network.positions_m[4, axis] += 50.0
    found = adjust(network, start_of(network, truth, seed), FINAL)
    np.testing.assert_array_equal(np.flatnonzero(~found.network.located), [4])
    assert found.stated.located.all()
    assert found.found is not None
    sigmas_m, _ = pose_sigmas(found.network, found.state, found.found)
    assert (np.abs(found.state.centers_m[4] - truth.centers_m[4]) < 3.5 * sigmas_m[4]).all()
    assert (found.position_factors < 1.5).all()


@pytest.mark.slow
def test_a_true_lens_is_found_in_a_block_with_cross_strips() -> None:
    """The principal point 40 px off, all terms of distortion: of 8 blocks, errors within 3 standard deviations."""
    true = lens(f=1012.0, cx=639.5, cy=439.5, k1=-0.08, k2=0.06, k3=-0.02, p1=0.0015, p2=-0.001)
    over = []
    for seed in range(5):
        network, truth = block(seed, true_lens=true)
        network = with_positions(network, truth, np.random.default_rng(seed + 50), 0.05)
        network = with_lens_prior(network, PLAIN, **UNKNOWN_LENS)
        found = adjust(network, start_of(network, truth, seed), FINAL)
        assert found.found is not None
        sigmas = found.found.lens_sigmas[0]
        free = sigmas > 0.0
        assert free[[LENS.index(name) for name in ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2")]].all()
        over.append(np.abs(found.state.lens[0] - true)[free] / sigmas[free])
        assert sigmas[1:3].max() < 0.5
        assert np.median(np.linalg.norm(found.state.points_m - truth.points_m, axis=1)) < 0.3
    worst = np.concatenate(over)
    assert (worst < 3.0).mean() > 0.97
    assert 0.75 < np.sqrt((worst**2).mean()) < 1.3


def points_off_m(seed: int, true_lens: FloatArray, **sigmas: float) -> float:
    """Median error of the points of four images in one strip, positions to 1 m."""
    network, truth = simulated(strips(1, 4), seed=seed, points=60, noise_px=0.5, true_lens=true_lens)
    network = with_positions(network, truth, np.random.default_rng(seed + 50), 1.0)
    network = with_lens_prior(network, PLAIN, **sigmas)
    found = adjust(network, start_of(network, truth, seed), FINAL)
    still = found.network.lens_sigmas[0] == 0.0
    np.testing.assert_array_equal(found.state.lens[0, still], PLAIN[still])
    assert not still[0]
    assert still[[LENS.index(name) for name in ("b1", "b2")]].all()
    return float(np.median(np.linalg.norm(found.state.points_m - truth.points_m, axis=1)))


@pytest.mark.slow
def test_a_weak_block_calibrates_no_worse_than_its_prior_and_better_where_that_is_wrong() -> None:
    """Lenses by chance, as far off as nobody knows; and a lens that is exactly as was thought, where all that a block
    tells of it is noise."""
    ratios: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(3):
        off = np.random.default_rng(seed + 200).normal(0.0, 1.0, 12) * [UNKNOWN_LENS.get(name, 0.0) for name in LENS]
        for by_chance, values in ratios.items():
            true = PLAIN + off * by_chance
            free = points_off_m(seed, true, **UNKNOWN_LENS)
            values.append(free / points_off_m(seed, true, f=UNKNOWN_LENS["f"]))
    assert np.exp(np.mean(np.log(ratios[True]))) < 0.7
    assert np.exp(np.mean(np.log(ratios[False]))) < 1.4


@SEEDS
def test_exact_positions_stay_exact_beside_a_focal_length_that_is_known_to_a_hundredth(seed: int) -> None:
    true = lens(f=1008.0)
    network, truth = block(seed, true_lens=true)
    network = with_positions(network, truth, np.random.default_rng(seed + 50), 0.02)
    network = with_lens_prior(network, PLAIN, f=10.0)
    found = adjust(network, start_of(network, truth, seed), FINAL)
    assert found.found is not None
    sigmas_m, _ = pose_sigmas(found.network, found.state, found.found)
    assert (np.abs(found.state.centers_m - truth.centers_m) < 3.5 * sigmas_m).all()
    assert (sigmas_m < 0.025).all()
    assert abs(found.state.lens[0, 0] - 1000.0) < 3.0 * 10.0
    assert abs(found.state.lens[0, 0] - 1008.0) < 3.0 * found.found.lens_sigmas[0, 0]


def test_a_rough_adjustment_states_no_deviations_and_frees_nothing() -> None:
    network, truth = block(0)
    network = with_positions(network, truth, np.random.default_rng(0), 0.3)
    found = adjust(network, start_of(network, truth, 0), ROUGH)
    assert found.found is None
    np.testing.assert_array_equal(found.network.flight_sigmas, 0.0)
    assert np.linalg.norm(found.state.centers_m - truth.centers_m, axis=1).max() < 1.0


@pytest.mark.parametrize("seed", [1, 2])
def test_a_focal_length_far_from_its_prior_counts_only_where_the_residuals_tell_it(seed: int) -> None:
    """EXIF states 1000 +- 30 px. On ground as flat as a meadow 1300 px are hardly told, and stay as stated; over relief
    1150 px are."""
    network, truth = simulated(strips(2, 5), seed=seed, points=150, true_lens=lens(f=1300.0))
    truth = replace(truth, points_m=truth.points_m * [1.0, 1.0, 0.1])
    rng = np.random.default_rng(seed)
    network = replace(network, xy_px=project(network, truth) + rng.normal(0.0, 0.5, network.xy_px.shape))
    network = with_positions(network, truth, np.random.default_rng(seed + 50), 5.0)
    flat = adjust(with_lens_prior(network, PLAIN, f=30.0), start_of(network, truth, seed), FINAL)
    assert (flat.state.lens[0, 0], flat.network.lens_sigmas[0, 0]) == (PLAIN[0], 0.0)
    network, truth = block(seed, true_lens=lens(f=1150.0))
    network = with_lens_prior(with_positions(network, truth, rng, 5.0), PLAIN, f=30.0)
    relief = adjust(network, start_of(network, truth, seed), FINAL)
    assert relief.state.lens[0, 0] == pytest.approx(1150.0, rel=0.01)
    assert relief.network.lens_sigmas[0, 0] == 30.0


def test_what_pictures_say_of_a_lens_that_is_held() -> None:
    network, truth = block(0, true_lens=lens(f=1012.0))
    network = with_positions(network, truth, np.random.default_rng(50), 0.05)
    unknown = np.zeros((1, 12))
    unknown[0, 0] = 30.0
    for held, change, worth in ((1000.0, 12.0, 1.0), (1012.0, 0.0, 0.0)):
        given = replace(network, lens_prior=lens(f=held)[None])
        found = adjust(given, replace(start_of(given, truth, 0), lens=given.lens_prior), FINAL)
        changes, worths = lenses_if_freed(found.network, found.state, unknown, 1e-6)
        assert changes[0, 0] == pytest.approx(change, abs=1.0)
        assert (worths > 1.0) == (worth > 0.0)
        np.testing.assert_array_equal(changes[0, 1:], 0.0)
