"""The adjustment of a network with the weights that its own residuals show, and with what it determines of calibration.

Observations of one kind (image points, positions horizontally and vertically) have standard deviations in the ratio
that was stated; how large they are together is estimated from their residuals and redundancy (variance components:
Foerstner 1979; Luhmann et al., Close-Range Photogrammetry, section 2.4). All unknowns of calibration have a prior, so
that what the block says little of stays near it; what it says nothing significant of is held (`_hold_undetermined`).
What else may explain residuals (shifts of flights, a delay of positions, a lever arm, the read-out of the shutter) is
unknown only where the block is much better with it (`_explained`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.sfm.bundle.covariance import Covariance, covariance
from aeromatch_cli.sfm.bundle.network import LENS, READOUT, Network, Unknowns, is_uncorrected
from aeromatch_cli.sfm.bundle.normal_equations import cost, off_by_flight_m, residuals_in_sigmas
from aeromatch_cli.sfm.bundle.projection import project_with_derivatives
from aeromatch_cli.sfm.bundle.shared import FlightLens, lenses_by_flight
from aeromatch_cli.sfm.bundle.solve import solve

# The standard deviation of image points is estimated again until it changes by less than this share.
_SETTLED, _MAX_ROUNDS = 0.1, 5
_ROUGH, _ROUGH_ROUNDS = 1e-3, 2
# Poses and calibration that move by less than so many of their standard deviations together stand still: of the final
# adjustment, and of those before it.
_STILL, _ROUGH_STILL = 0.2, 1.0
# No coordinate of an image point is measured more exactly, pixels; where poses are rough, none counts as worse.
_LEAST_SIGMA_PX, _MOST_SIGMA_PX = 0.05, 20.0
# Distances of normally distributed residuals in the plane have this mean, in standard deviations of a coordinate. Those
# beyond so many medians are outliers, and count as that: more than the loss leaves of them, less than they are.
_MEAN_DISTANCE, _OUTLYING = 1.2533, 5.0
# What was stated of the accuracy of positions counts as much as so many residuals. Positions that are off by more than
# the larger factor have another reason than their accuracy: they are not given up for it.
_STATED_RESIDUALS, _MOST_FACTOR, _LEAST_FACTOR = 3.0, 5.0, 0.2
# A position that is so many standard deviations from its image is not that of the image. How large these are is told
# by the share of positions that are right at least: of normally distributed ones so many have their largest coordinate
# within so many standard deviations.
_WRONG_SIGMAS, _RIGHT, _RIGHT_SIGMAS = 5.0, 0.8, 1.8
# Before the block is adjusted, the poses of some are not known much better.
_FAR_SIGMAS = 15.0
# Positions that make residuals of image points larger by this factor bend the block.
_BENT = 1.1
# An unknown of calibration is held at its prior where its change is less than so many of its standard deviations and
# the block has told less than half of what was not known of it, or it moves no image point by so much of the standard
# deviation of one.
_SIGNIFICANT_SIGMAS, _DETERMINED, _SEEN_SIGMAS = 3.0, 0.5, 0.5
# A focal length that would be so many standard deviations from what is known of it, though the sum of squares rises by
# less than this share with it held, is a fault of the image points: moving tree tops and a rolling shutter put that of
# the real block brighton 18 % away, where a twentieth of the squares tells it.
_IMPLAUSIBLE_SIGMAS, _TELLING_SHARE = 3.0, 0.1
# Explanations are tried where positions are off by more than so many times what was stated, and taken where each of
# their unknowns lowers the sum of squares by so much and is so many times as large as its standard deviation.
_UNEXPLAINED, _WORTH_SQUARES, _WORTH_SIGMAS = 1.3, 25.0, 5.0
# None is taken that is so many times as large as what is usual (an antenna of 3 m hides a wrong focal length), and no
# read-out that runs backwards.
_BELIEVED_SIGMAS = 5.0
# Standard deviations of what may explain residuals, before the block is asked: shifts of a flight's positions, metres;
# their delay, seconds; the lever arm, metres; the read-out of a shutter, seconds.
_SHIFT_M, _LAG_S, _LEVER_M, _READOUT_S = 20.0, 1.0, 0.5, 0.03


@dataclass(frozen=True)
class Options:
    """tolerance: the adjustment ends when a step lowers the cost by a smaller share. final: whether standard deviations
    are wanted and explanations of residuals tried. choose: whether unknowns of lenses are held that are not determined.
    readout: whether a rolling shutter is one of the explanations."""

    tolerance: float
    final: bool
    choose: bool = True
    readout: bool = True

    @property
    def still_sigmas(self) -> float:
        return _STILL if self.final else _ROUGH_STILL


@dataclass(frozen=True, eq=False)
class Adjusted:
    """network: with the weights and positions that were used in the end. sigma_px: of a coordinate of an image point.
    position_factors: (2,) by which positions are less exact than stated, horizontally and vertically. found: None
    unless asked for. stated: the network as it was given. flight_lenses: of cameras in several flights, likewise."""

    network: Network
    state: Unknowns
    sigma_px: float
    position_factors: FloatArray
    found: Covariance | None
    stated: Network
    flight_lenses: tuple[FlightLens, ...] = ()


def adjust(network: Network, start: Unknowns, options: Options) -> Adjusted:
    """Return the block that fits its observations best, from `start`, whose image points may be off by many pixels."""
    stated = network
    network, start = _without_far_positions(network, start)
    network, state = _with_image_sigma(network, start, options, near=False)
    network, state = _with_plausible_focal_lengths(network, state, options)
    if options.final:
        held = _hold_undetermined(network, state, covariance(network, state)) if options.choose else network
        if held is not network:
            state = replace(state, lens=np.where(held.lens_sigmas > 0.0, state.lens, held.lens_prior))
            network, state = _with_image_sigma(held, state, options)
        explained, state = _explained(network, state, options)
        if explained is not network:
            network, state = _with_image_sigma(explained, state, options)
    network, state, factors = _with_position_sigmas(network, state, options)
    if not options.final:
        return Adjusted(network, state, network.tie_sigma_px, factors, None, stated)
    found = covariance(_with_common_errors(network, stated), state)
    lenses = tuple(lenses_by_flight(network, state, options.tolerance))
    return Adjusted(network, state, network.tie_sigma_px, factors, found, stated, lenses)


def _with_common_errors(network: Network, stated: Network) -> Network:
    """The network as its standard deviations are to be stated: a flight's positions may be off together."""
    common = network.flight_sigmas.copy()
    for flight in range(network.flights):
        sigmas_m = stated.position_sigmas_m[network.located & (network.flight == flight)]
        if len(sigmas_m) and is_uncorrected(float(np.median(sigmas_m))):
            common[flight, :3] = np.maximum(common[flight, :3], np.median(sigmas_m, axis=0))
    return replace(network, flight_sigmas=common)


