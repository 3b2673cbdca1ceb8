"""Where the points of one image must lie in another, as far as both poses and the ground are known.

A pixel's ray meets the ground plane at X, which the other camera sees at u. First-order changes of u (H&Z section 5.2,
propagation of covariance; small rotations a and shifts b in the world frame, n the vertical, r the ray, C the centres):
    camera 0 turned   dX = P (a x r t),  t the distance along the ray,  P = I - r n^T / (n^T r)
    camera 0 moved    dX = P b
    camera 1 turned   du = J ((X - C1) x a),  camera 1 moved  du = -J b,  J = du/dX.
What stands above or below the plane moves along the epipolar line, exactly.

Where matches are verified, the heights of the nearest ones tell more than the plane: `places_of_heights`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import BoolArray, Camera, FloatArray, IntArray, Pose
from aeromatch_cli.geometry.cameras import calibration_matrix, undistort

_NEAREST_DEPTH = 1e-6
_SMALLEST_STEP_PX = 1e-6


@dataclass(frozen=True, eq=False)
class Windows:
    """Rectangles in an image, one for each point of the other; a point that sees no ground has NaN and holds nothing.

    centers_px: (N, 2) undistorted pixels. axes: (N, 2, 2), rows = unit vectors along and across the epipolar line.
    halves_px: (N, 2) half lengths along and across.
    """

    centers_px: FloatArray
    axes: FloatArray
    halves_px: FloatArray

    def take(self, which: IntArray) -> Windows:
        return Windows(*(values[which] for values in vars(self).values()))

    def sample(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Points (count N, 2) drawn evenly from the windows, all of them again and again."""
        drawn = rng.uniform(-1.0, 1.0, (count, *self.halves_px.shape)) * self.halves_px
        return (self.centers_px + np.einsum("cnk,nki->cni", drawn, self.axes)).reshape(-1, 2)

    def forms(self) -> FloatArray:
        """(N, 2, 3) linear forms: (x, y) is inside where both |forms . (x, y, 1)| <= 1. Holds no point for NaN."""
        scaled = self.axes / self.halves_px[:, :, None]
        constant = -(scaled * self.centers_px[:, None, :]).sum(axis=2, keepdims=True)
        forms = np.concatenate([scaled, constant], axis=2)
        forms[~np.isfinite(forms).all(axis=(1, 2))] = [0.0, 0.0, np.inf]
        return forms

    def contain(self, points_px: FloatArray) -> BoolArray:
        """Whether points (N, 2), undistorted pixels, lie in the window of the same row."""
        offset = np.einsum("nij,nj->ni", self.axes, points_px - self.centers_px)
        with np.errstate(invalid="ignore"):
            return np.asarray((np.abs(offset) <= self.halves_px).all(axis=1))


def search_windows(
    points0_px: FloatArray,
    camera0: Camera,
    pose0: Pose,
    camera1: Camera,
    pose1: Pose,
    ground_z_m: float,
    *,
    relief_m: float,
    sigmas: float,
    sigma_px: float,
) -> Windows:
    """Windows in image 1 for stored pixels (N, 2) of image 0: the stretch of the epipolar line between the heights
    ground_z_m -+ relief_m, widened on all sides by `sigmas` standard deviations of the predicted place (poses and
    keypoints, sigma_px each). Raises ValueError without both attitudes.
    """
    if pose0.world_rotation is None or pose1.world_rotation is None:
        raise ValueError("a prediction needs both attitudes")
    rays = _world_rays(camera0, pose0, points0_px)
    place = _seen(camera1, pose1, _at_height(pose0, rays, ground_z_m))
    ends = [
        _seen(camera1, pose1, _at_height(pose0, rays, ground_z_m + sign * relief_m)).places_px for sign in (-1.0, 1.0)
    ]
    low, high = (np.where(np.isfinite(end), end, place.places_px) for end in ends)
    by_pixel = _by_pixel(camera0, pose0, pose1, rays, place)
    covariance = _covariance(pose0, pose1, rays, place)
    covariance += sigma_px**2 * (np.eye(2) + by_pixel @ by_pixel.transpose(0, 2, 1))
    length = np.linalg.norm(high - low, axis=1)
    # Without parallax every direction is along the line.
    unit = np.where((length > _SMALLEST_STEP_PX)[:, None], high - low, [1.0, 0.0])
    along = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    axes = np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=1)
    deviation = np.sqrt(np.einsum("nij,njk,nik->ni", axes, covariance, axes))
    halves = sigmas * deviation
    halves[:, 0] += 0.5 * length
    return Windows(0.5 * (low + high), axes, halves)


