"""The world frame: a projected CRS in metres minus a rounded origin, or a local frame.

Heights are transformed only where two inputs state what theirs count from (the ellipsoid, or a vertical CRS), and PROJ
has the geoid that lies between; else z is the altitude as given, whatever it counts from. Meridian convergence is the
grid azimuth's defect: grid azimuth = true azimuth - convergence. It is positive east of the central meridian in the
northern hemisphere, where true north lies to the left (west) of grid north. Worked case: at 28 N, 1 degree east of UTM
17's meridian it is +sin(28) = +0.47 degrees.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError

LOCAL = "local"
AUTO = "auto"
_ORIGIN_STEP_M = 1000.0
# A neighbouring zone is often used a little beyond its border.
_MARGIN_DEG = 3.0
# Eastings of some CRSs and many lists begin with the number of the zone, in millions.
_PREFIX_M = 1_000_000.0
_LONGEST_AREA = 160  # characters of what is said of the area of a CRS
_SAME_M = 0.001
# What heights count from where no vertical CRS does.
ELLIPSOID = "ellipsoid"
_LOCAL_WKT = ("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")
# N and S are hemispheres, other letters bands of latitude, which begin at 80 S and are northern from N on.
_UTM = re.compile(r"WGS\s*84[\s/]+UTM\s*(?:zone\s*)?(\d{1,2})\s*([C-HJ-NP-X])", re.IGNORECASE)


@dataclass(frozen=True)
class WorldFrame:
    """crs: authority code, or "local". origin_m: (x, y, z) subtracted from coordinates in that CRS."""

    crs: str
    origin_m: tuple[float, float, float]


def checked_crs(code: str) -> str:
    """The code of a usable world CRS in canonical spelling. Raises ConfigError where it is unknown or unfit.

    Fit is a projected CRS in metres with axes to the east and north; "local" passes.
    """
    if code.strip().lower() == LOCAL:
        return LOCAL
    whole = _crs(code)
    if not whole.is_projected:
        raise ConfigError(
            f"crs {code!r} ({whole.name}) is not projected: give one in metres, such as EPSG:32633, or auto"
        )
    crs = whole.to_2d()
    if is_stretched(crs):
        raise ConfigError(
            f"crs {code!r} ({crs.name}) has no true lengths: its metres grow towards the poles; export the list in UTM "
            "or in degrees"
        )
    for axis in crs.axis_info[:2]:
        if axis.direction.lower() not in ("east", "north") or axis.unit_conversion_factor != 1.0:
            raise ConfigError(
                f"crs {code!r} ({crs.name}) counts in {axis.unit_name} to the {axis.direction}: coordinates in metres "
                "whose axes point east and north are needed, or degrees; export the list in such a CRS"
            )
    if height_unit_m(f"crs {code!r}", whole) != 1.0:
        raise ConfigError(
            f"crs {code!r} ({whole.name}) counts heights in another unit than metres: export the list in a CRS with "
            "heights in metres, or write the unit behind the column's name (z [us-ft])"
        )
    authority = crs.to_authority()
    return ":".join(authority) if authority else code.strip()


def world_crs(given: str) -> str:
    """What the user gave for the world's CRS; one in feet as the same grid in metres."""
    if given.strip().lower() in ("", AUTO, LOCAL):
        return given
    crs = _crs(given)
    return metric_crs(crs) if has_other_units(crs) else given


def has_other_units(crs: Any) -> bool:
    """Whether coordinates or heights of a projected CRS count in another unit than metres."""
    return bool(crs.is_projected) and (across_unit_m(crs) != 1.0 or height_unit_m(crs.name, crs) != 1.0)


def parsed_crs(text: str) -> Any:
    """The CRS of a code, a PROJ string, WKT or words ("WGS84", "WGS84 UTM 33N", "WGS84 UTM 33U", "WGS 84 / UTM zone
    33N"); that without its shift to WGS84 where one is written with it. Raises pyproj's CRSError where there is none.
    """
    from pyproj import CRS

    text = text.strip(" \t;,\"'")  # as spreadsheets leave it
    utm = _UTM.fullmatch(text)
    northern = utm is not None and utm[2].upper() >= "N" and utm[2].upper() != "S"
    crs: Any = CRS.from_user_input(f"EPSG:{(32600 if northern else 32700) + int(utm[1])}" if utm else text)
    crs = crs.source_crs if crs.is_bound else crs
    crs.to_2d()  # of damaged WKT this alone may fail, and all that use a CRS do it
    return crs


