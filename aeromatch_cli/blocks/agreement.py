"""Whether a pose list and the GPS of the images tell of the same places.

The GPS of a camera is good to some metres, which is enough to find columns that are exchanged, another zone, lines of
other images and lists of other flights.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from aeromatch_cli.blocks.crs import AUTO, LOCAL, checked_crs, grid_from_geographic, utm_crs
from aeromatch_cli.blocks.exif import ExifFacts
from aeromatch_cli.blocks.observations import Observation
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.words import counted

# A camera's GPS without correction, and a pose list in another datum, are off by no more.
_SAME_M = 100.0
# Fewer positions tell of no list.
_MIN_IMAGES = 3
# Lines are those of other images where they are off by this share of the block's extent, and lie nearer to some other
# image by this factor.
_MIXED_EXTENT, _MIXED_SHARE = 0.2, 0.25
# Sea level lies within this of the ellipsoid everywhere, metres; the GPS of a camera adds some.
_GEOID_M = 130.0
_METRES_PER_DEG = 111_320.0
_LARGEST_DEG = 180.0
_WIDEST_DEG = 1.0  # a block is no wider, in degrees, and no narrower, in metres


def agreed(
    observations: Mapping[str, Observation], facts: Mapping[str, ExifFacts], crs: str, source: str
) -> tuple[dict[str, Observation], list[str]]:
    """The observations of a pose list, with exchanged coordinates put right, and remarks.

    observations, facts: by image name. crs: what x and y count in, "auto" or "local" where nobody said. source: the
    list's name, for messages.
    """
    found = dict(observations)
    names = [name for name in found if facts[name].latitude_deg is not None]
    if len(names) < _MIN_IMAGES:
        return found, []
    gps = np.array([(facts[name].latitude_deg, facts[name].longitude_deg) for name in names], dtype=np.float64)
    listed = np.array([found[name].position[:2] for name in names])
    if len({found[name].position_kind for name in names}) > 1:
        return found, []
    grid = found[names[0]].position_kind == "grid"
    if grid and crs in (AUTO, LOCAL, ""):
        return found, _zone_of_local(listed, gps, source)
    places = _grid_places(crs, gps) if grid else gps
    to_metres = np.ones(2) if grid else _METRES_PER_DEG * np.array([1.0, np.cos(np.deg2rad(np.median(gps[:, 0])))])
    if _of_other_images(listed * to_metres, places * to_metres):
        return found, [f"{source}: the lines look like those of other images, as the GPS of the images shows"]
    if _median_m(listed, places, to_metres) <= _SAME_M:
        return found, _other_heights(found, facts, names, source)
    if _median_m(listed[:, ::-1], places, to_metres) <= _SAME_M:
        both = "x and y" if grid else "lat and lon"
        remark = f"{source}: {both} are exchanged, as the GPS of the images shows: they were put right"
        return _exchanged(observations), [remark]
    away_km = _median_m(listed, places, to_metres) / 1000.0
    remark = f"{source} and the GPS of {counted(len(names), 'image')} are {away_km:,.1f} km apart"
    zone = _fitting_zone(listed, gps) if grid else None
    if zone:
        return found, [f"{remark}: x and y fit {zone}; give --crs {zone}"]
    return found, [f"{remark}: is it the list of another flight, or of another CRS?"]


def _exchanged(observations: Mapping[str, Observation]) -> dict[str, Observation]:
    """Return the observations with the first two coordinates exchanged."""
    found = {}
    for name, observation in observations.items():
        first, second, height = observation.position
        found[name] = replace(observation, position=(second, first, height))
    return found


def refuse_degrees(observations: Mapping[str, Observation], crs: str, source: str) -> None:
    """Raises ConfigError where x and y of a list are degrees below a projected CRS. crs: as in `agreed`."""
    if crs.strip().lower() in (AUTO, LOCAL, ""):
        return
    places = np.array([one.position[:2] for one in observations.values() if one.position_kind == "grid"]).reshape(-1, 2)
    places = places[places.any(axis=1)]  # zeros stand for "unknown"
    if len(places) and np.abs(places).max() <= _LARGEST_DEG and np.ptp(places, axis=0).max() < _WIDEST_DEG:
        x, y = places[0]
        raise ConfigError(
            f"{source}: x and y ({x:.6f}, {y:.6f}) are degrees by their size, and {crs[:60]} counts in metres: name "
            "the columns lat and lon, or in geo.txt EPSG:4326, with the longitude first"
        )


def _other_heights(
    found: Mapping[str, Observation], facts: Mapping[str, ExifFacts], names: Sequence[str], source: str
) -> list[str]:
    """What is said where heights differ by more than the ellipsoid's from sea level ever do."""
    heights = [(found[name].position[2], facts[name].altitude_m) for name in names]
    off_m = [listed_m - gps_m for listed_m, gps_m in heights if gps_m is not None and np.isfinite(listed_m)]
    median_m = float(np.median(off_m)) if len(off_m) >= _MIN_IMAGES else 0.0
    if abs(median_m) <= _GEOID_M:
        return []
    side = "above" if median_m > 0 else "below"
    return [
        f"{source}: heights are {abs(median_m):.0f} m {side} those of the GPS of the images: are they heights above "
        "ground or the take-off point? Ground heights (--ground) must count from the same zero"
    ]


