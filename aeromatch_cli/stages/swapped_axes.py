"""Whether given positions that contradict the pictures fit them in another reading of their columns."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from aeromatch_cli.blocks.crs import LOCAL, geographic_from_grid, grid_from_geographic, utm_crs
from aeromatch_cli.data import Block, FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.sfm.georeferencing import place
from aeromatch_cli.sfm.mapping import Model


def fitting_reading(block: Block, model: Model) -> str:
    """Return how the given positions fit a model that contradicts them: "exchanged" (latitude and longitude),
    "mirrored", or "" where they do not.

    Longitudes in the place of latitudes lie in another zone: they are not merely mirrored there. With x and y
    exchanged, or one of them of another sign, positions are the same up to a turn about the vertical.
    """
    ids = sorted(model.centers_m.keys() & block.poses.keys())
    if len(ids) < 3:  # two of them fit anything
        return ""
    centers = np.array([model.centers_m[i] for i in ids])
    given_m = np.array([block.poses[i].center_m for i in ids])
    sigmas_m = np.array([block.poses[i].sigma_position_m for i in ids])
    for reading, positions_m in _readings(block, given_m):
        placement = place(centers, model.points_m, positions_m, sigmas_m)
        # Some of few positions fit any reading by chance.
        if placement.kind == "positions" and not placement.contradiction and placement.trusted:
            return reading
    return ""


def _readings(block: Block, given_m: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Names of readings, and positions (N, 3) in these, about their middle."""
    if block.crs != LOCAL:
        latitudes, longitudes = geographic_from_grid(block.crs, given_m[:, :2] + np.array(block.origin_m[:2])).T
        try:
            zone = utm_crs(longitudes, latitudes)
        except ConfigError:  # beyond the poles: those are no latitudes
            zone = ""
        places_m = grid_from_geographic(zone, longitudes, latitudes) if zone else np.full((1, 2), np.nan)
        if np.isfinite(places_m).all():
            yield "exchanged", np.column_stack([places_m - places_m.mean(axis=0), given_m[:, 2]])
    yield "mirrored", given_m[:, [1, 0, 2]]