def _with_image_sigma(
    network: Network, state: Unknowns, options: Options, *, near: bool = True
) -> tuple[Network, Unknowns]:
    """The network with the accuracy of tie points that their residuals show, and its solution.

    Positions weigh no more meanwhile than what they are off by allows: with too much weight they bend the block, and
    image points would seem inexact. near: whether that accuracy and the solution are known but for some unknowns.
    """
    if not near:
        network = _of_sigma(network, _sigma_px(network, state, redundant=False))
        state = solve(_loosened(network, state), state, _ROUGH, still_sigmas=_ROUGH_STILL).state
        network = _of_sigma(network, _sigma_px(network, state, redundant=True))
    for _ in range(_MAX_ROUNDS):
        state = _solved(_loosened(network, state), state, options)
        before, sigma_px = network.tie_sigma_px, _sigma_px(network, state, redundant=True)
        network = _of_sigma(network, sigma_px)
        if abs(sigma_px / before - 1.0) < _SETTLED:
            break
    return network, state


def _solved(network: Network, state: Unknowns, options: Options) -> Unknowns:
    """The solution near `state`."""
    return solve(network, state, options.tolerance, near=True, still_sigmas=options.still_sigmas).state


def _loosened(network: Network, state: Unknowns) -> Network:
    """The network with standard deviations of positions that most of their residuals agree with; the same where the
    stated ones do."""
    usual = _off_sigmas(network, state)[1]
    return replace(network, position_sigmas_m=usual * network.position_sigmas_m) if usual > 1.0 else network


def _of_sigma(network: Network, sigma_px: float) -> Network:
    return replace(network, sigma_px=np.where(network.tie_points, sigma_px, network.sigma_px))


