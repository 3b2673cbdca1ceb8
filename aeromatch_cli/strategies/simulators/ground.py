"""The ground seen straight from above, north up, at the block's common scale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import Camera, FloatArray, Neighbour, Pose, View
from aeromatch_cli.geometry.footprints import (
    MAX_DISTANCE_FACTOR,
    clip_half_plane,
    ground_footprint,
    ground_sampling_distance_m,
)
from aeromatch_cli.geometry.rotations import tilt_deg
from aeromatch_cli.geometry.warps import undistorted_from_ground
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.simulators.none import source_view

# A smaller view holds no feature worth the name; the source is used instead.
_SMALLEST_VIEW_PX = 32


class GroundView(Strategy):
    """A north-up nadir view of the ground plane by plane-induced homography (H&Z section 13.1).

    Rotation, scale and perspective between overlapping images vanish for flat ground. View pixel (0, 0) is the centre
    of the top-left pixel, x runs east and y south along the grid. The view's box encloses the footprint cut at
    max_distance_factor flying heights and, in oblique images, at the depth from where on the view would enlarge the
    source more than max_stretch times (square root of area). Its scale is the common ground sampling distance, made
    coarser where the image itself is coarser (max_magnification) and where the box would exceed max_megapixels.

    Without attitude, ground or common ground sampling distance, or where no ground is seen: the source view alone.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"camera", "pose", "ground"})
    name: Literal["ground"] = "ground"
    source: bool = Field(default=False, description="Also use the source image, as view 0.")
    max_megapixels: float = Field(
        default=32.0, gt=0.0, description="Largest view; one that would be larger is scaled down to this."
    )
    max_distance_factor: float = Field(
        default=MAX_DISTANCE_FACTOR,
        gt=0.0,
        description="Ground farther away than this many flying heights is left out.",
    )
    max_magnification: float = Field(
        default=1.0,
        gt=0.0,
        le=2.0,
        description="The view is never finer than the middle of the image by more than this.",
    )
    max_stretch: float = Field(
        default=3.0, gt=1.0, description="Far ground that the view would enlarge more than this is left out."
    )

    def __call__(
        self,
        camera: Camera,
        pose: Pose | None,
        ground_z_m: float | None,
        gsd_m: float | None,
        neighbours: Sequence[Neighbour] = (),
    ) -> tuple[View, ...]:
        """Views of one image; see the family's table for the contract."""
        source = source_view(camera, pose)
        if pose is None or ground_z_m is None or gsd_m is None:
            return (source,)
        ground = self._ground_view(camera, pose, ground_z_m, gsd_m)
        if ground is None:
            return (source,)
        return (source, ground) if self.source else (ground,)

    def _ground_view(self, camera: Camera, pose: Pose, ground_z_m: float, gsd_m: float) -> View | None:
        own_gsd = ground_sampling_distance_m(camera, pose, ground_z_m, self.max_distance_factor)
        if pose.world_rotation is None or own_gsd is None:
            return None
        scale_m = max(gsd_m, own_gsd / self.max_magnification)
        undistorted_from_world = undistorted_from_ground(camera, pose, ground_z_m)
        max_distance = self.max_distance_factor * (float(pose.center_m[2]) - ground_z_m)
        polygon = ground_footprint(camera, pose, ground_z_m, max_distance)
        polygon = _clip_depth(polygon, undistorted_from_world, scale_m * self.max_stretch)
        if len(polygon) < 3:
            return None
        low, high = polygon.min(axis=0), polygon.max(axis=0)
        extent = high - low
        scale_m = max(scale_m, float(np.sqrt(extent.prod() / (self.max_megapixels * 1e6))))
        # Whole pixels within the box: less than one is lost at the east and south edges, and the bound holds.
        width, height = (max(int(np.floor(side / scale_m)), 1) for side in extent)
        if min(width, height) < _SMALLEST_VIEW_PX:
            return None
        world_from_view = np.array(
            [
                [scale_m, 0.0, low[0] + 0.5 * scale_m],
                [0.0, -scale_m, high[1] - 0.5 * scale_m],
                [0.0, 0.0, 1.0],
            ]
        )
        # The third homogeneous coordinate is the depth in metres: positive exactly for ground before the camera.
        undistorted_from_view = undistorted_from_world @ world_from_view
        return View(
            name="ground",
            width_px=width,
            height_px=height,
            undistorted_from_view=undistorted_from_view,
            is_source=False,
            angle_deg=tilt_deg(pose.world_rotation),
            world_direction=np.array([0.0, 0.0, -1.0]),
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
