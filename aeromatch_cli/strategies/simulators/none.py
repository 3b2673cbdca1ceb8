"""No simulation: features are found in the image as it was taken."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from aeromatch_cli.data import Camera, Pose, View
from aeromatch_cli.strategies import Strategy


def source_view(camera: Camera) -> View:
    """The stored raster as a view. Its pixels are the stored, distorted pixels; the identity stands for no warp."""
    return View("source", camera.width_px, camera.height_px, np.eye(3), is_source=True, angle_deg=0.0)


class SourceOnly(Strategy):
    """One view: the source image."""

    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    name: Literal["none"] = "none"

    def __call__(
        self, camera: Camera, pose: Pose | None, ground_z_m: float | None, gsd_m: float | None
    ) -> tuple[View, ...]:
        """Views of one image; see the family's table for the contract."""
        return (source_view(camera),)
