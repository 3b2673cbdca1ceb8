"""Mutual nearest neighbours with the ratio test over views of like direction: the classical matcher."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import BoolArray, Features, FloatArray, IntArray, Matches, PairGeometry
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.prediction import Windows, search_windows
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.matchers.assignment import distinct, one_to_one
from aeromatch_cli.strategies.matchers.guided import Found, search_again
from aeromatch_cli.strategies.matchers.scan import Limits, mutual_nearest
from aeromatch_cli.strategies.matchers.views import appearances, like_views

# Matches closer than this in both images are one.
_SAME_MATCH_PX = 1.0


class Nearest(Strategy):
    """Mutual nearest neighbours between views of like direction, at most one match per keypoint.

    Most pairs of an ordinary block are settled by the pictures as they were taken (`ample`); the others are searched
    harder. guided: where both attitudes and the ground are known, a keypoint of image 0 is only compared with those of
    image 1 that lie where the poses and their sigma put it; then, whatever is known, around the places that the
    verified matches predict (`matchers.guided`).
    """

    version: ClassVar[int] = 2
    needs: ClassVar[frozenset[str]] = frozenset({"camera", "pose", "sigma", "ground"})
    name: Literal["nearest"] = "nearest"
    ratio: float = Field(
        0.8, gt=0.0, le=1.0, description="Largest distance to the nearest over that to the next other keypoint."
    )
    ratio_both: bool = Field(False, description="The ratio must hold from image 1's side as well.")
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

        Scores are 1 - d1/d2, or 1 - cost where a model guided the search.
        """
        alike = like_views(features0, features1, self.max_direction_deg)
        pictures = [alike & which for which in appearances(features0, features1)]
        windows = self._windows(features0, geometry) if self.guided else None
        found = self._scan(features0, features1, pictures[0], None)
        if windows is not None:
            idx0, idx1 = found.keypoints(features0, features1)
            seen = windows.take(idx0).contain(undistort(geometry.camera1, features1.keypoints_px[idx1]))
            found = found.take(seen)
        if len(found.rows) < self.ample:
            found = self._search_harder(found, features0, features1, geometry, pictures, windows)
        return _matches(found, features0, features1)

    def _search_harder(
        self,
        first: Found,
        features0: Features,
        features1: Features,
        geometry: PairGeometry,
        pictures: list[BoolArray],
        windows: Windows | None,
    ) -> Found:
        """Matches where those of the pictures as taken, `first`, are few. pictures: view pairs of each kind."""
        limits = None
        if windows is not None:
            limits = Limits(windows.forms(), undistort(geometry.camera1, features1.keypoints_px))
        scans = [
            first if limits is None and not index else self._scan(features0, features1, views, limits)
            for index, views in enumerate(pictures)
        ]
        # Under one sun the borders of shadows are texture, under two they are not: the number of matches tells.
        chosen = max(range(len(scans)), key=lambda index: len(scans[index].rows))
        if not self.guided:
            return scans[chosen]
        return search_again(scans[chosen], features0, features1, geometry, pictures[chosen], windows)

    def _windows(self, features0: Features, geometry: PairGeometry) -> Windows | None:
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

    def _scan(self, features0: Features, features1: Features, alike: BoolArray, limits: Limits | None) -> Found:
        """Matches of all view pairs that are alike, costs d1/d2."""
        nothing = np.zeros(0, np.int64)
        parts: list[tuple[IntArray, IntArray, FloatArray]] = [(nothing, nothing, np.zeros(0))]
        for view0, view1 in np.argwhere(alike):
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
            parts.append((of0[rows], of1[columns], ratios))
        return Found(*(np.concatenate(column) for column in zip(*parts, strict=True)))


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
