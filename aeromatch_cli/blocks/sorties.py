"""Which images were taken in one flight, and how fast the aircraft flew.

A flight is what lies between take-off and landing, usually one battery: what its receiver, its barometer and its clock
have wrong, they have wrong in the same way in all of its images. A new one begins

- with another serial number of the aircraft;
- where the capture time jumps by more than two minutes and five times the usual interval, or on another date; images
  that are missing by their running numbers explain a jump, and aircraft faster than small drones take minutes to turn,
  so that these need a quarter of an hour;
- where capture times are missing: in another folder, with other letters at the beginning of the name, or where the
  running numbers of the names jump by more than 20 and five times the usual step;
- where the height of the take-off point (the altitude less the height above that point) jumps, and stays there.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import PurePosixPath

import numpy as np

from aeromatch_cli.blocks.crs import LOCAL, WorldFrame, convergence_deg, geographic_from_grid
from aeromatch_cli.blocks.exif import ExifFacts
from aeromatch_cli.data import BoolArray, FloatArray, Image, Pose

_DAY_S = 86400.0
# What is longer than this, and than so many usual intervals, is a landing: nobody changes a battery in less. Aircraft
# beyond a speed take longer to turn.
_LANDING_S, _LANDING_INTERVALS = 120.0, 5.0
_FAST_M_S, _LONGEST_TURN_S = 40.0, 900.0
# Running numbers without a flight: more than so many, and than so many usual steps.
_MISSING_NUMBERS, _MISSING_STEPS = 20, 5.0
_LONGEST_NUMBER = 5  # digits
# The take-off point is known to some metres; it moves where the medians of so many images on both sides differ.
_TAKEOFF_M, _TAKEOFF_STEPS, _TAKEOFF_IMAGES, _LEAST_IMAGES = 3.0, 5.0, 5, 3
# Beyond this the track turns between two images.
_TURN_DEG = 20.0
# An image so many usual intervals away says nothing about the speed.
_NEAR_INTERVALS = 3.0
# Clocks that count whole seconds need a longer way: so many images on either side.
_REACH, _REACH_WHOLE_SECONDS = 1, 3
# No aircraft that takes pictures is faster: the clock is wrong.
_FASTEST_M_S = 150.0


@dataclass(frozen=True, eq=False)
class Capture:
    """When and where an image was taken.

    name: path relative to the images folder. serial: number of the aircraft, "" where unknown. time_s: of capture, on a
    clock that all images share, None where unknown. center_m: (3,) in the world frame, or None. takeoff_m: height of
    the take-off point as the header states it, or None. speed_m_s: (3,) in the world frame as the header states it, or
    None.
    """

    image_id: str
    name: str
    camera_id: str
    serial: str = ""
    time_s: float | None = None
    center_m: FloatArray | None = None
    takeoff_m: float | None = None
    speed_m_s: FloatArray | None = None


def captures_of(
    images: Iterable[Image], facts: Mapping[str, ExifFacts], poses: Mapping[str, Pose], frame: WorldFrame
) -> list[Capture]:
    """What headers and positions say of the images. facts, poses: by image name."""
    # A clock without its offset counts as the others do.
    zoned = all(fact.utc_offset for fact in facts.values() if fact.time)
    turn = _world_from_ned(poses, frame)
    found = []
    for image in images:
        fact, pose = facts[image.name], poses.get(image.name)
        speed_m_s = None if turn is None or fact.speed_m_s is None else turn @ np.array(fact.speed_m_s)
        both = fact.altitude_m, fact.relative_altitude_m
        found.append(
            Capture(
                image_id=image.image_id,
                name=image.name,
                camera_id=image.camera_id,
                serial=fact.serial,
                time_s=datetime.fromisoformat(fact.time + (fact.utc_offset if zoned else "+00:00")).timestamp()
                if fact.time
                else None,
                center_m=None if pose is None else pose.center_m,
                takeoff_m=both[0] - both[1] if both[0] is not None and both[1] is not None else None,
                speed_m_s=speed_m_s,
            )
        )
    return found


def _world_from_ned(poses: Mapping[str, Pose], frame: WorldFrame) -> FloatArray | None:
    """(3, 3) from north, east and down to the world's axes, None where north is not known."""
    if frame.crs == LOCAL or not poses:
        return None
    place = np.median([pose.center_m[:2] for pose in poses.values()], axis=0) + np.array(frame.origin_m[:2])
    latitudes_deg, longitudes_deg = geographic_from_grid(frame.crs, place[None]).T
    if not np.isfinite([latitudes_deg, longitudes_deg]).all():
        return None
    turn = np.deg2rad(convergence_deg(frame.crs, latitudes_deg, longitudes_deg)[0])
    cos, sin = float(np.cos(turn)), float(np.sin(turn))
    return np.array([[-sin, cos, 0.0], [cos, sin, 0.0], [0.0, 0.0, -1.0]])


