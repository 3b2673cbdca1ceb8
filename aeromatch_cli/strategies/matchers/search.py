"""What matchers of described keypoints share: views to compare, where matches may lie, and the second search."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import Field

from aeromatch_cli.data import BoolArray, Features, FloatArray, IntArray, Matches, PairGeometry
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.prediction import Windows, search_windows
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.matchers.assignment import distinct, one_to_one
from aeromatch_cli.strategies.matchers.guided import Found, search_again
from aeromatch_cli.strategies.matchers.views import appearances, like_views

# Matches closer than this in both images are one.
_SAME_MATCH_PX = 1.0


@dataclass(frozen=True, eq=False)
class Where:
    """Windows in image 1 for the keypoints of image 0, and image 1's keypoints as they see them.

    places_px: (K1, 2) undistorted.
    """

    windows: Windows
    places_px: FloatArray

    def within(self, found: Found, features0: Features, features1: Features) -> Found:
        """Those of the matches that lie in their windows."""
        idx0, idx1 = found.keypoints(features0, features1)
        return found.take(self.windows.take(idx0).contain(self.places_px[idx1]))


class Search(Strategy):
    """A matcher that compares the views of like direction of two images, at most one match per keypoint.

    Most pairs of an ordinary block are settled by the pictures as they were taken (`ample`); the others are searched
    harder. guided: where both attitudes and the ground are known, a keypoint of image 0 is only compared with those of
    image 1 that lie where the poses and their sigma put it; then, whatever is known, around the places that the
    verified matches predict (`matchers.guided`).
    """

    needs: ClassVar[frozenset[str]] = frozenset({"camera", "pose", "sigma", "ground"})
    max_direction_deg: float = Field(
        5.0, ge=0.0, le=180.0, description="Simulated views whose directions are farther apart are not compared."
    )
    guided: bool = Field(
        False, description="Search where the poses say, then once more around what verified matches predict."
    )
    ample: int = Field(
        500,
        ge=1,
        description="Where so many matches are found at once, enhanced pictures and guided search are left out: they "
        "cost more than they add.",
    )
    sigmas: float = Field(3.0, gt=0.0, description="Guided: half-width of the window in predicted standard deviations.")
    sigma_px: float = Field(1.5, gt=0.0, description="Guided: standard deviation of a keypoint, pixels.")
    relief: float = Field(
        0.3, gt=0.0, lt=1.0, description="Guided: how far things rise over or fall below the ground, in flying heights."
    )

    def reads(self) -> frozenset[str]:
        """Nothing of the geometry, unless guided."""
        return self.needs if self.guided else frozenset()

    def __call__(self, features0: Features, features1: Features, geometry: PairGeometry) -> Matches:
        """Matches of one pair, sorted by keypoint of image 0.

        Scores are the matcher's own, or 1 - cost where a model guided the search.
        """
        alike = like_views(features0, features1, self.max_direction_deg)
        pictures = [alike & which for which in appearances(features0, features1)]
        windows = self.windows(features0, geometry) if self.guided else None
        where = Where(windows, undistort(geometry.camera1, features1.keypoints_px)) if windows is not None else None
        found = self.scan(features0, features1, pictures[0], geometry, None)
        if where is not None:
            found = where.within(found, features0, features1)
        if len(found.rows) < self.ample:
            found = self._search_harder(found, features0, features1, geometry, pictures, where)
        return _matches(found, features0, features1)

    @abstractmethod
    def scan(
        self, features0: Features, features1: Features, alike: BoolArray, geometry: PairGeometry, where: Where | None
    ) -> Found:
        """Matches of all view pairs (V0, V1) that are alike; with `where` only such as lie in its windows.

        A keypoint may occur several times. Costs lie in 0-1; the score of a match is 1 - cost.
        """

    def _search_harder(
        self,
        first: Found,
        features0: Features,
        features1: Features,
        geometry: PairGeometry,
        pictures: list[BoolArray],
        where: Where | None,
    ) -> Found:
        """Matches where those of the pictures as taken, `first`, are few. pictures: view pairs of each kind."""
        scans = [
            self.scan(features0, features1, views, geometry, where) if index or where is not None else first
            for index, views in enumerate(pictures)
        ]
        # Under one sun the borders of shadows are texture, under two they are not: the number of matches tells.
        chosen = max(range(len(scans)), key=lambda index: len(scans[index].rows))
        alike, found = pictures[chosen], scans[chosen]
        if self.guided:
            windows = where.windows if where else None
            found = search_again(found, features0, features1, geometry, alike, windows)
        return self.look_closer(found, features0, features1, geometry, alike, where)

    def look_closer(
        self,
        found: Found,
        features0: Features,
        features1: Features,
        geometry: PairGeometry,
        alike: BoolArray,
        where: Where | None,
    ) -> Found:
        """What a dearer search of the views that are alike makes of the matches found so far."""
        return found

    def windows(self, features0: Features, geometry: PairGeometry) -> Windows | None:
        """Where every keypoint of image 0 may lie in image 1, None where that is unknown."""
        pose0, pose1, ground_z_m = geometry.pose0, geometry.pose1, geometry.ground_z_m
        if pose0 is None or pose1 is None or ground_z_m is None:
            return None
        heights_m = [float(pose.center_m[2]) - ground_z_m for pose in (pose0, pose1)]
        if pose0.world_rotation is None or pose1.world_rotation is None or min(heights_m) <= 0.0:
            return None
        return search_windows(
            features0.keypoints_px,
            geometry.camera0,
            pose0,
            geometry.camera1,
            pose1,
            ground_z_m,
            relief_m=self.relief * min(heights_m),
            sigmas=self.sigmas,
            sigma_px=self.sigma_px,
        )


def joined(parts: Sequence[tuple[IntArray, IntArray, FloatArray]]) -> Found:
    """Descriptor rows, columns and costs of several view pairs together."""
    nothing = np.zeros(0, np.int64)
    return Found(*(np.concatenate(column) for column in zip((nothing, nothing, np.zeros(0)), *parts, strict=True)))


def _matches(found: Found, features0: Features, features1: Features) -> Matches:
    """The cheapest matches in which each keypoint occurs once, and no two lie together in both images."""
    idx0, idx1 = found.keypoints(features0, features1)
    kept = one_to_one(idx0, idx1, found.costs)
    places: FloatArray = np.concatenate(
        [features0.keypoints_px[idx0[kept]], features1.keypoints_px[idx1[kept]]], axis=1, dtype=np.float64
    )
    kept = kept[distinct(places, found.costs[kept], _SAME_MATCH_PX)]
    kept = kept[np.argsort(idx0[kept], kind="stable")]
    rows, columns = found.rows[kept], found.columns[kept]
    return Matches(
        indices=np.stack([idx0[kept], idx1[kept]], axis=1).astype(np.int32),
        scores=(1.0 - found.costs[kept]).astype(np.float32),
        view_pairs=np.stack([features0.view_idx[rows], features1.view_idx[columns]], axis=1).astype(np.int16),
    )
