"""The adjustment of a network with the weights that its own residuals show, and with what it determines of calibration.

Observations of one kind (image points, positions horizontally and vertically) have standard deviations in the ratio
that was stated; how large they are together is estimated from their residuals and redundancy (variance components:
Foerstner 1979; Luhmann et al., Close-Range Photogrammetry, section 2.4). All unknowns of calibration have a prior, so
that what the block says little of stays near it; what it says nothing significant of is held (`_hold_undetermined`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.orientation.bundle.covariance import Covariance, covariance
from aeromatch_cli.orientation.bundle.network import LENS, Network, Unknowns
from aeromatch_cli.orientation.bundle.normal_equations import residuals_in_sigmas
from aeromatch_cli.orientation.bundle.solve import solve

# The standard deviation of image points is estimated again until it changes by less than this share.
_SETTLED, _MAX_ROUNDS = 0.1, 5
_ROUGH = 1e-3
# No coordinate of an image point is measured more exactly, pixels; where poses are rough, none counts as worse.
_LEAST_SIGMA_PX, _MOST_SIGMA_PX = 0.05, 20.0
# Distances of normally distributed residuals in the plane have this median, in standard deviations of a coordinate.
_MEDIAN_DISTANCE = 1.1774
# What was stated of the accuracy of positions counts as much as so many residuals. Positions that are off by more than
# the larger factor have another reason than their accuracy: they are not given up for it.
_STATED_RESIDUALS, _MOST_FACTOR, _LEAST_FACTOR = 3.0, 5.0, 0.2
# A position that is so many standard deviations from its image is not that of the image.
_WRONG_SIGMAS = 5.0
# An unknown of calibration is held at its prior where its change is less than so many of its standard deviations and
# the block has told less than half of what was not known of it.
_SIGNIFICANT_SIGMAS, _DETERMINED = 3.0, 0.5


@dataclass(frozen=True)
class Options:
    """tolerance: the adjustment ends when a step lowers the cost by a smaller share. final: whether standard deviations
    are wanted, and unknowns that are not determined held."""

    tolerance: float
    final: bool


@dataclass(frozen=True, eq=False)
class Adjusted:
    """network: with the weights and positions that were used in the end. sigma_px: of a coordinate of an image point.
    position_factors: (2,) by which positions are less exact than stated, horizontally and vertically. found: None
    unless asked for."""

    network: Network
    state: Unknowns
    sigma_px: float
    position_factors: FloatArray
    found: Covariance | None


def adjust(network: Network, start: Unknowns, options: Options) -> Adjusted:
    """The block that fits its observations best, from `start`, whose image points may be off by many pixels."""
    network, state, sigma_px = _with_image_sigma(network, start, options.tolerance)
    factors = np.ones(2)
    found: Covariance | None = None
    if options.final:
        found = covariance(network, state)
        held = _hold_undetermined(network, state, found)
        if held is not network:
            state = replace(state, lens=np.where(held.lens_sigmas > 0.0, state.lens, held.lens_prior))
            network, state, sigma_px = _with_image_sigma(held, state, options.tolerance)
            found = covariance(network, state)
    stated = network
    for _ in range(_MAX_ROUNDS):
        wrong = _wrong_positions(network, state)
        new = _position_factors(stated, state, found, wrong)
        if not wrong.any() and np.abs(new / factors - 1.0).max() < 2.0 * _SETTLED:
            break
        factors = new
        stated = replace(stated, positions_m=np.where(wrong[:, None], np.nan, stated.positions_m))
        network = replace(stated, position_sigmas_m=stated.position_sigmas_m * factors[[0, 0, 1]])
        state = solve(network, state, options.tolerance).state
        found = covariance(network, state) if options.final else None
    return Adjusted(network, state, sigma_px, factors, found)


def _with_image_sigma(network: Network, state: Unknowns, tolerance: float) -> tuple[Network, Unknowns, float]:
    """The network solved with the accuracy of image points that its residuals show."""
    unit = replace(network, sigma_px=np.ones_like(network.sigma_px))
    sigma_px = _sigma_px(unit, state, redundant=False)
    for number in range(_MAX_ROUNDS):
        network = replace(network, sigma_px=np.full_like(network.sigma_px, sigma_px))
        state = solve(network, state, _ROUGH if number == 0 else tolerance).state
        before, sigma_px = sigma_px, _sigma_px(unit, state, redundant=True)
        if number and abs(sigma_px / before - 1.0) < _SETTLED:
            break
    return replace(network, sigma_px=np.full_like(network.sigma_px, sigma_px)), state, sigma_px


def _sigma_px(unit: Network, state: Unknowns, *, redundant: bool) -> float:
    """Standard deviation of a coordinate of an image point, from the median residual and, with redundant, what the
    unknowns have taken from it."""
    apart_px = residuals_in_sigmas(unit, state)
    if not len(apart_px):
        return 1.0
    coordinates = 2 * len(apart_px)
    unknowns = 3 * len(state.points_m) + 6 * int((~unit.held).sum())
    taken = np.sqrt(coordinates / max(coordinates - unknowns, 0.1 * coordinates)) if redundant else 1.0
    return float(np.clip(np.median(apart_px) / _MEDIAN_DISTANCE * taken, _LEAST_SIGMA_PX, _MOST_SIGMA_PX))


def position_residuals_m(network: Network, state: Unknowns) -> FloatArray:
    """(N, 3) measured minus adjusted positions, of the antenna and with what was found of the flight; NaN where there
    is none."""
    lever = np.einsum("nji,nj->ni", state.rotations, state.mount[network.camera, 3:])
    flight = state.flight[network.flight]
    expected = state.centers_m + lever + flight[:, :3] + network.velocities_m_s * flight[:, 3:4]
    return np.where(network.located[:, None], network.positions_m - expected, np.nan)


def _wrong_positions(network: Network, state: Unknowns) -> BoolArray:
    """(N,) images whose positions contradict all others: the worst first, at most a fifth of all at once."""
    off = np.abs(position_residuals_m(network, state)) / network.position_sigmas_m
    worst = np.nan_to_num(np.where(np.isfinite(off), off, 0.0).max(axis=1))
    limit = max(_WRONG_SIGMAS, float(np.quantile(worst[network.located], 0.8)) if network.located.any() else 0.0)
    return np.asarray(worst > limit)


def _position_factors(network: Network, state: Unknowns, found: Covariance | None, wrong: BoolArray) -> FloatArray:
    """(2,) by how much positions are less exact than stated, horizontally and vertically."""
    used = network.located & ~wrong
    if not used.any():
        return np.ones(2)
    sigmas_m = network.position_sigmas_m[used]
    off = (position_residuals_m(network, state)[used] / sigmas_m) ** 2
    # What the unknowns take of the residuals, of each coordinate between all and nothing.
    taken = np.zeros_like(off)
    if found is not None:
        variances = np.diagonal(found.images[:, 3:, 3:], axis1=1, axis2=2)[used]
        taken = np.clip(variances / sigmas_m**2, 0.0, 0.99)
    factors = []
    for axes in ([0, 1], [2]):
        redundancy = float((1.0 - taken[:, axes]).sum())
        factors.append(np.sqrt((off[:, axes].sum() + _STATED_RESIDUALS) / (redundancy + _STATED_RESIDUALS)))
    return np.clip(factors, _LEAST_FACTOR, _MOST_FACTOR)


def _hold_undetermined(network: Network, state: Unknowns, found: Covariance) -> Network:
    """The network with unknowns of lenses held that it says nothing significant of; the same where there are none."""
    sigmas = found.lens_sigmas
    prior = network.lens_sigmas
    free = prior > 0.0
    change = np.abs(state.lens - network.lens_prior)
    unclear = change < _SIGNIFICANT_SIGMAS * sigmas
    untold = sigmas > _DETERMINED * np.where(np.isfinite(prior), prior, np.inf)
    held = free & unclear & untold
    held[:, LENS.index("f")] = False  # its prior weighs
    if not held.any():
        return network
    return replace(network, lens_sigmas=np.where(held, 0.0, prior))
