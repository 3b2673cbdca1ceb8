"""Criteria of the calibration: by how much cameras differ from what is known of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from aeromatch_cli.geometry.cameras import BROWN, MODELS
from aeromatch_cli.results.adjustment import (
    Calibration,
    GroupResult,
    Parameter,
)
from aeromatch_cli.sfm.quality.deformation import TILT_DEG, tilt_deg
from aeromatch_cli.sfm.quality.finding import (
    LEVELS,
    Finding,
    Found,
    Level,
    Limits,
    QualityInput,
    finding_of,
    flight_words,
    level_of,
    number,
)
from aeromatch_cli.words import counted

# From the first row of a picture to its last: no shutter needs as long.
_READOUT_S: Limits = (0.2, None)
# A calibration that differs so much from what is known of the camera, in standard deviations of that: a camera file of
# another camera, pictures of another size, or positions that force it.
_LENS_SIGMAS: Limits = (3.0, 6.0)
# b1 and b2 of a lens that nobody has calibrated.
_AFFINITY_SIGMAS: Limits = (_LENS_SIGMAS[0], None)
# Parameters of a camera, and by how many standard deviations those of affinity differ from square pixels.
_Affinity = tuple[Mapping[str, Parameter], Mapping[str, float]]
# What a lens of its own for a flight is worth, over what is asked for: beyond, the flights do not share a calibration.
_FLIGHT_LENS: Limits = (1.0, None)


def calibration(evidence: QualityInput) -> Found:
    """The parameter of every camera that differs most from what is known of it."""
    told = set[str]()
    affinities: dict[str, _Affinity] = {}
    for group in evidence.groups:
        for camera_id, camera in group.calibration.items():
            if camera_id in told:  # a camera is one and the same for all groups
                continue
            parameters = camera.parameters
            yield from _read_out(camera_id, parameters)
            changes = {name: change for name, change in _changes(parameters).items() if name not in evidence.held}
            if "f" in changes and parameters["f"].sigma == 0.0:
                words = (
                    f"camera {camera_id} keeps its focal length of {number(parameters['f'].value)} px: matches put it "
                    "where no lens is, though their residuals hardly tell. Moving trees, a rolling shutter or wrong "
                    "distortion do that: a calibration of the camera, or another flying height, helps"
                )
                yield Finding("focal length", None, None, "doubtful", words)
            affinity = {name: changes.pop(name) for name in ({"b1", "b2"} - _stated(parameters)) & changes.keys()}
            if affinity:
                affinities[camera_id] = parameters, affinity
            yield from _wrongly_held(evidence, camera_id, camera)
            if changes:
                told.add(camera_id)
                yield from _flight_lenses(camera_id, camera)
                yield _largest_change(evidence, group, camera_id, changes)
    yield from _affinities(evidence, affinities)
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
    if tilt_deg(group) > TILT_DEG[0]:  # what does not tell its tilt does not tell the principal point either
        limits |= dict.fromkeys({"cx", "cy"} & changes.keys(), (_LENS_SIGMAS[0], None))
    levels = {key: LEVELS.index(level_of(changes[key], limits[key])) for key in changes}
    name = max(changes, key=lambda key: (levels[key], changes[key]))
    words = _change(camera_id, name, group.calibration[camera_id].parameters[name], changes[name])
    words += f" ({_held_words(evidence)})" if evidence.held else ""
    remedy = (
        "is it the calibration of this camera, at this size of the pictures? positions that are off change it "
        "as well, and heights with it"
    )
    return finding_of("calibration", changes[name], limits[name], words, remedy)


def _has_read_out(parameters: Mapping[str, Parameter]) -> bool:
    return "readout_s" in parameters and parameters["readout_s"].sigma > 0.0


def _read_out(camera_id: str, parameters: Mapping[str, Parameter]) -> Iterator[Finding]:
    if _has_read_out(parameters):
        seconds = parameters["readout_s"].value
        words = f"camera {camera_id} reads a picture in {seconds:+.3f} s (rolling shutter)"
        remedy = "no shutter needs as long, or backwards: check the times of the images"
        yield finding_of("rolling shutter", seconds if seconds > 0.0 else np.inf, _READOUT_S, words, remedy)


def _affinities(evidence: QualityInput, cameras: Mapping[str, _Affinity]) -> Iterator[Finding]:
    """Cameras with the same level and remedy share a finding, which says the remedy once."""
    alike: dict[tuple[Level, str], list[tuple[float, str]]] = {}
    for camera_id, (parameters, affinity) in cameras.items():
        name = max(affinity, key=lambda key: affinity[key])
        key = level_of(affinity[name], _AFFINITY_SIGMAS), _affinity_remedy(evidence, parameters)
        alike.setdefault(key, []).append((affinity[name], _change(camera_id, name, parameters[name], affinity[name])))
    for (_, remedy), found in alike.items():
        words = "; ".join(words for _, words in found)
        yield finding_of("affinity", max(found)[0], _AFFINITY_SIGMAS, words, remedy)


def _affinity_remedy(evidence: QualityInput, parameters: Mapping[str, Parameter]) -> str:
    square, not_tried = "pixels of sensors are square", evidence.adjust.readout_not_tried
    if _has_read_out(parameters):
        return f"{square}: a part of the rolling shutter may be in it, which looks the same"
    if not_tried:
        return f"{square}: a rolling shutter looks like that, and its read-out time was not tried: {not_tried}"
    return (
        f"{square}: a rolling shutter looks like that, but its read-out time, tried where velocities are known, does "
        "not explain it; a calibration of the camera (--cameras FILE) tells more"
    )


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


def with_held(evidence: QualityInput, remedy: str) -> str:
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
        f"{number(known[name].value + freed.change[name])}, not at {number(known[name].value)}"
    )
    remedy = "free it, or give the calibration of this camera at this size of the pictures"
    yield finding_of("held calibration", freed.worth, _FLIGHT_LENS, words, remedy)


def _flight_lenses(camera_id: str, camera: Calibration) -> Iterator[Finding]:
    for one in camera.flights:
        images = counted(one.images, "image")
        shown = ", ".join(f"{name} by {one.change.get(name, 0.0):+.1f} px" for name in ("f", "cx", "cy"))
        words = (
            f"camera {camera_id} has another calibration in {flight_words(one.flight)} ({images}) than in "
            f"the largest of its flights: {shown}"
        )
        if level_of(one.worth, _FLIGHT_LENS) == "good":
            words = f"camera {camera_id} has the same calibration in {flight_words(one.flight)} as in the largest"
        remedy = (
            "was it focused, zoomed or exchanged in between? with the images of each flight in a folder of their own "
            "and `--cameras folder` each flight has a camera of its own"
        )
        yield finding_of("flights of a camera", one.worth, _FLIGHT_LENS, words, remedy)


def _change(camera_id: str, name: str, parameter: Parameter, sigmas: float) -> str:
    value, _, prior, prior_sigma = parameter
    return (
        f"calibration of camera {camera_id}: {name} {number(value)} where {number(prior)} +- {number(prior_sigma)} "
        f"is known, {sigmas:.1f} standard deviations"
    )


def _stated(parameters: Mapping[str, Parameter]) -> set[str]:
    """Parameters that are judged by what is known of them. Terms that nobody has stated are what they are: those of
    distortion of a lens that is not calibrated, or that the model of its camera file lacks."""
    return {"f", "cx", "cy"} | {name for name, one in parameters.items() if one.prior != 0.0}
