"""What is said of one pair: how its matches did, and how hard it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray

CORRECT_PX, WITHIN_PX = 3.0, 5.0
# Class -> its upper bound, exclusive.
VIEW_ANGLE_CLASSES = (("0-20", 20.0), ("20-40", 40.0), ("40-60", 60.0), (">60", math.inf))
SHADOW_CLASSES = (("<5 %", 0.05), ("5-20 %", 0.20), (">=20 %", math.inf))
# Local grey-level deviation over the local mean; overlap.py says how it is measured and what the bounds part.
TEXTURE_CLASSES = (("poor", 0.05), ("medium", 0.15), ("rich", math.inf))
UNKNOWN = "unknown"
HARD_SHADOW_SHARE, HARD_VIEW_ANGLE_DEG = 0.20, 30.0


def class_of(value: float, classes: tuple[tuple[str, float], ...]) -> str:
    """Name of the class that a value falls into, "unknown" for NaN."""
    return next((name for name, bound in classes if value < bound), UNKNOWN)


@dataclass(frozen=True)
class Conditions:
    """How hard a pair is.

    view_angle_deg: median angle between both rays over the places that both images see. overlap: share of an image's
    pixels that the other image sees, the larger of both. shadow_share: share of the overlap in shadow, the larger of
    both images'. texture: see overlap.py, the smaller of both images'. NaN where unknown.
    """

    view_angle_deg: float
    overlap: float
    shadow_share: float
    texture: float

    @property
    def view_angle_class(self) -> str:
        return class_of(self.view_angle_deg, VIEW_ANGLE_CLASSES)

    @property
    def shadow_class(self) -> str:
        return class_of(self.shadow_share, SHADOW_CLASSES)

    @property
    def texture_class(self) -> str:
        return class_of(self.texture, TEXTURE_CLASSES)

    @property
    def hard(self) -> bool:
        """Shadow share of 20 % or more, or a view angle of 30 degrees or more."""
        return self.shadow_share >= HARD_SHADOW_SHARE or self.view_angle_deg >= HARD_VIEW_ANGLE_DEG

    @property
    def difficulty(self) -> str:
        """ "hard", "easy", or "unknown" for images that share nothing."""
        if self.hard:
            return "hard"
        return UNKNOWN if math.isnan(self.view_angle_deg) else "easy"


@dataclass(frozen=True, eq=False)
class PairScore:
    """How the matches of one pair did, after thinning to 2 px in both images. Figures that a truth cannot give are NaN.

    keypoints0, keypoints1: as given. possible: distinct keypoints of image 0 that have one of image 1 within 3 px of
    their true place. kept: matches after thinning; correct: error <= 3 px and not hidden; within_5px: the same at 5 px.
    hidden: matches whose surface the other image does not see; unseen: of sky, or of what lies outside the other image;
    both are wrong. mean, median: of the errors of the kept matches that have one. coverage: of the overlap in image 0,
    by correct matches. *_in_shadow: in either image (keypoints_in_shadow: summed over both images); wrong_at_border:
    within 8 px of a shadow's border in either image. errors_px: (kept,), NaN where unseen.
    kept_idx: (kept,) into the matches given; correct_idx: (correct,), too.
    """

    keypoints0: int
    keypoints1: int
    possible: float
    kept: int
    correct: int
    within_5px: int
    hidden: int
    unseen: int
    coverage: float
    rotation_error_deg: float
    translation_error_deg: float
    keypoints_in_shadow: float = math.nan
    kept_in_shadow: float = math.nan
    correct_in_shadow: float = math.nan
    wrong_at_border: float = math.nan
    errors_px: FloatArray = field(default_factory=lambda: np.zeros(0))
    kept_idx: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    correct_idx: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @property
    def wrong(self) -> int:
        return self.kept - self.correct

    @property
    def correctness(self) -> float:
        return ratio(self.correct, self.kept)

    @property
    def recall(self) -> float:
        """Below 1 even for a perfect matcher: correct matches are thinned to 2 px, possible ones are not."""
        return recall_of(self.correct, self.possible)

    @property
    def mean_error_px(self) -> float:
        return mean_of(self.errors_px)

    @property
    def median_error_px(self) -> float:
        return median_of(self.errors_px)

    @property
    def pose_error_deg(self) -> float:
        """The larger of both angles, what AUC is made of; NaN without an estimate."""
        both = [e for e in (self.rotation_error_deg, self.translation_error_deg) if not math.isnan(e)]
        return max(both, default=math.nan)

    def row(self) -> dict[str, float]:
        """Every figure by name, arrays left out."""
        stored = [f.name for f in fields(self) if f.name not in ("errors_px", "kept_idx", "correct_idx")]
        derived = ("wrong", "correctness", "recall", "mean_error_px", "median_error_px", "pose_error_deg")
        return {name: getattr(self, name) for name in (*stored, *derived)}


def recall_of(correct: float, possible: float) -> float:
    """NaN where more is correct than keypoints allow: points that were measured without a detector."""
    return ratio(correct, possible) if not correct > possible else math.nan


def ratio(part: float, whole: float) -> float:
    """part / whole, NaN for 0 or NaN."""
    return part / whole if whole > 0 else math.nan


def mean_of(values: FloatArray) -> float:
    """Mean of the finite values, NaN without any."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else math.nan


def median_of(values: FloatArray) -> float:
    """Median of the finite values, NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan
