"""Which views of two images show the same things comparable."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import BoolArray, Features, FloatArray


def comparable_views(features0: Features, features1: Features, max_direction_deg: float) -> BoolArray:
    """View pairs (V0, V1) worth comparing: pictures as taken, of distant ground too, with each other, and simulated
    views whose directions differ by at most max_direction_deg. A view of unknown direction is compared with every view.
    """
    directions0, directions1 = (np.asarray(f.view_directions, np.float64) for f in (features0, features1))
    return comparable(directions0, directions1, _is_source(features0), _is_source(features1), max_direction_deg)


def comparable(
    directions0: FloatArray, directions1: FloatArray, source0: BoolArray, source1: BoolArray, max_direction_deg: float
) -> BoolArray:
    """(V0, V1) as in `comparable_views`. directions: (V, 3) unit vectors, NaN where unknown. source: (V,) bool."""
    known0, known1 = (np.asarray(np.isfinite(directions).all(axis=1)) for directions in (directions0, directions1))
    with np.errstate(invalid="ignore"):
        found = directions0 @ directions1.T >= np.cos(np.deg2rad(max_direction_deg)) - 1e-6
    found &= source0[:, None] == source1
    found |= source0[:, None] & source1
    found |= ~known0[:, None] | ~known1
    return np.asarray(found)


def appearances(features0: Features, features1: Features) -> list[BoolArray]:
    """View pairs (V0, V1) of the pictures as taken, and of the enhanced ones where either image has any.

    A picture in which nothing was enhanced is its own enhanced one.
    """
    found = [~features0.view_enhanced[:, None] & ~features1.view_enhanced]
    if features0.view_enhanced.any() or features1.view_enhanced.any():
        sides = [f.view_enhanced if f.view_enhanced.any() else ~f.view_enhanced for f in (features0, features1)]
        found.append(sides[0][:, None] & sides[1])
    return found


def _is_source(features: Features) -> BoolArray:
    """The source, or its part with distant ground, is the first view of its picture where there is one, without a
    ground sampling distance and not turned from its own axis."""
    flags = np.isnan(features.view_gsd_m) & (features.view_angles_deg == 0.0)
    first = np.ones(len(flags), dtype=bool)
    first[1:] = features.view_enhanced[1:] != features.view_enhanced[:-1]
    return np.asarray(flags & first)
