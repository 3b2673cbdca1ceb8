"""Criteria of expected deformations: bowl, tilt and errors of heights."""

from __future__ import annotations

import numpy as np

from aeromatch_cli.results.adjustment import (
    GroupResult,
    HeightErrors,
)
from aeromatch_cli.sfm.quality.finding import (
    Found,
    Limits,
    QualityInput,
    angles_given,
    finding_of,
    part_words,
    plain,
)

# Expected deformations: how far the middle of the block may lie above its border, ground pixels; and by which angle it
# may be tilted, degrees, which is what one strip has about its line.
_BOWL_PIXELS: Limits = (5.0, None)
TILT_DEG: Limits = (2.0, None)
# Expected errors of heights as a whole: ground pixels, or so many standard deviations of the heights of positions.
_HEIGHT_PIXELS, _HEIGHT_SIGMAS = 5.0, 3.0
# Errors of so many times the block's reach say no more than that something is not determined.
_MEANINGLESS = 10.0
_STRIPS = "two strips across, images from another height, or three control points determine it"


def deformation(evidence: QualityInput) -> Found:
    """Judge the deformation of the group that is worst in each respect."""
    known = [(group, group.heights) for group in evidence.groups if group.heights]
    if not known:
        yield "expected deformation: the block was not adjusted, or has too few points"
        return

    def part(group: GroupResult) -> str:
        return part_words(group, evidence.groups, evidence.names)

    worst, heights = max(known, key=lambda one: one[1].in_pixels(one[1].bowl))
    words = f"the middle of {part(worst)} may lie {_length(heights, heights.bowl)} above or below its border"
    remedy = f"straight views from one height do not determine it; {_STRIPS}"
    yield finding_of("bowl", heights.in_pixels(heights.bowl), _BOWL_PIXELS, words, remedy)
    placed = [one for one in known if one[0].kind != "level"]
    if not placed:
        return
    worst = max((group for group, _ in placed), key=tilt_deg)
    angle = tilt_deg(worst)
    words = f"{part(worst)} may be tilted by {angle:.2f} degrees"
    measured = "" if angles_given(evidence) else "measured angles, "
    remedy = (
        "its positions are not exact enough over its extent: exacter ones, a second strip beside a single one, "
        f"{measured}or three control points tell"
    )
    yield finding_of("tilt", angle, TILT_DEG, words, remedy)
    stated = [(group, heights, group.positions.stated_m[2]) for group, heights in placed if group.positions]
    if stated:
        worst, heights, stated_m = max(stated, key=lambda one: one[1].in_pixels(one[1].sigma))
        # As exact as positions are is as exact as can be asked for.
        limit = max(_HEIGHT_PIXELS, _HEIGHT_SIGMAS * heights.in_pixels(stated_m))
        exact = _length(heights, heights.sigma)
        words = f"heights of {part(worst)} are exact to {exact}, its positions to {plain(stated_m)} m"
        remedy = f"its images do not tell heights from focal length and tilt; {_STRIPS}"
        yield finding_of("heights", heights.in_pixels(heights.sigma), (limit, None), words, remedy)


def _length(heights: HeightErrors, value: float) -> str:
    """A length in ground pixels and, where it has them, in metres; in words where the errors are beyond the linear
    model that states them, as of an image that hangs on one pair."""
    if value > _MEANINGLESS * heights.reach:
        return "many times farther than the block extends"
    return f"{heights.in_pixels(value):.1f} ground pixels" + (f" ({plain(value)} m)" if heights.metric else "")


def tilt_deg(group: GroupResult) -> float:
    """Expected error of a part's tilt; 0 where it is not known."""
    heights = group.heights
    return 0.0 if heights is None else float(np.rad2deg(np.arctan2(heights.tilt, heights.reach)))
