"""Positions and heights that EXIF and XMP of the same images both state, and that contradict each other; angles that
contradict the definition of their tags.

EXIF counts, since corrected positions (PPK) are written there, unless it is the broken one: coarser than XMP (cut to
minutes, the same for all), or in single images far from where all others are, and XMP is not.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from aeromatch_cli.blocks.altitudes import consistent_altitudes
from aeromatch_cli.blocks.exif import ExifFacts
from aeromatch_cli.blocks.xmp import from_level
from aeromatch_cli.data import BoolArray, FloatArray

_METRES_PER_DEGREE = 111_320.0
# What is stated twice differs by less: rounding, and the time between two readings.
_ALIKE_M = 3.0
# One of two statements is the coarser where it has at most this share of the other's different numbers.
_COARSE = 0.5
# A single position is elsewhere beyond so many times the extent of the others, and so many metres.
_ELSEWHERE, _ELSEWHERE_M = 2.0, 200.0
_NAMES = 5


def settled(facts: Mapping[str, ExifFacts]) -> tuple[dict[str, ExifFacts], list[str]]:
    """Headers with the sounder of both statements as their position, and what is said of it. facts: by image name."""
    found, remarks = dict(facts), []
    both = [n for n, fact in found.items() if fact.latitude_deg is not None and fact.xmp_position[0] is not None]
    if both:
        exif_deg = np.array([[found[name].latitude_deg, found[name].longitude_deg] for name in both], dtype=float)
        xmp_deg = np.array([found[name].xmp_position[:2] for name in both], dtype=float)
        scale = _METRES_PER_DEGREE * np.array([1.0, math.cos(math.radians(float(np.median(exif_deg[:, 0]))))])
        taken, remark = _sounder("positions", both, exif_deg * scale, xmp_deg * scale)
        remarks += remark
        for name, (latitude, longitude) in zip(both, xmp_deg, strict=True):
            if name in taken:
                found[name] = replace(found[name], latitude_deg=float(latitude), longitude_deg=float(longitude))
    found, said = consistent_altitudes(found)
    remarks += said
    both = [n for n, fact in found.items() if fact.altitude_m is not None and fact.xmp_position[2] is not None]
    if both:
        exif_m = np.array([[found[name].altitude_m] for name in both], dtype=float)
        xmp_m = np.array([[found[name].xmp_position[2]] for name in both], dtype=float)
        taken, remark = _sounder("heights", both, exif_m, xmp_m)
        remarks += remark
        found |= {name: replace(found[name], altitude_m=found[name].xmp_position[2]) for name in taken}
    return found, remarks


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
            f"{_some(names, np.ones(len(names), dtype=bool))} have a pitch of {np.median(pitches):.0f} degrees, which "
            "by its tag (Pix4D's Camera:Pitch) looks backwards: it is taken as counted from level, where -90 looks "
            "down; --set block.angles=nadir reads it by its tag"
        )
    return found, remarks


def _sounder(what: str, names: Sequence[str], exif_m: FloatArray, xmp_m: FloatArray) -> tuple[set[str], list[str]]:
    """Images of which XMP counts, and what is said. exif_m, xmp_m: (N, K)."""
    apart_m = np.linalg.norm(xmp_m - exif_m, axis=1)
    far = apart_m > _ALIKE_M
    if not far.any():
        return set(), []
    contradiction = f"EXIF and XMP state different {what} of {_some(names, far)}, by {np.median(apart_m[far]):,.1f} m"
    counts = [sum(len(np.unique(column)) for column in one.T) for one in (exif_m, xmp_m)]
    if counts[0] <= _COARSE * counts[1]:
        return set(names), [f"{contradiction}: EXIF has the same or rounded numbers in many images, so XMP is used"]
    if counts[1] <= _COARSE * counts[0]:
        return set(), [f"{contradiction}: XMP has the same or rounded numbers in many images, so EXIF is used"]
    strays = _strays(exif_m, far) & ~_strays(xmp_m, far)
    remarks = []
    if strays.any():
        remarks.append(f"EXIF states {what} of {_some(names, strays)} far from all others, XMP does not: XMP is used")
    if (far & ~strays).any():
        rest = far & ~strays
        remarks.append(
            f"EXIF and XMP state different {what} of {_some(names, rest)}, by {np.median(apart_m[rest]):,.1f} m: EXIF "
            "is used"
        )
    return {name for name, stray in zip(names, strays, strict=True) if stray}, remarks


def _strays(places_m: FloatArray, far: BoolArray) -> BoolArray:
    """(N,) which lie elsewhere than those that both state alike, which must be most of them."""
    if 2 * far.sum() >= len(far):
        return np.zeros(len(far), dtype=bool)
    middle = np.median(places_m[~far], axis=0)
    distances = np.linalg.norm(places_m - middle, axis=1)
    return np.asarray(distances > _ELSEWHERE * distances[~far].max() + _ELSEWHERE_M)


def _some(names: Sequence[str], chosen: BoolArray) -> str:
    shown = [name for name, one in zip(names, chosen, strict=True) if one]
    return f"{len(shown)} of {len(names)} images ({', '.join(shown[:_NAMES])}{', ...' if len(shown) > _NAMES else ''})"
