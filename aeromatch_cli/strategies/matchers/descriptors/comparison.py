"""Two images to be compared by their descriptors, and the matches that are found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Features, FloatArray, IntArray, PairGeometry
from aeromatch_cli.geometry.prediction import Windows
from aeromatch_cli.strategies.matchers.descriptors.scan import Limits, mutual_nearest, ratios_of

# Largest distance to the nearest over that to the next other keypoint, where nothing else is said.
RATIO = 0.8


@dataclass(frozen=True, eq=False)
class Found:
    """Matches as descriptors (N,) of either image, with costs in 0-1, smaller is better."""

    rows: IntArray
    columns: IntArray
    costs: FloatArray

    def take(self, which: IntArray | BoolArray) -> Found:
        """Those of the given positions or mask."""
        return Found(self.rows[which], self.columns[which], self.costs[which])


def joined(parts: Sequence[Found]) -> Found:
    """All of them, one after the other."""
    nothing = Found(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    return Found(
        *(np.concatenate(column) for column in zip(*(vars(p).values() for p in (nothing, *parts)), strict=True))
    )


@dataclass(frozen=True, eq=False)
class Where:
    """Windows in image 1 for the keypoints of image 0, and image 1's keypoints as they see them.

    places_px: (K1, 2) undistorted.
    """

    windows: Windows
    places_px: FloatArray


@dataclass(frozen=True, eq=False)
class ViewPair:
    """What one view of either image describes: descriptors (D, C), their numbers of0 (D0,), of1 (D1,) in the image,
    and their keypoints. limits: which of image 1 those of image 0 may take, None for all.
    """

    of0: IntArray
    of1: IntArray
    descriptors0: NDArray[Any]
    descriptors1: NDArray[Any]
    keypoint_idx0: IntArray
    keypoint_idx1: IntArray
    limits: Limits | None


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two images, and which of their views are compared.

    comparable: (V0, V1) bool. where: search windows, None for everywhere. shown: (K0,), (K1,) which keypoints the other
    image may show, None for all.
    """

    features0: Features
    features1: Features
    geometry: PairGeometry
    comparable: BoolArray
    where: Where | None = None
    shown: tuple[BoolArray, BoolArray] | None = None

    def view_pairs(self) -> Iterator[ViewPair]:
        """The comparable view pairs, in the order of their indices."""
        features0, features1 = self.features0, self.features1
        limits = None if self.where is None else Limits(self.where.windows.forms(), self.where.places_px)
        for view0, view1 in np.argwhere(self.comparable):
            of0, of1 = self._described(0, int(view0)), self._described(1, int(view1))
            keypoints0, keypoints1 = features0.descriptor_keypoint_idx[of0], features1.descriptor_keypoint_idx[of1]
            yield ViewPair(
                of0=of0,
                of1=of1,
                descriptors0=features0.descriptors[of0],
                descriptors1=features1.descriptors[of1],
                keypoint_idx0=keypoints0,
                keypoint_idx1=keypoints1,
                limits=None if limits is None else Limits(limits.forms[keypoints0], limits.places[keypoints1]),
            )

    def _described(self, side: int, view: int) -> IntArray:
        """Descriptors (D,) of a view of one image, of keypoints that the other one may show."""
        features = (self.features0, self.features1)[side]
        here = features.view_idx == view
        if self.shown is not None:
            here = here & self.shown[side][features.descriptor_keypoint_idx]
        return np.flatnonzero(here)

    def keypoints(self, found: Found) -> tuple[IntArray, IntArray]:
        """Matches as keypoints (N,) of either image."""
        rows, columns = found.rows, found.columns
        return self.features0.descriptor_keypoint_idx[rows], self.features1.descriptor_keypoint_idx[columns]

    def within(self, found: Found) -> Found:
        """The matches within the search windows."""
        if self.where is None:
            return found
        idx0, idx1 = self.keypoints(found)
        return found.take(self.where.windows.take(idx0).contain(self.where.places_px[idx1]))


def ratio_test(comparison: Comparison, ratio: float = RATIO) -> Found:
    """Mutual nearest neighbours of all view pairs that are comparable and hold the ratio, costs d1/d2."""
    parts = []
    for views in comparison.view_pairs():
        rows, columns, ratios = mutual_nearest(
            views.descriptors0, views.descriptors1, views.keypoint_idx1, ratio=ratio, limits=views.limits
        )
        parts.append(Found(views.of0[rows], views.of1[columns], ratios))
    return joined(parts)


def ratio_test_both_ways(comparison: Comparison, ratio: float) -> Found:
    """Mutual nearest neighbours of all view pairs that are comparable and hold the ratio from either image, costs the
    larger d1/d2."""
    parts = []
    for views in comparison.view_pairs():
        rows, columns, ratios = mutual_nearest(
            views.descriptors0, views.descriptors1, views.keypoint_idx1, ratio=ratio, limits=views.limits
        )
        back = ratios_of(
            views.descriptors1[columns],
            views.descriptors0,
            views.keypoint_idx0,
            limits=None if views.limits is None else views.limits.seen_from(columns),
        )
        held = back < ratio
        costs = np.maximum(ratios, back)[held]
        parts.append(Found(views.of0[rows[held]], views.of1[columns[held]], costs))
    return joined(parts)
