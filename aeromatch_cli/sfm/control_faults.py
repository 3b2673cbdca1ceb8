"""This module finds what is wrong with a list of control points as a whole: a unit, exchanged axes, a sign."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray

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
