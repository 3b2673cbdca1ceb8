"""Ground control points in the block: their coordinates in its world, and the images that show them.

The files of ODM, Pix4D and Metashape that hold them are read by `control_files`.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from aeromatch_cli.blocks.control_files import Mark, Survey, SurveyedPoint, read_survey
from aeromatch_cli.blocks.crs import (
    AUTO,
    LOCAL,
    across_unit_m,
    converted_heights,
    has_other_units,
    height_unit_m,
    heights_of,
    heights_words,
    is_local,
    local_unit_m,
    parsed_crs,
)
from aeromatch_cli.blocks.image_names import matched_names
from aeromatch_cli.blocks.pose_files.geodesy import unit_remarks
from aeromatch_cli.data import ControlPoint, FloatArray, Image, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX
from aeromatch_cli.words import counted, form, listed

ControlUse = Literal["adjust", "check"]

# Control points so many extents of the block, and so many metres more, from its middle are elsewhere.
_FAR_EXTENTS, _FAR_M = 5.0, 2000.0
# More measurements outside their image than these are no slips of the pen: the pixels are those of other pictures.
_FEW_OUTSIDE, _SHARE_OUTSIDE = 2, 0.25
_LARGEST_SIZE = 8
_WGS84 = "EPSG:4326"
_ZEROS = 3  # so many heights of exactly 0 are none
_LATITUDE_DEG, _LONGITUDE_DEG = 90.0, 180.0


def read_control(
    name: str,
    images: tuple[Image, ...],
    crs: str,
    origin_m: tuple[float, float, float],
    *,
    marks: str = "",
    poses: Mapping[str, Pose] | None = None,
    use: ControlUse = "adjust",
    heights: str = "",
    usual_crs: str = AUTO,
) -> tuple[tuple[ControlPoint, ...], list[str]]:
    """Points in the world frame that images of the block show, and remarks; nothing of no file ("").

    crs, origin_m: of the block; a local block takes the coordinates as they are. marks: file of the image measurements
    where they stand apart, "" to look for it beside. poses: of the block, to tell exchanged coordinates and degrees by.
    use: "check": all are check points. heights: what those of the world count from, as of `crs.heights_of`. usual_crs:
    what the user says that coordinates of a file without CRS count in, where that is one in feet. Raises ConfigError
    with file and line where a file is malformed, or its CRS cannot be brought to the block's.
    """
    if not name:
        return (), []
    path = Path(name)
    survey = read_survey(path, Path(marks) if marks else None, _in_feet(usual_crs))
    places_m, remarks = _places(survey, path, crs, np.array(origin_m), poses or {})
    places_m, converted = _in_world_heights(survey, path, crs, np.array(origin_m), places_m, heights)
    measured, said = _measured(survey.marks, survey.measured_in, images)
    remarks = [*survey.remarks, *remarks, *converted, *said]
    points, unseen = [], []
    for point, place_m in zip(survey.points, places_m, strict=True):
        seen = measured.pop(point.name, [])
        if not seen:
            unseen.append(point.name)
            continue
        points.append(_control_point(point, place_m, seen, check=point.check or use == "check"))
    if unseen:
        count = f"{len(unseen)} of {len(survey.points)} control points"
        remarks.append(
            f"{count} {form(len(unseen), 'is', 'are')} measured in no image of the block: left out: {listed(unseen)}"
        )
    if measured:
        what = f"{counted(len(measured), 'point')} without coordinates"
        remarks.append(f"{survey.measured_in.name} measures {what} in images: left out: {listed(measured)}")
    surveyed = [point.position[2] for point in survey.points]
    if len(surveyed) >= _ZEROS and not any(surveyed):
        remarks.append(f"{path.name}: all {len(surveyed)} control points have the height 0: were heights surveyed?")
    return tuple(points), remarks + far_control(points, poses or {}, name)


def _in_feet(crs: str) -> str | None:
    """The CRS, None where it counts in metres or degrees."""
    return None if crs.strip().lower() in ("", AUTO, LOCAL) or not has_other_units(parsed_crs(crs)) else crs


def far_control(points: Sequence[ControlPoint], poses: Mapping[str, Pose], name: str) -> list[str]:
    """One sentence where control points lie far outside the block: in another CRS."""
    places_m = np.array([point.position_m for point in points]).reshape(-1, 3)
    apart_m = _apart_m(places_m, poses)
    if apart_m is None:
        return []
    return [
        f"the control points of {Path(name).name} lie {apart_m / 1000.0:,.1f} km from the images: is the CRS that the "
        "file states right?"
    ]


def _apart_m(places_m: FloatArray, poses: Mapping[str, Pose]) -> float | None:
    """How far places (N, 3) are from the block, None where they are as near as control points are, or that is not
    known."""
    if len(places_m) == 0 or len(poses) < 2:
        return None
    centers_m = np.array([pose.center_m[:2] for pose in poses.values()])
    extent_m = float(np.linalg.norm(np.ptp(centers_m, axis=0)))
    apart_m = float(np.linalg.norm(np.median(places_m[:, :2], axis=0) - np.median(centers_m, axis=0)))
    return None if apart_m <= _FAR_EXTENTS * extent_m + _FAR_M else apart_m


def _control_point(
    point: SurveyedPoint, place_m: FloatArray, seen: Sequence[tuple[str, Mark]], *, check: bool
) -> ControlPoint:
    """Return a point at a place (3,) of the world with its measurements by image_id. What it does not state of
    standard deviations is as usual."""
    pixels = {image_id: np.array(mark.pixel) - COLMAP_OFFSET_PX for image_id, mark in seen}
    sigmas: dict[str, Any] = {}
    if point.sigmas_m is not None:
        sigmas["sigmas_m"] = point.sigmas_m
    sigmas_px = [mark.sigma_px for _, mark in seen if mark.sigma_px is not None]
    if sigmas_px:
        sigmas["sigma_px"] = float(np.median(sigmas_px))
    return ControlPoint(point.name, place_m, check, pixels, **sigmas)


def _places(
    survey: Survey, path: Path, crs: str, origin_m: FloatArray, poses: Mapping[str, Pose]
) -> tuple[FloatArray, list[str]]:
    """Positions (N, 3) of the points in the world frame, and a remark where the file has them exchanged."""
    stated, across_m, up_m, remarks = _stated(survey, crs)
    given = np.array([point.position for point in survey.points], dtype=np.float64).reshape(-1, 3)
    given[:, 2] *= up_m
    if crs == LOCAL:
        if stated is not None and stated.is_geographic:
            raise ConfigError(
                f"{survey.crs_where}: the control points are in degrees, and the block has no CRS that they could be "
                "brought to: give one with --crs, such as EPSG:32633"
            )
        return given * (across_m, across_m, 1.0) - origin_m, remarks
    if stated is None:
        given[:, :2] *= across_m
        stated = parsed_crs(crs).to_2d()
    degrees = _as_degrees(given)
    exchanged = given[:, [1, 0, 2]]
    said = f"{path.name}: the coordinates of the control points are exchanged (x and y): they were put right"
    if stated.is_geographic and not degrees:
        if _as_degrees(exchanged):
            return _to_block(survey, stated, crs, exchanged) - origin_m, [*remarks, said]
        raise ConfigError(
            f"{survey.points[0].where}: {given[0, 0]:g}, {given[0, 1]:g} are no degrees, and {stated.name} counts in "
            "degrees: name the projected CRS of the coordinates, such as EPSG:32633"
        )
    places_m = _to_block(survey, stated, crs, given) - origin_m
    if _apart_m(places_m, poses) is None:
        return places_m, remarks
    turned_m = _to_block(survey, stated, crs, exchanged, strict=False) - origin_m
    if np.isfinite(turned_m).all() and _apart_m(turned_m, poses) is None:
        return turned_m, [*remarks, said]
    for order in (given, exchanged) if not stated.is_geographic else ():
        if _as_degrees(order):
            as_degrees_m = _to_block(survey, parsed_crs(_WGS84), crs, order, strict=False) - origin_m
            if np.isfinite(as_degrees_m).all() and _apart_m(as_degrees_m, poses) is None:
                raise ConfigError(
                    f"{survey.crs_where}: the coordinates of the control points are degrees, and {stated.name} counts "
                    f"in metres: name {_WGS84} there"
                )
    return places_m, remarks


def _in_world_heights(
    survey: Survey, path: Path, crs: str, origin_m: FloatArray, places_m: FloatArray, heights: str
) -> tuple[FloatArray, list[str]]:
    """Positions (N, 3) in the world with its heights, where both sides state theirs, and a remark."""
    own = (heights_of(survey.crs) if survey.crs else "") or survey.heights if crs != LOCAL else ""
    if survey.heights and not heights:
        words = heights_words(survey.heights)
        return places_m, [
            f"{path.name}: {words} of control points: nothing states what those of the images count from: they must "
            "count from the same zero; --set block.heights=... names theirs"
        ]
    if not (own and heights) or own == heights:
        return places_m, []
    heights_m, why_not = converted_heights(crs, own, heights, places_m + origin_m)
    if why_not:
        return places_m, [f"{path.name}: {why_not}"]
    by_m = float(np.median(heights_m - origin_m[2] - places_m[:, 2]))
    words = f"from {heights_words(own)} to {heights_words(heights)}"
    return np.column_stack([places_m[:, :2], heights_m - origin_m[2]]), [
        f"{path.name}: heights of control points are transformed {words}: {by_m:+.2f} m (median)"
    ]


def _as_degrees(positions: FloatArray) -> bool:
    """Whether x and y may be longitudes and latitudes."""
    largest = np.abs(positions[:, :2]).max(axis=0, initial=0.0)
    return bool(largest[0] <= _LONGITUDE_DEG and largest[1] <= _LATITUDE_DEG)


def _stated(survey: Survey, crs: str) -> tuple[Any, float, float, list[str]]:
    """The CRS of the coordinates without heights, None for the block's own, metres of one unit of x and y and of
    heights, and remarks. crs: the block's."""
    from pyproj.exceptions import CRSError

    if survey.crs is None:
        return parsed_crs(_WGS84) if survey.geographic else None, 1.0, 1.0, []
    text = survey.crs.strip()
    if text.lower() == LOCAL:
        return None, 1.0, 1.0, []
    if is_local(text):
        one_m = local_unit_m(text)
        return None, one_m, one_m, []
    try:
        found = parsed_crs(text)
    except CRSError as error:
        if crs == LOCAL:
            return None, 1.0, 1.0, []
        raise ConfigError(
            f"{survey.crs_where}: {text[:60]!r} is no CRS: write a code such as EPSG:32633, or WGS84 UTM 33N"
        ) from error
    if found.is_geocentric:
        raise ConfigError(f"{survey.crs_where}: geocentric coordinates: export them in a projected CRS or in degrees")
    if not (found.is_geographic or found.is_projected):
        raise ConfigError(f"{survey.crs_where}: {found.name} has no easting and northing: name a projected CRS")
    up_m = height_unit_m(survey.crs_where, found)
    return found.to_2d(), across_unit_m(found), up_m, unit_remarks(survey.crs_where, found)


