"""Checks of what a pose list, EXIF tags and a ground claim together. Each warning is one sentence: what is odd, in
which images, and what to do."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import Block, BoolArray, FloatArray
from aeromatch_cli.geometry.footprints import (
    MAX_DISTANCE_FACTOR,
    Degenerate,
    block_footprints,
    degenerate_words,
    sees_horizon,
)
from aeromatch_cli.geometry.places import place_labels
from aeromatch_cli.geometry.rotations import angle_between_deg, from_omega_phi_kappa, from_yaw_pitch_roll, rotation_z
from aeromatch_cli.words import counted, listed

# Image names (N,) as an array, so that masks select them.
Names = NDArray[np.object_]

_PLACES_SHOWN = 3
_LOWEST_HEIGHT_M, _HIGHEST_HEIGHT_M = 5.0, 10_000.0
_NULL_ISLAND_DEG = 0.01
# Dry land lies hardly below sea level: a ground this low below images that fly above 0 most likely means altitudes
# above the take-off point, or above the ellipsoid, which lies up to 106 m above sea level.
_LOW_GROUND_M = -40.0
# Largest relative altitude that is worth suspecting.
_RELATIVE_ALTITUDE_M = 1500.0


def warnings_of(block: Block, unpaired: Collection[str] = ()) -> tuple[str, ...]:
    """Every warning about a block, the gravest first.

    unpaired: names of the images that no pair holds.
    """
    ids = [i.image_id for i in block.images if i.image_id in block.poses]
    names_by_id = block.names
    names = np.array([names_by_id[image_id] for image_id in ids], dtype=object)
    centers = np.array([block.poses[image_id].center_m for image_id in ids]).reshape(-1, 3)
    degenerate = {i: one.degenerate for i, one in block_footprints(block).items() if one.degenerate is not None}
    found = [
        *_position_warnings(block, names, centers),
        *_height_warnings(block, names, centers, np.array([i in degenerate for i in ids], dtype=bool)),
        *_degenerate_warnings(block, degenerate),
        *_attitude_warnings(block, ids, names),
    ]
    if unpaired and len(block.images) > 1:
        found.append(f"{_some(list(unpaired))} in no pair: check the poses, or lower pairs.min_overlap")
    return tuple(found)


def _position_warnings(block: Block, names: Names, centers: FloatArray) -> list[str]:
    found = []
    null_island = _at_null_island(block, centers)
    if null_island.any():
        found.append(
            f"{_some(names[null_island])} at latitude 0, longitude 0: no GPS fix; remove these positions so that the "
            "images are paired by name"
        )
    rest = centers[~null_island, :2]
    if len(rest) >= 2 and block.metric:
        if float(np.hypot(*np.ptp(rest, axis=0))) < 1e-3:
            found.append(
                f"all {len(rest)} positions are identical: the position of the project or take-off point instead of "
                "each image's? Give the projection centres, or --poses none"
            )
        found += _places_warning(names[~null_island], rest)
    return found


def _places_warning(names: Names, positions_m: FloatArray) -> list[str]:
    """Where images (N,) at positions (N, 2) lie in several places, and how far these are from each other."""
    labels = place_labels(positions_m)
    count = int(labels.max()) + 1
    if count == 1:
        return []
    middles_m = np.array([np.median(positions_m[labels == n], axis=0) for n in range(count)])
    farthest_km = max(float(np.linalg.norm(middles_m - middle, axis=1).max()) for middle in middles_m) / 1000.0
    shown = listed((_some(names[labels == n]) for n in range(count)), _PLACES_SHOWN, "; ")
    up_to = "up to " if count > 2 else ""
    return [
        f"the positions lie in {count} places {up_to}{farthest_km:,.0f} km apart: {shown}. "
        "Images of different places show no common ground and are not paired by position: run each place by itself; "
        "if all are of one flight, check exchanged coordinates (x and y, lat and lon) and --crs"
    ]


def _at_null_island(block: Block, centers: FloatArray) -> BoolArray:
    """(N,) True where a position is latitude 0, longitude 0, or x = y = 0 of a projected CRS."""
    if block.crs == "local" or len(centers) == 0:
        return np.zeros(len(centers), dtype=bool)
    from pyproj import Transformer

    easting, northing = (centers[:, :2] + np.asarray(block.origin_m[:2])).T
    to_geographic = Transformer.from_crs(block.crs, "EPSG:4326", always_xy=True)
    longitude, latitude = to_geographic.transform(easting, northing)
    at_zero = (np.abs(latitude) < _NULL_ISLAND_DEG) & (np.abs(longitude) < _NULL_ISLAND_DEG)
    return np.asarray(at_zero | ((np.abs(easting) < 1.0) & (np.abs(northing) < 1.0)))


def _degenerate_warnings(block: Block, degenerate: Mapping[str, Degenerate]) -> list[str]:
    if not degenerate:
        return []
    names = [image.name for image in block.images if image.image_id in degenerate]
    first = next(iter(degenerate.values()))
    return [
        f"{_some(names)} with a {degenerate_words(first, block)}: the ground of the images around is used "
        "instead; if cameras fly low beside steep ground, give --ground"
    ]


def _height_warnings(block: Block, names: Names, centers: FloatArray, elsewhere: BoolArray) -> list[str]:
    """elsewhere: (N,) whether another ground than that below the camera is used."""
    # Heights in units of arbitrary length are odd in no sense.
    if block.ground is None or len(centers) == 0 or not block.metric:
        return []
    found = []
    ground = block.ground.height_m(centers[:, :2])
    heights = centers[:, 2] - ground
    altitudes, ground_altitude = centers[:, 2] + block.origin_m[2], float(np.median(ground)) + block.origin_m[2]
    below = (heights <= 0.0) & ~elsewhere
    if 2 * below.sum() > len(below) and (np.abs(altitudes) < _RELATIVE_ALTITUDE_M).all() and (altitudes > 0.0).all():
        found.append(
            f"the altitudes ({altitudes.min():.0f} to {altitudes.max():.0f} m) look relative to the take-off point: "
            f"{_some(names[below])} below the ground at {ground_altitude:.0f} m; give --ground in the altitudes' own "
            "frame, or --ground auto, or absolute altitudes"
        )
    elif below.any():
        found.append(
            f"{_some(names[below])} below the ground ({ground_altitude:.0f} m): these images see nothing; check their "
            "altitude and --ground"
        )
    elif block.crs != "local" and ground_altitude < _LOW_GROUND_M and altitudes.max() >= 0.0:
        found.append(
            f"the ground lies at {ground_altitude:.0f} m: do the altitudes ({altitudes.min():.0f} to "
            f"{altitudes.max():.0f} m) count from the take-off point, or from the ellipsoid? Fine within this block, "
            "but a DEM or another flight that counts from sea level will not fit; give absolute altitudes if that "
            "matters"
        )
    odd = ~below & ~elsewhere & ((heights < _LOWEST_HEIGHT_M) | (heights > _HIGHEST_HEIGHT_M))
    if odd.any():
        found.append(
            f"{_some(names[odd])} flown {heights[odd].min():,.1f} to {heights[odd].max():,.1f} m above ground: check "
            "units (feet?), --crs and --ground"
        )
    return found


def _attitude_warnings(block: Block, ids: Sequence[str], names: Names) -> list[str]:
    cameras = {image.image_id: block.camera(image) for image in block.images}
    oriented = [(row, i, r) for row, i in enumerate(ids) if (r := block.poses[i].world_rotation) is not None]
    if not oriented:
        return []
    rotations = [rotation for _, _, rotation in oriented]
    if len(rotations) >= 2 and _all_zero(rotations):
        return [
            f"all angles of {_some(names[[row for row, _, _ in oriented]])} are zero: most likely they were never "
            "measured; leave them out, and the images are paired by position"
        ]
    horizon = [row for row, image_id, rotation in oriented if sees_horizon(cameras[image_id], rotation)]
    if horizon:
        return [
            f"{_some(names[horizon])} with the horizon in view: ground beyond {MAX_DISTANCE_FACTOR:g} flying heights "
            "does not count as overlap; if the flight was not oblique, check the angle convention"
        ]
    return []


def _all_zero(rotations: Sequence[FloatArray]) -> bool:
    """Whether all attitudes are one, and that one is what zero angles of some convention give.

    Yaw that was given against true north is turned by the meridian convergence, at most a few degrees.
    """
    first = rotations[0]
    if any(angle_between_deg(first, rotation) > 0.1 for rotation in rotations[1:]):
        return False
    zeros = [
        from_omega_phi_kappa(0.0, 0.0, 0.0),
        from_yaw_pitch_roll(0.0, 0.0, 0.0, forward=True),
        from_yaw_pitch_roll(0.0, 0.0, 0.0, forward=False),
        np.eye(3),
    ]
    for zero in zeros:
        world_turn = zero.T @ first
        heading = float(np.rad2deg(np.arctan2(world_turn[1, 0], world_turn[0, 0])))
        if abs(heading) < 5.0 and angle_between_deg(world_turn, rotation_z(heading)) < 1e-3:
            return True
    return False


def _some(names: Sequence[str] | Names) -> str:
    """How many images, and the first of them by name."""
    return f"{counted(len(names), 'image')} ({listed(names)})"
