"""This module states what an adjustment says of a group of images: calibration, accuracy of observations, expected
deformation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX
from aeromatch_cli.results.adjustment import (
    Calibration,
    Correlation,
    Estimate,
    FlightCorrection,
    FlightLens,
    FlightOffset,
    GroupResult,
    HeightErrors,
    LensChange,
    Mount,
    Parameter,
    PositionResiduals,
    Xyz,
    xyz,
)
from aeromatch_cli.sfm.bundle.adjust import position_residuals_m
from aeromatch_cli.sfm.bundle.covariance import Covariance, lens_correlations
from aeromatch_cli.sfm.bundle.network import FLIGHT, LENS, MOUNT, SLOPES, Network, Unknowns
from aeromatch_cli.sfm.model_adjustment import WRONG_SIGMAS, Given, Outcome

# Correlations that are stated, and how many of them.
_STRONG, _MOST_LISTED = 0.9, 5
# Points whose heights stand for those of the whole block: so many, spread over it.
_HEIGHTS = 150
# Slopes of the heights of a flight are said that are so many of their standard deviations.
_SIGNIFICANT = 3.0
# Cells along the longer side of the map of expected errors of height.
_CELLS = 12


@dataclass(frozen=True)
class Names:
    """Names of what an adjustment knows by numbers. images, cameras: of the numbers from 1; flights: from 0."""

    images: Sequence[str]
    cameras: Sequence[str]
    flights: Sequence[str]

    def image(self, number: int) -> str:
        return self.images[number - 1]

    def camera(self, number: int) -> str:
        return self.cameras[number - 1]

    def flight(self, number: int) -> str:
        """Empty for -1, which stands for images that belong to no flight."""
        return self.flights[number] if number >= 0 else ""


def adjusted_group(group: GroupResult, outcome: Outcome, given: Given, names: Names) -> GroupResult:
    """Return a group with what its adjustment has found. given: what its images had."""
    network, state, found = outcome.result.network, outcome.result.state, outcome.result.found
    heights = None if found is None else _heights(network, state, found, metric=group.kind != "level")
    return group.model_copy(
        update={
            "sigma_px": outcome.result.sigma_px,
            "positions": _positions(group.kind, outcome, given, names),
            "flights": _flights(outcome, names),
            "mounts": _mounts(outcome, names),
            "calibration": {names.camera(n): _calibration(outcome, k, names) for k, n in enumerate(outcome.cameras)},
            "heights": heights,
        }
    )


def _positions(kind: str, outcome: Outcome, given: Given, names: Names) -> PositionResiduals | None:
    """Return how positions agree with the adjusted block.

    Positions that were left out before the adjustment, because they lay too far off, count as wrong ones. Where given
    poses have too few positions for these to be used, only those count that lie too far off.
    """
    result, rows = outcome.result, np.array(outcome.images, dtype=int) - 1
    steps_m = 0.0 if outcome.steps_m is None else outcome.steps_m[rows][:, None] * [0.0, 0.0, 1.0]
    stated = replace(
        result.network, positions_m=given.positions_m[rows] - steps_m, position_sigmas_m=given.sigmas_m[rows]
    )
    known, used = stated.located, result.network.located
    if not known.any():
        return None
    off_m = position_residuals_m(stated, result.state)
    wrong = known & ~used
    if kind == "given" and not used.any():
        wrong &= np.linalg.norm(off_m, axis=1) > WRONG_SIGMAS * given.mean_sigmas_m[rows]
    return PositionResiduals(
        images=int(known.sum()),
        used=int(used.sum()),
        wrong=[names.image(outcome.images[k]) for k in np.flatnonzero(wrong)],
        rms_m=_rms(off_m[used]),
        rms_sigmas=_rms((off_m / stated.position_sigmas_m)[used]),
        stated_m=xyz(np.median(stated.position_sigmas_m[known], axis=0)),
        factors=(float(result.position_factors[0]), float(result.position_factors[1])),
        flights=_offsets(outcome, off_m, used, names),
    )


def _offsets(outcome: Outcome, off_m: FloatArray, used: BoolArray, names: Names) -> list[FlightOffset]:
    """Return, for every flight with used positions, by how much these lie off on average, and how they scatter."""
    flight = outcome.result.network.flight
    listed = []
    for row, number in enumerate(outcome.flights):
        own_m = off_m[used & (flight == row)]
        if len(own_m):
            means = {"mean_m": xyz(own_m.mean(axis=0)), "scatter_m": xyz(own_m.std(axis=0))}
            listed.append(FlightOffset(flight=names.flight(number), images=len(own_m), **means))
    return listed


def _rms(values: FloatArray) -> Xyz | None:
    return xyz(np.sqrt((values**2).mean(axis=0))) if len(values) else None


def _flights(outcome: Outcome, names: Names) -> list[FlightCorrection]:
    """Return what was found of flights: steps of height taken out before, shifts, delays of positions."""
    network, state, found = outcome.result.network, outcome.result.state, outcome.result.found
    listed = []
    for row, number in enumerate(outcome.flights):
        images = [i for i, flight in zip(outcome.images, network.flight, strict=True) if flight == row]
        step_m = 0.0 if outcome.steps_m is None else float(outcome.steps_m[images[0] - 1])
        free = network.flight_sigmas[row] > 0.0
        sigmas = np.zeros(6) if found is None else np.sqrt(np.maximum(np.diag(found.flight[row]), 0.0))
        free[SLOPES] &= np.abs(state.flight[row, SLOPES]) > _SIGNIFICANT * sigmas[SLOPES]
        if not free.any() and step_m == 0.0:
            continue
        values = {FLIGHT[k]: Estimate(float(state.flight[row, k]), float(sigmas[k])) for k in np.flatnonzero(free)}
        listed.append(FlightCorrection(flight=names.flight(number), images=len(images), step_m=step_m, **values))
    return listed


def _mounts(outcome: Outcome, names: Names) -> dict[str, Mount]:
    """Return boresight and lever arm of every camera, by camera_id."""
    network, state, found = outcome.result.network, outcome.result.state, outcome.result.found
    mounts = {}
    for row, number in enumerate(outcome.cameras):
        free = network.mount_sigmas[row] > 0.0
        if free.any():
            sigmas = np.zeros(6) if found is None else np.sqrt(np.maximum(np.diag(found.mount[row]), 0.0))
            scale = np.array([np.rad2deg(1.0)] * 3 + [1.0] * 3)
            mounts[names.camera(number)] = Mount(
                **{
                    MOUNT[k]: Estimate(float(state.mount[row, k] * scale[k]), float(sigmas[k] * scale[k]))
                    for k in np.flatnonzero(free)
                }
            )
    return mounts


def _calibration(outcome: Outcome, row: int, names: Names) -> Calibration:
    network, state, found, stated = (
        outcome.result.network, outcome.result.state, outcome.result.found, outcome.result.stated
    )  # fmt: skip
    sigmas = np.zeros(len(LENS)) if found is None else found.lens_sigmas[row]
    free = network.lens_sigmas[row] > 0.0
    corner_px = np.array([COLMAP_OFFSET_PX * (name in ("cx", "cy")) for name in LENS])
    values, priors = state.lens[row] + corner_px, stated.lens_prior[row] + corner_px
    parameters = {}
    for k, name in enumerate(LENS):
        if name == "unused" or (name == "readout_s" and not free[k]):
            continue
        sigma = float(sigmas[k]) if free[k] else 0.0
        parameters[name] = Parameter(float(values[k]), sigma, float(priors[k]), float(stated.lens_sigmas[row, k]))
    strong = []
    if found is not None:
        for camera, first, second, value in lens_correlations(found):
            if camera == row and abs(value) > _STRONG:
                strong.append(Correlation(first, second, round(value, 3)))
    change, worth = np.zeros(len(LENS)), 0.0
    if outcome.if_freed is not None:
        changes, worth = outcome.if_freed
        change = changes[row]
    return Calibration(
        images=int((network.camera == row).sum()),
        parameters=parameters,
        if_freed=LensChange(change=_changes(change), worth=worth),
        correlations=strong[:_MOST_LISTED],
        flights=[
            FlightLens(
                flight=names.flight(outcome.flights[one.flight]),
                images=int(((network.camera == row) & (network.flight == one.flight)).sum()),
                change=_changes(one.change),
                worth=one.worth,
            )
            for one in outcome.result.flight_lenses
            if one.camera == row
        ],
    )


def _changes(change: FloatArray) -> dict[str, float]:
    """Return, by name of parameter, those of the changes (12,) that are not zero."""
    return {LENS[k]: float(change[k]) for k in np.flatnonzero(change)}


def _heights(network: Network, state: Unknowns, found: Covariance, *, metric: bool) -> HeightErrors | None:
    """Expected errors of the heights of points over the block, None with few points. metric: whether lengths of the
    frame are metres.

    Where place and scale are open (a free network) the errors are those of the shape.
    """
    rows = _spread(network, state)
    if len(rows) < 6:
        return None
    together = found.of_points(rows)[2::3, 2::3]
    xy = state.points_m[rows, :2]
    middle, reach = xy.mean(axis=0), float(np.abs(xy - xy.mean(axis=0)).max()) or 1.0
    x, y = ((xy - middle) / reach).T
    shapes = np.column_stack([np.ones_like(x), x, y, x * x + y * y])
    fit = np.linalg.pinv(shapes)
    covariance = fit @ together @ fit.T
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    heights_m = np.sqrt(np.maximum(np.diag(together), 0.0))
    return HeightErrors(
        metric=metric,
        sigma=float(np.median(heights_m)),
        bowl=float(sigmas[3]),
        tilt=float(np.hypot(sigmas[1], sigmas[2])),
        reach=reach,
        pixel=_ground_pixel(network, state),
        points=[(float(px), float(py), float(sigma)) for (px, py), sigma in zip(xy, heights_m, strict=True)],
    )


def _ground_pixel(network: Network, state: Unknowns) -> float:
    """Return the size of a pixel on the ground, in units of the frame: a median over images of medians over points."""
    away = state.points_m[network.point] - state.centers_m[network.image]
    depths = np.einsum("mi,mi->m", away, state.rotations[network.image, 2])
    pixels = depths / state.lens[network.camera[network.image], 0]
    return float(np.median([np.median(pixels[network.image == image]) for image in np.unique(network.image)]))


def _spread(network: Network, state: Unknowns) -> IntArray:
    """Rows of points all over the block that at least three images see, where there are any."""
    seen = np.bincount(network.point, minlength=len(state.points_m))
    usable = np.flatnonzero(np.isfinite(state.points_m).all(axis=1) & (seen >= min(3, int(seen.max(initial=0)))))
    if len(usable) <= _HEIGHTS:
        return usable
    xy = state.points_m[usable, :2]
    low, high = np.quantile(xy, [0.01, 0.99], axis=0)
    cell_m = max(float((high - low).max()), 1e-9) / _CELLS
    cells = np.clip((xy - low) // cell_m, 0, _CELLS).astype(int)
    order = np.random.default_rng(0).permutation(len(usable))
    _, first = np.unique(cells[order] @ [1, _CELLS + 1], return_index=True)
    return np.asarray(usable[np.sort(order[first])][:_HEIGHTS])
