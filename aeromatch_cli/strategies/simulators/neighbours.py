"""The ground as the neighbours see it: straight from above and, where that blurs it, along their common directions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import Camera, FloatArray, Neighbour, Pose, View
from aeromatch_cli.geometry.footprints import polygon_area_m2, polygon_centroid_m
from aeromatch_cli.geometry.views import (
    common_stretch,
    direction_of,
    intersection,
    nearest_sample,
    tilt_azimuths_rad,
)
from aeromatch_cli.strategies.simulators.none import source_view
from aeromatch_cli.strategies.simulators.plane import GroundPlane, PlaneViews

# Points along each side of a footprint that overlaps are made of: within the margin, and quick with many neighbours.
_PER_SIDE = 2


class NeighbourViews(PlaneViews):
    """The north-up ground view of what neighbours see too, and views along common directions where the ground is
    stretched.

    The ground view serves every neighbour. Where an image and a neighbour together resolve the ground min_stretch times
    more coarsely along one axis than across (`geometry.views.common_stretch`, at the middle of their overlap), both
    also make the view along the direction that evens this out. Directions are clustered by rounding to a set that is
    fixed to the world, so that two images make the same views without knowing of each other's other neighbours; those
    that serve most overlap come first. Opposite directions share a view, crossed ones are served by the ground view.

    A budget per image is spent best on the ground view, whatever the tilt: correct matches grow faster than the
    descriptors of a view, so that a view which shares them loses more than it finds (a quarter of the matches at 2048,
    measured up to 70 degrees). By default, therefore, only neighbours that hardly see the ground get one. With a budget
    per view min_stretch = 1.2 finds 1.5 to 2 times the matches, for 2.5 to 4 times the descriptors.

    Without attitude, ground or common ground sampling distance, or where no ground is seen: the source view alone.
    Tilts are no substitute there: the other images of the block have no such views to compare them with.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"camera", "pose", "ground", "neighbours"})
    name: Literal["neighbours"] = "neighbours"
    max_views: int = Field(
        default=4,
        ge=1,
        description="Largest number of views per image, the ground view included. Larger: the budget is shared by "
        "more views.",
    )
    min_stretch: float = Field(
        default=4.0,
        gt=1.0,
        description="Smallest stretch of the ground between an image and a neighbour for which a view along their "
        "common direction is added. Larger: fewer added views.",
    )
    margin: float = Field(
        default=0.1,
        ge=0.0,
        description="Margin of a view around the overlap with neighbours, in flying heights. Larger: allows for less "
        "accurate poses, more pixels.",
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
        ground = self.ground_plane(camera, pose, ground_z_m, gsd_m)
        if ground is None or pose is None or ground_z_m is None or gsd_m is None:
            return (source,)
        own = Neighbour(camera, pose, 1.0, ground_z_m)
        wanted = [self._wanted(ground, own, other, gsd_m) for other in neighbours]
        shared = [item for item in wanted if item is not None]
        served = np.concatenate([item.polygon_m for item in shared]) if shared else ground.polygon_m
        down = direction_of(0, 0.0)
        # A sliver of overlap is no reason to fall back to the source.
        views = [
            self.plane_view(ground, served, down, "ground") or self.plane_view(ground, ground.polygon_m, down, "ground")
        ]
        views += [self._tilted(ground, shared, sample) for sample in self._ranked(shared)]
        made = tuple(view for view in views if view is not None)
        if not made:
            return (source,)
        return (source, *made) if self.keep_source else (*self.far_view(camera, ground), *made)

    def _wanted(self, ground: GroundPlane, own: Neighbour, other: Neighbour, gsd_m: float) -> _Wanted | None:
        """What one neighbour asks for, None where both share no ground."""
        heights = [item.ground_z_m for item in (own, other) if item.ground_z_m is not None]
        # One plane and both grounds cut by the same rules: the pair's direction is the same from either side.
        plane_m = sum(heights) / len(heights)
        seen, theirs = (self.ground_plane(item.camera, item.pose, plane_m, gsd_m, _PER_SIDE) for item in (own, other))
        if seen is None or theirs is None:
            return None
        overlap = intersection(seen.polygon_m, theirs.polygon_m)
        if not len(overlap):
            return None
        middle = np.append(polygon_centroid_m(overlap), plane_m)
        stretch, azimuth_rad = common_stretch(middle - own.pose.center_m, middle - other.pose.center_m)
        sample = nearest_sample(stretch, azimuth_rad) if stretch >= self.min_stretch else (0, 0)
        polygon = intersection(ground.polygon_m, theirs.polygon_m, self.margin * ground.flying_height_m)
        return _Wanted(polygon, polygon_area_m2(overlap), sample)

    def _tilted(self, ground: GroundPlane, shared: Sequence[_Wanted], sample: tuple[int, int]) -> View | None:
        """Return the view along the direction of a sample of the ground that it serves; None where it shows none."""
        level, azimuth = sample
        polygon = np.concatenate([item.polygon_m for item in shared if item.sample == sample])
        azimuth_rad = float(tilt_azimuths_rad(level)[azimuth])
        direction = direction_of(level, azimuth_rad)
        tilt_deg = np.rad2deg(np.arccos(-direction[2]))
        name = f"tilt{tilt_deg:.0f}-azimuth{np.rad2deg(azimuth_rad):.0f}"
        return self.plane_view(ground, polygon, direction, name)

    def _ranked(self, wanted: Sequence[_Wanted]) -> list[tuple[int, int]]:
        """Samples besides the ground view's, those that serve most overlap first, as many as there may be."""
        samples = {item.sample for item in wanted} - {(0, 0)}
        # Sums that do not depend on the order of the neighbours.
        served = {s: math.fsum(item.area_m2 for item in wanted if item.sample == s) for s in samples}
        return sorted(samples, key=lambda sample: (-served[sample], sample))[: self.max_views - 1]


@dataclass(frozen=True, eq=False)
class _Wanted:
    """polygon_m: (N, 2) the ground shared with a neighbour, with margin. sample: level and azimuth of its direction."""

    polygon_m: FloatArray
    area_m2: float
    sample: tuple[int, int]
