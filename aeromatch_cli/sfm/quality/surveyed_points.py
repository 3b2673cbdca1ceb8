"""Criteria of surveyed points: control points that contradict the others, and errors at check points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.results.adjustment import (
    Control,
    ControlInGroup,
    Xyz,
    xyz,
)
from aeromatch_cli.sfm.heights import height_remedy, shift_of_points_m, zeros_words
from aeromatch_cli.sfm.quality.finding import Finding, Found, Limits, QualityInput, finding_of
from aeromatch_cli.words import form

# Root mean square at points that took no part, in their standard deviations and those of their measurement.
_CONTROL_SIGMAS: Limits = (3.0, 8.0)
_WRONG_CONTROL: Limits = (0.0, 0.3)


def control_points(evidence: QualityInput) -> Found:
    """Judge control points that contradict the others, and errors at points that took no part."""
    control = evidence.adjust.control
    if control is None or not control.points:
        yield "control points: none are given"
        return
    inside = [group.control for group in evidence.groups if group.control]
    yield _contradicting(control, inside)
    if control.sigmas_m is None:
        yield "control points: too few to check the block by them"
        return
    # A point is known as its survey says, and found as it is measured in its images, in a block that lies as exactly as
    # its positions or the other points put it.
    stated_m = np.hypot(control.sigmas_m, evidence.adjust.sigma_position_m or 0.0)
    for one in inside:
        if not one.kept:
            yield _refused(one, stated_m)
    errors = _independent_errors_m(control, inside)
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
    yield finding_of("check points", sigmas, _CONTROL_SIGMAS, words, remedy)


def _contradicting(control: Control, adjusted: Sequence[ControlInGroup]) -> Finding:
    """Judge how many of the surveyed points contradict the others. adjusted: what the adjustment found of them."""
    unlike, left_out = set(control.doubtful), set[str]()
    for one in adjusted:
        unlike.update(one.wrong, one.exchanged)
        if one.kept:
            left_out.update(one.wrong, one.exchanged)
    count = max(control.control + control.check + len(left_out), 1)
    words = f"{len(unlike)} of {count} surveyed points {form(len(unlike), 'contradicts', 'contradict')} the others"
    remedy = f"{', '.join(sorted(unlike)[:5])}; check their names, coordinates and where they were measured"
    return finding_of("wrong control points", len(unlike) / count, _WRONG_CONTROL, words, remedy)


def _independent_errors_m(control: Control, adjusted: Sequence[ControlInGroup]) -> list[Xyz]:
    """Return the errors of points that took no part, by axis: in every group, and under a similarity."""
    errors = []
    for one in adjusted:
        # Points left out of few leave a block that is not the one that all of them hold.
        telling = one.held_out == "check points" or len(one.used) > 3
        if one.kept and telling and one.held_out_rms_m:
            errors.append(one.held_out_rms_m)
    if control.check_rmse_m:
        errors.append(control.check_rmse_m)
    return errors


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
