"""Control points as observations of the adjustment, kept only where points that take no part in it get better.

A control point is a point of the network whose coordinates are observed with their standard deviations, as are its
image points. Positions of the images keep their shape: what all of a flight have in common (another geoid, another
base station) is an unknown then, so that control and positions do not fight for the datum. Where a list as a whole does
not fit the block, `fault_of_list` looks for what is wrong with it: a unit, exchanged axes, a sign.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.cameras import BROWN, FISHEYE, world_rays
from aeromatch_cli.results.adjustment import ControlInGroup, Xyz, xyz
from aeromatch_cli.sfm.bundle.adjust import adjust
from aeromatch_cli.sfm.bundle.network import Network, Unknowns
from aeromatch_cli.sfm.bundle.normal_equations import cost
from aeromatch_cli.sfm.bundle.solve import solve
from aeromatch_cli.sfm.calibration import camera_of
from aeromatch_cli.sfm.control import intersected
from aeromatch_cli.sfm.model_adjustment import Outcome, Work, take_outcome

# Control points farther from the block than this, metres, are in another coordinate system.
_FAR_M = 300.0
# Standard deviation of what the positions of a flight have in common, metres: from one geoid or datum to another.
_DATUM_M = 100.0
# Control points contradict each other where they raise the sum of squares by more than so many times what chance does;
# one of them is wrong where that falls by this factor without it, and does not without any other one.
_CONTRADICTING, _TOLD = 4.0, 3.0
# So many points tell a wrong one.
_TELLING = 4
# An adjustment that starts from the solution of nearly the same network ends when a step lowers the cost by less.
_TOLERANCE = 1e-4
# So many points tell.
_LEAST_POINTS = 3
# A fault explains the list where points lie nearer by this factor with it put right, and so near in units of their
# extent.
_EXPLAINED, _FITTING = 10.0, 0.01
_FOOT_M = 0.3048
_X, _Y, _Z = np.eye(3)
# What a list may have -> coordinates as they should be, by those that it has.
_FAULTS: tuple[tuple[str, FloatArray], ...] = (
    ("their x and y are exchanged", np.array([_Y, _X, _Z])),
    ("they are in feet, not in metres", _FOOT_M * np.eye(3)),
    ("they are in metres and were taken as feet", np.eye(3) / _FOOT_M),
    ("their x and y are in feet, not in metres", np.diag([_FOOT_M, _FOOT_M, 1.0])),
    ("their heights are in feet, not in metres", np.diag([1.0, 1.0, _FOOT_M])),
    ("their x has the other sign", np.diag([-1.0, 1.0, 1.0])),
    ("their y has the other sign", np.diag([1.0, -1.0, 1.0])),
    ("their heights have the other sign", np.diag([1.0, 1.0, -1.0])),
)


@dataclass(frozen=True)
class Surveyed:
    """A control point of the task. position_m: (3,); sigmas_m: (3,); pixels: (image number, x, y), from the centre of
    the first pixel; check: it takes no part."""

    name: str
    position_m: tuple[float, ...]
    sigmas_m: tuple[float, ...]
    sigma_px: float
    check: bool
    pixels: tuple[tuple[int, float, float], ...]

    @classmethod
    def of_task(cls, entry: dict[str, Any]) -> Surveyed:
        pixels = tuple((int(number), float(x), float(y)) for number, x, y in entry["pixels"])
        return cls(
            entry["name"],
            tuple(entry["position_m"]),
            tuple(entry["sigmas_m"]),
            entry["sigma_px"],
            entry["check"],
            pixels,
        )

    def seen_by(self, images: Collection[int]) -> int:
        return sum(number in images for number, _, _ in self.pixels)


def with_control(
    work: Work, model: Any, outcome: Outcome, surveyed: Sequence[Surveyed]
) -> tuple[Outcome, ControlInGroup | None]:
    """Return the block adjusted once more with control points, where that makes held-out points better; and what was
    found, None where no point is measured in two images."""
    images = set(outcome.images)
    base = _Block(outcome.result.network, outcome.result.state, outcome)
    seen = [point for point in surveyed if point.seen_by(images) >= 2 and np.isfinite(base.error_m(point)).all()]
    if not seen:
        return outcome, None
    control, checks = [p for p in seen if not p.check], [p for p in seen if p.check]
    without_m = {point.name: base.error_m(point) for point in seen}
    errors_m = np.array(list(without_m.values()))
    offset_m = np.median(errors_m, axis=0)
    stated_m = np.array([point.position_m for point in seen])
    fault = fault_of_list(stated_m + errors_m, stated_m)
    if not control or fault or float(np.abs(offset_m).max()) > _FAR_M:
        return outcome, _as_it_is(_errors(without_m, checks), fault, kept=not control)
    exchanged = _exchanged(base, control)
    used = [point for point in control if point.name not in exchanged]
    solved, rests, used, wrong = _without_wrong(work, base.moved(-offset_m), used)
    held_out = checks or (used if len(used) > 1 else [])
    held_out_m = _held_out_errors_m(solved, rests, used, checks)
    before_m = _errors(without_m, held_out)
    kept = _is_as_good(solved, held_out_m, before_m)
    found = ControlInGroup(
        used=[point.name for point in used] if kept else [],
        wrong=wrong,
        exchanged=exchanged,
        fault="",
        held_out="check points" if checks else "leave one out",
        held_out_rms_m=_rms(held_out_m) if held_out else None,
        without_rms_m=_rms(before_m),
        kept=kept,
    )
    if not kept:
        return outcome, found
    taken = replace(outcome, result=replace(solved.outcome.result, stated=outcome.result.stated))
    take_outcome(work, model, taken)
    return taken, found


def _errors(errors_m: Mapping[str, FloatArray], points: Sequence[Surveyed]) -> FloatArray:
    """Return the errors (N, 3) of some points. errors_m: by name of a point, (3,) each."""
    return np.array([errors_m[point.name] for point in points]).reshape(-1, 3)


def _is_as_good(solved: _Block, held_out_m: FloatArray, before_m: FloatArray) -> bool:
    """Whether a block is whole and its errors (N, 3) at held-out points are no larger than before."""
    if not np.isfinite(solved.state.centers_m).all():
        return False
    return not len(before_m) or _size(held_out_m) <= _size(before_m)


def _held_out_errors_m(
    solved: _Block, rests: Sequence[_Block], used: Sequence[Surveyed], checks: Sequence[Surveyed]
) -> FloatArray:
    """Return the errors (N, 3) at check points, without any at every control point in the block without it. rests: the
    block without each point of `used`."""
    if checks:
        return np.array([solved.error_m(point) for point in checks])
    errors_m = [rest.error_m(point) for rest, point in zip(rests, used, strict=True)]
    return np.array(errors_m).reshape(-1, 3)


def _as_it_is(check_errors_m: FloatArray, fault: str, *, kept: bool) -> ControlInGroup:
    """Return what is known of control points that take no part, because they do not fit or because there are none.

    check_errors_m: (N, 3) of the check points. fault: of the list. kept: whether the block lacks control points.
    """
    rms_m = _rms(check_errors_m)
    return ControlInGroup(
        used=[],
        wrong=[],
        exchanged=[],
        fault=fault,
        held_out="check points",
        held_out_rms_m=rms_m,
        without_rms_m=rms_m,
        kept=kept,
    )


def _without_wrong(
    work: Work, start: _Block, used: Sequence[Surveyed]
) -> tuple[_Block, list[_Block], list[Surveyed], list[str]]:
    """Return the block adjusted with control points, without each of them, those that are left, and those that
    contradict the others: one after the other the worst is taken out."""
    used, wrong = list(used), list[str]()
    while True:
        solved = start.adjusted(work, used)
        rests = [solved.without([other for other in used if other is not point]) for point in used]
        worst = _worst(solved, rests, len(used)) if len(used) >= _TELLING else None
        if worst is None:
            return solved, rests, used, wrong
        wrong.append(used.pop(worst).name)


@dataclass(frozen=True, eq=False)
class _Block:
    """A solved network; points of `outcome.points` come first, control points after them."""

    network: Network
    state: Unknowns
    outcome: Outcome

    @property
    def solution(self) -> tuple[Network, Unknowns]:
        return self.network, self.state

    def moved(self, by_m: FloatArray) -> _Block:
        """The block as a whole elsewhere, as far from its positions: an adjustment starts best where control is."""
        state, flight = self.state, self.state.flight.copy()
        flight[:, :3] -= by_m
        centers_m, points_m = state.centers_m + by_m, state.points_m + by_m
        return replace(self, state=replace(state, centers_m=centers_m, points_m=points_m, flight=flight))

    def with_points(self, points: Sequence[Surveyed]) -> tuple[Network, Unknowns]:
        """The network of tie points with these control points instead of what it has."""
        ties = len(self.outcome.points)
        own = self.network.point < ties
        row = {number: k for k, number in enumerate(self.outcome.images)}
        places = [
            (row[n], ties + k, x, y, p.sigma_px) for k, p in enumerate(points) for n, x, y in p.pixels if n in row
        ]
        image, point, x, y, sigma_px = np.array(places).reshape(-1, 5).T
        old = self.network
        network = replace(
            old,
            image=np.concatenate([old.image[own], image.astype(np.int64)]),
            point=np.concatenate([old.point[own], point.astype(np.int64)]),
            xy_px=np.concatenate([old.xy_px[own], np.column_stack([x, y])]),
            sigma_px=np.concatenate([old.sigma_px[own], sigma_px]),
            control=ties + np.arange(len(points)),
            control_m=np.array([p.position_m for p in points]).reshape(-1, 3),
            control_sigmas_m=np.array([p.sigmas_m for p in points]).reshape(-1, 3),
        )
        found = [self.place_m(p) for p in points]
        start_m = [p.position_m if place is None else place for p, place in zip(points, found, strict=True)]
        points_m = np.concatenate([self.state.points_m[:ties], np.array(start_m).reshape(-1, 3)])
        state = replace(self.state, points_m=points_m)
        return network, state

    def place_m(self, point: Surveyed) -> FloatArray | None:
        """(3,) where the rays of the block meet, None where they do not."""
        row = {number: k for k, number in enumerate(self.outcome.images)}
        seen = [(row[n], x, y) for n, x, y in point.pixels if n in row]
        rays = [world_rays(self._camera(k), self.state.rotations[k], np.array([[x, y]]))[0] for k, x, y in seen]
        return intersected(self.state.centers_m[[k for k, _, _ in seen]], np.array(rays).reshape(-1, 3))

    def _camera(self, image: int) -> Camera:
        """Return the camera of an image; the size of its pictures plays no part."""
        camera = self.network.camera[image]
        kind = Camera(FISHEYE if self.network.fisheye[camera] else BROWN, 0, 0, ())
        return camera_of(self.state.lens[camera], kind)

    def error_m(self, point: Surveyed) -> FloatArray:
        """(3,) where the rays of the block meet, less the surveyed position; NaN where they do not."""
        place_m = self.place_m(point)
        return np.full(3, np.nan) if place_m is None else place_m - np.array(point.position_m)

    def adjusted(self, work: Work, points: Sequence[Surveyed]) -> _Block:
        """The block with these control points, all else determined anew."""
        network, state = self.with_points(points)
        shifts = network.flight_sigmas.copy()
        shifts[:, :3] = _DATUM_M
        result = adjust(replace(network, flight_sigmas=shifts), state, work.options)
        return _Block(result.network, result.state, replace(self.outcome, result=result))

    def without(self, points: Sequence[Surveyed]) -> _Block:
        """The block with these control points alone, weights and calibration's unknowns as they are."""
        network, state = self.with_points(points)
        return replace(self, network=network, state=solve(network, state, _TOLERANCE, near=True).state)


