"""Ground height from a few adjacent image pairs: matched, triangulated with the given poses, judged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pose
from aeromatch_cli.geometry.cameras import parameters, undistort, world_rays
from aeromatch_cli.geometry.epipolar import fundamental_from_poses, sampson_distance_px, triangulate
from aeromatch_cli.geometry.footprints import view_angles_deg

# Neighbours by distance that a seed image is paired with: near ones match surely, far ones triangulate well.
_RANKS = (1, 3, 7)
_SIMILAR_DIRECTION_DEG = 30.0
_MIN_POINTS_PER_PAIR = 15
_MIN_POINTS = 30
_MIN_RAY_ANGLE_DEG = 1.0
_INLIER_PX = 3.0
_MAX_ERROR_PX = 3.0
_MAX_STRAIN = 4.0
_SIGMA_FLOOR = (np.deg2rad(0.01), 0.01)
_MAX_UNCERTAINTY = 0.1


@dataclass(frozen=True)
class GroundEstimate:
    """What adjacent images say of the ground.

    z_m: world height, or None where the evidence is poor. reason: in words, how it was found or why it was not.
    pairs, points: how many were used. spread_m: standard error of the mean over the pairs.
    """

    z_m: float | None
    reason: str
    pairs: int = 0
    points: int = 0
    spread_m: float = float("nan")


@dataclass(frozen=True)
class PairHeight:
    """Height of one pair's points: z_m their median, camera_z_m the mean height of both cameras, weight relative."""

    z_m: float
    camera_z_m: float
    points: int
    weight: float


def choose_adjacent_pairs(poses: Mapping[str, Pose], seeds: int) -> list[tuple[str, str]]:
    """Up to 3 `seeds` pairs of images with attitude, spread over the block, near each other and looking alike.

    Seeds are spread by farthest-point sampling; each is paired with its nearest, third and seventh neighbour among the
    images that look within 30 degrees of its direction. The same for any order of the mapping.
    """
    ids = sorted(i for i, p in poses.items() if p.world_rotation is not None and np.isfinite(p.center_m).all())
    if len(ids) < 2 or seeds < 1:
        return []
    centers = np.array([poses[image_id].center_m for image_id in ids])
    axes = np.array([_rotation(poses[image_id])[2] for image_id in ids])
    chosen: dict[tuple[str, str], None] = {}
    for seed in _spread_out(centers, min(seeds, len(ids))):
        distances = np.linalg.norm(centers - centers[seed], axis=1)
        alike = axes @ axes[seed] >= np.cos(np.deg2rad(_SIMILAR_DIRECTION_DEG))
        near = [int(i) for i in np.argsort(distances, kind="stable") if alike[i] and distances[i] > 1e-6]
        for rank in _RANKS:
            if len(near) >= rank:
                first, second = sorted((seed, near[rank - 1]))
                chosen[ids[first], ids[second]] = None
    return list(chosen)


def ground_height(
    matches: Mapping[tuple[str, str], tuple[FloatArray, FloatArray]],
    poses: Mapping[str, Pose],
    cameras: Mapping[str, Camera],
) -> GroundEstimate:
    """Height of the ground from matches of a few posed pairs, or the reason why there is none.

    matches: by the image ids of the pairs (see `choose_adjacent_pairs`), stored pixels ((N, 2), (N, 2)); wrong ones may
    be among them. poses, cameras: by image_id.
    Each pair's poses are first fitted to its matches within their stated sigma (angles of a degree would spoil the
    height by ten percent), then its matches are triangulated; the pair gives the median height of its points. The
    result is the weighted mean of the pairs that agree. Refused: too few points, matches that contradict the poses,
    heights above the cameras, pairs that contradict each other.
    """
    if not matches:
        return GroundEstimate(None, "no adjacent images with attitude")
    attempts = [
        pair_height(poses[id0], poses[id1], cameras[id0], cameras[id1], *points)
        for (id0, id1), points in matches.items()
    ]
    found = [attempt for attempt in attempts if isinstance(attempt, PairHeight)]
    points = sum(pair.points for pair in found)
    tried = f"{len(found)} of {len(matches)} adjacent pairs"
    if points < _MIN_POINTS:
        causes = Counter(attempt for attempt in attempts if isinstance(attempt, str))
        why = "".join(f"; {count} x {cause}" for cause, count in sorted(causes.items()))
        return GroundEstimate(None, f"only {points} points could be triangulated in {tried}{why}", len(found), points)
    heights, weights = np.array([pair.z_m for pair in found]), np.array([pair.weight for pair in found])
    middle = _weighted_median(heights, weights)
    flying = float(np.median([pair.camera_z_m for pair in found])) - middle
    if flying <= 0.0:
        reason = f"the points of {tried} lie above the cameras: check the angle convention"
        return GroundEstimate(None, reason, len(found), points)
    # A pair's height is as uncertain as its rays are parallel: judge and average with that weight.
    scaled = np.abs(heights - middle) * np.sqrt(weights / weights.mean())
    agree = scaled <= max(3.0 * 1.4826 * float(np.median(scaled)), 0.01 * flying)
    z = float(np.average(heights[agree], weights=weights[agree]))
    variance = float(np.average((heights[agree] - z) ** 2, weights=weights[agree]))
    spread = float(np.sqrt(variance / max(int(agree.sum()) - 1, 1)))
    if spread > _MAX_UNCERTAINTY * flying or 2 * agree.sum() <= len(found):
        reason = f"the heights of {tried} contradict each other ({heights.min():.0f} to {heights.max():.0f} m in the "
        return GroundEstimate(None, reason + "world frame): check poses and camera", len(found), points, spread)
    used = int(agree.sum())
    return GroundEstimate(z, f"triangulated from {points} points of {used} adjacent pairs", used, points, spread)


