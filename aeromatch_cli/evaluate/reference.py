"""Matches of a real block, judged by the epipolar geometry of reference poses.

Reference poses come from an adjustment and are good to a few pixels: shares within 3 and 5 px compare methods, they do
not measure exactness. A mistake along the epipolar line goes unseen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aeromatch_cli.blocks.camera_files import CameraFile, read_camera_file
from aeromatch_cli.blocks.observations import observation_of_row, oriented
from aeromatch_cli.blocks.poses import PoseRow, read_poses
from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pose
from aeromatch_cli.errors import ConfigError, InputError
from aeromatch_cli.evaluate.metrics import coverage, pose_error_deg, thin
from aeromatch_cli.evaluate.overlap import OverlapFinder
from aeromatch_cli.evaluate.scores import CORRECT_PX, WITHIN_PX, Conditions, PairScore
from aeromatch_cli.geometry.cameras import project, undistort, world_rays
from aeromatch_cli.geometry.epipolar import fundamental_from_poses, symmetric_distance_px
from aeromatch_cli.geometry.footprints import MAX_DISTANCE_FACTOR


@dataclass(frozen=True, eq=False)
class PlaneSight:
    """What images show of a horizontal plane, up to 5 flying heights away."""

    cameras: Mapping[str, Camera]
    poses: Mapping[str, Pose]
    ground_z_m: float

    def surface_points(self, image: str, points_px: FloatArray) -> FloatArray:
        """Ground points (N, 3) at stored pixels (N, 2), NaN where the ray meets none."""
        pose = self.poses[image]
        assert pose.world_rotation is not None
        rays = world_rays(self.cameras[image], pose.world_rotation, points_px)
        height_m = float(pose.center_m[2]) - self.ground_z_m
        down = np.where(rays[:, 2] < -1e-9, -rays[:, 2], np.nan)
        distance = height_m / down
        far = np.hypot(rays[:, 0], rays[:, 1]) * distance > MAX_DISTANCE_FACTOR * height_m
        points_m = pose.center_m + np.where(far | (distance < 0), np.nan, distance)[:, None] * rays
        points_m[:, 2] = np.where(np.isnan(points_m[:, 0]), np.nan, self.ground_z_m)
        return points_m

    def project(self, image: str, points_m: FloatArray) -> FloatArray:
        pose = self.poses[image]
        assert pose.world_rotation is not None
        return project(self.cameras[image], pose.world_rotation, pose.center_m, points_m)

    def unblocked(self, image: str, points_m: FloatArray) -> BoolArray:
        """Nothing stands on a plane."""
        return np.ones(len(points_m), dtype=bool)


class ReferenceTruth:
    """Judges pairs of a real block by reference poses and cameras of the images as they are matched.

    ground_z_m: height of the ground, for overlap and view angle. images_folder: for texture; None leaves it unknown.
    """

    kind = "reference"

    def __init__(
        self,
        cameras: Mapping[str, Camera],
        poses: Mapping[str, Pose],
        ground_z_m: float,
        images_folder: Path | None = None,
    ) -> None:
        self.images_folder = images_folder
        self._sight = PlaneSight(cameras, poses, ground_z_m)
        self._overlaps = OverlapFinder(self._sight, images_folder)

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Camera of every image, by name."""
        return self._sight.cameras

    @property
    def poses(self) -> Mapping[str, Pose]:
        """Pose of every image, by name, around the origin of the reference's frame."""
        return self._sight.poses

    def near(self, name: str, others: Sequence[str]) -> BoolArray:
        """Which of the others (N,) may show some of the same ground; the rest share nothing."""
        return self._overlaps.near(name, others)

    def overlap_at_most(self, name0: str, name1: str) -> float:
        """An upper estimate of the overlap: a quick way to pass over pairs that share nothing."""
        return self._overlaps.at_most(name0, name1)

    def conditions(self, name0: str, name1: str) -> Conditions:
        """How hard a pair is: angle and overlap on the ground plane; shadow is not known."""
        found = self._overlaps.between(name0, name1)
        return Conditions(found.view_angle_deg, found.overlap, math.nan, self._overlaps.texture(name0, name1))

    def judge(
        self,
        name0: str,
        name1: str,
        keypoints0_px: FloatArray,
        keypoints1_px: FloatArray,
        points0_px: FloatArray,
        points1_px: FloatArray,
        scores: FloatArray,
    ) -> PairScore:
        """How matches did that join stored pixels points0_px and points1_px (M, 2), of scores (M,), larger is better.

        Errors are symmetric epipolar distances on undistorted pixels, correct those within 3 px; what would need the
        surface (possible, recall, hidden, shadow) is NaN or 0. Coverage: matches within 3 px over the ground overlap.
        """
        points0, points1 = (np.asarray(p, dtype=np.float64).reshape(-1, 2) for p in (points0_px, points1_px))
        kept = thin(points0, points1, scores)
        points0, points1 = points0[kept], points1[kept]
        errors_px = self.errors(name0, name1, points0, points1)
        known = np.where(np.isnan(errors_px), np.inf, errors_px)
        correct = known <= CORRECT_PX
        cameras, poses = self._sight.cameras, self._sight.poses
        rotation_deg, translation_deg = pose_error_deg(
            points0, points1, cameras[name0], cameras[name1], poses[name0], poses[name1]
        )
        return PairScore(
            keypoints0=len(keypoints0_px),
            keypoints1=len(keypoints1_px),
            possible=math.nan,
            kept=len(kept),
            correct=int(correct.sum()),
            within_5px=int((known <= WITHIN_PX).sum()),
            hidden=0,
            unseen=int(np.isinf(known).sum()),
            coverage=coverage(points0[correct], self._overlaps.between(name0, name1).samples0_px),
            rotation_error_deg=rotation_deg,
            translation_error_deg=translation_deg,
            errors_px=errors_px,
            kept_idx=kept,
            correct_idx=kept[correct],
        )

    def errors(self, name0: str, name1: str, points0_px: FloatArray, points1_px: FloatArray) -> FloatArray:
        """Symmetric epipolar distances (M,) of stored pixels (M, 2); NaN where the lens model has no ray."""
        camera0, camera1 = (self._sight.cameras[name] for name in (name0, name1))
        pose0, pose1 = (self._sight.poses[name] for name in (name0, name1))
        matrix = fundamental_from_poses(camera0, pose0, camera1, pose1)
        return symmetric_distance_px(matrix, undistort(camera0, points0_px), undistort(camera1, points1_px))