def _sigma_px(network: Network, state: Unknowns, *, redundant: bool) -> float:
    """Standard deviation of a coordinate of a tie point, from the residuals and, with redundant, what the unknowns have
    taken from them. Matches of small blocks have long tails: their median alone would promise too much."""
    apart_px = (residuals_in_sigmas(network, state) * network.sigma_px)[network.tie_points]
    if not len(apart_px):
        return 1.0
    coordinates = 2 * len(apart_px)
    unknowns = 3 * len(state.points_m) + 6 * int((~network.held).sum())
    taken = np.sqrt(coordinates / max(coordinates - unknowns, 0.1 * coordinates)) if redundant else 1.0
    mean_px = np.minimum(apart_px, _OUTLYING * np.median(apart_px)).mean()
    return float(np.clip(mean_px / _MEAN_DISTANCE * taken, _LEAST_SIGMA_PX, _MOST_SIGMA_PX))


def _hold_undetermined(network: Network, state: Unknowns, found: Covariance) -> Network:
    """The network with unknowns of lenses held that it says nothing significant of; the same where there are none."""
    sigmas, prior = found.lens_sigmas, network.lens_sigmas
    change = np.abs(state.lens - network.lens_prior)
    unclear = change < _SIGNIFICANT_SIGMAS * sigmas
    untold = sigmas > _DETERMINED * np.where(np.isfinite(prior), prior, np.inf)
    unseen = _moved_px(network, state, change) < _SEEN_SIGMAS * network.tie_sigma_px
    held = (prior > 0.0) & unclear & (untold | unseen)
    held[:, LENS.index("f")] = False  # its prior weighs
    return replace(network, lens_sigmas=np.where(held, 0.0, prior)) if held.any() else network


def _with_plausible_focal_lengths(network: Network, state: Unknowns, options: Options) -> tuple[Network, Unknowns]:
    """The network with focal lengths held that go where no lens is though the residuals hardly tell, and with them
    where these lenses are centred; and its solution. The same where there are none."""
    row = LENS.index("f")
    prior, sigmas = network.lens_prior[:, row], network.lens_sigmas[:, row]
    far = np.abs(state.lens[:, row] - prior) > _IMPLAUSIBLE_SIGMAS * np.where(sigmas > 0.0, sigmas, np.inf)
    if not far.any():
        return network, state
    held, lens = network.lens_sigmas.copy(), state.lens.copy()
    held[far, row], lens[far, row] = 0.0, prior[far]
    tried = replace(network, lens_sigmas=held)
    solved = solve(tried, replace(state, lens=lens), options.tolerance, still_sigmas=options.still_sigmas)
    if solved.cost > (1.0 + _TELLING_SHARE) * cost(network, state):
        return network, state
    # What such image points say of where a lens is centred is no better.
    central = np.isin(LENS, ("cx", "cy", "p1", "p2", "b1", "b2"))
    held[far[:, None] & central] = 0.0
    lens = np.asarray(np.where(held > 0.0, solved.state.lens, network.lens_prior))
    tried = replace(network, lens_sigmas=held)
    return _with_image_sigma(tried, replace(solved.state, lens=lens), options)


def _moved_px(network: Network, state: Unknowns, change: FloatArray) -> FloatArray:
    """(K, 12) by how much a change of the unknowns of lenses (K, 12) moves an image point at most, pixels."""
    by_lens = np.nan_to_num(np.abs(project_with_derivatives(network, state).by_lens).max(axis=1))
    most = np.zeros_like(change)
    np.maximum.at(most, network.camera[network.image], by_lens)
    return most * change


def _explained(network: Network, state: Unknowns, options: Options) -> tuple[Network, Unknowns]:
    """The network with those further unknowns that its residuals speak for, the clearest first, and its solution."""
    while True:
        found = [_worth(network, state, tried, options.tolerance) for tried in _explanations(network, state, options)]
        taken = max((one for one in found if one is not None), key=lambda one: one[0], default=None)
        if taken is None:
            return network, state
        network, state = taken[1:]


