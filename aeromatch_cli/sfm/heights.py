"""Heights that count from two zeros: the ellipsoid and the geoid, as those of GNSS receivers and of surveyors do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from aeromatch_cli.results.adjustment import GroupResult

# The geoid lies between these heights above the ellipsoid (106 m below it south of India, 85 m above at New Guinea);
# the difference may have either sign, and what is smaller than the last is as likely another fault.
_LOWEST_M, _HIGHEST_M, _LEAST_M = -110.0, 90.0, 2.0
# Differences of the geoid's size are nearly constant in a block: flights, or points, agree to so many metres, or
# standard deviations.
_ALIKE_M, _ALIKE_SIGMAS = 0.5, 3.0


def is_undulation(metres: float) -> bool:
    """Whether heights may differ by so much because one counts from the ellipsoid, the other from the geoid."""
    return _LEAST_M <= abs(metres) <= max(-_LOWEST_M, _HIGHEST_M)


def zeros_words(metres: float) -> str:
    """Say what probably causes a constant difference of heights."""
    if is_undulation(metres):
        return "most likely one counts from the ellipsoid (GNSS, RTK), the other from the geoid (sea level)"
    return "they count from another zero (take-off point, ellipsoid, sea level)"


def height_remedy(metres: float, other: str) -> str:
    """Say how to bring the block to the heights of something else, which lie so many metres above its own."""
    exactly = (
        ", or name both (--crs EPSG:32633+5773, block.heights) where PROJ has the geoid"
        if is_undulation(metres)
        else ""
    )
    return f"to have the block in the heights of {other}: --set block.height_shift_m={metres:.2f}{exactly}"


def shift_to_control_m(group: GroupResult) -> float | None:
    """Return how far heights of the positions of a group lie above those of its control points, metres, where control
    points hold it, all flights are off by nearly the same, and neither sideways; None otherwise."""
    if group.control is None or not group.control.used or not group.flights:
        return None
    stated_m = np.zeros(3) if group.positions is None else np.array(group.positions.stated_m)
    shifts_m = np.array([[one.value for one in flight.shifts] for flight in group.flights])
    shifts_m[:, 2] += [flight.step_m for flight in group.flights]
    limits_m = np.maximum(_ALIKE_M, _ALIKE_SIGMAS * stated_m)
    up_m = float(np.median(shifts_m[:, 2]))
    alike = np.abs(shifts_m - [0.0, 0.0, up_m]) <= limits_m
    if not is_undulation(up_m) or abs(up_m) <= limits_m[2] or not alike.all():
        return None
    return up_m


def shift_of_points_m(errors_m: Sequence[Sequence[float]], sigmas_m: Sequence[float]) -> float | None:
    """Return how far a block lies above surveyed points, metres, where their heights differ by nearly the same, and no
    more sideways than is expected; None otherwise. errors_m: (N, 3) block less survey; sigmas_m: (3,) of one point."""
    errors, limits_m = np.array(errors_m).reshape(-1, 3), np.maximum(_ALIKE_M, _ALIKE_SIGMAS * np.array(sigmas_m))
    if len(errors) < 2:
        return None
    up_m = float(np.median(errors[:, 2]))
    off = np.abs(errors - [0.0, 0.0, up_m]) <= limits_m
    return up_m if is_undulation(up_m) and abs(up_m) > limits_m[2] and bool(off.all()) else None
