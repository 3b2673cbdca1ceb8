"""Positions, heights and angles in the headers of a block that contradict each other or the definition of their tags.

Each header may be plausible alone: those of the other images, and what XMP says of the same image, tell. Altitudes may
count from different zeros, in other units, or with the wrong sign.

EXIF counts, since corrected positions (PPK) are written there, unless it is the broken one: coarser than XMP (cut to
minutes, the same for all), or in single images far from where all others are, and XMP is not.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from aeromatch_cli.blocks.exif import ExifFacts
from aeromatch_cli.blocks.xmp import from_level
from aeromatch_cli.data import BoolArray, FloatArray
from aeromatch_cli.words import of_images

_METRES_PER_DEGREE = 111_320.0
# One of two statements is the coarser where it has at most this share of the other's different numbers.
_COARSE = 0.5
# A single position is elsewhere beyond so many times the extent of the others, and so many metres.
_ELSEWHERE, _ELSEWHERE_M = 2.0, 200.0
# In so few images nothing is told by their altitudes.
_LEAST_IMAGES = 3
# What is stated twice differs by less: rounding, and the time between two readings.
_ALIKE_M = 3.0
_FOOT_M = 0.3048
# Numbers that were rounded to a metre, and survey feet, differ by less from those in feet; lower ones tell nothing.
_FEET_SHARE, _LEAST_FEET_M = 0.02, 5.0
# Two levels are so many times as far apart as each of them is thick, and so many metres.
_APART, _APART_M = 2.0, 15.0

Facts = dict[str, ExifFacts]


def settled(facts: Mapping[str, ExifFacts]) -> tuple[dict[str, ExifFacts], list[str]]:
    """Headers with the sounder of both statements as their position, and what is said of it. facts: by image name."""
    found, remarks = _sounder_positions(facts)
    found, said = consistent_altitudes(found)
    remarks += said
    found, said = _sounder_heights(found)
    return found, remarks + said


def _sounder_positions(facts: Mapping[str, ExifFacts]) -> tuple[dict[str, ExifFacts], list[str]]:
    """Return headers with the sounder of both latitudes and longitudes, and what is said of it."""
    found = dict(facts)
    both = [n for n, fact in found.items() if fact.latitude_deg is not None and fact.xmp_position[0] is not None]
    if not both:
        return found, []
    exif_deg = np.array([[found[name].latitude_deg, found[name].longitude_deg] for name in both], dtype=float)
    xmp_deg = np.array([found[name].xmp_position[:2] for name in both], dtype=float)
    scale = _METRES_PER_DEGREE * np.array([1.0, math.cos(math.radians(float(np.median(exif_deg[:, 0]))))])
    taken, remarks = _sounder("positions", both, exif_deg * scale, xmp_deg * scale)
    for name, (latitude, longitude) in zip(both, xmp_deg, strict=True):
        if name in taken:
            found[name] = replace(found[name], latitude_deg=float(latitude), longitude_deg=float(longitude))
    return found, remarks


def _sounder_heights(facts: Mapping[str, ExifFacts]) -> tuple[dict[str, ExifFacts], list[str]]:
    """Return headers with the sounder of both altitudes, and what is said of it."""
    both = _with_both(facts)
    if not both:
        return dict(facts), []
    altitudes_m = np.array(list(both.values()))
    taken, remarks = _sounder("heights", list(both), altitudes_m[:, :1], altitudes_m[:, 1:])
    return {**facts, **{name: replace(facts[name], altitude_m=both[name][1]) for name in taken}}, remarks


def with_conventions(facts: Mapping[str, ExifFacts]) -> tuple[dict[str, ExifFacts], list[str]]:
    """Headers with the convention that the angles of each camera can have, and what is said where it is not that of the
    tags."""
    cameras: dict[tuple[str, str], list[str]] = defaultdict(list)
    for name, fact in facts.items():
        if fact.angles is not None and fact.angles.convention == "nadir":
            cameras[fact.make, fact.model].append(name)
    found, remarks = dict(facts), []
    for names in cameras.values():
        angles = {name: one for name in names if (one := facts[name].angles) is not None}
        pitches = [one.pitch_deg for one in angles.values()]
        if not from_level(pitches):
            continue
        found |= {name: replace(facts[name], angles=replace(one, convention="gimbal")) for name, one in angles.items()}
        remarks.append(
            f"{of_images(names, names, 'has', 'have')} a pitch of {np.median(pitches):.0f} degrees, "
            "which by its tag (Pix4D's Camera:Pitch) looks backwards: it is taken as counted from level, where -90 "
            "looks down; --set block.angles=nadir reads it by its tag"
        )
    return found, remarks


def _sounder(what: str, names: list[str], exif_m: FloatArray, xmp_m: FloatArray) -> tuple[set[str], list[str]]:
    """Images of which XMP counts, and what is said. exif_m, xmp_m: (N, K)."""
    apart_m = np.linalg.norm(xmp_m - exif_m, axis=1)
    far = apart_m > _ALIKE_M
    if not far.any():
        return set(), []
    contradiction = _contradiction(what, names, apart_m, far)
    counts = [sum(len(np.unique(column)) for column in one.T) for one in (exif_m, xmp_m)]
    if counts[0] <= _COARSE * counts[1]:
        return set(names), [f"{contradiction}: EXIF has the same or rounded numbers in many images, so XMP is used"]
    if counts[1] <= _COARSE * counts[0]:
        return set(), [f"{contradiction}: XMP has the same or rounded numbers in many images, so EXIF is used"]
    strays = _strays(exif_m, far) & ~_strays(xmp_m, far)
    stray_names, rest = _those(names, strays), far & ~strays
    remarks = []
    if stray_names:
        of_strays = of_images(stray_names, names)
        remarks.append(f"EXIF states {what} of {of_strays} far from all others, XMP does not: XMP is used")
    if rest.any():
        remarks.append(f"{_contradiction(what, names, apart_m, rest)}: EXIF is used")
    return set(stray_names), remarks


def _contradiction(what: str, names: list[str], apart_m: FloatArray, far: BoolArray) -> str:
    """Return what is said of the images (N,) that are `far`. apart_m: (N,) between both statements."""
    of_those = of_images(_those(names, far), names)
    return f"EXIF and XMP state different {what} of {of_those}, by {np.median(apart_m[far]):,.1f} m"


def _strays(places_m: FloatArray, far: BoolArray) -> BoolArray:
    """(N,) which lie elsewhere than those that both state alike, which must be most of them."""
    if 2 * far.sum() >= len(far):
        return np.zeros(len(far), dtype=bool)
    middle = np.median(places_m[~far], axis=0)
    distances = np.linalg.norm(places_m - middle, axis=1)
    return np.asarray(distances > _ELSEWHERE * distances[~far].max() + _ELSEWHERE_M)


def _those(names: Sequence[str], chosen: BoolArray) -> list[str]:
    """Return the names (N,) that are chosen."""
    return [name for name, one in zip(names, chosen, strict=True) if one]


def consistent_altitudes(facts: Mapping[str, ExifFacts]) -> tuple[Facts, list[str]]:
    """Headers with altitudes that count alike, where the headers tell, and what is said of those that do not. facts: by
    image name."""
    found, remarks = dict(facts), list[str]()
    for step in (_in_feet, _of_one_sign, _above_take_off, _without_zeros):
        changed, said = step(found)
        found |= changed
        remarks += said
    return found, remarks + _two_levels(found)


def _in_feet(facts: Mapping[str, ExifFacts]) -> tuple[Facts, list[str]]:
    """Headers whose GPSAltitude counts in feet, which EXIF does not know, and XMP states the same in metres."""
    both = _with_both(facts)
    feet = [name for name, (exif_m, xmp_m) in both.items() if abs(xmp_m) > _LEAST_FEET_M and _is_feet(exif_m, xmp_m)]
    if len(feet) < len(both) or not both:  # a single one is chance
        return {}, []
    words = f"GPSAltitude of {of_images(feet, facts)} counts in feet, as XMP states the same in metres: XMP is used"
    return {name: replace(facts[name], altitude_m=both[name][1]) for name in feet}, [words]


def _is_feet(exif_m: float, xmp_m: float) -> bool:
    return abs(exif_m * _FOOT_M - xmp_m) < max(_FEET_SHARE * abs(xmp_m), 0.5)


def _of_one_sign(facts: Mapping[str, ExifFacts]) -> tuple[Facts, list[str]]:
    """Headers with the sign of most altitudes, where all are alike but for it: GPSAltitudeRef is wrong in the others.
    Of as many of both, those above sea level are right."""
    stated = {name: fact.altitude_m for name, fact in facts.items() if fact.altitude_m}
    sizes = np.abs(list(stated.values()))
    below = [name for name, altitude_m in stated.items() if altitude_m < 0.0]
    if len(stated) < _LEAST_IMAGES or not below or len(below) == len(stated) or sizes.max() >= 2.0 * sizes.min():
        return {}, []
    wrong = below if 2 * len(below) <= len(stated) else [name for name in stated if name not in set(below)]
    words = (
        f"GPSAltitudeRef of {of_images(wrong, facts)} says {'below' if wrong is below else 'above'} sea level, and the "
        f"other altitudes are as large ({sizes.min():.0f} to {sizes.max():.0f} m): they get the sign of the others"
    )
    return {name: replace(facts[name], altitude_m=-stated[name]) for name in wrong}, [words]


def _above_take_off(facts: Mapping[str, ExifFacts]) -> tuple[Facts, list[str]]:
    """Headers with absolute altitudes in place of GPSAltitudes that are XMP's RelativeAltitude: those of XMP, else
    raised by the height of the take-off point that the other images of the block tell."""
    relative_m = {
        name: fact.relative_altitude_m for name, fact in facts.items() if fact.relative_altitude_m is not None
    }
    by_exif = _less({name: fact.altitude_m for name, fact in facts.items()}, relative_m)
    by_xmp = _less({name: fact.xmp_position[2] for name, fact in facts.items()}, relative_m)
    wrong = [name for name, takeoff_m in by_exif.items() if abs(takeoff_m) < _ALIKE_M]
    # Over a take-off point at sea level both are the same.
    takeoffs_m = [takeoff_m for takeoff_m in {**by_exif, **by_xmp}.values() if abs(takeoff_m) >= _ALIKE_M]
    if not wrong or len(takeoffs_m) < 2 or np.ptp(takeoffs_m) > _APART_M:
        return {}, []
    usual_m = float(np.median(takeoffs_m))
    raised_m = {name: by_xmp.get(name, usual_m) for name in wrong}
    changed = {
        name: replace(facts[name], altitude_m=relative_m[name] + up_m)
        for name, up_m in raised_m.items()
        if abs(up_m) >= _ALIKE_M
    }
    if not changed:
        return {}, []
    words = (
        f"GPSAltitude of {of_images(list(changed), facts)} counts from the take-off point (it is RelativeAltitude), "
        f"which lies at {usual_m:.0f} m by the other altitudes: it is raised by that"
    )
    return changed, [words]


def _without_zeros(facts: Mapping[str, ExifFacts]) -> tuple[Facts, list[str]]:
    """Headers of a block in which no height is stated, or 0 for all images: with heights above the take-off point,
    where all have them, else without."""
    placed = {name: fact for name, fact in facts.items() if fact.latitude_deg is not None}
    if len(placed) < _LEAST_IMAGES or any(fact.altitude_m for fact in placed.values()):
        return {}, []
    zeros = [name for name, fact in placed.items() if fact.altitude_m == 0.0]
    said = f"GPSAltitude is 0 in {len(zeros)} of {len(facts)} images" if zeros else "no image states an altitude"
    above_m = [fact.relative_altitude_m for fact in placed.values()]
    if None not in above_m and any(above_m):
        above = {name: replace(fact, altitude_m=fact.relative_altitude_m) for name, fact in placed.items()}
        return above, [f"{said}: heights above the take-off point (RelativeAltitude) are used"]
    if not zeros:
        return {}, []
    return {name: replace(placed[name], altitude_m=None) for name in zeros}, [f"{said}: not used"]


def _two_levels(facts: Mapping[str, ExifFacts]) -> list[str]:
    """What is said of altitudes on two levels where neither angles nor XMP tell whether the flight had two heights."""
    stated = {
        name: fact.altitude_m
        for name, fact in facts.items()
        if fact.altitude_m is not None
        and fact.angles is None
        and fact.relative_altitude_m is None
        and fact.xmp_position[2] is None
    }
    names = sorted(stated, key=lambda name: stated[name])
    heights_m = np.array([stated[name] for name in names])
    if len(names) < 2 * _LEAST_IMAGES or len(names) < len(facts):
        return []
    first = int(np.argmax(np.diff(heights_m))) + 1
    lower, upper = heights_m[:first], heights_m[first:]
    gap_m = upper[0] - lower[-1]
    thick_m = max(np.ptp(lower), np.ptp(upper))
    if min(len(lower), len(upper)) < _LEAST_IMAGES or gap_m < max(_APART * thick_m, _APART_M):
        return []
    step_m = float(np.median(upper) - np.median(lower))
    return [
        f"the altitudes lie on two levels, {step_m:.0f} m apart: {lower[0]:.0f} to {lower[-1]:.0f} m in "
        f"{of_images(sorted(names[:first]), facts)}, {upper[0]:.0f} to {upper[-1]:.0f} m in the others. If all were "
        "flown at one height, one level counts from the take-off point and the other from sea level, and the block "
        "comes out tilted: give altitudes of one kind with --poses"
    ]


def _less(altitudes_m: Mapping[str, float | None], relative_m: Mapping[str, float]) -> dict[str, float]:
    """Heights of the take-off point, of images that state both."""
    return {name: z_m - relative_m[name] for name, z_m in altitudes_m.items() if z_m is not None and name in relative_m}


def _with_both(facts: Mapping[str, ExifFacts]) -> dict[str, tuple[float, float]]:
    """Altitudes of EXIF and of XMP of the images that have both."""
    return {
        name: (fact.altitude_m, fact.xmp_position[2])
        for name, fact in facts.items()
        if fact.altitude_m is not None and fact.xmp_position[2] is not None
    }
