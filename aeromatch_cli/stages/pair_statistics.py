"""Pair statistics: what steps of a cascade have found of a pair, what it lacks, and what a further step may find.

The logarithm of the expected number is linear in those of what is known. The weights are the steps' own, found on
rendered blocks by `scripts/train evidence`, which says how far they hold on others. Coverage, candidates and
what the pairs of the same images have found say nothing that matches, keypoints, overlap and view angle do not say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.strategies.steps import Step

# Pairs that overlap by less tie images that others tie better: fewer matches are enough, wherever they lie.
_TYING_OVERLAP = 0.4
# A pair with fewer verified matches is never settled, however small its overlap; an image with fewer keypoints shows
# nothing (covered lens, fog, water), and no step looks for more.
_LEAST_MATCHES = 30
# Images with fewer keypoints promise matches in proportion.
_ENOUGH_KEYPOINTS = 2000
# A pair has plenty with so many times the matches that are enough: no step is taken for more.
_PLENTY = 2.0
# Added to numbers whose logarithm is taken: below it they are much the same.
_FEW = 10.0
_DAMPING = 0.1
# Beyond it views differ in all they can, degrees.
_MOST_ANGLE_DEG = 90.0
# No step finds more keypoints in an image than one for so many of its pixels, nor the first one on the best texture.
_PIXELS_PER_KEYPOINT, _PIXELS_PER_FIRST = 100.0, 75.0
# An image with a smaller share of the keypoints that the first step may find has little texture for it.
_POOR = 0.75


@dataclass(frozen=True)
class PairStatistics:
    """Holds what the steps of a cascade have found of a pair.

    verified: matches, those of two steps in one place once. overlap: share of the image that the other one shows, of
    the image where it is larger. coverage: share of the overlap's cells that verified matches lie in; both NaN where
    poses or ground are unknown, coverage also where there is no overlap. keypoints: of the first step, in the image
    that has fewer. candidates: matches before verification. angle_deg: between both views of the ground, NaN where
    unknown. pixels: of the smaller image. sought: most keypoints that the first step looks for in an image.
    """

    verified: int
    overlap: float
    coverage: float
    keypoints: int
    candidates: int = 0
    angle_deg: float = float("nan")
    pixels: float = float("inf")
    sought: int = 0

    @property
    def shows_nothing(self) -> bool:
        """Whether one of the images has next to no keypoints."""
        return self.keypoints < _LEAST_MATCHES

    @property
    def poor(self) -> bool:
        """Whether one of the images has little texture for the first step."""
        return self.keypoints < _POOR * min(self.sought, self.pixels / _PIXELS_PER_FIRST)

    def enough(self, step: Step) -> int:
        """Verified matches with which the pair needs no step like this."""
        # Poses that no picture has confirmed predict nothing for pairs that overlap: taken at their word, a rendered
        # block of grass under five cameras loses two fifths of its correct matches.
        share = self.overlap if self.overlap > 0.0 else 1.0
        promised = step.below_matches * share * min(1.0, share / _TYING_OVERLAP)
        return max(_LEAST_MATCHES, round(promised * min(1.0, self.keypoints / _ENOUGH_KEYPOINTS)))

    def lacks(self, step: Step) -> str:
        """Say what the pair lacks so that it needs a step like this, "" where it lacks nothing."""
        known = self.overlap > 0.0
        share = self.overlap if known else 1.0
        least = self.enough(step)
        if self.verified < least:
            unknown = "no overlap predicted" if self.overlap == 0.0 else "overlap unknown"
            by = f" for an overlap of {100 * share:.0f} % of the image" if known else f", {unknown}"
            return f"{self.verified} verified matches of {least} that are enough{by}"
        if share >= _TYING_OVERLAP and self.coverage < step.below_coverage:
            return f"verified matches in {100 * self.coverage:.0f} % of the overlap"
        return ""

    def asks_for(self, step: Step, keypoints: int) -> str:
        """Say why the pair takes the step, "" where it need not. keypoints: most that the step finds in an image."""
        expected = self.expected(step, keypoints)
        lacks = self.lacks(step)
        if lacks:
            return lacks + (f", about {_rounded(expected)} expected after it" if np.isfinite(expected) else "")
        # Small overlaps promise large gains of few matches, and where the first step finds what it looks for it does
        # well: easy blocks would load networks for nothing.
        ties, plenty = self.overlap >= _TYING_OVERLAP, self.verified >= _PLENTY * self.enough(step)
        gain = getattr(step, "large_gain", np.inf)
        if self.poor and ties and not plenty and expected >= (1.0 + gain) * self.verified:
            return f"enough with {self.verified} verified matches, but about {_rounded(expected)} expected after it"
        return ""

    def expected(self, step: Step, keypoints: int) -> float:
        """Verified matches that the pair can be expected to have after the step; NaN where overlap or view angle are
        unknown, an image shows nothing, or there are no weights for the step. keypoints: most that the step finds in
        an image."""
        known = columns(self, keypoints)
        if step.expectation_weights is None or known is None or self.shows_nothing:
            return float("nan")
        number = expected_number(known, step.expectation_weights)
        return max(number, float(self.verified)) if step.own_features else number


def _rounded(number: float) -> int:
    """Round to two significant digits."""
    return int(float(f"{number:.2g}"))


def columns(evidence: PairStatistics, keypoints: int) -> FloatArray | None:
    """Return the columns (5,) in which the model is linear: one, and of verified matches, keypoints in the overlap,
    view angle, and the most keypoints that the step may find in the overlap. None where overlap or view angle are
    unknown."""
    if not (evidence.overlap > 0.0 and np.isfinite(evidence.angle_deg)):
        return None
    most = min(keypoints, evidence.pixels / _PIXELS_PER_KEYPOINT)
    counts = evidence.verified, evidence.keypoints * evidence.overlap, most * evidence.overlap
    verified, own, further = np.log(np.array(counts) + _FEW)
    return np.array([1.0, verified, own, min(evidence.angle_deg, _MOST_ANGLE_DEG) / _MOST_ANGLE_DEG, further])


def expected_number(known: FloatArray, weights: Sequence[float]) -> float:
    """Return the expected number of verified matches of a pair with such `columns` (5,) after a step with these weights
    (5,)."""
    return max(0.0, float(np.exp(known @ np.array(weights))) - _FEW)


def fitted_weights(known: Sequence[FloatArray], found: Sequence[int]) -> FloatArray:
    """Return the weights (5,) by least squares of the logarithm, damped a little: where the step uses the first one's
    keypoints, two columns say the same. known: `columns` of pairs; found: their verified matches after the step."""
    values, wanted = np.array(known), np.log(np.array(found) + _FEW)
    return np.asarray(np.linalg.solve(values.T @ values + _DAMPING * np.eye(values.shape[1]), values.T @ wanted))


def log_error(expected: FloatArray, found: FloatArray) -> FloatArray:
    """Return by how much (N,) expected numbers are larger than those found, natural logarithm."""
    return np.asarray(np.log(expected + _FEW) - np.log(found + _FEW))
