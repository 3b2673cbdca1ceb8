"""Stage 2 of learned features: pairs of photographs of real blocks, truth by their reference reconstruction.

The surface around a keypoint is as high as one of the nearest reference points. A partner lies on the epipolar line, at
a place that one of these heights predicts, in both directions, and does not look quite different: what is hidden has
none, but other keypoints may lie where it would be.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from aeromatch_cli.data import Camera, FloatArray, Pose
from aeromatch_cli.formats.features import read_features
from aeromatch_cli.geometry.cameras import undistort, undistorted_places
from aeromatch_cli.geometry.epipolar import fundamental_from_poses, symmetric_distance_px
from aeromatch_cli.geometry.prediction import homogeneous
from aeromatch_cli.stages import extract
from trainings.lightglue.blocks import LEAST_PARTNERS, Pair, prepared_reference
from trainings.lightglue.sides import UNKNOWN, Array, Partners, Seen, partners, seen

SIZE_PX, KEYPOINTS = 1280, 2000
HEIGHTS = 6  # reference points around a keypoint whose depths are tried
LINE_PX = 1.5
# Share of random pairs of keypoints that look more alike than a partner may look different.
_CHANCE, _DRAWS = 0.2, 4096
MOST_PAIRS = 400  # of a block, evenly over all that overlap


@dataclass(frozen=True, eq=False)
class Picture:
    """name: of the image. places_px of the side are undistorted. inverse_depths: (N, HEIGHTS), of the keypoints."""

    name: str
    camera: Camera
    pose: Pose
    side: Seen
    inverse_depths: FloatArray


def photograph_pairs(folder: Path, recipe: tuple[str, ...], *, most: int = MOST_PAIRS) -> list[Pair]:
    """Pairs with partners enough of a real block, BLOCK/images and BLOCK/reference with poses, cameras and points."""
    found = []
    taken = pictures_of(folder, recipe)
    for picture0, picture1 in combinations(taken, 2):
        truth = truth_of(picture0, picture1)
        if truth.count >= LEAST_PARTNERS:
            found.append(Pair(picture0.side, picture1.side, truth, False))
    return found[:: max(1, -(-len(found) // most))]


def pictures_of(folder: Path, recipe: tuple[str, ...]) -> list[Picture]:
    """Every picture of a block, in its ground view."""
    with tempfile.TemporaryDirectory() as scratch:
        changes = (*recipe, f"extract.keypoints={KEYPOINTS}", "pairs=exhaustive")
        context, points_m = prepared_reference(folder, scratch, changes, SIZE_PX)
        found = []
        for image in context.block.images:
            task = extract.task_of(context, image.image_id)
            extract.run_task(task)
            features = read_features(task.path)
            camera, pose = context.block.camera(image), context.block.poses.get(image.image_id)
            if pose is None or pose.world_rotation is None or not len(features.descriptors):
                continue
            raw = seen(features, signed=True)
            side = Seen(**{**raw.arrays(), "places_px": undistort(camera, raw.places_px).astype(np.float32)})
            depths = _inverse_depths(camera, pose, side.places_px.astype(np.float64), points_m)
            if depths is not None:
                found.append(Picture(image.name, camera, pose, side, depths))
    return found


def _inverse_depths(camera: Camera, pose: Pose, places_px: FloatArray, points_m: FloatArray) -> FloatArray | None:
    """(N, HEIGHTS) of the reference points that are nearest in the picture; None where it shows too few."""
    there, depths_m = undistorted_places(camera, np.asarray(pose.world_rotation), pose.center_m, points_m)
    inside = ((there >= 0.0) & (there <= [camera.width_px, camera.height_px])).all(axis=1)
    if inside.sum() < 10 * HEIGHTS:
        return None
    rows = cKDTree(there[inside]).query(places_px, k=HEIGHTS)[1]
    return np.asarray(1.0 / depths_m[inside][rows])


def truth_of(picture0: Picture, picture1: Picture) -> Partners:
    """Who is whose partner."""
    side0, side1 = picture0.side, picture1.side
    there = [_place_in(picture0, picture1), _place_in(picture1, picture0)]
    found = partners(side0, side1, *there)
    rows = np.flatnonzero(found.of0 >= 0)
    matrix = fundamental_from_poses(picture0.camera, picture0.pose, picture1.camera, picture1.pose)
    columns = found.of0[rows]
    apart = symmetric_distance_px(matrix, side0.places_px[rows].astype(np.float64), side1.places_px[columns])
    doubtful = (apart > LINE_PX) | (_looks(side0, side1, rows, columns) > _usual(side0, side1))
    of0, of1 = found.of0.copy(), found.of1.copy()
    of0[rows[doubtful]] = of1[columns[doubtful]] = UNKNOWN
    return Partners(of0, of1)


def _place_in(picture: Picture, other: Picture) -> FloatArray:
    """(N, 2) where keypoints lie in the other picture, at that of the heights around which a keypoint there is nearest;
    NaN outside of it."""
    rays = homogeneous(picture.camera, picture.side.places_px.astype(np.float64))
    rays = rays @ np.asarray(picture.pose.world_rotation)
    points = picture.pose.center_m + rays[:, None] / picture.inverse_depths[..., None]
    view = other.camera, np.asarray(other.pose.world_rotation), other.pose.center_m
    there = undistorted_places(*view, points.reshape(-1, 3))[0].reshape(*points.shape[:2], 2)
    size = np.array([other.camera.width_px, other.camera.height_px])
    there[((there < 0.0) | (there > size)).any(axis=2)] = np.nan
    known = np.isfinite(there).all(axis=2)
    distance = np.full(known.shape, np.inf)
    distance[known] = cKDTree(other.side.places_px).query(there[known])[0]
    return np.asarray(there[np.arange(len(there)), distance.argmin(axis=1)])


def _looks(side0: Seen, side1: Seen, rows: Array, columns: Array) -> FloatArray:
    apart = side0.descriptors[rows].astype(np.float64) - side1.descriptors[columns]
    return np.asarray(np.linalg.norm(apart, axis=1))


def _usual(side0: Seen, side1: Seen) -> float:
    """Distance of descriptors that wrong pairs of keypoints mostly exceed."""
    rng = np.random.default_rng(0)
    rows, columns = (rng.integers(0, len(side.descriptors), _DRAWS) for side in (side0, side1))
    return float(np.quantile(_looks(side0, side1, rows, columns), _CHANCE))
