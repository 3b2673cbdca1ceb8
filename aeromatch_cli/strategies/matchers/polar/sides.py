"""Both sides of a pair in the frames that a similarity relates: stored pictures, or the ground seen from above.

Where both attitudes and the ground are known, tilt and lens are taken out beforehand: both pictures are read as they
look straight down on the plane of the ground, north up, at one ground sampling distance. What is left between them is
the error of the poses, and the relief.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeromatch_cli.data import BoolArray, Camera, FloatArray, PairGeometry, Pose, Raster
from aeromatch_cli.geometry.footprints import ground_footprint, ground_sampling_distance_m
from aeromatch_cli.geometry.warps import source_from_view, undistorted_from_ground, view_from_source
from aeromatch_cli.strategies.matchers.polar.registration import Prior

# Ground farther off than this many flying heights is left out: it is seen at less than 27 degrees.
_FARTHEST = 2.0
_NODE_PX = 8  # between the places where the lens is followed exactly
_OUTSIDE_PX = -1e4


@dataclass(frozen=True, eq=False)
class Side:
    """One picture in its frame. camera, undistorted_from_frame: (3, 3), None where the frame is the stored picture.

    width_px, height_px: of the frame. source_scale: stored px per frame px, about.
    """

    raster: Raster
    width_px: int
    height_px: int
    camera: Camera | None = None
    undistorted_from_frame: FloatArray | None = None
    source_scale: float = 1.0

    @classmethod
    def stored(cls, raster: Raster) -> Side:
        """The stored picture as it is."""
        return cls(raster, raster.width_px, raster.height_px)

    @property
    def finest(self) -> float:
        """The largest scale that it may be read at."""
        return min(1.0, self.raster.finest * (1.0 if self.camera is None else self.source_scale))

    def source_from_frame(self, points_px: FloatArray) -> FloatArray:
        """Stored pixels (N, 2) of frame pixels (N, 2); NaN where nothing is seen."""
        if self.camera is None or self.undistorted_from_frame is None:
            return np.asarray(points_px, np.float64)
        return source_from_view(self.camera, self.undistorted_from_frame, points_px)

    def frame_from_source(self, points_px: FloatArray) -> FloatArray:
        """The inverse."""
        if self.camera is None or self.undistorted_from_frame is None:
            return np.asarray(points_px, np.float64)
        return view_from_source(self.camera, self.undistorted_from_frame, points_px)

    def read(self, scale: float) -> tuple[FloatArray, BoolArray | None]:
        """The frame's picture reduced to `scale` and where it is valid."""
        if self.camera is None:
            return self.raster.reduced(scale)
        import cv2

        stored_scale = min(self.raster.finest, scale / self.source_scale)
        pixels, valid = self.raster.reduced(stored_scale)
        maps = self._maps(scale, stored_scale)
        x, y = maps[..., 0], maps[..., 1]
        found = cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        height, width = pixels.shape
        inside = ((maps >= 0.0) & (maps <= np.array([width - 1.0, height - 1.0]))).all(axis=2)
        if valid is not None:
            inside &= np.asarray(cv2.remap(valid.astype(np.uint8), x, y, cv2.INTER_NEAREST)) > 0
        return np.asarray(found, np.float32), np.asarray(inside)

    def _maps(self, scale: float, stored_scale: float) -> FloatArray:
        """(H, W, 2) float32 places in the reduced stored picture of every pixel of the reduced frame."""
        import cv2

        width, height = max(1, round(self.width_px * scale)), max(1, round(self.height_px * scale))
        xs, ys = (np.arange(0, length + _NODE_PX, _NODE_PX, dtype=float) for length in (width, height))
        nodes = (np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2) + 0.5) / scale - 0.5
        places = (self.source_from_frame(nodes) + 0.5) * stored_scale - 0.5
        places = np.nan_to_num(places, nan=_OUTSIDE_PX).astype(np.float32).reshape(len(ys), len(xs), 2)
        # Pixel x of the map lies at node x / 8 exactly: a warp, for cv2.resize counts from pixel corners.
        shrink = np.array([[1.0 / _NODE_PX, 0.0, 0.0], [0.0, 1.0 / _NODE_PX, 0.0]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(places, shrink, (width, height), flags=flags))


@dataclass(frozen=True, eq=False)
class Posed:
    """Both sides as seen from above. prior: a shift by whole pixels, and how far off it may be by the standard
    deviations of the poses, at `sigmas` of them.
    """

    side0: Side
    side1: Side
    prior: Prior


def grounded(raster0: Raster, raster1: Raster, geometry: PairGeometry, sigmas: float) -> Posed | None:
    """None where an attitude or the ground is unknown, or an image sees no ground."""
    ground_z = geometry.ground_z_m
    pose0, pose1 = geometry.pose0, geometry.pose1
    if ground_z is None or pose0 is None or pose1 is None:
        return None
    seen0, seen1 = _ground(geometry.camera0, pose0, ground_z), _ground(geometry.camera1, pose1, ground_z)
    if seen0 is None or seen1 is None:
        return None
    gsd_m = max(seen0[1], seen1[1])
    side0, ground0 = _side(raster0, geometry.camera0, pose0, ground_z, seen0, gsd_m)
    side1, ground1 = _side(raster1, geometry.camera1, pose1, ground_z, seen1, gsd_m)
    heights = [float(pose.center_m[2]) - ground_z for pose in (pose0, pose1)]
    turns = [np.deg2rad(pose.sigma_angle_deg) for pose in (pose0, pose1)]
    shifts = [
        np.hypot(pose.sigma_position_m, height * turn) / gsd_m
        for pose, height, turn in zip((pose0, pose1), heights, turns, strict=True)
    ]
    scales = [pose.sigma_position_m / height for pose, height in zip((pose0, pose1), heights, strict=True)]
    prior = Prior(
        np.asarray(np.linalg.inv(ground1) @ ground0),
        sigmas * float(np.hypot(turns[0], turns[1])),
        sigmas * float(np.hypot(scales[0], scales[1])),
        sigmas * float(np.hypot(shifts[0], shifts[1])),
    )
    return Posed(side0, side1, prior)


def _side(
    raster: Raster, camera: Camera, pose: Pose, ground_z_m: float, seen: tuple[FloatArray, float], gsd_m: float
) -> tuple[Side, FloatArray]:
    """A side, and (3, 3) world x, y from its frame: pixel edges lie at multiples of the scale from the origin."""
    polygon, own_gsd_m = seen
    corners = polygon * [1.0, -1.0] / gsd_m
    low, high = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
    world_from_frame = np.array(
        [[gsd_m, 0.0, gsd_m * (low[0] + 0.5)], [0.0, -gsd_m, -gsd_m * (low[1] + 0.5)], [0.0, 0.0, 1.0]]
    )
    undistorted = undistorted_from_ground(camera, pose, ground_z_m) @ world_from_frame
    width, height = (int(side) for side in high - low)
    return Side(raster, width, height, camera, undistorted, gsd_m / own_gsd_m), world_from_frame


def _ground(camera: Camera, pose: Pose | None, ground_z_m: float) -> tuple[FloatArray, float] | None:
    """Polygon (N, 2) on the ground and ground sampling distance of an image."""
    if pose is None or pose.world_rotation is None:
        return None
    height = float(pose.center_m[2]) - ground_z_m
    gsd_m = ground_sampling_distance_m(camera, pose, ground_z_m, _FARTHEST)
    polygon = ground_footprint(camera, pose, ground_z_m, _FARTHEST * height)
    return None if gsd_m is None or len(polygon) < 3 else (polygon, gsd_m)
