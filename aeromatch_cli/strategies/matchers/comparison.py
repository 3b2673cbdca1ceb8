"""What a matcher of described keypoints is asked, and what it finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import BoolArray, Features, FloatArray, IntArray, PairGeometry
from aeromatch_cli.geometry.prediction import Windows


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
class Comparison:
    """Two images, and which of their views are compared.

    alike: (V0, V1) of the views. where: where matches may lie, None for everywhere.
    """

    features0: Features
    features1: Features
    geometry: PairGeometry
    alike: BoolArray
    where: Where | None = None

    def keypoints(self, found: Found) -> tuple[IntArray, IntArray]:
        """Matches as keypoints (N,) of either image."""
        rows, columns = found.rows, found.columns
        return self.features0.descriptor_keypoint_idx[rows], self.features1.descriptor_keypoint_idx[columns]

    def within(self, found: Found) -> Found:
        """Those of the matches that lie where they may."""
        if self.where is None:
            return found
        idx0, idx1 = self.keypoints(found)
        return found.take(self.where.windows.take(idx0).contain(self.where.places_px[idx1]))
