"""Criteria of image points: reprojection error, and how many images see a point."""

from __future__ import annotations

from aeromatch_cli.sfm.quality.calibration import with_held
from aeromatch_cli.sfm.quality.finding import Finding, Found, Level, Limits, QualityInput, finding_of
from aeromatch_cli.words import form

# Mean distance of an image point from where its point is seen, pixels of the picture that it was found in: tie points
# measured by least squares, and those of a detector as it has left them. Sound blocks have 0.1 to 0.5 and 0.5 to 0.9.
_MEASURED_PX: Limits = (0.6, 1.2)
_DETECTED_PX: Limits = (1.0, 2.0)
# Images per point: two rays meet nearly always, only a third one checks them.
_FEWEST_IMAGES_PER_POINT = 2.5
# Share of the images with hardly a point of three images.
_HELD_BY_PAIRS: Limits = (0.1, 0.5)


def reprojection_errors(evidence: QualityInput) -> Found:
    """Judge the mean reprojection error against what detected and refined points have."""
    error_px = evidence.adjust.reprojection_error_px
    if error_px is None:
        return
    limits = _MEASURED_PX if evidence.refined else _DETECTED_PX
    found_px = error_px / evidence.reduced
    words = f"mean reprojection error {error_px:.2f} px, up to {limits[0] * evidence.reduced:.1f} px is usual"
    by_pictures = evidence.orient is not None and not evidence.orient.stays
    first = "" if by_pictures else "let the pictures find them (orient=global), and "
    remedy = f"poses or cameras do not fit the matches: {first}check --cameras and --poses"
    yield finding_of("reprojection error", found_px, limits, words, with_held(evidence, remedy))


def multiplicity(evidence: QualityInput) -> Found:
    """Judge how many images see a point, and name images whose points only pairs see."""
    if evidence.adjust.images < 3:
        return
    length = evidence.adjust.track_length
    level: Level = "good" if length >= _FEWEST_IMAGES_PER_POINT else "doubtful"
    words = f"a point is seen by {length:.1f} images"
    remedy = "" if level == "good" else ": where two see it nothing checks them; more overlap, or more keypoints, helps"
    yield Finding("images per point", length, _FEWEST_IMAGES_PER_POINT, level, words + remedy)
    held = evidence.adjust.held_by_pairs
    verb = form(held, "has", "have")
    words = f"{held} of {evidence.adjust.images} images {verb} hardly a point that three images see"
    share = held / evidence.adjust.images
    yield finding_of("held by pairs", share, _HELD_BY_PAIRS, words, "more overlap, or more keypoints, helps")
