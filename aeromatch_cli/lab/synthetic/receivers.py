"""Positions as receivers on board give them."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray

# Standard deviations of x, y, z.
RTK_M = (0.02, 0.02, 0.03)
# Of GPS without corrections: a drift that all pictures of a flight share, and what each has by itself.
GPS_COMMON_M, GPS_OWN_M = 5.0, 1.0
GPS_M = (float(np.hypot(GPS_COMMON_M, GPS_OWN_M)),) * 3


def rtk_errors_m(count: int, rng: np.random.Generator) -> FloatArray:
    """(N, 3), independent."""
    return np.asarray(rng.standard_normal((count, 3)) * RTK_M)


def gps_errors_m(count: int, rng: np.random.Generator) -> FloatArray:
    """(N, 3) in the order of taking: half a wave or so, and noise."""
    phase = np.linspace(0.0, 1.0, count)[:, None] * rng.uniform(0.5, 1.5, 3) * np.pi
    common = rng.standard_normal(3) * np.cos(phase) + rng.standard_normal(3) * np.sin(phase)
    return np.asarray(GPS_COMMON_M * common + GPS_OWN_M * rng.standard_normal((count, 3)))
