"""What an image sees of the ground: footprint polygons, sampling distance, viewing angles.

The ground below one image is a horizontal plane at the terrain's height in the middle of its footprint. Rays that look
near or above the horizon are cut at a horizontal distance given as a multiple of the flying height.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from aeromatch_cli.data import Block, Camera, FloatArray, Ground, Pose
from aeromatch_cli.geometry.cameras import focal_px, normalise
from aeromatch_cli.geometry.frames import length_words
from aeromatch_cli.geometry.rotations import tilt_deg
from aeromatch_cli.geometry.warps import border_px

# Ground farther away than this many flying heights is seen at less than 11 degrees: too flat to match.
MAX_DISTANCE_FACTOR = 5.0

# Ground that an image sees so many times finer than usual, and than the plane of the images around it, is no ground
# but a wrong height near the camera. How many images around count.
_LEAST_SHARE, _IMAGES_AROUND = 0.25, 8
_BORDER_POINTS_PER_SIDE = 8
_CUT_SIDES = 32


@dataclass(frozen=True, eq=False)
class Footprint:
    """The ground that one image sees.

    polygon_m: (N, 2) world x, y, in the order of the image border. ground_z_m: height of the plane it lies on.
    middle_m: (3,) centroid of the polygon on that plane. gsd_m: see `ground_sampling_distance_m`.
    tilt_deg: angle between the optical axis and straight down. degenerate: the terrain's own plane, which was not used.
    """

    polygon_m: FloatArray
    ground_z_m: float
    middle_m: FloatArray
    gsd_m: float
    tilt_deg: float
    degenerate: Degenerate | None = None


@dataclass(frozen=True)
class Degenerate:
    """A plane of the terrain that reaches up to the camera, or above it: a wrong terrain, or a camera beside a wall.

    ground_z_m: world height of the terrain. width_px, height_px: of the ground view that it would make.
    """

    ground_z_m: float
    width_px: int
    height_px: int


@functools.lru_cache(maxsize=256)
def border_rays(camera: Camera, per_side: int = _BORDER_POINTS_PER_SIDE) -> FloatArray:
    """Directions (N, 3) in the camera frame, z = 1, around the outer edge of the image, clockwise from the top left.

    Border points that no ray reaches under the lens model are left out. The array is shared and read-only.
    """
    uv = normalise(camera, border_px(camera, per_side))
    uv = uv[np.isfinite(uv).all(axis=1)]
    rays = np.concatenate([uv, np.ones((len(uv), 1))], axis=1)
    rays.setflags(write=False)
    return rays


def clip_half_plane(points: FloatArray, side: FloatArray) -> FloatArray:
    """The part of a closed polygon (N, D) where the linear function `side` (N,), given at its vertices, is <= 0.

    Source: Sutherland and Hodgman, Reentrant polygon clipping, CACM 17(1), 1974.
    """
    following, side_following = np.roll(points, -1, axis=0), np.roll(side, -1)
    inside = side <= 0.0
    crosses = inside != (side_following <= 0.0)
    t = np.where(crosses, side / np.where(crosses, side - side_following, 1.0), 0.0)
    crossings = points + t[:, None] * (following - points)
    # Each vertex yields itself (if inside) and then the crossing of its edge (if any), in the polygon's order.
    both = np.stack([points, crossings], axis=1).reshape(-1, points.shape[1])
    return both[np.stack([inside, crosses], axis=1).reshape(-1)]


def ground_footprint(
    camera: Camera,
    pose: Pose,
    ground_z_m: float,
    max_distance_m: float,
    per_side: int = _BORDER_POINTS_PER_SIDE,
) -> FloatArray:
    """Ground polygon (N, 2) seen by the image on the plane z = ground_z_m, world metres.

    Cut by a regular polygon of 32 sides inside the circle of radius max_distance_m around the camera's foot point.
    Empty (0, 2) when the camera is at or below the ground, has no attitude, or sees nothing within that distance.
    """
    nothing = np.zeros((0, 2))
    height = float(pose.center_m[2]) - ground_z_m
    if not height > 0.0 or pose.world_rotation is None:
        return nothing
    rays: FloatArray = border_rays(camera, per_side) @ pose.world_rotation
    apothem = max_distance_m * np.cos(np.pi / _CUT_SIDES)
    if len(rays) < 3:
        return nothing
    if (np.hypot(rays[:, 0], rays[:, 1]) * height > -apothem * rays[:, 2]).any():
        rays = _clip_distance(rays, height, apothem)
    if len(rays) < 3:
        return nothing
    return pose.center_m[:2] + rays[:, :2] * (height / -rays[:, 2:3])


def _clip_distance(rays: FloatArray, height_m: float, apothem_m: float) -> FloatArray:
    """The part of a cone of rays (N, 3) that meets the ground inside the regular polygon of that apothem.

    A side n of the polygon is the half space  n . (x, y) height + apothem z <= 0  of rays: linear, so that a cone
    which reaches above the horizon is cut exactly. Two opposite sides together imply z < 0.
    """
    angles = 2.0 * np.pi * np.arange(_CUT_SIDES) / _CUT_SIDES
    for x, y in zip(np.cos(angles), np.sin(angles), strict=True):
        side = (x * rays[:, 0] + y * rays[:, 1]) * height_m + apothem_m * rays[:, 2]
        if (side > 0.0).any():
            rays = clip_half_plane(rays, side)
            if len(rays) < 3:
                break
    return rays


def polygon_area_m2(polygon_m: FloatArray) -> float:
    """Area of a simple polygon (N, 2), positive whatever its direction; 0 below three points (shoelace formula)."""
    if len(polygon_m) < 3:
        return 0.0
    x, y = (polygon_m - polygon_m[0]).T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def polygon_centroid_m(polygon_m: FloatArray) -> FloatArray:
    """Centre of area (2,) of a simple polygon (N, 2), N >= 1; the mean of its points where it has no area."""
    local = polygon_m - polygon_m[0]
    x, y = local.T
    cross = x * np.roll(y, -1) - y * np.roll(x, -1)
    if abs(float(cross.sum())) < 1e-12:
        return np.asarray(polygon_m.mean(axis=0))
    moments = ((local + np.roll(local, -1, axis=0)) * cross[:, None]).sum(axis=0)
    return np.asarray(polygon_m[0] + moments / (3.0 * cross.sum()))


def ground_sampling_distance_m(
    camera: Camera, pose: Pose, ground_z_m: float, max_distance_factor: float = MAX_DISTANCE_FACTOR
) -> float | None:
    """Metres on the ground per pixel in the middle of the image, across the viewing direction.

    The distance to the ground along the optical axis over the focal length in px; where the axis meets the ground
    beyond max_distance_factor flying heights, or never, the distance to the middle of the footprint instead. None
    without attitude, or where the image sees no ground.
    """
    height = float(pose.center_m[2]) - ground_z_m
    if pose.world_rotation is None or not height > 0.0:
        return None
    axis = pose.world_rotation[2]
    if axis[2] < 0.0 and float(np.hypot(axis[0], axis[1])) <= max_distance_factor * -axis[2]:
        return height / -float(axis[2]) / focal_px(camera)
    polygon = ground_footprint(camera, pose, ground_z_m, max_distance_factor * height)
    if len(polygon) < 3:
        return None
    to_middle = polygon_centroid_m(polygon) - pose.center_m[:2]
    return float(np.hypot(np.hypot(*to_middle), height)) / focal_px(camera)


def image_footprint(
    camera: Camera, pose: Pose, ground: Ground, max_distance_factor: float = MAX_DISTANCE_FACTOR
) -> Footprint | None:
    """The ground seen by one image over a terrain, or None where it sees none or has no attitude.

    The plane starts at the terrain's height below the camera and is moved once to the height in the middle of the
    footprint that this gives.
    """
    if pose.world_rotation is None:
        return None
    foot_z = float(ground.height_m(pose.center_m[None, :2])[0])
    polygon = ground_footprint(camera, pose, foot_z, max_distance_factor * (float(pose.center_m[2]) - foot_z))
    if len(polygon) < 3:
        return None
    return _plane_footprint(
        camera, pose, float(ground.height_m(polygon_centroid_m(polygon)[None])[0]), max_distance_factor
    )


def _plane_footprint(camera: Camera, pose: Pose, ground_z_m: float, max_distance_factor: float) -> Footprint | None:
    """The same over a plane."""
    polygon = ground_footprint(camera, pose, ground_z_m, max_distance_factor * (float(pose.center_m[2]) - ground_z_m))
    gsd = ground_sampling_distance_m(camera, pose, ground_z_m, max_distance_factor)
    if len(polygon) < 3 or gsd is None or pose.world_rotation is None:
        return None
    middle = np.append(polygon_centroid_m(polygon), ground_z_m)
    return Footprint(polygon, ground_z_m, middle, gsd, tilt_deg(pose.world_rotation))


@functools.lru_cache(maxsize=8)
def block_footprints(block: Block, max_distance_factor: float = MAX_DISTANCE_FACTOR) -> Mapping[str, Footprint]:
    """Footprints by image_id of every image that has an attitude and sees ground; empty without a ground. Made once of
    a block: ask for it, do not change it.

    Where the terrain reaches up to a camera, but not to those around it, the footprint lies on the median plane of
    theirs, and says so: that of the terrain would be a few pixels wide.
    """
    if block.ground is None:
        return {}
    cameras = {image.image_id: block.camera(image) for image in block.images}
    poses = {i: block.poses[i] for i in cameras if i in block.poses and _is_whole(block.poses[i])}
    found = {}
    for image_id, pose in poses.items():
        footprint = image_footprint(cameras[image_id], pose, block.ground, max_distance_factor)
        if footprint is not None:
            found[image_id] = footprint
    least_m = _LEAST_SHARE * (common_gsd_m(found) or 0.0)
    sound = {i: footprint for i, footprint in found.items() if footprint.gsd_m >= least_m}
    if sound:
        for image_id in poses.keys() - sound.keys():
            pose, terrain = poses[image_id], found.get(image_id)
            plane_z_m = _plane_around_m(pose, poses, sound)
            degenerate = _degenerate_footprint(
                cameras[image_id], pose, block.ground, terrain, plane_z_m, max_distance_factor
            )
            if degenerate is not None:
                found[image_id] = degenerate
    return {i: found[i] for i in cameras if i in found}


def _is_whole(pose: Pose) -> bool:
    """Whether a pose has a position and an attitude."""
    return pose.world_rotation is not None and bool(np.isfinite(pose.center_m).all())


def _degenerate_footprint(
    camera: Camera,
    pose: Pose,
    ground: Ground,
    terrain: Footprint | None,
    plane_z_m: float,
    max_distance_factor: float,
) -> Footprint | None:
    """Return the footprint on a plane of an image whose footprint on the terrain is far smaller or is none.

    terrain: the latter. None where the image looks at the sky, and where the plane gives no larger footprint.
    """
    z_m = float(ground.height_m(pose.center_m[None, :2])[0]) if terrain is None else terrain.ground_z_m
    if terrain is None and z_m < pose.center_m[2]:
        return None
    plane = _plane_footprint(camera, pose, plane_z_m, max_distance_factor)
    if plane is None or (terrain is not None and terrain.gsd_m >= _LEAST_SHARE * plane.gsd_m):
        return None
    share = 0.0 if terrain is None else terrain.gsd_m / plane.gsd_m
    return replace(plane, degenerate=Degenerate(z_m, round(share * camera.width_px), round(share * camera.height_px)))


def _plane_around_m(pose: Pose, poses: Mapping[str, Pose], footprints: Mapping[str, Footprint]) -> float:
    """Median ground height of the images nearest to one. footprints: at least one."""
    centers_m = np.array([poses[i].center_m[:2] for i in footprints])
    nearest = np.argsort(np.linalg.norm(centers_m - pose.center_m[:2], axis=1), kind="stable")[:_IMAGES_AROUND]
    heights_m = np.array([footprint.ground_z_m for footprint in footprints.values()])
    return float(np.median(heights_m[nearest]))


def degenerate_words(degenerate: Degenerate, block: Block) -> str:
    """In words; the height counts in the block's CRS."""
    height = length_words(degenerate.ground_z_m + block.origin_m[2], 0, metric=block.metric)
    size = f"{degenerate.width_px}x{degenerate.height_px} px"
    return f"degenerate ground view ({size}: the terrain there, {height}, is nearly as high as the camera)"


def common_gsd_m(footprints: Mapping[str, Footprint], scales: Mapping[str, float] | None = None) -> float | None:
    """The block's ground sampling distance: the median over its images, or None where no image sees ground. scales:
    image_id -> what the image is reduced to; None for none."""
    if not footprints:
        return None
    return float(np.median([item.gsd_m / (scales[i] if scales else 1.0) for i, item in footprints.items()]))


def view_angles_deg(centers0_m: FloatArray, centers1_m: FloatArray, points_m: FloatArray) -> FloatArray:
    """Angles (N,) at world points (N, 3) between the rays to two projection centres (N, 3 each), in [0, 180]."""
    rays0, rays1 = centers0_m - points_m, centers1_m - points_m
    across = np.linalg.norm(np.cross(rays0, rays1), axis=1)
    return np.asarray(np.rad2deg(np.arctan2(across, (rays0 * rays1).sum(axis=1))))


def sees_horizon(camera: Camera, world_rotation: FloatArray) -> bool:
    """Whether any part of the image border looks level or up."""
    return bool((border_rays(camera) @ world_rotation[:, 2] >= 0.0).any())
