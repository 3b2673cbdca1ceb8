"""No simulation: features are found in the image as it was taken."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np

from aeromatch_cli.data import Camera, Neighbour, Pose, View
from aeromatch_cli.strategies import Strategy


def source_view(camera: Camera, pose: Pose | None = None) -> View:
    """The stored raster as a view. Its pixels are the stored, distorted pixels; the identity stands for no warp."""
    axis = None if pose is None or pose.world_rotation is None else np.array(pose.world_rotation[2])
    return View("source", camera.width_px, camera.height_px, np.eye(3), True, angle_deg=0.0, world_direction=axis)


class SourceOnly(Strategy):
    """One view: the source image."""

    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    name: Literal["none"] = "none"

    def __call__(
        self,
        camera: Camera,
        pose: Pose | None,
        ground_z_m: float | None,
        gsd_m: float | None,
        neighbours: Sequence[Neighbour] = (),
    ) -> tuple[View, ...]:
        """Views of one image; see the family's table for the contract."""
        return (source_view(camera),)
