"""Standard deviations of positions, by axis: what is stated of some axes, completed to all three, and by RTK status."""

from __future__ import annotations

import math

Sigmas = tuple[float, float, float]

# Heights by satellites are less exact than horizontal positions by about this factor: none stands below the horizon.
_HEIGHT_FACTOR = 2.0
# DJI's RTK status (RtkFlag, MRK): 50 is a fixed solution, 32 to 49 a floating one, 16 a single point, 0 none.
RTK_NONE, _RTK_FLOAT, RTK_FIXED = 0, 32, 50
# A floating solution is good to some decimetres, whatever the receiver states. metres
FLOAT_SIGMA_M = 0.5


def completed_sigmas_m(
    x_m: float | None = None,
    y_m: float | None = None,
    z_m: float | None = None,
    *,
    across_m: float | None = None,
    overall_m: float | None = None,
) -> Sigmas | None:
    """Standard deviations along x, y, z of what is stated, None where nothing is; those that are not positive do not
    count.

    What is stated of an axis counts before what is stated of both horizontal ones (across_m), and that before what is
    stated of all (overall_m). A height of which nothing is stated has twice the horizontal standard deviation, an axis
    that is left has that of the others.
    """
    across_m = _first_positive(across_m, overall_m)
    x_m, y_m = _first_positive(x_m, across_m), _first_positive(y_m, across_m)
    z_m = _first_positive(z_m, overall_m)
    x_m, y_m = _first_positive(x_m, y_m), _first_positive(y_m, x_m)
    if x_m is None or y_m is None:
        return None if z_m is None else (z_m, z_m, z_m)
    if z_m is None:
        z_m = _HEIGHT_FACTOR * max(x_m, y_m)
    return x_m, y_m, z_m


def _first_positive(*values: float | None) -> float | None:
    """Return the first of the values that is stated and positive, None without one."""
    for value in values:
        if value is not None and value > 0.0:
            return value
    return None


def overall_sigma_m(sigmas_m: Sigmas) -> float:
    """The root mean square of those of three axes."""
    first = sigmas_m[0]
    if sigmas_m == (first, first, first):
        return first
    return math.sqrt(sum(value * value for value in sigmas_m) / 3.0)


def believed_sigmas_m(sigmas_m: Sigmas | None, rtk_flag: float | None) -> tuple[Sigmas | None, str]:
    """What is to be believed of the standard deviations that an RTK receiver states, and what is said of it, or "".

    rtk_flag: DJI's, None where there is none. Without a fixed solution the receiver states how far it scatters, and not
    how far it is off: a floating solution has half a metre at least, and of others nothing is known (None).
    """
    if sigmas_m is None or rtk_flag is None or rtk_flag >= RTK_FIXED:
        return sigmas_m, ""
    if rtk_flag < _RTK_FLOAT:
        return None, "no RTK solution, so that the stated accuracy of the position does not count"
    x_m, y_m, z_m = (max(value, FLOAT_SIGMA_M) for value in sigmas_m)
    return (x_m, y_m, z_m), f"no fixed RTK solution, so that the position counts with {FLOAT_SIGMA_M:g} m at least"