def flights(captures: Iterable[Capture]) -> dict[str, str]:
    """image_id -> name of its flight, "flight 1" being the first; of all images."""
    parts = []
    for group in _by_aircraft(captures):
        parts += _of_aircraft(group)
    parts.sort(key=lambda part: (min(map(_time_s, part)), _place(part[0])))
    names: dict[str, str] = {}
    for number, part in enumerate(parts, start=1):
        names |= dict.fromkeys([one.image_id for one in part], f"flight {number}")
    return names


def velocities(captures: Iterable[Capture], flight_of: Mapping[str, str]) -> dict[str, FloatArray]:
    """image_id -> (3,) velocity in the world frame, metres per second, of images where it is known.

    That which the header states, else by the images before and after in the same flight: none where the track turns,
    or times are missing. A flight whose headers state nothing but zeros states none. flight_of: as in `flights`.
    """
    groups: dict[tuple[str, str], list[Capture]] = defaultdict(list)
    for one in captures:
        groups[flight_of[one.image_id], one.camera_id].append(one)
    found: dict[str, FloatArray] = {}
    for group in groups.values():
        stated = {one.image_id: one.speed_m_s for one in group if one.speed_m_s is not None}
        if any(speed.any() for speed in stated.values()):
            found |= _along_track(group) | stated
        elif not stated:
            found |= _along_track(group)
    return found


def _by_aircraft(captures: Iterable[Capture]) -> list[list[Capture]]:
    """Images without a serial number are those of the only one that has any."""
    groups: dict[str, list[Capture]] = defaultdict(list)
    for one in captures:
        groups[one.serial].append(one)
    if len(groups) == 2 and "" in groups:
        return [[one for group in groups.values() for one in group]]
    return list(groups.values())


def _of_aircraft(group: Sequence[Capture]) -> list[list[Capture]]:
    timed = sorted((one for one in group if one.time_s is not None), key=lambda one: (_time_s(one), _place(one)))
    parts = _flown_apart(timed, _landings(timed))
    number = {one.image_id: row for row, part in enumerate(parts) for one in part}
    rest: list[Capture] = []
    for series in _series(group):
        known = [number[one.image_id] for one in series if one.image_id in number]
        latest = known[0] if known else None
        for one in series:  # without a time: with the image before it
            latest = number.get(one.image_id, latest)
            if latest is None:
                rest.append(one)
            elif one.image_id not in number:
                parts[latest].append(one)
    for series in _series(rest):
        parts += _flown_apart(series, _gaps(series))
    return parts


def _flown_apart(sequence: Sequence[Capture], starts: Iterable[int]) -> list[list[Capture]]:
    """Return the parts of a sequence that begin at the given places, or where the take-off point has moved."""
    parts = []
    for piece in _cut(sequence, starts):
        parts += _cut(piece, _moved_takeoffs(piece))
    return parts


def _cut(sequence: Sequence[Capture], starts: Iterable[int]) -> list[list[Capture]]:
    """The parts of a sequence that begin at the given places."""
    places = [0, *starts, len(sequence)]
    return [list(sequence[a:b]) for a, b in pairwise(places) if b > a]


def _landings(timed: Sequence[Capture]) -> Iterator[int]:
    """Places in the order of time before which the aircraft has landed."""
    times_s = np.array([_time_s(one) for one in timed])
    gaps_s = np.diff(times_s)
    if not (gaps_s > 0.0).any():
        return
    steps = np.array([_step(first, second) for first, second in pairwise(timed)])
    usual_s = float(np.median(gaps_s[gaps_s > 0.0] / steps[gaps_s > 0.0]))
    fast = _usual_speed_m_s(timed, gaps_s) > _FAST_M_S
    least_s = _LONGEST_TURN_S if fast else _LANDING_S
    for row, gap_s in enumerate(gaps_s):
        other_date = times_s[row] // _DAY_S != times_s[row + 1] // _DAY_S
        unexplained_s = gap_s - steps[row] * usual_s
        if (other_date and gap_s > least_s) or unexplained_s > max(least_s, _LANDING_INTERVALS * usual_s):
            yield row + 1


def _step(first: Capture, second: Capture) -> int:
    """How many images later one was taken than another, by their running numbers; 1 where these do not tell."""
    (folder, letters, number, _), (other_folder, other_letters, later, _) = _place(first), _place(second)
    return later - number if (folder, letters) == (other_folder, other_letters) and later > number >= 0 else 1


def _usual_speed_m_s(timed: Sequence[Capture], gaps_s: FloatArray) -> float:
    ways_m = [
        math.dist(first.center_m[:2], second.center_m[:2]) / gap_s
        for first, second, gap_s in zip(timed[:-1], timed[1:], gaps_s, strict=True)
        if gap_s > 0.0 and first.center_m is not None and second.center_m is not None
    ]
    return float(np.median(ways_m)) if ways_m else 0.0


