"""Criteria of given positions and angles: how they are met, what flights and antennas are off by."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.results.adjustment import FlightOffset, PositionResiduals
from aeromatch_cli.sfm.heights import shift_to_control_m
from aeromatch_cli.sfm.quality.calibration import with_held
from aeromatch_cli.sfm.quality.finding import (
    MANY_WRONG_POSITIONS,
    WRONG_POSITIONS,
    Finding,
    Found,
    Limits,
    QualityInput,
    finding_of,
    flight_words,
    guess_words,
    plain,
    positions_given,
    rms,
)
from aeromatch_cli.words import counted, form

# Root mean square of the differences from given positions, in stated standard deviations: 1 is what was promised. Wide
# statements (5 m of GPS without a better word) are met easily, and that is good.
_POSITION_SIGMAS: Limits = (2.0, 5.0)
# What the positions of a flight are off by together (a step of height, a shift), in stated standard deviations: also
# where it was taken out, which of the flights is right is not known. It is no step where positions of one flight
# scatter by more than this share of it.
_FLIGHT_SIGMAS: Limits = (2.0, None)
_FLIGHT_SCATTER, _FLIGHT_IMAGES = 0.33, 2
# Found values count that are so many of their own standard deviations.
_SIGNIFICANT = 3.0
# Between exposure and position: less is within what receivers do.
_LAG_S: Limits = (0.1, None)
# From the projection centre to the antenna: no drone is larger, so that something else has been found.
_LEVER_M: Limits = (0.5, None)
# Medians of the differences from measured tilts, as standard deviations of what was stated.
_TILT_SIGMAS: Limits = (3.0, 6.0)


def positions(evidence: QualityInput) -> Found:
    """Judge the given positions of cameras against the adjusted ones."""
    found = [group.positions for group in evidence.groups if group.positions]
    if not found:
        if not positions_given(evidence):
            yield "positions: none are given"
        return
    guess = guess_words(evidence.adjust.guessed_cameras)
    yield _wrong(evidence, found, guess)
    yield from _met(evidence, found, guess)


def _wrong(evidence: QualityInput, found: Sequence[PositionResiduals], guess: str) -> Finding:
    """Whether positions contradict the pictures. guess: said of a guessed focal length, "" where none is."""
    images = sum(one.images for one in found)
    wrong = [i for one in found for i in one.wrong]
    if not wrong and not any(one.used for one in found):
        words = (
            f"{counted(images, 'given position is', 'given positions are')} too few to take part in the adjustment, "
            "which takes three: scale, north and place are those of the given poses"
        )
        return Finding("wrong positions", 0.0, WRONG_POSITIONS[0], "good", words)
    if wrong and evidence.adjust.images == 2:
        words = (
            f"{len(wrong)} of {images} given positions {form(len(wrong), 'is', 'are')} not used: with the angles and "
            "the focal length they do not fit the pictures, and a single pair does not tell which of these is wrong"
        )
        said = f"{words}; {guess or 'a third image that overlaps both, or control points, tell'}"
        return Finding("wrong positions", len(wrong) / images, WRONG_POSITIONS[0], "doubtful", said)
    verbs = ("contradicts", "is") if len(wrong) == 1 else ("contradict", "are")
    words = f"{len(wrong)} of {images} given positions {verbs[0]} the pictures and {verbs[1]} not used"
    remedy = f"{evidence.named(wrong)}; check which position belongs to which image"
    if guess and len(wrong) > MANY_WRONG_POSITIONS * images:  # single ones are wrong by themselves
        remedy = f"{evidence.named(wrong)}; {guess}; otherwise check which position belongs to which image"
    return finding_of("wrong positions", len(wrong) / images, WRONG_POSITIONS, words, remedy)


def _met(evidence: QualityInput, found: Sequence[PositionResiduals], guess: str) -> Found:
    """How well the adjustment meets the given positions, in units of what is stated."""
    met = [(one.rms_sigmas, one.rms_m, one.stated_m) for one in found if one.rms_sigmas and one.rms_m]
    if not met:
        return
    used = np.array([one.used for one in found if one.rms_sigmas and one.rms_m])
    shares = used / used.sum()
    remedy = (
        "they are less exact than stated, or another focal length, time or antenna offset stands behind it; state "
        "their real accuracy, or correct their cause"
    ) + (f"; {guess}" if guess else "")
    for name, axes in (("horizontally", "xy"), ("vertically", "z")):
        of = ["xyz".index(axis) for axis in axes]
        sigmas, off_m, stated_m = (
            float(np.sqrt(shares @ [rms(np.array(one)[of]) ** 2 for one in values]))
            for values in zip(*met, strict=True)
        )
        # Of x and y together, as in the page's table, which leaves in what is taken out here; what is stated is stated
        # of each.
        error_m = off_m * np.sqrt(len(of))
        words = (
            f"positions are met {name} to {plain(error_m, 3)} m (root mean square in {axes.upper()}, without "
            f"drifts, shifts and delays of flights and antenna offsets), {sigmas:.1f} times what is stated, "
            f"{plain(stated_m, 3)} m{' along each axis' if len(of) > 1 else ''}"
        )
        yield finding_of(f"positions {name}", sigmas, _POSITION_SIGMAS, words, with_held(evidence, remedy))


def flights(evidence: QualityInput) -> Found:
    """Steps, shifts and delays of whole flights, each with its size."""
    for group in evidence.groups:
        found = set[str]()
        stated_m = (np.inf, np.inf, np.inf) if group.positions is None else group.positions.stated_m
        for flight in group.flights:
            name, images, step_m = flight_words(flight.flight), flight.images, flight.step_m
            of = counted(images, "image")
            if step_m:
                words = (
                    f"heights of {name} ({of}) lie {abs(step_m):.1f} m "
                    f"{'above' if step_m > 0.0 else 'below'} those of the others, which was taken out"
                )
                remedy = "check the zero of its heights; control points tell which flight is right"
                yield finding_of("step of heights", abs(step_m) / stated_m[2], _FLIGHT_SIGMAS, words, remedy)
            shift_m, sigma_m = np.array(flight.shifts).T
            if (np.abs(shift_m) > _SIGNIFICANT * sigma_m).any():
                shown = ", ".join(f"{axis} {value:+.2f}" for axis, value in zip("xyz", shift_m, strict=True))
                words = f"positions of {name} ({of}) are off by {shown} m, which was taken out"
                remedy = "check its base station, geoid and coordinate system; control points tell what is right"
                if shift_to_control_m(group) is not None:  # adjust says what it is, and which heights are right
                    yield Finding("shift of a flight", None, None, "good", words)
                else:
                    known = np.abs(shift_m) > _SIGNIFICANT * sigma_m
                    sigmas = float((np.abs(shift_m) / np.array(stated_m))[known].max())
                    yield finding_of("shift of a flight", sigmas, _FLIGHT_SIGMAS, words, remedy)
            found.add(flight.flight)
            if flight.lag_s is not None:
                lag_s = flight.lag_s.value
                words = f"positions of {name} lag {lag_s:+.2f} s behind the exposures, which was taken out"
                remedy = "check the times by which positions were given to images"
                yield finding_of("delay of positions", abs(lag_s), _LAG_S, words, remedy)

        offsets = group.positions.flights if group.positions else []
        left = [one for one in offsets if one.flight not in found]
        yield from _apart(left, np.array(stated_m))


def _apart(flights: Sequence[FlightOffset], stated_m: FloatArray) -> Iterator[Finding]:
    """Flights whose positions lie off together, against that of most images, and nothing was taken out."""
    flights = [flight for flight in flights if flight.images >= _FLIGHT_IMAGES]
    most = max(flights, key=lambda one: one.images, default=None)
    for flight in flights:
        if most is None or flight is most:
            continue
        off_m = np.array(flight.mean_m) - np.array(most.mean_m)
        axis = int(np.argmax(np.abs(off_m) / stated_m))
        if max(flight.scatter_m[axis], most.scatter_m[axis]) > _FLIGHT_SCATTER * abs(off_m[axis]):
            continue
        what = ("x", "y", "heights")[axis]
        off = f"{'-' if off_m[axis] < 0.0 else '+'}{plain(abs(off_m[axis]), 3)} m"
        words = (
            f"{what} of {flight_words(flight.flight)} ({flight.images} images) lie {off} from those of the largest "
            "flight, which is in the result"
        )
        remedy = "check their datum and base stations, or state the accuracy of both as they are"
        yield finding_of("flights apart", float(abs(off_m[axis]) / stated_m[axis]), _FLIGHT_SIGMAS, words, remedy)


def mounts(evidence: QualityInput) -> Found:
    """Judge the antenna offsets that the adjustment estimated."""
    for group in evidence.groups:
        for camera_id, mount in group.mounts.items():
            length_m = float(np.linalg.norm(mount.lever_m))
            if length_m > 0.0:
                words = f"the antenna lies {length_m:.2f} m from camera {camera_id}, as its positions show"
                remedy = "no drone is as large: check which point the positions are of, and their heights"
                yield finding_of("antenna", length_m, _LEVER_M, words, remedy)


def angles(evidence: QualityInput) -> Found:
    """Judge measured tilts against the adjusted rotations and their stated deviations."""
    residuals = evidence.adjust.residuals
    if residuals is None or residuals.rotation_sigmas_median is None or residuals.rotation_deg_median is None:
        yield "angles: none are given"
        return
    sigmas = rms(residuals.rotation_sigmas_median[:2]) / 0.6745  # of a normal distribution's absolute values
    degrees = rms(residuals.rotation_deg_median[:2]) / 0.6745
    words = f"measured tilts differ by {degrees:.2f} degrees, {sigmas:.1f} times what was stated"
    remedy = "check the convention of the angles (--set block.angles), and the heights of the positions"
    yield finding_of("angles", sigmas, _TILT_SIGMAS, words, remedy)