def ground_places(camera: Camera, pose: Pose, points_px: FloatArray, ground_z_m: float) -> FloatArray:
    """World x, y (N, 2) where rays of stored pixels (N, 2) meet the ground plane; NaN where they do not go down."""
    return _at_height(pose, _world_rays(camera, pose, points_px), ground_z_m)[:, :2]


@dataclass(frozen=True, eq=False)
class _Seen:
    """World points and where a camera sees them. offsets_m: (N, 3) from its centre. by_world: (N, 2, 3) du/dX."""

    offsets_m: FloatArray
    places_px: FloatArray
    by_world: FloatArray


def _world_rays(camera: Camera, pose: Pose, points_px: FloatArray) -> FloatArray:
    """World directions (N, 3) of depth 1; NaN where they do not go down."""
    rays = homogeneous(camera, undistort(camera, points_px)) @ np.asarray(pose.world_rotation)
    rays[~(rays[:, 2] < -_NEAREST_DEPTH)] = np.nan
    return rays


def _at_height(pose: Pose, rays: FloatArray, height_m: float) -> FloatArray:
    distance = (height_m - pose.center_m[2]) / rays[:, 2]
    return pose.center_m + np.where(distance > 0.0, distance, np.nan)[:, None] * rays


def _seen(camera: Camera, pose: Pose, points_m: FloatArray) -> _Seen:
    calibration = calibration_matrix(camera)
    offsets = points_m - pose.center_m
    matrix = calibration @ np.asarray(pose.world_rotation)
    projected = offsets @ matrix.T
    depth = np.where(projected[:, 2] > _NEAREST_DEPTH, projected[:, 2], np.nan)
    places = projected[:, :2] / depth[:, None]
    by_world = (matrix[None, :2] - places[:, :, None] * matrix[2]) / depth[:, None, None]
    return _Seen(offsets, places, by_world)


def _on_ground(rays: FloatArray) -> FloatArray:
    """P (N, 3, 3): how a shift of a ray moves its point on the plane."""
    matrices = np.broadcast_to(np.eye(3), (len(rays), 3, 3)).copy()
    matrices[:, :, 2] -= rays / rays[:, 2:]
    return matrices


def _cross_matrices(vectors: FloatArray) -> FloatArray:
    zero = np.zeros(len(vectors))
    x, y, z = vectors.T
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _distance(pose0: Pose, pose1: Pose, place: _Seen) -> FloatArray:
    """Points from the centre of camera 0 (N, 3)."""
    return place.offsets_m + (pose1.center_m - pose0.center_m)


def _covariance(pose0: Pose, pose1: Pose, rays: FloatArray, place: _Seen) -> FloatArray:
    """(N, 2, 2) of the predicted place, from the errors of both poses."""
    by_shift = place.by_world @ _on_ground(rays)
    by_turn0 = by_shift @ _cross_matrices(_distance(pose0, pose1, place))
    by_turn1 = place.by_world @ _cross_matrices(place.offsets_m)
    parts = (
        (by_shift, pose0.sigma_position_m),
        (by_turn0, np.deg2rad(pose0.sigma_angle_deg)),
        (place.by_world, pose1.sigma_position_m),
        (by_turn1, np.deg2rad(pose1.sigma_angle_deg)),
    )
    return np.sum([sigma**2 * (matrix @ matrix.transpose(0, 2, 1)) for matrix, sigma in parts], axis=0)