def _to_block(survey: Survey, stated: Any, crs: str, positions: FloatArray, *, strict: bool = True) -> FloatArray:
    """Positions (N, 3) in the block's CRS; heights stay as they are. strict: raise ConfigError for those that cannot be
    brought there."""
    from pyproj import Transformer

    x, y = Transformer.from_crs(stated, crs, always_xy=True).transform(positions[:, 0], positions[:, 1])
    places = np.column_stack([x, y, positions[:, 2]])
    bad = np.flatnonzero(~np.isfinite(places).all(axis=1))
    if strict and len(bad):
        point = survey.points[int(bad[0])]
        raise ConfigError(f"{point.where}: {point.name} is no place in {stated.name}: is it the right CRS?")
    return places


def _remarks_on_marks(path: Path, absent: Sequence[str], twice: list[str]) -> list[str]:
    """Return what is said of measurements in images that the block does not have, and of repeated ones."""
    remarks = []
    if absent:
        count = counted(len(absent), "image")
        remarks.append(f"{path.name} names {count} that the block does not have: {listed(sorted(absent))}")
    if twice:
        remarks.append(f"{path.name} measures points twice in an image: the first counts: {listed(twice)}")
    return remarks


def _measured(
    marks: Sequence[Mark], path: Path, images: Sequence[Image]
) -> tuple[dict[str, list[tuple[str, Mark]]], list[str]]:
    """Point -> image_id and measurement of every image that shows it, and remarks on those that do not count."""
    by_name = {image.name: image for image in images}
    lines: dict[str, int] = {}
    for mark in marks:
        lines.setdefault(mark.image, mark.line)
    known, absent = matched_names(lines, list(by_name), str(path))
    points = {mark.point: mark.line for mark in marks}
    if marks and not known and (turned_round := matched_names(points, list(by_name), str(path))[0]):
        raise ConfigError(
            f"{path} names no image of the block where images are named, and images as points "
            f"({listed(turned_round)}): exchange the columns of image and point"
        )
    found: dict[str, dict[str, Mark]] = defaultdict(dict)
    outside, twice, turned = [], [], 0
    for mark in marks:
        if mark.image not in known:
            continue
        image = by_name[known[mark.image]]
        x, y = mark.pixel
        words = f"{mark.point} in {image.name}"
        if not _inside(image, x, y):
            outside.append(f"{words} at {x:g}, {y:g}")
            turned += _inside(image, y, x)
        elif found[mark.point].setdefault(image.image_id, mark).pixel != mark.pixel:
            twice.append(words)
    remarks = _remarks_on_marks(path, absent, twice)
    if len(outside) > max(_FEW_OUTSIDE, _SHARE_OUTSIDE * sum(mark.image in known for mark in marks)):
        raise ConfigError(f"{path}: {_other_pictures(marks, known, by_name, outside, turned)}")
    if outside:
        question = "are pixel x and y exchanged?" if turned == len(outside) else "were they measured in these pictures?"
        remarks.append(
            f"{len(outside)} of {len(marks)} measurements of control points {form(len(outside), 'lies', 'lie')} "
            f"outside their image and {form(len(outside), 'is', 'are')} left out ({listed(outside)}): {question}"
        )
    return {point: list(seen.items()) for point, seen in found.items() if seen}, remarks


def _other_pictures(
    marks: Sequence[Mark], known: Mapping[str, str], images: Mapping[str, Image], outside: list[str], turned: int
) -> str:
    """What is wrong with a file of which many measurements lie outside their image."""
    count = f"{len(outside)} measurements of control points lie outside their image ({listed(outside)})"
    if turned == len(outside):
        return f"{count}, and inside with x and y exchanged: exchange pixel x and y"
    shares = []
    for mark in marks:
        if mark.image in known:
            image = images[known[mark.image]]
            shares.append(max(mark.pixel[0] / image.width_px, mark.pixel[1] / image.height_px))
    times = math.ceil(max(shares) - 1e-9)
    return (
        f"{count}: most likely they were measured in pictures of {times} times the size; divide the pixels by {times}, "
        "or measure in these pictures"
        if 1 < times <= _LARGEST_SIZE
        else f"{count}: were they measured in these pictures, from the upper left corner?"
    )


def _inside(image: Image, x: float, y: float) -> bool:
    return 0.0 <= x <= image.width_px and 0.0 <= y <= image.height_px