def _worst(block: _Block, rests: Sequence[_Block], count: int) -> int | None:
    """The control point that the others contradict, None where there is none. rests: the block without each of them."""
    free = cost(*block.without([]).solution)
    squares = [2.0 * (cost(*one.solution) - free) for one in (block, *rests)]
    # Of three coordinates each, less the seven of a similarity that images and positions may leave open.
    expected = max(3.0 * count - 7.0, 1.0), max(3.0 * (count - 1) - 7.0, 1.0)
    best, second = np.argsort(squares[1:])[:2] + 1
    contradicting = squares[0] > _CONTRADICTING * expected[0]
    limit = _TOLD * max(squares[best], expected[1])
    return int(best) - 1 if contradicting and squares[0] > limit and squares[second] > limit else None


def _exchanged(base: _Block, control: Sequence[Surveyed]) -> list[str]:
    """Names of two control points each of which lies where the other was surveyed, after what all have in common."""
    if len(control) < _TELLING:
        return []
    found_m = np.array([base.error_m(point) + point.position_m for point in control])
    stated_m = np.array([point.position_m for point in control])
    common_m = np.median(found_m - stated_m, axis=0)
    apart_m = np.linalg.norm(found_m[:, None] - common_m - stated_m[None], axis=2)
    nearest = np.argmin(apart_m, axis=1)
    return [p.name for k, p in enumerate(control) if nearest[k] != k and nearest[nearest[k]] == k]


