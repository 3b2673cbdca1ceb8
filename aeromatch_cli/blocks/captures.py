"""Which images belong to which line of a list of exposures (DJI's MRK), by the order and the times of both.

Numbers in names need not be those of the list: P4 Multispectral counts exposures in tens and bands in ones, counters go
on from flight to flight, and images may be missing. So names are read in several ways, each shifted by a constant; the
one counts by which the times of images and lines agree, and among these the one that gives most images a line.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import PurePosixPath
from typing import NamedTuple

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray

# Groups of digits from the end of a name, and what their number is divided by.
_READINGS = ((1, 1), (1, 10), (2, 1), (3, 1))
# Times of images have whole seconds. seconds
_AGREE_S = 2.5
# Zones differ by quarters of an hour; a clock is set by GPS, whose time is ahead of UTC by so much. seconds
_ZONE_S, _LEAP_S = 900.0, 18.0
_MOST = 1_000_000  # exposures of a list


class _Fit(NamedTuple):
    """In the order in which fits are preferred. agree: images whose times agree; clock: their clock is a zone's."""

    clock: bool
    agree: int
    images: int
    same_numbers: bool
    earlier_reading: int
    numbers: dict[str, int]


def numbers_of_exposures(
    names: Sequence[str], times: Mapping[str, str], exposures: Mapping[int, float]
) -> dict[str, int]:
    """Image -> number of its exposure; of one folder alone, and empty where none or more than one fits.

    times: ISO text by name. exposures: number -> GPS time in seconds.
    """
    if max(exposures) - min(exposures) > _MOST:
        return {}
    folders: dict[str, list[str]] = defaultdict(list)
    for name in names:
        folders[str(PurePosixPath(name).parent)].append(name)
    fits = [fit for own in folders.values() if (fit := _best(own, times, exposures)) is not None]
    if len(fits) > 1:
        fits = [fit for fit in fits if fit.clock and fit.agree]
    return fits[0].numbers if len(fits) == 1 else {}


def _best(names: Sequence[str], times: Mapping[str, str], exposures: Mapping[int, float]) -> _Fit | None:
    first, last = min(exposures), max(exposures)
    exposure_s = np.full(last - first + 1, np.nan)
    for number, time_s in exposures.items():
        exposure_s[number - first] = time_s
    stamps = {name: datetime.fromisoformat(times[name]) for name in names if times.get(name)}
    fits = []
    for reading, (place, divisor) in enumerate(_READINGS):
        read = {}
        for name in names:
            digits = re.findall(r"\d+", PurePosixPath(name).stem)
            if len(digits) >= place and len(digits[-place]) <= 9:
                read[name] = int(digits[-place]) // divisor
        if not read:
            continue
        own = list(read)
        numbers = np.array([read[name] for name in own])
        image_s = np.array([_seconds(stamps[name]) if name in stamps else np.nan for name in own])
        for shift in _shifts(numbers, image_s, exposure_s, first):
            fit = _fit(own, numbers - shift - first, image_s, exposure_s, shift, -reading)
            if fit is not None:
                fits.append(fit._replace(numbers={name: k + first for name, k in fit.numbers.items()}))
    return max(fits, key=lambda fit: fit[:5], default=None)


def _seconds(stamp: datetime) -> float:
    return (stamp.replace(tzinfo=None) - datetime(1980, 1, 6)).total_seconds()  # GPS time begins here


def _shifts(numbers: IntArray, image_s: FloatArray, exposure_s: FloatArray, first: int) -> list[int]:
    """What to take off the numbers of names: nothing, what brings the first of both together where they are as many,
    and what brings times together."""
    unique = np.unique(numbers)
    found = {0}
    if len(unique) == int(np.isfinite(exposure_s).sum()):
        found.add(int(unique[0]) - first)
    timed = np.flatnonzero(np.isfinite(image_s))
    for row in timed[:1]:  # the exposures that the first image may be, by a clock that is a zone's
        off_s = (image_s[row] - exposure_s + _LEAP_S + _ZONE_S / 2.0) % _ZONE_S - _ZONE_S / 2.0
        found |= {int(numbers[row]) - first - int(k) for k in np.flatnonzero(np.abs(off_s) <= _AGREE_S)}
    return sorted(found)


def _fit(
    names: Sequence[str], places: IntArray, image_s: FloatArray, exposure_s: FloatArray, shift: int, preference: int
) -> _Fit | None:
    """places: of every image's exposure in exposure_s. None where no image has one."""
    inside = (places >= 0) & (places < len(exposure_s))
    times_s = np.where(inside, exposure_s[np.clip(places, 0, len(exposure_s) - 1)], np.nan)
    known = np.isfinite(times_s)
    off_s = image_s - times_s
    timed = np.isfinite(off_s)
    agree = np.zeros(len(names), dtype=bool)
    clock = False
    if timed.any():
        median_s = float(np.median(off_s[timed]))
        agree = timed & (np.abs(off_s - median_s) <= _AGREE_S)
        clock = abs((median_s + _LEAP_S + _ZONE_S / 2.0) % _ZONE_S - _ZONE_S / 2.0) <= _AGREE_S
        known &= agree | ~timed
        if 2 * int(agree.sum()) < int(timed.sum()):
            return None
    if not known.any():
        return None
    numbers = {name: int(place) for name, place, one in zip(names, places, known, strict=True) if one}
    return _Fit(clock, int(agree.sum()), len(numbers), shift == 0, preference, numbers)
