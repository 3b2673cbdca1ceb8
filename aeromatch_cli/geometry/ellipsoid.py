"""Geocentric and topocentric coordinates on WGS84 (EPSG method 9602, 9836), of latitude, longitude and height."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.data import FloatArray

_SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1.0 / 298.257223563


def geocentric(geodetic: FloatArray) -> FloatArray:
    """(N, 3) metres of latitude, longitude (degrees) and ellipsoidal height (N, 3)."""
    latitude, longitude = np.deg2rad(geodetic[:, 0]), np.deg2rad(geodetic[:, 1])
    squared = _FLATTENING * (2.0 - _FLATTENING)
    normal_m = _SEMI_MAJOR_M / np.sqrt(1.0 - squared * np.sin(latitude) ** 2)
    across_m = (normal_m + geodetic[:, 2]) * np.cos(latitude)
    up_m = (normal_m * (1.0 - squared) + geodetic[:, 2]) * np.sin(latitude)
    return np.column_stack([across_m * np.cos(longitude), across_m * np.sin(longitude), up_m])


def enu_from_geocentric(latitude_deg: float, longitude_deg: float) -> FloatArray:
    """(3, 3) from geocentric axes to east, north and up of a place."""
    latitude, longitude = np.deg2rad(latitude_deg), np.deg2rad(longitude_deg)
    sf, cf, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array([[-sl, cl, 0.0], [-sf * cl, -sf * sl, cf], [cf * cl, cf * sl, sf]])


def topocentric(reference: tuple[float, float, float], places: FloatArray) -> FloatArray:
    """East, north and up (N, 3) of a reference, metres. reference, places (N, 3): latitude, longitude, height."""
    apart_m = geocentric(places) - geocentric(np.array([reference]))
    return np.asarray(apart_m @ enu_from_geocentric(reference[0], reference[1]).T)