def pair_height(
    pose0: Pose, pose1: Pose, camera0: Camera, camera1: Camera, points0_px: FloatArray, points1_px: FloatArray
) -> PairHeight | str:
    """Median height of the points of one pair, or in a few words why there is none."""
    if pose0.world_rotation is None or pose1.world_rotation is None:
        return "no attitude"
    undistorted0, undistorted1 = undistort(camera0, points0_px), undistort(camera1, points1_px)
    inliers = _consistent_matches(camera0, camera1, undistorted0, undistorted1)
    if inliers.sum() < _MIN_POINTS_PER_PAIR:
        return "too few matches"
    pose0, pose1, error_px, strain = _fit_poses(
        pose0, pose1, camera0, camera1, undistorted0[inliers], undistorted1[inliers]
    )
    if error_px > _MAX_ERROR_PX or strain > _MAX_STRAIN:
        return "matches contradict the poses"
    rays0 = world_rays(camera0, _rotation(pose0), points0_px[inliers])
    rays1 = world_rays(camera1, _rotation(pose1), points1_px[inliers])
    points = triangulate(pose0.center_m, rays0, pose1.center_m, rays1)
    points = points[np.isfinite(points).all(axis=1)]
    angles = view_angles_deg(pose0.center_m, pose1.center_m, points)
    points, angles = points[angles >= _MIN_RAY_ANGLE_DEG], angles[angles >= _MIN_RAY_ANGLE_DEG]
    if len(points) < _MIN_POINTS_PER_PAIR:
        return "rays too parallel"
    camera_z = 0.5 * float(pose0.center_m[2] + pose1.center_m[2])
    # The height error falls with the angle between the rays; least squares weighs by its square.
    return PairHeight(float(np.median(points[:, 2])), camera_z, len(points), float(np.median(angles)) ** 2)


def _consistent_matches(
    camera0: Camera, camera1: Camera, undistorted0_px: FloatArray, undistorted1_px: FloatArray
) -> BoolArray:
    """(N,) True for the matches of one rigid motion of calibrated cameras (PoseLib, seeded)."""
    import poselib

    if len(undistorted0_px) < _MIN_POINTS_PER_PAIR:
        return np.zeros(len(undistorted0_px), dtype=bool)
    dicts = []
    for camera in (camera0, camera1):
        p = parameters(camera)
        pinhole = [p["fx"], p["fy"], p["cx"], p["cy"]]
        dicts.append({"model": "PINHOLE", "width": camera.width_px, "height": camera.height_px, "params": pinhole})
    options = {"max_epipolar_error": _INLIER_PX, "seed": 0, "max_iterations": 2000}
    _, info = poselib.estimate_relative_pose(undistorted0_px, undistorted1_px, *dicts, options, {})
    return np.asarray(info["inliers"], dtype=bool)


def _fit_poses(
    pose0: Pose, pose1: Pose, camera0: Camera, camera1: Camera, undistorted0_px: FloatArray, undistorted1_px: FloatArray
) -> tuple[Pose, Pose, float, float]:
    """Both poses moved within their sigma so that the matches meet their epipolar lines; median error in px; strain.

    Least squares over a small rotation and a shift of each camera: Sampson errors of the matches (1 px) and the poses'
    own standard deviations. strain: the largest correction in units of its sigma.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    sigmas = np.repeat(
        [
            np.deg2rad(pose0.sigma_angle_deg),
            np.deg2rad(pose1.sigma_angle_deg),
            pose0.sigma_position_m,
            pose1.sigma_position_m,
        ],
        3,
    )
    sigmas = np.maximum(sigmas, np.repeat(_SIGMA_FLOOR, (6, 6)))

    def moved(unit: FloatArray) -> tuple[Pose, Pose]:
        step = unit * sigmas
        turned = [Rotation.from_rotvec(step[3 * i : 3 * i + 3]).as_matrix() for i in (0, 1)]
        return (
            replace(pose0, world_rotation=turned[0] @ _rotation(pose0), center_m=pose0.center_m + step[6:9]),
            replace(pose1, world_rotation=turned[1] @ _rotation(pose1), center_m=pose1.center_m + step[9:12]),
        )

    def errors(unit: FloatArray) -> FloatArray:
        both = moved(unit)
        matrix = fundamental_from_poses(camera0, both[0], camera1, both[1])
        return sampson_distance_px(matrix, undistorted0_px, undistorted1_px)

    def residuals(unit: FloatArray) -> FloatArray:
        return np.concatenate([errors(unit), unit])

    fit = least_squares(residuals, np.zeros(12), method="lm", max_nfev=1000)
    best = moved(fit.x)
    return *best, float(np.median(np.abs(errors(fit.x)))), float(np.abs(fit.x).max())


def _rotation(pose: Pose) -> FloatArray:
    if pose.world_rotation is None:
        raise ValueError("the pose has no attitude")
    return pose.world_rotation


def _spread_out(points: FloatArray, count: int) -> list[int]:
    """Indices of `count` points (N, D), each the farthest from those before it; the first is nearest to the median."""
    chosen = [int(np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1)))]
    nearest = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    """The value at which half of the weight lies on either side."""
    order = np.argsort(values, kind="stable")
    share = np.cumsum(weights[order]) - 0.5 * weights[order]
    return float(np.interp(0.5 * weights.sum(), share, values[order]))
