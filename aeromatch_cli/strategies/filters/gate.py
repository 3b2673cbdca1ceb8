"""When a model verifies a pair: enough inliers, and more than random matches would give (a contrario test)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import BoolArray, FloatArray, Verdict
from aeromatch_cli.geometry.epipolar import sampson_distance_px
from aeromatch_cli.geometry.two_view import TwoView, chance_errors_px, log10_false_alarms
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.words import counted

# Of the threshold: the sharpest of these tests counts, since accurate matches are the less likely by chance.
_SHARES = (1.0, 0.5, 0.25)
Distance = Callable[[FloatArray, FloatArray], FloatArray]


def shortage(inliers: int, matches: int, needed: int) -> str:
    """Why so many inliers of so many matches do not verify a pair, "" if they are enough."""
    if inliers >= needed:
        return ""
    return f"{counted(inliers, 'inlier')} of {counted(matches, 'match', 'matches')}, {needed} needed"


class Gated(Strategy):
    """What filters that verify by one model have in common."""

    min_inliers: int = Field(
        15,
        ge=8,
        description="Smallest number of inliers of a verified pair; a pair with fewer matches is not verifiable. "
        "Larger: fewer pairs, fewer of them wrong.",
    )
    max_false_alarms: float = Field(
        0.01,
        gt=0.0,
        description="Largest expected number of models with as many inliers among random matches (a contrario test). "
        "Smaller: fewer pairs, fewer of them wrong.",
    )

    def too_few(self, usable: BoolArray) -> Verdict | None:
        """The verdict on a pair with fewer usable matches (M,) than min_inliers, else None."""
        if usable.sum() >= self.min_inliers:
            return None
        reason = f"{counted(int(usable.sum()), 'match', 'matches')}, {self.min_inliers} needed"
        return Verdict(keep=np.zeros(len(usable), dtype=bool), state="not verifiable", reason=reason)

    def refusal(
        self,
        distance_px: Distance,
        points0_px: FloatArray,
        points1_px: FloatArray,
        threshold_px: float,
        sample: int,
        inliers: BoolArray,
    ) -> str:
        """Why inliers (N,) of the matches (N, 2) do not verify the pair, "" if they do."""
        count = int(inliers.sum())
        if few := shortage(count, len(inliers), self.min_inliers):
            return few
        errors, wrong = distance_px(points0_px, points1_px), chance_errors_px(distance_px, points0_px, points1_px)
        expected = min(
            log10_false_alarms(points0_px, points1_px, inliers & (errors <= part), wrong, part, sample)
            for part in (threshold_px * share for share in _SHARES)
        )
        if expected + np.log10(len(_SHARES)) > np.log10(self.max_false_alarms):
            return f"{count} inliers of {len(inliers)} matches are no more than chance gives"
        return ""

    def verdict(
        self,
        usable: BoolArray,
        inliers: BoolArray,
        refused: Callable[[BoolArray], str],
        kind: Literal["E", "F", "H"],
        model: FloatArray,
        errors_px: FloatArray,
        rotation: FloatArray | None = None,
    ) -> Verdict:
        """On the M matches given, from what is known of the usable ones (N,). refused: `refusal` of inliers (N,)."""
        keep = np.zeros(len(usable), dtype=bool)
        if refusal := refused(inliers):
            return Verdict(keep=keep, state="rejected", reason=refusal)
        keep[usable] = inliers
        errors = np.full(len(usable), np.nan, dtype=np.float32)
        errors[usable] = errors_px
        return Verdict(
            keep=keep,
            state="verified",
            model_kind=kind,
            model=model,
            errors_px=errors,
            relative_rotation=rotation,
            doubt=lambda left: refused(inliers & left[usable]),
        )

    def epipolar_verdict(
        self, found: TwoView, points0_px: FloatArray, points1_px: FloatArray, usable: BoolArray, threshold_px: float
    ) -> Verdict:
        """Of an epipolar geometry found in the usable matches (N, 2), its inliers within the threshold."""
        distance = partial(sampson_distance_px, found.pixel_model)
        refused = partial(self.refusal, distance, points0_px, points1_px, threshold_px, found.sample)
        errors = distance(points0_px, points1_px)
        return self.verdict(usable, found.inliers, refused, found.kind, found.model, errors, found.rotation)


class TwoViewGated(Gated):
    """Those that find one two-view geometry of cameras, known or not."""

    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    model: Literal["relative_pose", "fundamental"] = Field(
        "relative_pose", description="Relative pose with the known cameras, or fundamental matrix without them."
    )
    threshold_px: float = Field(
        4.0,
        gt=0.0,
        description="Largest Sampson error of an inlier, undistorted pixels. Larger: more matches, less accurate ones.",
    )
