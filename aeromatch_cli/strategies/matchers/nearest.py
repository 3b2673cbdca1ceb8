"""Mutual nearest neighbours with the ratio test over views of like direction: the classical matcher."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.strategies.matchers.comparison import Comparison, Found, joined
from aeromatch_cli.strategies.matchers.scan import Limits, mutual_nearest
from aeromatch_cli.strategies.matchers.search import Search


class Nearest(Search):
    """Mutual nearest neighbours between views of like direction. Scores are 1 - d1/d2."""

    version: ClassVar[int] = 2
    name: Literal["nearest"] = "nearest"
    ratio: float = Field(
        0.8, gt=0.0, le=1.0, description="Largest distance to the nearest over that to the next other keypoint."
    )
    ratio_both: bool = Field(False, description="The ratio must hold from image 1's side as well, over all of image 0.")

    def scan(self, asked: Comparison) -> Found:
        """Matches of all view pairs that are alike, costs d1/d2."""
        features0, features1, where = asked.features0, asked.features1, asked.where
        limits = None if where is None else Limits(where.windows.forms(), where.places_px)
        parts = []
        for view0, view1 in np.argwhere(asked.alike):
            of0, of1 = np.flatnonzero(features0.view_idx == view0), np.flatnonzero(features1.view_idx == view1)
            keypoints0, keypoints1 = features0.descriptor_keypoint_idx[of0], features1.descriptor_keypoint_idx[of1]
            rows, columns, ratios = mutual_nearest(
                features0.descriptors[of0],
                features1.descriptors[of1],
                keypoints0,
                keypoints1,
                ratio=self.ratio,
                ratio_both=self.ratio_both,
                limits=None if limits is None else Limits(limits.forms[keypoints0], limits.places[keypoints1]),
            )
            parts.append(Found(of0[rows], of1[columns], ratios))
        return joined(parts)