def _worth(
    network: Network, state: Unknowns, tried: Network, tolerance: float
) -> tuple[float, Network, Unknowns] | None:
    """Return by how much further unknowns lower the sum of squares, their network and its solution; None where that is
    too little. Positions weigh by what they are off by once it is taken."""
    unknowns = _freed_since(network, tried)
    if not _count(unknowns):
        return None
    loose_m = _loosened(network, state).position_sigmas_m
    after = solve(replace(tried, position_sigmas_m=loose_m), state, tolerance, near=True).state
    fair = _loosened(tried, after)
    solved = solve(fair, after, tolerance, near=True)
    without = solve(replace(network, position_sigmas_m=fair.position_sigmas_m), state, tolerance, near=True)
    gain = 2.0 * (without.cost - solved.cost)
    if gain < _WORTH_SQUARES * _count(unknowns):
        return None
    after = solved.state
    values = _chosen((after.lens, after.mount, after.flight), unknowns)
    usual = _chosen((tried.lens_sigmas, tried.mount_sigmas, tried.flight_sigmas), unknowns)
    if (np.abs(values) > _BELIEVED_SIGMAS * usual).any() or (after.lens[:, READOUT] < 0.0).any():
        return None
    sigmas = _sigmas(covariance(fair, after), unknowns)
    return (gain, tried, after) if (np.abs(values) > _WORTH_SIGMAS * sigmas).any() else None


def _explanations(network: Network, state: Unknowns, options: Options) -> list[Network]:
    """Networks with one kind of further unknowns each."""
    tried = []
    off = position_residuals_m(network, state) / network.position_sigmas_m
    known = network.located
    if known.any() and float(np.sqrt(np.nanmean(off[known] ** 2))) > _UNEXPLAINED:
        several = np.bincount(network.flight[known], minlength=network.flights) > 0
        shifts = np.zeros_like(network.flight_sigmas)
        if several.sum() > 1:  # against the flight of most images
            shifts[np.arange(len(shifts)) != np.bincount(network.flight[known]).argmax(), :3] = _SHIFT_M
            tried.append(replace(network, flight_sigmas=np.maximum(network.flight_sigmas, shifts)))
        lags = network.flight_sigmas.copy()
        lags[:, 3] = _LAG_S * (np.abs(network.velocities_m_s).sum() > 0.0)
        levers = network.mount_sigmas.copy()
        levers[:, 3:] = _LEVER_M
        tried += [replace(network, flight_sigmas=lags), replace(network, mount_sigmas=levers)]
    if options.readout and np.abs(network.velocities_m_s).sum() > 0.0:
        readout = network.lens_sigmas.copy()
        readout[:, READOUT] = _READOUT_S
        tried.append(replace(network, lens_sigmas=readout))
    return tried


_Freed = tuple[BoolArray, BoolArray, BoolArray]


def _freed_since(before: Network, after: Network) -> _Freed:
    """Return which unknowns of lenses, mounts and flights are free in the second network and not in the first."""
    names = ("lens_sigmas", "mount_sigmas", "flight_sigmas")
    lens, mount, flight = ((getattr(after, name) > 0.0) & (getattr(before, name) == 0.0) for name in names)
    return lens, mount, flight


def _count(freed: _Freed) -> int:
    return int(sum(part.sum() for part in freed))


def _chosen(parts: tuple[FloatArray, FloatArray, FloatArray], freed: _Freed) -> FloatArray:
    """(U,) values of those unknowns. parts: of lenses, mounts and flights."""
    return np.concatenate([part[which] for part, which in zip(parts, freed, strict=True)])


def _sigmas(found: Covariance, freed: _Freed) -> FloatArray:
    parts = (np.diagonal(part, axis1=1, axis2=2) for part in (found.lens, found.mount, found.flight))
    return np.sqrt(np.maximum(np.concatenate([p[w] for p, w in zip(parts, freed, strict=True)]), 0.0))


def _without_far_positions(network: Network, state: Unknowns) -> tuple[Network, Unknowns]:
    """The network without positions that image points put far away, and a rough solution of it.

    With all its weight a wrong position would bend the block to where it fits, and others would seem wrong.
    """
    worst, usual = _off_sigmas(network, state)
    if worst.max(initial=0.0) <= _WRONG_SIGMAS:
        return network, state
    for _ in range(_ROUGH_ROUNDS):  # image points weigh rightly from the second on
        looser = np.maximum(usual, worst / _WRONG_SIGMAS)
        loose = replace(network, position_sigmas_m=network.position_sigmas_m * looser[:, None])
        state = solve(_of_sigma(loose, _sigma_px(network, state, redundant=False)), state, _ROUGH).state
        worst, _ = _off_sigmas(network, state)
    worst, usual = _off_sigmas(network, state)
    return _without(network, worst > _FAR_SIGMAS * usual), state