def load_reference(folder: Path, images_folder: Path | None = None) -> ReferenceTruth:
    """Truth from poses.csv and block.json. Raises ConfigError on malformed files, InputError on unusable ones."""
    pose_list, cameras = read_poses(folder / "poses.csv"), read_camera_file(folder / "block.json")
    if cameras.ground_z_m is None:
        raise InputError(f"{folder / 'block.json'} states no ground height: add ground_z (metres), overlaps rest on it")
    observations = {row.image: observation_of_row(row, "auto") for row in pose_list.rows}
    known = {name: found for name, found in observations.items() if found and np.isfinite(found.position).all()}
    located = oriented(known, "auto", cameras.crs, None, 0.0, 0.0)
    poses = {name: pose for name, pose in located.poses.items() if pose.world_rotation is not None}
    if len(poses) < 2:
        raise InputError(f"{folder / 'poses.csv'} gives {len(poses)} images position and attitude: two are needed")
    by_name = {row.image: _camera_of(row, cameras, folder) for row in pose_list.rows if row.image in poses}
    return ReferenceTruth(by_name, poses, cameras.ground_z_m - located.frame.origin_m[2], images_folder)


def _camera_of(row: PoseRow, file: CameraFile, folder: Path) -> Camera:
    if len(file.cameras) == 1:
        return next(iter(file.cameras.values()))
    if row.camera not in file.cameras:
        raise ConfigError(
            f"{folder / 'poses.csv'}, line {row.line}: {folder / 'block.json'} holds several cameras; name one of them "
            f"in a column camera: {', '.join(file.cameras)}"
        )
    return file.cameras[row.camera]
