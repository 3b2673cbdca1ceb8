"""Which views of two images show the same things alike."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import BoolArray, Features


def like_views(features0: Features, features1: Features, max_direction_deg: float) -> BoolArray:
    """View pairs (V0, V1) worth comparing: source with source, and simulated views whose directions differ by at most
    max_direction_deg. A view of unknown direction is compared with every view.
    """
    known0, known1 = (np.asarray(np.isfinite(f.view_directions).all(axis=1)) for f in (features0, features1))
    source0, source1 = _is_source(features0), _is_source(features1)
    with np.errstate(invalid="ignore"):
        cosines = features0.view_directions.astype(np.float64) @ features1.view_directions.astype(np.float64).T
        alike = cosines >= np.cos(np.deg2rad(max_direction_deg)) - 1e-6
    alike &= source0[:, None] == source1
    alike |= source0[:, None] & source1
    alike |= ~known0[:, None] | ~known1
    return np.asarray(alike)


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
    """The source is the first view of its picture where there is one, without a ground sampling distance and not turned
    from its own axis."""
    flags = np.isnan(features.view_gsd_m) & (features.view_angles_deg == 0.0)
    first = np.ones(len(flags), dtype=bool)
    first[1:] = features.view_enhanced[1:] != features.view_enhanced[:-1]
    return np.asarray(flags & first)
