"""Whether an adjusted block can be trusted: good, doubtful or bad, with the number that says so and the remedy.

Every criterion looks at one figure of the adjustment and at what it ought to be. The worst finding is the verdict.
What nothing was given for cannot be checked; it is named, and counts neither way, but for a block that nothing ties to
the ground.
"""

from __future__ import annotations

from aeromatch_cli.sfm.quality.calibration import calibration
from aeromatch_cli.sfm.quality.connection import (
    connection,
    contradicted,
    frames,
    kept_poses,
    left_out,
    unread,
    weak_ties,
)
from aeromatch_cli.sfm.quality.deformation import deformation
from aeromatch_cli.sfm.quality.finding import LEVELS, Finding, Quality, QualityInput
from aeromatch_cli.sfm.quality.image_points import multiplicity, reprojection_errors
from aeromatch_cli.sfm.quality.positions import angles, flights, mounts, positions
from aeromatch_cli.sfm.quality.surveyed_points import control_points


def judged(evidence: QualityInput) -> Quality:
    """Return the verdict on a block, and what it rests on."""
    findings, unchecked = [*connection(evidence), *unread(evidence)], list[str]()
    if evidence.adjust.images:
        for criterion in (
            left_out, frames, weak_ties, contradicted, positions, flights, mounts, angles, control_points,
            reprojection_errors, multiplicity, calibration, deformation, kept_poses,
        ):  # fmt: skip
            for found in criterion(evidence):
                if isinstance(found, Finding):
                    findings.append(found)
                else:
                    unchecked.append(found)
    elif evidence.images > 2:
        stopped = evidence.adjust.stopped or ("" if evidence.orient is None else evidence.orient.stopped)
        if stopped:
            words = (
                f"no image is adjusted: {stopped}; the same command tries again; matches are exported all the same, "
                "and poses as far as they were known before"
            )
            findings.append(Finding("oriented images", 0.0, None, "bad", words))
        elif evidence.adjust.remarks:
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
