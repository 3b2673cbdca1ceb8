"""What files state of their coordinates; geocentric and topocentric ones as latitude, longitude and height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from aeromatch_cli.blocks.crs import (
    across_unit_m,
    height_unit_m,
    heights_of,
    is_local,
    is_stretched,
    local_unit_m,
    metric_crs,
    parsed_crs,
)
from aeromatch_cli.blocks.pose_columns import PositionKind
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.ellipsoid import enu_from_geocentric, geocentric

# Eastings and northings of UTM, metres.
_UTM_M = ((160_000.0, 840_000.0), (1_000.0, 10_000_000.0))
_LARGEST_LATITUDE_DEG, _LARGEST_LONGITUDE_DEG = 90.0, 360.0


@dataclass(frozen=True)
class StatedCrs:
    """What a file states of its coordinates. crs: code or WKT of the grid in metres, None for a local one and for
    degrees. name: for messages. across_m, up_m: metres of one unit of x and y, and of heights. to_degrees: transforms
    x and y to WGS84 longitudes and latitudes where the file's are not such. stretched: x and y are metres of web maps.
    remarks: for a person. heights: as of `crs.heights_of`."""

    crs: str | None = None
    kind: PositionKind = "grid"
    name: str = ""
    across_m: float = 1.0
    up_m: float = 1.0
    to_degrees: Any = None
    stretched: bool = False
    remarks: tuple[str, ...] = ()
    heights: str = ""

    def position(self, where: str, x: float, y: float, z: float) -> tuple[float, float, float]:
        """Position of a `PoseRow`, in metres and degrees, of easting or longitude, northing or latitude, and height.
        Raises ConfigError for degrees that are none."""
        height_m = z * self.up_m
        if self.kind == "grid":
            return x * self.across_m, y * self.across_m, height_m
        if self.to_degrees is not None:
            x, y = self.to_degrees.transform(x, y)
        if abs(y) > _LARGEST_LATITUDE_DEG or abs(x) > _LARGEST_LONGITUDE_DEG:
            raise ConfigError(
                f"{where}: ({x:g}, {y:g}) are no longitude and latitude, in this order, in which {self.name} counts: "
                "name the CRS of the coordinates, or exchange them"
            )
        return y, x, height_m


def like_utm(stated: StatedCrs, given: Sequence[tuple[float, float]]) -> list[str]:
    """What is said where x and y that a file calls metres of a web map are such as UTM has, too. given: x and y."""
    if not stated.stretched or not given:
        return []
    x, y = np.median(np.array(given, dtype=np.float64), axis=0)
    (west, east), (south, north) = _UTM_M
    if not (west <= x <= east and south <= abs(y) <= north):
        return []
    longitude, latitude = stated.to_degrees.transform(x, y)
    return [
        f"the coordinates ({x:.0f}, {y:.0f}) lie at latitude {latitude:.2f}, longitude {longitude:.2f} in "
        f"{stated.name}, and look like those of UTM: is it the right CRS?"
    ]


def described_crs(where: str, text: str) -> StatedCrs:
    """text: EPSG:code, PROJ, WKT, or words as in `crs.parsed_crs`. Raises ConfigError where it is unknown, geocentric
    or vertical, or counts depths."""
    text = text.strip()
    if is_local(text):
        one_m = local_unit_m(text)
        return StatedCrs(name="a local CRS", across_m=one_m, up_m=one_m)
    crs = _crs(where, text)
    up_m = height_unit_m(where, crs)
    if crs.is_geocentric:
        raise ConfigError(f"{where}: geocentric coordinates ({crs.name}): export them in a projected CRS or in degrees")
    if not (crs.is_geographic or crs.is_projected):
        raise ConfigError(f"{where}: {crs.name} has no easting and northing: name a projected CRS, or one in degrees")
    if crs.is_geographic or is_stretched(crs.to_2d()):
        degrees = _to_degrees(where, crs)
        return StatedCrs(
            None, "geographic", crs.name, up_m=up_m, to_degrees=degrees, stretched=crs.is_projected,
            heights=heights_of(crs),
        )  # fmt: skip
    return StatedCrs(
        metric_crs(crs), "grid", crs.name, across_unit_m(crs), up_m, remarks=tuple(unit_remarks(where, crs)),
        heights=heights_of(crs),
    )  # fmt: skip


def unit_remarks(where: str, crs: Any) -> list[str]:
    """What is said where heights have the unit of a projected CRS that states nothing of them."""
    if across_unit_m(crs) == 1.0 or any(axis.direction.lower() == "up" for axis in crs.axis_info):
        return []
    unit, name = crs.axis_info[0].unit_name, "the CRS" if crs.name == "unknown" else crs.name
    return [
        f"{where}: heights are read in {unit}, the unit of {name}; where they are metres, name a vertical CRS, "
        "too, such as EPSG:2227+5703"
    ]


def _to_degrees(where: str, crs: Any) -> Any:
    """None for WGS84 itself."""
    from pyproj import CRS, Transformer
    from pyproj.exceptions import ProjError

    flat = crs.to_2d()
    try:
        return None if flat == CRS("EPSG:4326") else Transformer.from_crs(flat, "EPSG:4326", always_xy=True)
    except ProjError as error:
        raise ConfigError(f"{where}: {crs.name} cannot be brought to WGS84: name another CRS") from error


def _crs(where: str, text: str) -> Any:
    from pyproj.exceptions import CRSError

    try:
        return parsed_crs(text)
    except CRSError as error:
        raise ConfigError(
            f"{where}: the CRS {text[:60]!r} is unknown: give the list with a code such as EPSG:32633"
        ) from error


def geodetic(geocentric_m: FloatArray) -> FloatArray:
    """Latitude, longitude (degrees) and ellipsoidal height (N, 3) of geocentric metres (N, 3), WGS84."""
    from pyproj import Transformer

    backward = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    x, y, z = geocentric_m.T
    longitude, latitude, height = backward.transform(x, y, z)
    return np.column_stack([latitude, longitude, height])


def from_topocentric(
    reference: tuple[float, float, float], centers_m: FloatArray, rotations: Sequence[FloatArray | None]
) -> tuple[FloatArray, list[FloatArray | None]]:
    """Geodetic centres (N, 3), and attitudes relative to true north at each of them.

    reference: latitude, longitude, height of the frame's origin. centers_m: (N, 3) east, north, up of the reference.
    rotations: (3, 3) cam_from_enu of the reference, or None.
    """
    frame = enu_from_geocentric(reference[0], reference[1])
    places = geodetic(geocentric(np.array([reference])) + centers_m @ frame)
    local = [enu_from_geocentric(float(place[0]), float(place[1])) for place in places]
    turned: list[FloatArray | None] = [
        None if rotation is None else rotation @ frame @ own.T for rotation, own in zip(rotations, local, strict=True)
    ]
    return places, turned
