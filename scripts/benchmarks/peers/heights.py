"""Whether matches of real pairs lie at the height of reference points: what an epipolar line does not tell.

A wrong match that verification has kept lies near its epipolar line, and reference poses call it right. The surface at
a keypoint is about as high as the reference points nearest to it in its image: a match counts where it is within
TOLERANCE_PX of the places that heights between theirs predict, from either image. tests/test_bench_heights.py shows how
well that tells true matches from wrong ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from aeromatch_cli.blocks.observations import observation_of_row
from aeromatch_cli.blocks.poses import read_poses
from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pose
from aeromatch_cli.evaluate.reference import ReferenceTruth
from aeromatch_cli.geometry.cameras import undistort, undistorted_places
from aeromatch_cli.geometry.prediction import homogeneous

TOLERANCE_PX = 2.0
# Reference points around a keypoint, and how many an image must show to tell.
_AROUND, _LEAST = 6, 60


@dataclass(frozen=True, eq=False)
class Heights:
    """Cameras and poses of images by name, and reference points (P, 3) in the frame of the poses. Points that something
    hides from an image count as seen by it: they widen the range of depths."""

    cameras: Mapping[str, Camera]
    poses: Mapping[str, Pose]
    points_m: FloatArray

    @classmethod
    def of(cls, folder: Path, truth: ReferenceTruth) -> Heights:
        """From the points.npz (xyz) beside the poses.csv that the truth was read from."""
        # The truth has moved the poses to an origin of its own.
        row = next(row for row in read_poses(folder / "poses.csv").rows if row.image in truth.poses)
        given = observation_of_row(row, "auto")
        assert given is not None
        with np.load(folder / "points.npz") as archive:
            points = archive["xyz"] - (np.asarray(given.position) - truth.poses[row.image].center_m)
        return cls(truth.cameras, truth.poses, points)

    def agreeing(self, name0: str, name1: str, points0_px: FloatArray, points1_px: FloatArray) -> BoolArray:
        """Which matches (M,) of stored pixels (M, 2) lie at a height of reference points, seen from either image."""
        places = [undistort(self.cameras[name], p) for name, p in ((name0, points0_px), (name1, points1_px))]
        return self._from(name0, name1, places[0], places[1]) & self._from(name1, name0, places[1], places[0])

    def _from(self, name: str, other: str, places: FloatArray, there: FloatArray) -> BoolArray:
        """Undistorted places (M, 2), and those of their partners in the other image."""
        seen, depths = self._seen_by(name)
        if len(seen) < _LEAST:
            return np.ones(len(places), bool)
        rays = homogeneous(self.cameras[name], places) @ np.asarray(self.poses[name].world_rotation)
        around = depths[cKDTree(seen).query(places, k=_AROUND)[1]]
        nearest, farthest = (
            self._projected(other, self.poses[name].center_m + rays * depth[:, None])[0]
            for depth in (around.min(axis=1), around.max(axis=1))
        )
        along = farthest - nearest
        length2 = np.maximum((along**2).sum(axis=1), 1e-12)
        share = np.clip(((there - nearest) * along).sum(axis=1) / length2, 0.0, 1.0)
        return np.asarray(np.linalg.norm(there - nearest - share[:, None] * along, axis=1) <= TOLERANCE_PX)

    def _seen_by(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Undistorted places (S, 2) and depths (S,) of the reference points that an image may show."""
        camera = self.cameras[name]
        places, depths = self._projected(name, self.points_m)
        inside = ((places >= 0.0) & (places <= [camera.width_px, camera.height_px])).all(axis=1)
        return places[inside], depths[inside]

    def _projected(self, name: str, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Undistorted places (N, 2), NaN behind the camera, and depths (N,)."""
        pose = self.poses[name]
        return undistorted_places(self.cameras[name], np.asarray(pose.world_rotation), pose.center_m, points_m)