def _without(network: Network, wrong: BoolArray) -> Network:
    return replace(network, positions_m=np.where(wrong[:, None], np.nan, network.positions_m))


def _with_position_sigmas(network: Network, state: Unknowns, options: Options) -> tuple[Network, Unknowns, FloatArray]:
    """The network solved with the accuracy of positions that their residuals show, without wrong ones; and by how much
    they are less exact than stated, horizontally and vertically."""
    stated, factors = network, np.asarray([1.0, 1.0])
    tight = _solved(stated, state, options)
    bent = _sigma_px(stated, tight, redundant=True) > _BENT * stated.tie_sigma_px
    network, state = (_loosened(stated, state), state) if bent else (stated, tight)
    settled = network is stated
    for _ in range(_MAX_ROUNDS):
        wrong = _wrong_positions(network, state)
        new = _position_factors(stated, network, state, covariance(network, state) if options.final else None, wrong)
        if settled and not wrong.any() and np.abs(new / factors - 1.0).max() < 2.0 * _SETTLED:
            break
        factors, stated, settled = new, _without(stated, wrong), True
        network = replace(stated, position_sigmas_m=stated.position_sigmas_m * factors[[0, 0, 1]])
        state = _solved(network, state, options)
    return network, state, factors


def position_residuals_m(network: Network, state: Unknowns) -> FloatArray:
    """Return measured minus adjusted positions (N, 3), of the antenna and with what was found of the flight; NaN where
    there is none."""
    lever = np.einsum("nji,nj->ni", state.rotations, state.mount[network.camera, 3:])
    off_m = off_by_flight_m(state.flight[network.flight], network.velocities_m_s, network.arms_m)
    expected = state.centers_m + lever + off_m
    return np.where(network.located[:, None], network.positions_m - expected, np.nan)


def _off_sigmas(network: Network, state: Unknowns) -> tuple[FloatArray, float]:
    """(N,) largest coordinates of the residuals of positions, in standard deviations, 0 where there is none; and how
    large these standard deviations are by most of them, at least 1."""
    off = np.abs(position_residuals_m(network, state)) / network.position_sigmas_m
    worst = np.where(np.isfinite(off), off, 0.0).max(axis=1)
    if not network.located.any():
        return worst, 1.0
    usual = float(np.quantile(worst[network.located], _RIGHT, method="lower"))
    return worst, max(1.0, usual / _RIGHT_SIGMAS)


def _wrong_positions(network: Network, state: Unknowns) -> BoolArray:
    """(N,) images whose positions contradict all others."""
    worst, usual = _off_sigmas(network, state)
    return np.asarray(worst > _WRONG_SIGMAS * usual)


def _position_factors(
    stated: Network, network: Network, state: Unknowns, found: Covariance | None, wrong: BoolArray
) -> FloatArray:
    """(2,) by how much positions are less exact than stated, horizontally and vertically; not more exact where it is
    not known what the unknowns take of their residuals. network: with the weights that led to `state`."""
    used = stated.located & ~wrong
    if not used.any():
        return np.ones(2)
    off = (position_residuals_m(stated, state)[used] / stated.position_sigmas_m[used]) ** 2
    # What the unknowns take of the residuals, of each coordinate between all and nothing.
    taken = np.zeros_like(off)
    if found is not None:
        variances = np.diagonal(found.images[:, 3:, 3:], axis1=1, axis2=2)[used]
        taken = np.clip(variances / network.position_sigmas_m[used] ** 2, 0.0, 1.0)
    factors = []
    for axes in ([0, 1], [2]):
        redundancy = float((1.0 - taken[:, axes]).sum())
        factors.append(np.sqrt((off[:, axes].sum() + _STATED_RESIDUALS) / (redundancy + _STATED_RESIDUALS)))
    return np.clip(factors, 1.0 if found is None else _LEAST_FACTOR, _MOST_FACTOR)
