"""Geocentric and topocentric coordinates: geodetic latitude, longitude and ellipsoidal height of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from aeromatch_cli.blocks.poses import PositionKind
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError


def described_crs(where: str, text: str) -> tuple[str | None, PositionKind]:
    """Code or text of a CRS and what coordinates in it are; None for a local one and for WGS84 degrees.

    text: EPSG:code, PROJ or WKT; "WGS84 UTM 16N". Raises ConfigError where it is unknown or geocentric.
    """
    import re

    utm = re.fullmatch(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS])", text.strip(), re.IGNORECASE)
    code = f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}" if utm else text.strip()
    if code.upper().startswith(("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")):
        return None, "grid"
    crs = _crs(where, code)
    if crs.is_bound:  # a CRS that is written with its shift to WGS84 (TOWGS84)
        crs = crs.source_crs
    if crs.is_geographic:
        return None, "geographic"
    if crs.is_geocentric:
        raise ConfigError(f"{where}: geocentric coordinates ({crs.name}): export them in a projected CRS or in degrees")
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    authority = horizontal.to_authority(min_confidence=60)
    return ":".join(authority) if authority else horizontal.to_wkt(), "grid"


def _crs(where: str, code: str) -> Any:
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        return CRS.from_user_input(code)
    except CRSError as error:
        raise ConfigError(
            f"{where}: the CRS {code[:60]!r} is unknown: give the list with a code such as EPSG:32633"
        ) from error


def geocentric(geodetic: FloatArray) -> FloatArray:
    """(N, 3) metres of latitude, longitude (degrees) and ellipsoidal height (N, 3), WGS84."""
    from pyproj import Transformer

    forward = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    return np.column_stack(forward.transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2]))


def geodetic(geocentric_m: FloatArray) -> FloatArray:
    """Latitude, longitude (degrees) and ellipsoidal height (N, 3) of geocentric metres (N, 3), WGS84."""
    from pyproj import Transformer

    backward = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    x, y, z = geocentric_m.T
    longitude, latitude, height = backward.transform(x, y, z)
    return np.column_stack([latitude, longitude, height])


def enu_from_geocentric(latitude_deg: float, longitude_deg: float) -> FloatArray:
    """(3, 3) from geocentric axes to east, north and up of a place."""
    latitude, longitude = np.deg2rad(latitude_deg), np.deg2rad(longitude_deg)
    sf, cf, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array([[-sl, cl, 0.0], [-sf * cl, -sf * sl, cf], [cf * cl, cf * sl, sf]])


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