def is_local(text: str) -> bool:
    """Whether WKT is that of a local frame."""
    return text.strip().upper().startswith(_LOCAL_WKT)


def local_unit_m(text: str) -> float:
    """Metres of one unit of a local frame, by its WKT."""
    unit = re.search(r'UNIT\["[^"]*",\s*([\d.]+)', text)
    return float(unit[1]) if unit else 1.0


def is_stretched(crs: Any) -> bool:
    """Whether lengths in a projected CRS grow with the latitude, as in the web's maps."""
    return crs.coordinate_operation is not None and "mercator" in crs.coordinate_operation.method_name.lower().replace(
        "transverse mercator", ""
    ).replace("oblique mercator", "")


def height_unit_m(where: str, crs: Any) -> float:
    """Metres of one unit of heights: that of the vertical axis, else of the projected CRS, else metres.

    Raises ConfigError where the CRS counts depths. where: begins the message.
    """
    for axis in crs.axis_info:
        if axis.direction.lower() == "down":
            raise ConfigError(f"{where}: {crs.name} counts depths downwards: give heights")
        if axis.direction.lower() == "up":
            return float(axis.unit_conversion_factor)
    return across_unit_m(crs)


def across_unit_m(crs: Any) -> float:
    """Metres of one unit of the horizontal axes, 1 where these are degrees."""
    return float(crs.axis_info[0].unit_conversion_factor) if crs.is_projected and crs.axis_info else 1.0


def heights_of(crs: Any) -> str:
    """What the heights of a CRS count from: code, else WKT, of its vertical CRS, ELLIPSOID, or "" for unknown.

    crs: of pyproj, or a text as for `parsed_crs`; a text that is none says nothing.
    """
    from pyproj.exceptions import CRSError

    if isinstance(crs, str):
        try:
            crs = parsed_crs(crs)
        except CRSError:
            return ""
    for part in crs.sub_crs_list if crs.is_compound else (crs,):
        if part.is_vertical:
            authority = part.to_authority()
            return ":".join(authority) if authority else str(part.to_wkt())
        if len(part.axis_info) == 3 and (part.is_geographic or part.is_projected):
            return ELLIPSOID
    return ""


def checked_heights(text: str) -> str:
    """What heights count from, in canonical spelling: ELLIPSOID, or the code of a vertical CRS, also where it is part
    of a compound one. Raises ConfigError."""
    found = ELLIPSOID if text.strip().lower() == ELLIPSOID else heights_of(text.strip())
    if not found:
        raise ConfigError(f"heights {text!r} are unknown: give ellipsoid, or a vertical CRS such as EPSG:5773 (EGM96)")
    return found


def heights_words(heights: str) -> str:
    """What heights count from, for people."""
    return "heights above the ellipsoid" if heights == ELLIPSOID else f"{parsed_crs(heights).name} ({heights[:20]})"


