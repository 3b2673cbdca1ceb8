"""Whether an adjusted block can be trusted: good, doubtful or bad, with the number that says so and the remedy.

Every criterion looks at one figure of the adjustment and at what it ought to be. The worst
finding is the verdict. What nothing was given for cannot be checked; it is named, and counts neither way, but for a
block that nothing ties to the ground.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.cameras import BROWN, MODELS
from aeromatch_cli.results.adjustment import (
    Calibration,
    Control,
    ControlInGroup,
    FlightOffset,
    GroupResult,
    HeightErrors,
    Parameter,
    xyz,
)
from aeromatch_cli.results.record import Record
from aeromatch_cli.results.stages import AdjustResult, OrientResult
from aeromatch_cli.sfm.heights import height_remedy, shift_of_points_m, shift_to_control_m, zeros_words

Level = Literal["good", "doubtful", "bad"]
LEVELS: tuple[Level, ...] = ("good", "doubtful", "bad")

# Each pair: doubtful beyond the first, bad beyond the second; None: never bad by itself.
Limits = tuple[float, float | None]
# Root mean square of the differences from given positions, in stated standard deviations: 1 is what was promised. Wide
# statements (5 m of GPS without a better word) are met easily, and that is good.
_POSITION_SIGMAS: Limits = (2.0, 5.0)
# Of the given positions, the share that the pictures contradict: single wrong ones happen.
_WRONG_POSITIONS: Limits = (0.05, 0.3)
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
# From the first row of a picture to its last: no shutter needs as long.
_READOUT_S: Limits = (0.2, None)
# Medians of the differences from measured tilts, as standard deviations of what was stated.
_TILT_SIGMAS: Limits = (3.0, 6.0)
# Root mean square at points that took no part, in their standard deviations and those of their measurement.
_CONTROL_SIGMAS: Limits = (3.0, 8.0)
_WRONG_CONTROL: Limits = (0.0, 0.3)
# Mean distance of an image point from where its point is seen, pixels of the picture that it was found in: tie points
# measured by least squares, and those of a detector as it has left them. Sound blocks have 0.1 to 0.5 and 0.5 to 0.9.
_MEASURED_PX: Limits = (0.6, 1.2)
_DETECTED_PX: Limits = (1.0, 2.0)
# Images per point: two rays meet nearly always, only a third one checks them.
_FEWEST_IMAGES_PER_POINT = 2.5
# Share of the images with hardly a point of three images.
_HELD_BY_PAIRS: Limits = (0.1, 0.5)
# A calibration that differs so much from what is known of the camera, in standard deviations of that: a camera file of
# another camera, pictures of another size, or positions that force it.
_LENS_SIGMAS: Limits = (3.0, 6.0)
# What a lens of its own for a flight is worth, over what is asked for: beyond, the flights do not share a calibration.
_FLIGHT_LENS: Limits = (1.0, None)
# Expected deformations: how far the middle of the block may lie above its border, ground pixels; and by which angle it
# may be tilted, degrees, which is what one strip has about its line.
_BOWL_PIXELS: Limits = (5.0, None)
_TILT_DEG: Limits = (2.0, None)
# Expected errors of heights as a whole: ground pixels, or so many standard deviations of the heights of positions.
_HEIGHT_PIXELS, _HEIGHT_SIGMAS = 5.0, 3.0
# Share of the images that are not oriented, or not in the largest part: none is as it should be.
_LEFT_OUT: Limits = (0.0, 0.2)
# Parts of so many images and more that share too few points with the others to be tied by them.
_PART_IMAGES = 3
# Share of the verified matches that the adjusted block contradicts. Sound blocks have 1 to 16 %.
_CONTRADICTED: Limits = (0.25, 0.6)
# Share of the images of which it contradicts so many that these are no exceptions.
_CONTRADICTING: Limits = (0.05, 0.5)
# Share of the images whose matches kept poses (orient=given) do not explain.
_UNEXPLAINED: Limits = (0.1, 0.5)
# So many positions, or points, hold a block.
_HOLDING = 3

_STRIPS = "two strips across, images from another height, or three control points determine it"


@dataclass(frozen=True)
class Finding:
    """what: name of the criterion; value and limit: its figure, and where doubt begins, None where it is no number;
    sentence: both in words and, where it is not good, the remedy."""

    what: str
    value: float | None
    limit: float | None
    level: Level
    sentence: str


@dataclass(frozen=True)
class Quality:
    """findings: of all that was checked, the worst first. unchecked: what could not be, in words."""

    verdict: Level
    findings: tuple[Finding, ...]
    unchecked: tuple[str, ...] = ()

    @property
    def faults(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.level != "good")

    def as_facts(self) -> dict[str, Any]:
        """JSON-ready."""
        findings = [asdict(one) | {"value": _rounded(one.value)} for one in self.findings]
        return {"verdict": self.verdict, "findings": findings, "unchecked": list(self.unchecked)}


class QualityInput(Record):
    """Holds what a block is judged by.

    images: of the block. adjust, orient: results of these stages. components: sizes of the groups of images that
    verified pairs connect, the largest first. refined: whether tie points were measured by least squares. contradicted:
    share of the verified matches that the adjusted block contradicts, None where it is not known; contradicting: ids of
    images of which it contradicts most. reduced: stored pixels in a pixel of the pictures that keypoints were found in.
    names: of the files, by image_id.
    """

    images: int
    adjust: AdjustResult
    orient: OrientResult | None = None
    components: tuple[int, ...] = ()
    refined: bool = False
    contradicted: float | None = None
    contradicting: tuple[str, ...] = ()
    reduced: float = 1.0
    names: dict[str, str] = Field({})

    @property
    def groups(self) -> Sequence[GroupResult]:
        return self.adjust.groups

    @property
    def held(self) -> Mapping[str, str]:
        """Parameter of cameras -> setting that holds it."""
        return self.adjust.held_by

    def named(self, image_ids: Sequence[str], most: int = 5) -> str:
        shown = ", ".join(self.names.get(i, i) for i in image_ids[:most])
        return shown + (f" and {len(image_ids) - most} more" if len(image_ids) > most else "")


def judged(evidence: QualityInput) -> Quality:
    """Return the verdict on a block, and what it rests on."""
    findings, unchecked = [*_connection(evidence)], list[str]()
    if evidence.adjust.images:
        for criterion in (
            _left_out, _frames, _weak_ties, _contradicted, _positions, _flights, _mounts, _angles, _control, _errors,
            _multiplicity, _calibration, _deformation, _kept_poses,
        ):  # fmt: skip
            for found in criterion(evidence):
                if isinstance(found, Finding):
                    findings.append(found)
                else:
                    unchecked.append(found)
    elif evidence.images > 2:
        if evidence.adjust.remarks:
            words = (
                "no image is oriented: more overlap, or known positions and attitudes (--poses) and cameras "
                "(--cameras) help; matches are exported all the same"
            )
            findings.append(Finding("oriented images", 0.0, None, "bad", words))
        else:  # nothing is said of an orientation that nobody wanted
            unchecked.append("orientation: orient=none asks for none")
    else:
        unchecked.append("adjustment: two images have none")
    findings.sort(key=lambda one: -LEVELS.index(one.level))
    verdict = findings[0].level if findings else "good"
    return Quality(verdict, tuple(findings), tuple(unchecked))


_Found = Iterator[Finding | str]


def _level(value: float, limits: Limits) -> Level:
    doubtful, bad = limits
    if bad is not None and value > bad:
        return "bad"
    return "doubtful" if value > doubtful else "good"


def _finding(what: str, value: float, limits: Limits, words: str, remedy: str) -> Finding:
    level = _level(value, limits)
    return Finding(what, float(value), limits[0], level, words if level == "good" else f"{words}: {remedy}")


def _connection(evidence: QualityInput) -> Iterator[Finding]:
    sizes = list(evidence.components)
    if not sizes:
        return
    beside = 1.0 - max(sizes) / max(evidence.images, 1)
    if len(sizes) == 1:
        yield Finding("connection", 0.0, 0.0, "good", "all images are connected")
        return
    shown = ", ".join(map(str, sizes[:5])) + (", ..." if len(sizes) > 5 else "")
    words = f"{len(sizes)} groups of images ({shown}) that no verified pair connects"
    remedy = "more overlap between them helps; --set pairs=exhaustive finds pairs that positions hide"
    yield _finding("connection", beside, _LEFT_OUT, words, remedy)


def _left_out(evidence: QualityInput) -> _Found:
    outside = list(evidence.adjust.outside)
    missing = max(len(outside), evidence.images - evidence.adjust.images)
    words = f"{evidence.images - missing} of {evidence.images} images are oriented"
    if outside:
        one = evidence.names.get(outside[0], outside[0])
        remedy = (
            f"not oriented: {evidence.named(outside)}; lost.csv says why; `aeromatch show WORK {one}` shows "
            "what it has; images of other places may be left out"
        )
    else:
        remedy = "the others have too few points in common with them; more overlap helps"
    yield _finding("oriented images", missing / max(evidence.images, 1), _LEFT_OUT, words, remedy)


def _frames(evidence: QualityInput) -> _Found:
    """Parts of frames of their own, and whether anything ties the block to the ground."""
    kinds = [group.kind for group in evidence.groups]
    parts = kinds.count("level") + any(kind != "level" for kind in kinds)  # those that positions place lie in one frame
    if parts > 1 and len(evidence.components) <= 1:
        words = (
            f"{parts} parts whose scale and place nothing ties to each other: positions (--poses) place each of them"
        )
        yield Finding("parts", float(parts), 1.0, "bad", words)
    yield from _placed_parts(evidence)
    given = _positions_given(evidence)
    used = sum(group.positions.used for group in evidence.groups if group.positions)
    kept = any(kind == "given" for kind in kinds)
    # Control points that took no part show how the block is to be moved; they do not hold it.
    surveyed = sum(len(group.control.used) for group in evidence.groups if group.control)
    if used >= _HOLDING or surveyed >= _HOLDING or kept:
        return
    if given >= _HOLDING:
        words = (
            f"none of the {given} given positions is used, the pictures contradict them: check the coordinate "
            "system, the order of x and y, and which position belongs to which image"
        )
        yield Finding("positions", 1.0, _WRONG_POSITIONS[0], "bad", words)
    else:
        words = (
            "shape only: nothing ties the block to the ground, place, north and scale are arbitrary: positions "
            "(--poses) do; control points alone show how the block is to be moved"
        )
        yield Finding("ground", None, None, "doubtful", words)


def _positions_given(evidence: QualityInput) -> int:
    """Count the images with a given position, those that the orientation has left out as well, of which the adjustment
    does not know."""
    return max(evidence.adjust.positions_given, evidence.orient.positions_given if evidence.orient else 0)


def _weak_ties(evidence: QualityInput) -> _Found:
    """Parts of a block that is one by single points; several parts are judged by `_placed_parts`."""
    parts = [size for size in evidence.adjust.tied_parts if size >= _PART_IMAGES]
    if len(parts) > 1 and len(evidence.groups) == 1:
        words = (
            f"{_sizes(parts)} share fewer than 20 points: single points, or their positions, put them to each other; "
            "more overlap between them helps"
        )
        yield Finding("weakly tied parts", float(len(parts)), 1.0, "doubtful", words)


def _contradicted(evidence: QualityInput) -> _Found:
    """Matches that the block contradicts, and images of which it contradicts most."""
    if evidence.contradicted is None:
        return
    remedy = (
        "many of them are wrong, or poses and cameras are: `aeromatch show WORK IMAGE IMAGE --rejected` shows those of "
        "a pair; repeated patterns, water and moving shadows need other settings or --masks"
    )
    words = f"the adjusted block contradicts {100.0 * evidence.contradicted:.0f} % of the verified matches"
    yield _finding("contradicted matches", evidence.contradicted, _CONTRADICTED, words, remedy)
    count = len(evidence.contradicting)
    words = f"most matches of {count} of {evidence.images} images contradict the adjusted block"
    if count:
        words += f" ({evidence.named(evidence.contradicting)})"
    yield _finding("contradicting images", count / max(evidence.images, 1), _CONTRADICTING, words, remedy)


def _placed_parts(evidence: QualityInput) -> Iterator[Finding]:
    placed = [(group, group.positions) for group in evidence.groups if group.kind == "positions" and group.positions]
    pixel_m = evidence.adjust.ground_pixel_m
    if len(placed) < 2 or not pixel_m:
        return
    # Of a part of N images by the square root of N better; that of the smallest counts.
    exact_m = max(_rms(positions.stated_m) / np.sqrt(max(positions.used, 1)) for _, positions in placed)
    sizes = _sizes([group.images for group, _ in placed])
    words = (
        f"{sizes} share too few points and lie to each other as their positions put them, to {plain(exact_m)} m "
        f"({exact_m / pixel_m:.1f} ground pixels): more overlap between them, better positions, or control points in "
        "each tie them"
    )
    yield Finding("parts", float(exact_m / pixel_m), None, "doubtful", words)


def _sizes(parts: Sequence[int]) -> str:
    shown = ", ".join(map(str, parts[:5])) + (", ..." if len(parts) > 5 else "")
    return f"{len(parts)} parts ({shown} images)"


def _positions(evidence: QualityInput) -> _Found:
    found = [group.positions for group in evidence.groups if group.positions]
    if not found:
        if not _positions_given(evidence):
            yield "positions: none are given"
        return
    images = sum(one.images for one in found)
    wrong = [i for one in found for i in one.wrong]
    remedy = f"{evidence.named(wrong)}; check which position belongs to which image"
    words = f"{len(wrong)} of {images} given positions contradict the pictures and are not used"
    yield _finding("wrong positions", len(wrong) / images, _WRONG_POSITIONS, words, remedy)
    met = [(one.rms_sigmas, one.rms_m, one.stated_m) for one in found if one.rms_sigmas and one.rms_m]
    if not met:
        return
    used = np.array([one.used for one in found if one.rms_sigmas and one.rms_m])
    shares = used / used.sum()
    remedy = (
        "they are less exact than stated, or another focal length, time or antenna offset stands behind it; state "
        "their real accuracy, or correct their cause"
    )
    for name, axes in (("horizontally", [0, 1]), ("vertically", [2])):
        sigmas, off_m, stated_m = (
            float(np.sqrt(shares @ [_rms(np.array(one)[axes]) ** 2 for one in values]))
            for values in zip(*met, strict=True)
        )
        words = f"positions are met {name} to {plain(off_m, 3)} m, {sigmas:.1f} times the {plain(stated_m, 3)} m stated"
        yield _finding(f"positions {name}", sigmas, _POSITION_SIGMAS, words, _with_held(evidence, remedy))


def _flights(evidence: QualityInput) -> _Found:
    """Steps, shifts and delays of whole flights, each with its size."""
    for group in evidence.groups:
        found = set[str]()
        stated_m = (np.inf, np.inf, np.inf) if group.positions is None else group.positions.stated_m
        for flight in group.flights:
            name, images, step_m = _flight(flight.flight), flight.images, flight.step_m
            if step_m:
                words = (
                    f"heights of {name} ({images} images) lie {abs(step_m):.1f} m "
                    f"{'above' if step_m > 0.0 else 'below'} those of the others, which was taken out"
                )
                remedy = "check the zero of its heights; control points tell which flight is right"
                yield _finding("step of heights", abs(step_m) / stated_m[2], _FLIGHT_SIGMAS, words, remedy)
            shift_m, sigma_m = np.array(flight.shifts).T
            if (np.abs(shift_m) > _SIGNIFICANT * sigma_m).any():
                shown = ", ".join(f"{axis} {value:+.2f}" for axis, value in zip("xyz", shift_m, strict=True))
                words = f"positions of {name} ({images} images) are off by {shown} m, which was taken out"
                remedy = "check its base station, geoid and coordinate system; control points tell what is right"
                if shift_to_control_m(group) is not None:  # adjust says what it is, and which heights are right
                    yield Finding("shift of a flight", None, None, "good", words)
                else:
                    known = np.abs(shift_m) > _SIGNIFICANT * sigma_m
                    sigmas = float((np.abs(shift_m) / np.array(stated_m))[known].max())
                    yield _finding("shift of a flight", sigmas, _FLIGHT_SIGMAS, words, remedy)
            found.add(flight.flight)
            if flight.lag_s is not None:
                lag_s = flight.lag_s.value
                words = f"positions of {name} lag {lag_s:+.2f} s behind the exposures, which was taken out"
                remedy = "check the times by which positions were given to images"
                yield _finding("delay of positions", abs(lag_s), _LAG_S, words, remedy)

        offsets = group.positions.flights if group.positions else []
        left = [one for one in offsets if one.flight not in found]
        yield from _apart(left, np.array(stated_m))


def _flight(name: str) -> str:
    """Names of flights may begin with that word."""
    if not name:
        return "the flight without times"
    return name if name.lower().startswith("flight") else f"flight {name}"


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
            f"{what} of {_flight(flight.flight)} ({flight.images} images) lie {off} from those of the largest "
            "flight, which is in the result"
        )
        remedy = "check their datum and base stations, or state the accuracy of both as they are"
        yield _finding("flights apart", float(abs(off_m[axis]) / stated_m[axis]), _FLIGHT_SIGMAS, words, remedy)


def _mounts(evidence: QualityInput) -> _Found:
    for group in evidence.groups:
        for camera_id, mount in group.mounts.items():
            length_m = float(np.linalg.norm(mount.lever_m))
            if length_m > 0.0:
                words = f"the antenna lies {length_m:.2f} m from camera {camera_id}, as its positions show"
                remedy = "no drone is as large: check which point the positions are of, and their heights"
                yield _finding("antenna", length_m, _LEVER_M, words, remedy)


def _angles(evidence: QualityInput) -> _Found:
    residuals = evidence.adjust.residuals
    if residuals is None or residuals.rotation_sigmas_median is None or residuals.rotation_deg_median is None:
        yield "angles: none are given"
        return
    sigmas = _rms(residuals.rotation_sigmas_median[:2]) / 0.6745  # of a normal distribution's absolute values
    degrees = _rms(residuals.rotation_deg_median[:2]) / 0.6745
    words = f"measured tilts differ by {degrees:.2f} degrees, {sigmas:.1f} times what was stated"
    remedy = "check the convention of the angles (--set block.angles), and the heights of the positions"
    yield _finding("angles", sigmas, _TILT_SIGMAS, words, remedy)


def _control(evidence: QualityInput) -> _Found:
    """Control points that contradict the others, and errors at points that took no part."""
    control = evidence.adjust.control
    if control is None or not control.points:
        yield "control points: none are given"
        return
    inside = [group.control for group in evidence.groups if group.control]
    unlike = sorted({*(n for one in inside for n in (*one.wrong, *one.exchanged)), *control.doubtful})
    left_out = {n for one in inside if one.kept for n in (*one.wrong, *one.exchanged)}
    count = max(control.control + control.check + len(left_out), 1)
    words = f"{len(unlike)} of {count} surveyed points contradict the others"
    remedy = f"{', '.join(unlike[:5])}; check their names, coordinates and where they were measured"
    yield _finding("wrong control points", len(unlike) / count, _WRONG_CONTROL, words, remedy)
    if control.sigmas_m is None:
        yield "control points: too few to check the block by them"
        return
    # A point is known as its survey says, and found as it is measured in its images, in a block that lies as exactly as
    # its positions or the other points put it.
    stated_m = np.hypot(control.sigmas_m, evidence.adjust.sigma_position_m or 0.0)
    for one in inside:
        if not one.kept:
            yield _refused(one, stated_m)
    # Points left out of few leave a block that is not the one that all of them hold.
    held_out = [one for one in inside if one.kept and (one.held_out == "check points" or len(one.used) > 3)]
    found = [one.held_out_rms_m for one in held_out] + [control.check_rmse_m]
    errors = [error_m for error_m in found if error_m]
    as_it_is = list(control.residuals.values()) if _is_as_it_is(control, inside) else []
    up_m = shift_of_points_m(as_it_is, control.sigmas_m)
    if up_m is not None:
        errors = [xyz(np.sqrt(np.mean((np.array(as_it_is) - [0.0, 0.0, up_m]) ** 2, axis=0)))]
        words = (
            f"the block lies {abs(up_m):.2f} m {'above' if up_m > 0.0 else 'below'} all surveyed points: "
            f"{zeros_words(up_m)}; {height_remedy(-up_m, 'the points')}, or let some of them take part"
        )
        yield Finding("heights of surveyed points", up_m, None, "doubtful", words)
    if not errors:
        yield "control points: too few to check the block by them"
        return
    errors_m = max(errors, key=lambda error_m: float((np.array(error_m) / stated_m).max()))
    sigmas = float((np.array(errors_m) / stated_m).max())
    words = (
        f"points that took no part are met to {_axes(errors_m)} m, {sigmas:.1f} times what can be expected "
        f"({_axes(stated_m)})"
    )
    remedy = "check their coordinates and measurements; more control points at the border of the block help"
    yield _finding("check points", sigmas, _CONTROL_SIGMAS, words, remedy)


def _is_as_it_is(control: Control, adjusted: Sequence[ControlInGroup]) -> bool:
    """Whether residuals are of the block as it is, which no surveyed point holds."""
    return control.transformation is None and not any(one.used for one in adjusted)


def _refused(control: ControlInGroup, stated_m: FloatArray) -> Finding:
    """Control points that the adjustment left out: because it was as good without them, or because they do not fit."""
    errors_m = [control.held_out_rms_m, control.without_rms_m]
    sigmas = max(float((np.array(one) / stated_m).max()) if one else np.inf for one in errors_m)
    limit, without_m = _CONTROL_SIGMAS[0], errors_m[1]
    if without_m and sigmas <= limit:
        words = f"control points agree with the block to {_axes(without_m)} m and were not needed"
        return Finding("control points", sigmas, limit, "good", words)
    words = (
        f"the control points fit the block if {control.fault}; they were left out: correct the list"
        if control.fault
        else "the control points contradict the images and their positions, and were left out: check their coordinate "
        "system, their heights, their names, and where they were measured in the pictures"
    )
    return Finding("control points", sigmas if np.isfinite(sigmas) else None, limit, "doubtful", words)


def _axes(errors_m: Iterable[float]) -> str:
    return ", ".join(f"{axis} {error_m:.3f}" for axis, error_m in zip("xyz", errors_m, strict=True))


def _errors(evidence: QualityInput) -> _Found:
    error_px = evidence.adjust.reprojection_error_px
    if error_px is None:
        return
    limits = _MEASURED_PX if evidence.refined else _DETECTED_PX
    found_px = error_px / evidence.reduced
    words = f"mean reprojection error {error_px:.2f} px, up to {limits[0] * evidence.reduced:.1f} px is usual"
    remedy = (
        "poses or cameras do not fit the matches: let the pictures find them (orient=global), and check --cameras and "
        "--poses"
    )
    yield _finding("reprojection error", found_px, limits, words, _with_held(evidence, remedy))


def _multiplicity(evidence: QualityInput) -> _Found:
    if evidence.adjust.images < 3:
        return
    length = evidence.adjust.track_length
    level: Level = "good" if length >= _FEWEST_IMAGES_PER_POINT else "doubtful"
    words = f"a point is seen by {length:.1f} images"
    remedy = "" if level == "good" else ": where two see it nothing checks them; more overlap, or more keypoints, helps"
    yield Finding("images per point", length, _FEWEST_IMAGES_PER_POINT, level, words + remedy)
    held = evidence.adjust.held_by_pairs
    words = f"{held} of {evidence.adjust.images} images have hardly a point that three images see"
    share = held / evidence.adjust.images
    yield _finding("held by pairs", share, _HELD_BY_PAIRS, words, "more overlap, or more keypoints, helps")


def _calibration(evidence: QualityInput) -> _Found:
    """The parameter of every camera that differs most from what is known of it."""
    told = set[str]()
    for group in evidence.groups:
        for camera_id, camera in group.calibration.items():
            if camera_id in told:  # a camera is one and the same for all groups
                continue
            parameters = camera.parameters
            yield from _read_out(camera_id, parameters)
            changes = {name: change for name, change in _changes(parameters).items() if name not in evidence.held}
            if "f" in changes and parameters["f"].sigma == 0.0:
                words = (
                    f"camera {camera_id} keeps its focal length of {_number(parameters['f'].value)} px: matches put it "
                    "where no lens is, though their residuals hardly tell. Moving trees, a rolling shutter or wrong "
                    "distortion do that: a calibration of the camera, or another flying height, helps"
                )
                yield Finding("focal length", None, None, "doubtful", words)
            affinity = {name: changes.pop(name) for name in ({"b1", "b2"} - _stated(parameters)) & changes.keys()}
            yield from _affinity(camera_id, parameters, affinity)
            yield from _wrongly_held(evidence, camera_id, camera)
            if changes:
                told.add(camera_id)
                yield from _flight_lenses(camera_id, camera)
                yield _largest_change(evidence, group, camera_id, changes)
    if not told:
        yield f"calibration: {_held_words(evidence) or 'it was not adjusted'}"


def _changes(parameters: Mapping[str, Parameter]) -> dict[str, float]:
    """Parameters that are judged -> by how many standard deviations they differ from what was known."""
    judged = _stated(parameters) | {"b1", "b2"}
    return {
        name: abs(one.value - one.prior) / one.prior_sigma
        for name, one in parameters.items()
        if one.prior_sigma > 0.0 and np.isfinite(one.prior_sigma) and name in judged
    }


def _largest_change(
    evidence: QualityInput, group: GroupResult, camera_id: str, changes: Mapping[str, float]
) -> Finding:
    limits = dict.fromkeys(changes, _LENS_SIGMAS)
    if _tilt_deg(group) > _TILT_DEG[0]:  # what does not tell its tilt does not tell the principal point either
        limits |= dict.fromkeys({"cx", "cy"} & changes.keys(), (_LENS_SIGMAS[0], None))
    levels = {key: LEVELS.index(_level(changes[key], limits[key])) for key in changes}
    name = max(changes, key=lambda key: (levels[key], changes[key]))
    words = _change(camera_id, name, group.calibration[camera_id].parameters[name], changes[name])
    words += f" ({_held_words(evidence)})" if evidence.held else ""
    remedy = (
        "is it the calibration of this camera, at this size of the pictures? positions that are off change it "
        "as well, and heights with it"
    )
    return _finding("calibration", changes[name], limits[name], words, remedy)


def _has_read_out(parameters: Mapping[str, Parameter]) -> bool:
    return "readout_s" in parameters and parameters["readout_s"].sigma > 0.0


def _read_out(camera_id: str, parameters: Mapping[str, Parameter]) -> Iterator[Finding]:
    if _has_read_out(parameters):
        seconds = parameters["readout_s"].value
        words = f"camera {camera_id} reads a picture in {seconds:+.3f} s (rolling shutter)"
        remedy = "no shutter needs as long, or backwards: check the times of the images"
        yield _finding("rolling shutter", seconds if seconds > 0.0 else np.inf, _READOUT_S, words, remedy)


def _affinity(camera_id: str, parameters: Mapping[str, Parameter], affinity: Mapping[str, float]) -> Iterator[Finding]:
    """affinity: by how much its parameters differ from those of square pixels, in standard deviations."""
    if affinity:
        name = max(affinity, key=lambda key: affinity[key])
        words = _change(camera_id, name, parameters[name], affinity[name])
        remedy = "pixels of sensors are square: " + (
            "a part of the rolling shutter may be in it, which looks the same"
            if _has_read_out(parameters)
            else "a rolling shutter looks like that where images have no velocities; give capture times or a "
            "shorter exposure"
        )
        yield _finding("affinity", affinity[name], (_LENS_SIGMAS[0], None), words, remedy)


def _held_words(evidence: QualityInput) -> str:
    """Say which settings hold which parameters of the cameras, "" where none does."""
    by_setting: dict[str, list[str]] = {}
    for name, setting in evidence.held.items():
        by_setting.setdefault(setting, []).append(name)
    whole = len(MODELS[BROWN])
    return ", ".join(
        f"{setting} holds {'all parameters' if len(names) == whole else ', '.join(names)}"
        for setting, names in by_setting.items()
    )


def _with_held(evidence: QualityInput, remedy: str) -> str:
    """The remedy for what a wrong calibration may have done, with the settings that have held parameters of it."""
    held = _held_words(evidence)
    return f"{remedy}; {held} of cameras as stated, which may be wrong" if held else remedy


def _wrongly_held(evidence: QualityInput, camera_id: str, camera: Calibration) -> Iterator[Finding]:
    freed, known = camera.if_freed, camera.parameters
    if not freed.change:
        return
    in_sigmas = {
        n: abs(c) / known[n].prior_sigma for n, c in freed.change.items() if n in known and known[n].prior_sigma > 0.0
    }
    name = max(in_sigmas, key=lambda key: in_sigmas[key], default=next(iter(freed.change)))
    words = (
        f"{_held_words(evidence)} of camera {camera_id}: the pictures put {name} at "
        f"{_number(known[name].value + freed.change[name])}, not at {_number(known[name].value)}"
    )
    remedy = "free it, or give the calibration of this camera at this size of the pictures"
    yield _finding("held calibration", freed.worth, _FLIGHT_LENS, words, remedy)


def _flight_lenses(camera_id: str, camera: Calibration) -> Iterator[Finding]:
    for one in camera.flights:
        shown = ", ".join(f"{name} by {one.change.get(name, 0.0):+.1f} px" for name in ("f", "cx", "cy"))
        words = (
            f"camera {camera_id} has another calibration in {_flight(one.flight)} ({one.images} images) than in "
            f"the largest of its flights: {shown}"
        )
        if _level(one.worth, _FLIGHT_LENS) == "good":
            words = f"camera {camera_id} has the same calibration in {_flight(one.flight)} as in the largest"
        remedy = (
            "was it focused or zoomed in between? with the images of each flight in a folder of their own and "
            "`--cameras folder` each flight has a camera of its own"
        )
        yield _finding("flights of a camera", one.worth, _FLIGHT_LENS, words, remedy)


def _change(camera_id: str, name: str, parameter: Parameter, sigmas: float) -> str:
    value, _, prior, prior_sigma = parameter
    return (
        f"calibration of camera {camera_id}: {name} {_number(value)} where {_number(prior)} +- {_number(prior_sigma)} "
        f"is known, {sigmas:.1f} standard deviations"
    )


def _stated(parameters: Mapping[str, Parameter]) -> set[str]:
    """Parameters that are judged by what is known of them: of a lens that nobody has calibrated, terms of distortion
    are what they are, and those of affinity are judged by themselves."""
    terms = {"k1", "k2", "k3", "p1", "p2", "b1", "b2"}
    calibrated = any(parameters[name].prior != 0.0 for name in terms & parameters.keys())
    return {"f", "cx", "cy"} | (terms if calibrated else set())


def _deformation(evidence: QualityInput) -> _Found:
    """Judge the deformation of the group that is worst in each respect."""
    known = [(group, group.heights) for group in evidence.groups if group.heights]
    if not known:
        yield "expected deformation: the block was not adjusted, or has too few points"
        return

    def part(group: GroupResult) -> str:
        return "the block" if len(evidence.groups) == 1 else f"the part of {group.images} images"

    worst, heights = max(known, key=lambda one: one[1].in_pixels(one[1].bowl))
    words = f"the middle of {part(worst)} may lie {_length(heights, heights.bowl)} above or below its border"
    remedy = f"straight views from one height do not determine it; {_STRIPS}"
    yield _finding("bowl", heights.in_pixels(heights.bowl), _BOWL_PIXELS, words, remedy)
    placed = [one for one in known if one[0].kind != "level"]
    if not placed:
        return
    worst = max((group for group, _ in placed), key=_tilt_deg)
    angle = _tilt_deg(worst)
    words = f"{part(worst)} may be tilted by {angle:.2f} degrees"
    remedy = (
        "its positions are not exact enough over its extent: exacter ones, a second strip beside a single one, "
        "measured angles, or three control points tell"
    )
    yield _finding("tilt", angle, _TILT_DEG, words, remedy)
    stated = [(group, heights, group.positions.stated_m[2]) for group, heights in placed if group.positions]
    if stated:
        worst, heights, stated_m = max(stated, key=lambda one: one[1].in_pixels(one[1].sigma))
        # As exact as positions are is as exact as can be asked for.
        limit = max(_HEIGHT_PIXELS, _HEIGHT_SIGMAS * heights.in_pixels(stated_m))
        exact = _length(heights, heights.sigma)
        words = f"heights of {part(worst)} are exact to {exact}, its positions to {plain(stated_m)} m"
        remedy = f"its images do not tell heights from focal length and tilt; {_STRIPS}"
        yield _finding("heights", heights.in_pixels(heights.sigma), (limit, None), words, remedy)


def _length(heights: HeightErrors, value: float) -> str:
    """A length in ground pixels and, where it has them, in metres."""
    return f"{heights.in_pixels(value):.1f} ground pixels" + (f" ({plain(value)} m)" if heights.metric else "")


def _tilt_deg(group: GroupResult) -> float:
    """Expected error of a part's tilt; 0 where it is not known."""
    heights = group.heights
    return 0.0 if heights is None else float(np.rad2deg(np.arctan2(heights.tilt, heights.reach)))


def _kept_poses(evidence: QualityInput) -> _Found:
    """Judge whether poses that were kept as they were given explain the matches."""
    orient = evidence.orient
    if orient is None or not orient.stays or not orient.images_matched:
        return
    matched, explained = orient.images_matched, orient.given_poses_explained
    words = f"given poses explain the matches of {explained} of {matched} images"
    remedy = "they are kept because of orient=given; orient=global finds better ones"
    yield _finding("kept poses", 1.0 - explained / matched, _UNEXPLAINED, words, remedy)


def _rms(values: Any) -> float:
    return float(np.sqrt((np.asarray(values, np.float64) ** 2).mean()))


def _number(value: float) -> str:
    return f"{value:.1f}" if abs(value) >= 10.0 else f"{value:.3g}"


def plain(value: float, digits: int = 2) -> str:
    """Write a number with at least so many significant digits, without a power of ten where it is large: 110, 2.9,
    0.034."""
    return f"{value:.0f}" if abs(value) >= 10.0 ** (digits - 1) else f"{value:.{digits}g}"


def _rounded(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(f"{value:.4g}")
