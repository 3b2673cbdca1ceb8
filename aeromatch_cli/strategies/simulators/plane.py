"""What the strategies that look at the ground plane share: how much ground an image offers, and one view of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from aeromatch_cli.data import Camera, FloatArray, Pose, View
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.footprints import (
    MAX_DISTANCE_FACTOR,
    clip_half_plane,
    ground_footprint,
    ground_sampling_distance_m,
)
from aeromatch_cli.geometry.views import direction_of, view_from_ground
from aeromatch_cli.geometry.warps import border_px, ground_beyond, undistorted_from_ground
from aeromatch_cli.strategies import Strategy

# A smaller view holds no feature worth the name; the source is used instead.
_SMALLEST_VIEW_PX = 32
# Of a pixel: a box whose side falls on a pixel's edge up to rounding keeps that pixel.
_ROUNDING_PX = 1e-6
# Distant ground is looked at by itself where it fills this share of an image, counted on so many places a side.
_LEAST_FAR, _FAR_SAMPLES = 0.05, 40
# OpenCV warps no longer ones.
_LONGEST_VIEW_PX = 32_766


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """The ground that one image offers to views.

    polygon_m: (N, 2) world x, y. undistorted_from_world: (3, 3) as in `geometry.warps.undistorted_from_ground`.
    axis: (3,) the optical axis. gsd_m: scale of the views. flying_height_m: above the plane.
    """

    polygon_m: FloatArray
    undistorted_from_world: FloatArray
    axis: FloatArray
    gsd_m: float
    flying_height_m: float


class PlaneViews(Strategy):
    """Settings of views of the ground plane, and how one is made."""

    name: str  # a strategy's own, first in every listing
    keep_source: bool = Field(default=False, description="Also use the source image, as view 0.")
    max_megapixels: float = Field(
        default=32.0,
        gt=0.0,
        description="Largest view, megapixels; a larger one is scaled down. Larger: more detail, more time and memory.",
    )
    max_distance_factor: float = Field(
        default=MAX_DISTANCE_FACTOR,
        gt=0.0,
        description="Ground farther away than this many flying heights is left out of the ground view (but see "
        "far_ground). Larger: more distant ground.",
    )
    max_magnification: float = Field(
        default=1.0,
        gt=0.0,
        le=2.0,
        description="Largest magnification of a view against the middle of the source image. Larger: finer views than "
        "the image itself, more time.",
    )
    max_stretch: float = Field(
        default=3.0,
        gt=1.0,
        description="Largest magnification of distant ground; ground that would be stretched more is left out of the "
        "ground view (but see far_ground). Larger: more distant, more blurred ground.",
    )
    far_ground: bool = Field(
        default=True,
        description="Look at distant ground that the ground view leaves out as the image shows it, where that is 5 % "
        "of the image or more. It gets keypoints of its own, as many for each pixel as the rest of the image.",
    )

    def ground_plane(
        self, camera: Camera, pose: Pose | None, ground_z_m: float | None, gsd_m: float | None, per_side: int = 8
    ) -> GroundPlane | None:
        """The ground that an image offers, or None where something is unknown or no ground is seen.

        per_side: points along each side of the image that the polygon is made of.
        """
        if pose is None or pose.world_rotation is None or ground_z_m is None or gsd_m is None:
            return None
        own_gsd = ground_sampling_distance_m(camera, pose, ground_z_m, self.max_distance_factor)
        if own_gsd is None:
            return None
        scale_m = max(gsd_m, own_gsd / self.max_magnification)
        undistorted_from_world = undistorted_from_ground(camera, pose, ground_z_m)
        height_m = float(pose.center_m[2]) - ground_z_m
        polygon = ground_footprint(camera, pose, ground_z_m, self.max_distance_factor * height_m, per_side)
        polygon = _clip_depth(polygon, undistorted_from_world, scale_m * self.max_stretch)
        if len(polygon) < 3:
            return None
        return GroundPlane(polygon, undistorted_from_world, np.array(pose.world_rotation[2]), scale_m, height_m)

    def far_view(self, camera: Camera, ground: GroundPlane) -> tuple[View, ...]:
        """The part of the undistorted image that shows more distant ground than views do, where there is enough.

        Ground that no neighbour shares counts as shown.
        """
        near = self.plane_view(ground, ground.polygon_m, direction_of(0, 0.0), "near") if self.far_ground else None
        if near is None:
            return ()
        steps = np.array([camera.width_px, camera.height_px]) / _FAR_SAMPLES
        columns, rows = (np.arange(_FAR_SAMPLES) + 0.5) * steps[:, None]
        places = undistort(camera, np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2))
        far = places[ground_beyond(near, places)]
        if len(far) < _LEAST_FAR * len(places):
            return ()
        outline = undistort(camera, border_px(camera, _FAR_SAMPLES))
        low = np.floor(np.maximum(far.min(axis=0) - steps, np.nanmin(outline, axis=0)) + 0.5)
        high = np.ceil(np.minimum(far.max(axis=0) + steps, np.nanmax(outline, axis=0)) - 0.5)
        sides = high - low + 1.0
        scale = max(1.0, float(np.sqrt(sides.prod() / (self.max_megapixels * 1e6))), sides.max() / _LONGEST_VIEW_PX)
        width, height = (int(side / scale) for side in sides)
        if min(width, height) < _SMALLEST_VIEW_PX:
            return ()
        part = np.diag([scale, scale, 1.0])
        part[:2, 2] = low + 0.5 * (scale - 1.0)
        return (View("far", width, height, part, is_source=False, angle_deg=0.0, world_direction=ground.axis,
                     beyond=near),)  # fmt: skip

    def plane_view(self, ground: GroundPlane, polygon_m: FloatArray, direction: FloatArray, name: str) -> View | None:
        """The parallel view along a downward unit `direction` of the box around polygon_m, or None if that is small.

        A ground point's pixel follows from the direction and the scale alone, up to whole pixels: pixel edges lie at
        multiples of the scale from the world's origin.
        """
        if len(polygon_m) < 3:
            return None
        shrunk = view_from_ground(direction)
        corners = polygon_m @ shrunk.T
        low, high = corners.min(axis=0), corners.max(axis=0)
        scale_m = max(ground.gsd_m, float(np.sqrt((high - low).prod() / (self.max_megapixels * 1e6))))
        # Whole pixels within the box: less than one is lost at each edge, and the bound holds.
        first, last = np.ceil(low / scale_m - _ROUNDING_PX), np.floor(high / scale_m + _ROUNDING_PX)
        width, height = (int(side) for side in last - first)
        if min(width, height) < _SMALLEST_VIEW_PX:
            return None
        world_from_view = np.eye(3)
        world_from_view[:2, :2] = np.linalg.inv(shrunk) * scale_m
        world_from_view[:2, 2] = world_from_view[:2, :2] @ (first + 0.5)
        return View(
            name=name,
            width_px=width,
            height_px=height,
            # The third homogeneous coordinate is the depth in metres: positive exactly for ground before the camera.
            undistorted_from_view=ground.undistorted_from_world @ world_from_view,
            is_source=False,
            angle_deg=float(np.rad2deg(np.arccos(np.clip(ground.axis @ direction, -1.0, 1.0)))),
            world_direction=direction,
            gsd_m=scale_m,
            north_up=True,
            ground_from_view=world_from_view,
        )


def _clip_depth(polygon_m: FloatArray, undistorted_from_world: FloatArray, coarsest_m: float) -> FloatArray:
    """The part of a ground polygon (N, 2) where a source pixel covers at most coarsest_m squared of ground.

    A square metre of ground covers det(H) / depth^3 square pixels, H being undistorted_from_world and depth its third
    homogeneous coordinate: a bound on the scale is a bound on the depth, which is a straight line on the ground.
    """
    if len(polygon_m) < 3:
        return polygon_m
    largest_depth = np.cbrt(abs(float(np.linalg.det(undistorted_from_world))) * coarsest_m**2)
    depth = polygon_m @ undistorted_from_world[2, :2] + undistorted_from_world[2, 2]
    return clip_half_plane(polygon_m, depth - largest_depth)