def converted_heights(crs: str, source: str, target: str, places_m: FloatArray) -> tuple[FloatArray, str]:
    """Heights (N,) of places (N, 3) whose heights count from `source`, as they count from `target`, both in metres; and
    why they stay as they are where PROJ cannot transform them, "" where it can. crs: of x and y, projected."""
    from pyproj import CRS
    from pyproj.crs import CompoundCRS
    from pyproj.transformer import TransformerGroup

    heights_m = np.asarray(places_m[:, 2], dtype=np.float64)
    if source == target or not len(heights_m):
        return heights_m, ""
    flat = _crs(crs).to_2d()
    own, other = (
        flat.to_3d() if one == ELLIPSOID else CompoundCRS(flat.name, [flat, CRS(one)]) for one in (source, target)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the best operation is not available is said below
        group = TransformerGroup(own, other, always_xy=True, allow_ballpark=False)
    units_m = [height_unit_m(side.name, side) for side in (own, other)]
    for one in group.transformers:  # the best first
        _, _, found = one.transform(places_m[:, 0], places_m[:, 1], heights_m / units_m[0])
        found_m = np.asarray(found, dtype=np.float64) * units_m[1]
        if np.isfinite(found_m).all():
            return found_m, ""
    grids = [grid.short_name for one in group.unavailable_operations[:1] for grid in one.grids if not grid.available]
    remedy = f"; PROJ lacks the grid {grids[0]}: `pyproj sync --file {grids[0]}` fetches it" if grids else ""
    return heights_m, (
        f"{heights_words(source)} cannot be brought to {heights_words(target)} and stay as they are{remedy}"
    )


def metric_crs(crs: Any) -> str:
    """Code, else WKT, of the horizontal part of a projected CRS, or of the same grid in metres."""
    from pyproj import CRS

    horizontal = (crs.sub_crs_list[0] if crs.is_compound else crs).to_2d()
    if across_unit_m(horizontal) != 1.0:
        twin = _metric_twin(horizontal)
        if twin:
            return twin
        tree = horizontal.to_json_dict()
        for axis in tree["coordinate_system"]["axis"]:
            axis["unit"] = "metre"
        tree.pop("id", None)
        tree["name"] = f"{horizontal.name}, metres"
        horizontal = CRS.from_json_dict(tree)
    authority = horizontal.to_authority(min_confidence=60)
    return ":".join(authority) if authority else str(horizontal.to_wkt())


def _metric_twin(crs: Any) -> str:
    """Code of the CRS that has the name of one in feet without its unit, and the same places; "" for none."""
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError

    if crs.area_of_use is None or "(ft" not in crs.name:
        return ""
    try:
        twin = CRS.from_user_input(crs.name.partition("(ft")[0].strip())
    except CRSError:
        return ""
    area = crs.area_of_use
    place = (area.west + area.east) / 2.0, (area.south + area.north) / 2.0
    own, other = (
        np.array(Transformer.from_crs(one.geodetic_crs, one, always_xy=True).transform(*place)) * across_unit_m(one)
        for one in (crs, twin)
    )
    code = twin.to_authority()
    fits = twin.is_projected and across_unit_m(twin) == 1.0 and crs.geodetic_crs == twin.geodetic_crs
    return ":".join(code) if code and fits and float(np.abs(own - other).max()) < _SAME_M else ""


def utm_crs(latitudes_deg: FloatArray, longitudes_deg: FloatArray) -> str:
    """Code of the WGS84 UTM zone of the median position. Raises ConfigError beyond UTM's 80 S to 84 N."""
    latitude = float(np.median(latitudes_deg))
    first = float(longitudes_deg[0])
    # Across the antimeridian the median must not fall on the other side of the globe.
    turned = (np.asarray(longitudes_deg) - first + 180.0) % 360.0 - 180.0 + first
    longitude = (float(np.median(turned)) + 180.0) % 360.0 - 180.0
    if not -80.0 <= latitude <= 84.0:
        raise ConfigError(
            f"no UTM zone at latitude {latitude:.2f}: are latitude and longitude exchanged? Else give a projected CRS "
            "with --crs"
        )
    zone = min(int((longitude + 180.0) // 6.0) + 1, 60)
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"


def grid_from_geographic(crs: str, latitudes_deg: FloatArray, longitudes_deg: FloatArray) -> FloatArray:
    """Easting and northing (N, 2) in metres of WGS84 positions; NaN outside the area of the CRS."""
    from pyproj import Transformer

    if crs == LOCAL:
        raise ConfigError("latitudes and longitudes cannot be placed in a local frame: give a CRS, or auto, with --crs")
    transformer = Transformer.from_crs("EPSG:4326", _crs(crs).to_2d(), always_xy=True)
    xy_m = np.stack(transformer.transform(longitudes_deg, latitudes_deg), axis=-1).astype(np.float64).reshape(-1, 2)
    xy_m[~np.isfinite(xy_m).all(axis=1)] = np.nan
    return xy_m


def geographic_from_grid(crs: str, xy_m: FloatArray) -> FloatArray:
    """Latitude and longitude (N, 2) in degrees, WGS84, of eastings and northings (N, 2) in a CRS."""
    from pyproj import Transformer

    transformer = Transformer.from_crs(_crs(crs).to_2d(), "EPSG:4326", always_xy=True)
    longitudes, latitudes = transformer.transform(xy_m[:, 0], xy_m[:, 1])
    return np.column_stack([latitudes, longitudes])


def _first_sentence(text: str) -> str:
    """Of PROJ's words on an area, cut between words where it is very long."""
    first = re.split(r"\.(?:\s|$)", text, maxsplit=1)[0]
    return first if len(first) <= _LONGEST_AREA else first[:_LONGEST_AREA].rpartition(" ")[0] + " ..."


def outside_area(crs: str, xy_m: FloatArray) -> str:
    """What is odd about coordinates (N, 2) in a CRS, for a person: the block lies far from where the CRS is used, or
    eastings begin with the number of the zone; "" where nothing is, and in a local frame."""
    if crs == LOCAL or not len(xy_m):
        return ""
    known = _crs(crs).to_2d()
    x, y = np.nanmedian(xy_m, axis=0)
    zone = re.fullmatch(r"(\d{1,2})[NS]", known.utm_zone or "")
    if zone and x // _PREFIX_M == int(zone[1]):
        return (
            f"x begins with the number of the zone ({x:.0f} in {crs}): take {zone[1]},000,000 off, or name a CRS that "
            "counts so"
        )
    area = known.area_of_use
    latitude, longitude = geographic_from_grid(crs, np.array([[x, y]]))[0]
    if area is None or not np.isfinite(latitude + longitude):
        return "" if area is None else f"the coordinates ({x:.0f}, {y:.0f}) are no place in {crs}: is it the right CRS?"
    width = (area.east - area.west) % 360.0
    east = (longitude - area.west + _MARGIN_DEG) % 360.0
    south, north = area.south - _MARGIN_DEG, area.north + _MARGIN_DEG
    if east <= width + 2.0 * _MARGIN_DEG and south <= latitude <= north:
        return ""
    return (
        f"the block lies at latitude {latitude:.2f}, longitude {longitude:.2f}, far outside {crs} ({known.name}, "
        f"{_first_sentence(area.name)}): is it the right CRS?"
    )


def convergence_deg(crs: str, latitudes_deg: FloatArray, longitudes_deg: FloatArray) -> FloatArray:
    """Meridian convergence (N,) in degrees: grid azimuth = true azimuth - convergence; 0 in a local frame."""
    from pyproj import Proj

    if crs == LOCAL:
        return np.zeros(len(latitudes_deg))
    factors = Proj(_crs(crs).to_2d()).get_factors(np.asarray(longitudes_deg), np.asarray(latitudes_deg))
    return np.atleast_1d(np.asarray(factors.meridian_convergence, dtype=np.float64))


def rounded_origin_m(centers_m: FloatArray) -> tuple[float, float, float]:
    """Origin of the world frame: the median position (N, 3) rounded down to kilometres, height 0."""
    x, y = np.floor(np.median(np.asarray(centers_m)[:, :2], axis=0) / _ORIGIN_STEP_M) * _ORIGIN_STEP_M
    return float(x), float(y), 0.0


def choose_crs(given: str, stated: str | None, latitudes_deg: Sequence[float], longitudes_deg: Sequence[float]) -> str:
    """The world's CRS: the user's, else the one stated by an input file, else the UTM zone, else "local".

    given: a code, "local", "auto" or "". stated: a code from block.json, or None. The positions are empty where the
    pose list holds grid coordinates.
    """
    if given.strip().lower() not in ("", AUTO):
        return checked_crs(given)
    if stated is not None and not (len(latitudes_deg) and stated.strip().lower() == LOCAL):
        return checked_crs(stated)
    if len(latitudes_deg):
        return utm_crs(np.asarray(latitudes_deg), np.asarray(longitudes_deg))
    return LOCAL


def _crs(code: str) -> Any:
    """With its heights."""
    from pyproj.exceptions import CRSError

    try:
        return parsed_crs(code)
    except CRSError as error:
        raise ConfigError(f"crs {code!r} is unknown: give a code such as EPSG:32633, or auto, or local") from error
