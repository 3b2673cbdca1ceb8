"""Which line of a pose list, or of a list of exposures (DJI's MRK), belongs to which image.

Lines with names are compared by these. Exposures have numbers, which need not be those in the names of images: P4
Multispectral counts exposures in tens and bands in ones, counters go on from flight to flight, and images may be
missing. So names are read in several ways, each shifted by a constant; the one counts by which the times of images and
lines agree, and among these the one that gives most images a line.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass
from datetime import datetime
from pathlib import PurePosixPath
from typing import NamedTuple

import numpy as np

from aeromatch_cli.blocks.fields import IMAGE
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.words import form, listed, of_images

# Running numbers are looked for in so many groups of digits of a name, from the end.
_DIGIT_GROUPS = 3
# Groups of digits from the end of a name, and what their number is divided by.
_READINGS = ((1, 1), (1, 10), (2, 1), (3, 1))
# Times of images have whole seconds. seconds
_AGREE_S = 2.5
# Zones differ by quarters of an hour; a clock is set by GPS, whose time is ahead of UTC by so much. seconds
_ZONE_S, _LEAP_S = 900.0, 18.0
_MOST_EXPOSURES = 1_000_000  # of a list


def matched_rows(
    pose_list: PoseList, names: Sequence[str], source: str, times: Mapping[str, str] | None = None
) -> tuple[dict[str, PoseRow], list[str]]:
    """Image name -> its line, and remarks on lines without image and images without line.

    An exact relative path comes first; then the same path in another case, the bare file name, the name without suffix
    (Metashape's labels), and that with another suffix (a list of the raw pictures, or of PNG that became JPEG); of
    several, the one whose folders are named, too. A path does not fall back
    to an image that has a line of its own, nor, where the list has several of its file name, to one of another folder.
    Running numbers (PATB) stand in the names, of one folder; those of exposures with times (DJI's MRK) are matched by
    order and time (`captures`). times: of the images, ISO text by name. Raises ConfigError where two images fit a line,
    or two lines an image.
    """
    rows, absent = _matches(pose_list.rows, names, source, times or {})
    if names and not rows:
        raise ConfigError(
            f"{source} names none of the {len(names)} images in the folder: it says {pose_list.rows[0].image}, the "
            f"folder holds {names[0]}; write paths relative to the images folder"
        )
    remarks = []
    if absent:
        what = form(len(absent), "image that is", "images that are")
        remarks.append(f"{source} names {len(absent)} {what} not in the folder: {listed(absent)}")
    unnamed = [name for name in names if name not in rows]
    if unnamed:
        remarks.append(f"{of_images(unnamed, names, 'is', 'are')} not in {source}")
    return rows, remarks


def matched_names(lines: Mapping[str, int], names: Sequence[str], source: str) -> tuple[dict[str, str], list[str]]:
    """Name as a file has it -> the image that it means, by the same rules, and those that mean none.

    lines: name as the file has it -> the line where it stands first. Raises ConfigError as `matched_rows`.
    """
    written = [PoseRow(name, line, None, "grid", None, "none") for name, line in lines.items()]
    rows, absent = _matches(written, names, source, {})
    return {row.image: name for name, row in rows.items()}, absent


def _matches(
    written: Sequence[PoseRow], names: Sequence[str], source: str, times: Mapping[str, str]
) -> tuple[dict[str, PoseRow], list[str]]:
    """Image name -> its line, and names of lines that mean no image."""
    exposures = {int(row.image): row for row in written if row.numbered and row.time_s is not None}
    by_exposure = _of_exposures(exposures, names, times)
    if by_exposure:
        used = {int(row.image) for row in by_exposure.values()}
        return by_exposure, [row.image for number, row in exposures.items() if number not in used]
    candidates = _Candidates.of(names, written)
    rows = {row.image: row for row in written if row.image in candidates.exact}
    absent: list[str] = []
    for row in written:
        if row.image in candidates.exact:
            continue
        found = candidates.by_name(row.image)
        if row.numbered and not found:
            found = candidates.by_number.get(int(float(row.image)), [])
            if len({PurePosixPath(name).parent for name in found}) == 1:
                rows |= dict.fromkeys(found, row)  # the cameras of one exposure
                continue
        if "/" in row.image:
            found = candidates.in_folders_of(row.image, found, rows)
        image = _only(row, found, rows, source)
        if image is None:
            absent.append(row.image)
        else:
            rows[image] = row
    return rows, absent


def _of_exposures(
    exposures: Mapping[int, PoseRow], names: Sequence[str], times: Mapping[str, str]
) -> dict[str, PoseRow]:
    """Return image -> line of its exposure, by the order and the times of both; empty where these do not tell."""
    if not exposures:
        return {}
    times_s = {number: row.time_s or 0.0 for number, row in exposures.items()}
    return {name: exposures[number] for name, number in numbers_of_exposures(names, times, times_s).items()}


@dataclass(frozen=True)
class _Candidates:
    """The images of a block by what a list may call them.

    exact: their names. by_key: by whole name, file name and stem in small letters. by_number: by running number.
    alike: file name in small letters -> how many lines of the list have it.
    """

    exact: Set[str]
    by_key: Mapping[str, list[str]]
    by_number: Mapping[int, list[str]]
    alike: Counter[str]

    @classmethod
    def of(cls, names: Sequence[str], written: Sequence[PoseRow]) -> _Candidates:
        by_key: dict[str, list[str]] = defaultdict(list)
        for name in names:
            path = PurePosixPath(name)
            for key in {name.lower(), path.name.lower(), path.stem.lower(), str(path.with_suffix("")).lower()}:
                by_key[key].append(name)
        by_number = _numbered(names, {int(float(row.image)) for row in written if row.numbered})
        alike = Counter(PurePosixPath(row.image.lower()).name for row in written)
        return cls(set(names), by_key, by_number, alike)

    def by_name(self, written: str) -> list[str]:
        """Return the images that a name may mean. Programs write paths of the machine that they ran on."""
        path = PurePosixPath(written.lower())
        found = self.by_key.get(written.lower()) or self.by_key.get(path.name, [])
        if found or not IMAGE.fullmatch(written.lower()):
            return found
        # An image that has a line of its own is not meant by another.
        return [name for name in self.by_key.get(path.stem, []) if PurePosixPath(name).name.lower() not in self.alike]

    def in_folders_of(self, written: str, found: Sequence[str], rows: Mapping[str, PoseRow]) -> list[str]:
        """Return those of the images found that the path of a line may mean. rows: the lines that images have so far.

        An image that its whole name means is out of the question; where several lines have the same file name, so is
        one that shares no folder with the path.
        """
        several = self.alike[PurePosixPath(written.lower()).name] > 1
        free = [name for name in found if name not in rows or rows[name].image not in self.exact]
        return [name for name in free if not several or _shared_folders(written, name)]


def _only(row: PoseRow, found: Sequence[str], rows: Mapping[str, PoseRow], source: str) -> str | None:
    """The image that a line means, of those that it may: of several the one most of whose folders are named, too.
    Raises ConfigError where two images fit as well, or another line means that image, too."""
    most = max((_shared_folders(row.image, name) for name in found), default=0)
    found = [name for name in found if len(found) == 1 or _shared_folders(row.image, name) == most]
    if len(found) > 1:
        raise ConfigError(
            f"{source}, line {row.line}, column image: {row.image!r} may be {found[0]} or {found[1]}: write the "
            "path relative to the images folder"
        )
    if found and found[0] in rows:
        raise ConfigError(
            f"{source}, line {row.line}, column image: {row.image!r} and {rows[found[0]].image!r} (line "
            f"{rows[found[0]].line}) both mean the image {found[0]}: keep one of the two lines"
        )
    return found[0] if found else None


def _numbered(names: Sequence[str], numbers: Collection[int]) -> dict[int, list[str]]:
    """Running number -> the images that have it: of the groups of digits of their names, counted from the end, the one
    that most numbers of the list are found in."""
    found: dict[int, list[str]] = {}
    for place in range(1, _DIGIT_GROUPS + 1):
        by_number: dict[int, list[str]] = defaultdict(list)
        for name in names:
            digits = re.findall(r"\d+", PurePosixPath(name).stem)
            if len(digits) >= place:
                by_number[int(digits[-place])].append(name)
        if len(by_number.keys() & numbers) > len(found.keys() & numbers):
            found = by_number
    return found


def _shared_folders(written: str, name: str) -> int:
    """How many folders, from the last on, a path has in common with one as it was written on another machine."""
    wanted, own = (PurePosixPath(path.lower()).parent.parts[::-1] for path in (written, name))
    return next((k for k, (a, b) in enumerate(zip(wanted, own, strict=False)) if a != b), min(len(wanted), len(own)))


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
    if max(exposures) - min(exposures) > _MOST_EXPOSURES:
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