def _size(errors_m: FloatArray) -> float:
    return float(np.sqrt((errors_m**2).sum(axis=1).mean()))


def _rms(errors_m: FloatArray) -> Xyz | None:
    """Return the root mean square (3,) of errors (N, 3), metres; None without points, or where rays do not meet."""
    if not len(errors_m) or not np.isfinite(errors_m).all():
        return None
    return xyz(np.round(np.sqrt((errors_m**2).mean(axis=0)), 4))


def fault_of_list(found_m: FloatArray, stated_m: FloatArray) -> str:
    """Return the fault that explains why points (N, 3) do not lie where they were surveyed, "" where none does.

    found_m: where the block has them, metres. Whatever all have in common, such as another zero of heights, is no fault
    of this kind.
    """
    if len(found_m) < _LEAST_POINTS:
        return ""
    as_it_is_m = _apart_m(found_m, stated_m)
    extent_m = float(np.linalg.norm(np.ptp(found_m, axis=0)))
    apart_m = [_apart_m(found_m, stated_m @ right.T) for _, right in _FAULTS]
    best = int(np.argmin(apart_m))
    explained = apart_m[best] * _EXPLAINED < as_it_is_m and apart_m[best] < _FITTING * extent_m
    return _FAULTS[best][0] if explained and as_it_is_m > _FITTING * extent_m else ""


def _apart_m(found_m: FloatArray, stated_m: FloatArray) -> float:
    """Median distance, after what all have in common."""
    off_m = found_m - stated_m
    return float(np.median(np.linalg.norm(off_m - np.median(off_m, axis=0), axis=1)))
