"""Many pairs in one row: sums of counts, shares of those sums, medians over pairs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.evaluate.metrics import AUC_THRESHOLDS_DEG, auc
from aeromatch_cli.evaluate.scores import (
    SHADOW_CLASSES,
    TEXTURE_CLASSES,
    UNKNOWN,
    VIEW_ANGLE_CLASSES,
    Conditions,
    PairScore,
    mean_of,
    median_of,
    ratio,
    recall_of,
)

# A pair that a consumer can build on.
ENOUGH_CORRECT = 30
_SUMMED = (
    "possible",
    "kept",
    "correct",
    "wrong",
    "within_5px",
    "hidden",
    "unseen",
    "keypoints_in_shadow",
    "kept_in_shadow",
    "correct_in_shadow",
    "wrong_at_border",
)
NOT_TRIED = "not tried"


@dataclass(frozen=True, eq=False)
class PairRow:
    """One pair that was judged. state: of its verdict, or "not tried" where the pair was not chosen or not filtered."""

    name0: str
    name1: str
    state: str
    conditions: Conditions
    score: PairScore


def total(rows: Sequence[PairRow]) -> dict[str, float]:
    """One row for many pairs. Empty sums are 0, figures without any value NaN.

    Counts are sums over pairs; correctness, within_5px_share and recall are ratios of these sums; mean_error_px and
    median_error_px are over all kept matches that have an error; coverage and the angles are medians over pairs
    (coverage over all, angles over those with an estimate); auc_* over all pairs, a pair without estimate failing.
    """
    scores = [row.score for row in rows]
    sums = {name: _sum(getattr(score, name) for score in scores) for name in _SUMMED}
    errors_px = np.concatenate([np.zeros(0), *(score.errors_px for score in scores)])
    areas = auc(np.array([score.pose_error_deg for score in scores]))
    return {
        "pairs": len(rows),
        "pairs_verified": sum(row.state == "verified" for row in rows),
        "pairs_not_tried": sum(row.state == NOT_TRIED for row in rows),
        "pairs_with_pose": sum(not math.isnan(score.pose_error_deg) for score in scores),
        f"pairs_with_{ENOUGH_CORRECT}_correct": sum(score.correct >= ENOUGH_CORRECT for score in scores),
        **sums,
        "correctness": ratio(sums["correct"], sums["kept"]),
        "within_5px_share": ratio(sums["within_5px"], sums["kept"]),
        "recall": recall_of(sums["correct"], sums["possible"]),
        "mean_error_px": mean_of(errors_px),
        "median_error_px": median_of(errors_px),
        "coverage": median_of(np.array([score.coverage for score in scores])),
        "rotation_error_deg": median_of(np.array([score.rotation_error_deg for score in scores])),
        "translation_error_deg": median_of(np.array([score.translation_error_deg for score in scores])),
        **{f"auc_{t:g}deg": area for t, area in zip(AUC_THRESHOLDS_DEG, areas, strict=True)},
    }


def by_condition(rows: Sequence[PairRow]) -> list[tuple[str, str, dict[str, float]]]:
    """(condition, class, total) of every class that has pairs, classes in their own order."""
    found = []
    for condition, classes, attribute in (
        ("view angle", VIEW_ANGLE_CLASSES, "view_angle_class"),
        ("shadow", SHADOW_CLASSES, "shadow_class"),
        ("texture", TEXTURE_CLASSES, "texture_class"),
    ):
        for name in (*(name for name, _ in classes), UNKNOWN):
            own = [row for row in rows if getattr(row.conditions, attribute) == name]
            if own:
                found.append((condition, name, total(own)))
    for name in ("easy", "hard", UNKNOWN):
        own = [row for row in rows if row.conditions.difficulty == name]
        if own:
            found.append(("difficulty", name, total(own)))
    return found


def _sum(values: Iterable[float]) -> float:
    """Sum of the known values, NaN where none is known of some pairs."""
    listed = list(values)
    known = [value for value in listed if not math.isnan(value)]
    return sum(known) if known or not listed else math.nan
