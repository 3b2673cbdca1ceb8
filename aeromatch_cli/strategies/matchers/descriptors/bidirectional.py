"""Bidirectional ratio purification: the ratio test from either image, over views of like direction."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.strategies.matchers.descriptors.comparison import Comparison, Found, joined
from aeromatch_cli.strategies.matchers.descriptors.scan import mutual_nearest, ratios_of
from aeromatch_cli.strategies.matchers.descriptors.search import Search


class Bidirectional(Search):
    """Mutual nearest neighbours with the ratio test in both directions. Scores are 1 - the larger of both ratios.

    Guided, a second search around the places that the verified ones predict follows, as in every `Search`: by place and
    likeness, without ratio.
    At 0.85 from either image SIFT finds a little more correct matches than at 0.8 from one, as few of them wrong.
    Source: the purification of J. Geo-inf. Sci. 2021(10), 1823-1837.
    """

    version: ClassVar[int] = 2
    name: Literal["bidirectional"] = "bidirectional"
    ratio: float = Field(
        0.85,
        gt=0.0,
        le=1.0,
        description="Largest ratio of the distances to the nearest and the second nearest descriptor, in both "
        "directions. Larger: more matches, more of them wrong.",
    )

    def scan(self, comparison: Comparison) -> Found:
        """Matches of all view pairs that are comparable, costs the larger d1/d2."""
        parts = []
        for views in comparison.view_pairs():
            rows, columns, ratios = mutual_nearest(
                views.descriptors0, views.descriptors1, views.keypoint_idx1, ratio=self.ratio, limits=views.limits
            )
            back = ratios_of(
                views.descriptors1[columns],
                views.descriptors0,
                views.keypoint_idx0,
                limits=None if views.limits is None else views.limits.seen_from(columns),
            )
            held = back < self.ratio
            costs = np.maximum(ratios, back)[held]
            parts.append(Found(views.of0[rows[held]], views.of1[columns[held]], costs))
        return joined(parts)