def _median_m(listed: FloatArray, places: FloatArray, to_metres: FloatArray) -> float:
    return float(np.median(np.linalg.norm((listed - places) * to_metres, axis=1)))


def _grid_places(crs: str, gps: FloatArray) -> FloatArray:
    try:
        return grid_from_geographic(checked_crs(crs), gps[:, 0], gps[:, 1])
    except ConfigError:
        return np.full(gps.shape, np.nan)  # an unknown CRS is refused later, in its own words


def _fitting_zone(listed: FloatArray, gps: FloatArray) -> str | None:
    """The UTM zone in which x and y are where the GPS is, None where neither the own nor a neighbouring one is."""
    own = utm_crs(gps[:, 0], gps[:, 1])
    for step in (0, -1, 1):
        code = f"{own[:-2]}{(int(own[-2:]) + step - 1) % 60 + 1:02d}"
        if _median_m(listed, grid_from_geographic(code, gps[:, 0], gps[:, 1]), np.ones(2)) <= _SAME_M:
            return code
    return None


def _zone_of_local(listed: FloatArray, gps: FloatArray, source: str) -> list[str]:
    """Return a remark on x and y (N, 2) without a CRS that are those of a zone of UTM. Raises ConfigError where they
    are degrees."""
    for order, words in ((gps, "lat and lon"), (gps[:, ::-1], "lon and lat")):
        if _median_m(listed, order, np.full(2, _METRES_PER_DEG)) <= _SAME_M:
            raise ConfigError(f"{source}: x and y are degrees, as the GPS of the images shows: name them {words}")
    zone = _fitting_zone(listed, gps)
    return [f"{source}: by the GPS of the images, x and y are {zone}: give --crs {zone}"] if zone else []


def _of_other_images(listed_m: FloatArray, places_m: FloatArray) -> bool:
    """Whether the lines fit the places of other images clearly better than those of their own."""
    from scipy.spatial import cKDTree

    if not np.isfinite(places_m).all():
        return False
    moved_m = listed_m + np.median(places_m, axis=0) - np.median(listed_m, axis=0)
    own_m = float(np.median(np.linalg.norm(moved_m - places_m, axis=1)))
    nearest_m = float(np.median(cKDTree(places_m).query(moved_m)[0]))
    extent_m = float(np.linalg.norm(np.ptp(places_m, axis=0)))
    return own_m > _MIXED_EXTENT * extent_m and nearest_m < _MIXED_SHARE * own_m
