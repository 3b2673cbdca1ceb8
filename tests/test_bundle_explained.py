"""What residuals speak for: shifts of flights, delays, lever arms and the read-out of the shutter, and none of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from make_networks import (
    cross_strips,
    disturbed,
    flight,
    lens,
    mount,
    seeds,
    simulated,
    strips,
    values_of,
    with_lens_prior,
    with_positions,
)

from aeromatch_cli.sfm.bundle.adjust import Adjusted, Options, adjust
from aeromatch_cli.sfm.bundle.network import LENS, READOUT, Network, Unknowns
from aeromatch_cli.sfm.bundle.projection import project

RTK_M = 0.02
FINAL = Options(1e-6, final=True)
SEEDS = seeds(3)


def flown(seed: int, *, noise_m: float = RTK_M, points: int = 150, **planted: Any) -> tuple[Network, Unknowns]:
    """Three strips, and two across them in a second flight, with positions to 2 cm."""
    crossing = cross_strips(3, 5)
    plan = strips(3, 5).and_then(replace(crossing, flights=crossing.flights + 1))
    network, truth = simulated(plan, seed=seed, points=points, noise_px=0.5, **planted)
    return with_positions(network, truth, np.random.default_rng(seed + 50), RTK_M, noise_m=noise_m), truth


def adjusted(network: Network, truth: Unknowns, seed: int) -> Adjusted:
    return adjust(network, disturbed(network, truth, np.random.default_rng(seed + 100), metres=0.5, degrees=0.3), FINAL)


def explained(found: Adjusted) -> set[str]:
    network = found.network
    flights, levers = network.flight_sigmas > 0.0, network.mount_sigmas[:, 3:] > 0.0
    taken = {"shift": flights[:, :3], "lag": flights[:, 3], "lever": levers, "readout": network.lens_sigmas[:, READOUT]}
    return {name for name, which in taken.items() if which.any()}


@seeds(10)
@pytest.mark.parametrize("noise_m", [RTK_M, 3 * RTK_M])
def test_nothing_is_found_where_nothing_is_planted(seed: int, noise_m: float) -> None:
    """Positions as exact as stated, and three times less exact."""
    network, truth = flown(seed, noise_m=noise_m)
    found = adjusted(network, truth, seed)
    assert explained(found) == set()
    np.testing.assert_array_equal(found.state.flight, 0.0)
    np.testing.assert_array_equal(found.state.mount, 0.0)
    assert found.state.lens[0, READOUT] == 0.0


@SEEDS
def test_the_shift_of_a_second_flight_by_a_metre_is_found(seed: int) -> None:
    shift = flight(shift_x=0.6, shift_y=-0.5, shift_z=0.62)
    network, truth = flown(seed, true_flights=np.array([flight(), shift]))
    found = adjusted(network, truth, seed)
    assert explained(found) == {"shift"}
    np.testing.assert_array_equal(found.state.flight[0], 0.0)
    off_m = np.abs(found.state.flight[1, :3] - shift[:3])
    assert found.found is not None
    assert (off_m < 4.0 * np.sqrt(np.diag(found.found.flight[1])[:3])).all()
    assert off_m.max() < 0.1
    assert (found.position_factors < 1.5).all()
    assert found.network.located.all()


@SEEDS
def test_a_delay_of_a_fifth_of_a_second_is_found(seed: int) -> None:
    network, truth = flown(seed, true_flights=np.array([flight(lag_s=0.2)] * 2))
    found = adjusted(network, truth, seed)
    assert explained(found) == {"lag"}
    assert found.state.flight[:, 3] == pytest.approx([0.2, 0.2], rel=0.1)
    assert np.linalg.norm(found.state.centers_m - truth.centers_m, axis=1).mean() < 0.05


@SEEDS
def test_a_lever_arm_of_forty_centimetres_is_found(seed: int) -> None:
    """Across the axis; along it, it is nearly a shift of all heights under level cameras."""
    network, truth = flown(seed, true_mount=mount(lever_x=0.24, lever_y=0.32))
    found = adjusted(network, truth, seed)
    assert explained(found) == {"lever"}
    assert found.state.mount[0, 3:5] == pytest.approx([0.24, 0.32], abs=0.04)
    assert found.found is not None
    sigmas_m = np.sqrt(np.diagonal(found.found.mount[0])[3:])
    assert (np.abs(found.state.mount[0, 3:] - [0.24, 0.32, 0.0]) < 4.0 * sigmas_m).all()


@SEEDS
def test_a_read_out_of_thirty_milliseconds_is_found(seed: int) -> None:
    network, truth = flown(seed, true_lens=lens(readout_s=0.03))
    network = replace(network, lens_prior=lens()[None])
    found = adjusted(network, truth, seed)
    assert explained(found) == {"readout"}
    assert found.state.lens[0, READOUT] == pytest.approx(0.03, rel=0.1)
    assert found.sigma_px == pytest.approx(0.5, rel=0.1)


@pytest.mark.slow
@SEEDS
def test_a_delay_and_a_read_out_are_found_together(seed: int) -> None:
    flights = np.array([flight(lag_s=0.2)] * 2)
    network, truth = flown(seed, true_flights=flights, true_lens=lens(readout_s=0.03))
    found = adjusted(replace(network, lens_prior=lens()[None]), truth, seed)
    assert explained(found) == {"lag", "readout"}
    assert found.state.lens[0, READOUT] == pytest.approx(0.03, rel=0.1)
    assert found.state.flight[:, 3] == pytest.approx([0.2, 0.2], rel=0.1)


def test_a_read_out_is_not_tried_where_the_shutter_does_not_roll() -> None:
    network, truth = flown(0, true_lens=lens(readout_s=0.03))
    network = replace(network, lens_prior=lens()[None])
    start = disturbed(network, truth, np.random.default_rng(1))
    found = adjust(network, start, replace(FINAL, readout=False))
    assert "readout" not in explained(found)


def in_two_flights(seed: int, focal: float, centre_px: float) -> Adjusted:
    """A camera whose lens is another one in its second flight, by this factor and these pixels."""
    network, truth = flown(seed, points=600)
    network = with_lens_prior(network, truth.lens[0], f=100.0, cx=20.0, cy=20.0, k1=0.1)
    other = truth.lens * values_of(LENS, f=focal - 1.0) + truth.lens + values_of(LENS, cx=centre_px)
    moved_px = project(network, replace(truth, lens=other)) - project(network, truth)
    second = network.flight[network.image] == 1
    return adjusted(replace(network, xy_px=network.xy_px + moved_px * second[:, None]), truth, seed)


@pytest.mark.slow
@SEEDS
def test_flights_of_one_lens_share_a_calibration(seed: int) -> None:
    [one] = in_two_flights(seed, 1.0, 0.0).flight_lenses
    assert (one.camera, one.flight) == (0, 1)
    assert one.worth < 0.3


@pytest.mark.slow
@SEEDS
def test_a_lens_that_was_focused_anew_is_another_one(seed: int) -> None:
    found = in_two_flights(seed, 1.01, 8.0)
    [one] = found.flight_lenses
    assert one.worth > 1.0
    assert one.change[LENS.index("f")] == pytest.approx(0.01 * found.state.lens[0, 0], rel=0.2)
    assert one.change[LENS.index("cx")] == pytest.approx(8.0, abs=1.5)


def test_a_flight_that_tells_nothing_of_its_lens_is_not_compared() -> None:
    network, truth = flown(0)
    network = with_lens_prior(network, truth.lens[0], f=100.0)
    few = replace(network, flight=(np.arange(network.images) >= network.images - 3).astype(int))
    assert adjusted(few, truth, 0).flight_lenses == ()