def _moved_takeoffs(sequence: Sequence[Capture]) -> Iterator[int]:
    """Places before which the take-off point has moved; a single height that is off moves nothing."""
    rows = [row for row, one in enumerate(sequence) if one.takeoff_m is not None]
    heights_m = np.array([one.takeoff_m for one in sequence if one.takeoff_m is not None])
    steps_m = np.abs(np.diff(heights_m))
    least_m = max(_TAKEOFF_M, _TAKEOFF_STEPS * float(np.median(steps_m))) if len(steps_m) else 0.0
    first = 0
    for k in np.flatnonzero(steps_m > least_m) + 1:
        before, after = heights_m[max(first, k - _TAKEOFF_IMAGES) : k], heights_m[k : k + _TAKEOFF_IMAGES]
        if min(len(before), len(after)) < _LEAST_IMAGES or abs(np.median(after) - np.median(before)) <= least_m:
            continue
        first = int(k)
        yield rows[first]


def _series(group: Iterable[Capture]) -> list[list[Capture]]:
    """Images whose names differ by their running number alone, in its order."""
    found: dict[tuple[str, str], list[Capture]] = defaultdict(list)
    for one in sorted(group, key=_place):
        folder, letters, _, _ = _place(one)
        found[folder, letters].append(one)
    return list(found.values())


def _gaps(series: Sequence[Capture]) -> Iterator[int]:
    """Places before which running numbers are missing."""
    steps = np.diff([_place(one)[2] for one in series])
    if not (steps > 0).any():
        return
    limit = max(_MISSING_NUMBERS, _MISSING_STEPS * float(np.median(steps[steps > 0])))
    yield from (int(row) + 1 for row in np.flatnonzero(steps > limit))


def _place(one: Capture) -> tuple[str, str, int, str]:
    """Folder, letters before the first digit, running number (the last digits of the name), name."""
    path = PurePosixPath(one.name)
    letters = re.match(r"\D*", path.stem)
    digits = re.findall(r"\d+", path.stem)
    # Longer ones are times of the day, dates and hashes.
    number = int(digits[-1]) if digits and len(digits[-1]) <= _LONGEST_NUMBER else -1
    return str(path.parent), letters[0] if letters else "", number, one.name


def _time_s(one: Capture) -> float:
    return math.inf if one.time_s is None else one.time_s


def _along_track(group: Sequence[Capture]) -> dict[str, FloatArray]:
    """Return the velocities of images on straight lines, by the images before and after them on the same line."""
    track = sorted((one for one in group if one.time_s is not None and one.center_m is not None), key=_time_s)
    if len(track) < 3:
        return {}
    times_s = np.array([_time_s(one) for one in track])
    centers_m = np.array([one.center_m for one in track])
    if not (np.diff(times_s) > 0.0).any():
        return {}
    on, flown = _lines_of_track(times_s, centers_m)
    reach = _REACH if (times_s % 1.0).any() else _REACH_WHOLE_SECONDS
    found = {}
    for row in range(len(track)):
        first, last = _ends_of_line(row, on, flown, reach)
        if first == last or (first < row < last and not on[row]):  # at a corner two lines meet
            continue
        velocity = (centers_m[last] - centers_m[first]) / (times_s[last] - times_s[first])
        if np.linalg.norm(velocity) <= _FASTEST_M_S:
            found[track[row].image_id] = velocity
    return found


def _ends_of_line(row: int, on: BoolArray, flown: BoolArray, reach: int) -> tuple[int, int]:
    """Return the first and the last image on the line of an image, `reach` places away at most. on, flown: as of
    `_lines_of_track`."""
    first = last = row
    while first > 0 and flown[first - 1] and (on[first] or first == row) and row - first < reach:
        first -= 1
    while last < len(flown) and flown[last] and (on[last] or last == row) and last - row < reach:
        last += 1
    return first, last


def _lines_of_track(times_s: FloatArray, centers_m: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Return at which images (N,) of a track a line goes on, and which ways (N - 1,) from image to image are flown on
    a line, not on the way to another one. times_s (N,) ascending, two of them apart; centers_m (N, 3)."""
    gaps_s, ways_m = np.diff(times_s), np.diff(centers_m, axis=0)
    lengths_m = np.hypot(ways_m[:, 0], ways_m[:, 1])
    near = (gaps_s > 0.0) & (gaps_s <= _NEAR_INTERVALS * np.median(gaps_s[gaps_s > 0.0])) & (lengths_m > 0.0)
    along = (ways_m[1:, :2] * ways_m[:-1, :2]).sum(axis=1)
    ahead = along >= math.cos(math.radians(_TURN_DEG)) * lengths_m[1:] * lengths_m[:-1]
    on = np.concatenate([[False], near[1:] & near[:-1] & ahead, [False]])
    beside = np.concatenate([[False], near[:-1]]) | np.concatenate([near[1:], [False]])
    return on, near & (on[:-1] | on[1:] | ~beside)