def _by_pixel(camera0: Camera, pose0: Pose, pose1: Pose, rays: FloatArray, place: _Seen) -> FloatArray:
    """(N, 2, 2) change of the predicted place by that of the undistorted pixel in image 0."""
    by_pixel = np.asarray(pose0.world_rotation).T @ np.linalg.inv(calibration_matrix(camera0))[:, :2]
    depth = _distance(pose0, pose1, place)[:, 2] / rays[:, 2]
    return depth[:, None, None] * (place.by_world @ (_on_ground(rays) @ by_pixel))


@dataclass(frozen=True, eq=False)
class Stereo:
    """Two cameras whose relative pose is known up to the length of the baseline.

    rotation, translation: (3, 3) and (3,) of cam1_from_cam0. up: (3,) unit vector, vertical in the frame of camera 0.
    """

    camera0: Camera
    camera1: Camera
    rotation: FloatArray
    translation: FloatArray
    up: FloatArray


def stereo_of(
    essential: FloatArray, rotation: FloatArray, camera0: Camera, camera1: Camera, up: FloatArray | None
) -> Stereo:
    """From E = [t]x R and its R. Without `up` the optical axis of camera 0 stands for the vertical."""
    skew = essential @ rotation.T
    translation = np.array([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]]) / 2.0
    return Stereo(camera0, camera1, rotation, translation, np.array([0.0, 0.0, -1.0]) if up is None else up)


def inverse_depths(stereo: Stereo, points0_px: FloatArray, points1_px: FloatArray) -> FloatArray:
    """One over the depth in camera 0 (N,), in baselines, of matches (N, 2) on undistorted pixels: that which puts the
    point of image 0 nearest to the line of sight of the other; 0 where the baseline has no parallax.
    """
    turned = homogeneous(stereo.camera0, points0_px) @ stereo.rotation.T
    rays1 = homogeneous(stereo.camera1, points1_px)
    # rays1 x (turned + inverse depth * translation) = 0, by least squares.
    still, moving = np.cross(rays1, turned), np.cross(rays1, stereo.translation)
    square = (moving**2).sum(axis=1)
    return -np.divide((still * moving).sum(axis=1), square, out=np.zeros_like(square), where=square > 0.0)


def places_of_heights(stereo: Stereo, points0_px: FloatArray, base0_px: FloatArray, inverse: FloatArray) -> FloatArray:
    """Places (N, Q, 2) in image 1 of points (N, 2), each as high as base points (N, Q, 2) of inverse depths (N, Q).

    Undistorted pixels. A horizontal plane's inverse depth is proportional to (up . ray): between points of one height
    it follows the ratio. NaN behind camera 1 and where a point and its base lie on different sides of the horizon.
    """
    count = base0_px.shape[1]
    rays = homogeneous(stereo.camera0, points0_px)
    own = rays @ stereo.up
    of_base = (homogeneous(stereo.camera0, base0_px.reshape(-1, 2)) @ stereo.up).reshape(-1, count)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = own[:, None] / of_base
    scaled = inverse * np.where(ratio > 0.0, ratio, np.nan)
    seen = (rays @ stereo.rotation.T)[:, None] + stereo.translation * scaled[..., None]
    projected = seen @ calibration_matrix(stereo.camera1).T
    depth = np.where(projected[..., 2:] > _NEAREST_DEPTH, projected[..., 2:], np.nan)
    return np.asarray(projected[..., :2] / depth)


def homogeneous(camera: Camera, undistorted_px: FloatArray) -> FloatArray:
    """Rays (N, 3) of depth 1 in the camera of undistorted pixels (N, 2)."""
    extended = np.concatenate([undistorted_px, np.ones((len(undistorted_px), 1))], axis=1)
    return np.asarray(extended @ np.linalg.inv(calibration_matrix(camera)).T)
