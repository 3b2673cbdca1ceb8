"""The ground seen straight from above, north up, at the block's common scale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

from aeromatch_cli.data import Camera, Neighbour, Pose, View
from aeromatch_cli.geometry.views import direction_of
from aeromatch_cli.strategies.simulators.none import source_view
from aeromatch_cli.strategies.simulators.plane import PlaneViews


class GroundView(PlaneViews):
    """A north-up nadir view of the ground plane by plane-induced homography (Hartley and Zisserman, section 13.1).

    Rotation, scale and perspective between overlapping images vanish for flat ground. View pixel (0, 0) is the centre
    of the top-left pixel, x runs east and y south along the grid. The view's box encloses the footprint cut at
    max_distance_factor flying heights and, in oblique images, at the depth from where on the view would enlarge the
    source more than max_stretch times (square root of area). Its scale is the common ground sampling distance, made
    coarser where the image itself is coarser (max_magnification) and where the box would exceed max_megapixels. Ground
    beyond the box is view 0, as the image shows it, where there is enough of it (far_ground).

    Without attitude, ground or common ground sampling distance, or where no ground is seen: the source view alone.
    """

    version: ClassVar[int] = 2
    needs: ClassVar[frozenset[str]] = frozenset({"camera", "pose", "ground"})
    name: Literal["ground"] = "ground"

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
        if ground is None:
            return (source,)
        view = self.plane_view(ground, ground.polygon_m, direction_of(0, 0.0), self.name)
        if view is None:
            return (source,)
        return (source, view) if self.keep_source else (*self.far_view(camera, ground), view)
