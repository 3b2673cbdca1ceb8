"""The source image rotated and tilted: simulated views for images without pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import Camera, FloatArray, Neighbour, Pose, View
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.rotations import rotation_z
from aeromatch_cli.geometry.views import TILT_STEP, tilt_azimuths_rad
from aeromatch_cli.geometry.warps import border_px
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.simulators.none import source_view

_BORDER_POINTS_PER_SIDE = 8


class Tilts(Strategy):
    """Affine views of the whole image as in ASIFT: in-plane rotations, and tilts by sqrt(2)^k with azimuths every 72
    degrees / tilt.

    A tilt shrinks the picture by its factor along one axis, so that its view has that much fewer pixels. Neither pose
    nor ground is used. Meant for `extract.budget: view`: views that share an image's budget find fewer matches than the
    source alone. Source: Morel and Yu, ASIFT, SIAM J. Imaging Sciences 2(2), 2009.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"camera"})
    name: Literal["tilts"] = "tilts"
    levels: int = Field(
        default=1,
        ge=0,
        le=5,
        description="Number of simulated tilts (1.41, 2, 2.83 ...), with 4, 5, 8 ... views of 2.8, 2.5, 2.8 ... image "
        "sizes. Larger: more views, more time.",
    )
    rotations: int = Field(
        default=1,
        ge=1,
        le=12,
        description="Number of in-plane rotations, evenly spaced, the source image being the first. SIFT needs 1, "
        "networks that are not invariant to rotation 4 or more.",
    )
    max_megapixels: float = Field(
        default=32.0,
        gt=0.0,
        description="Largest simulated view, megapixels; a larger one is scaled down. Larger: more detail, more time.",
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
        step_deg = 360.0 / self.rotations
        turned = [self._view(camera, f"turn{turn}", step_deg * turn, 1.0) for turn in range(1, self.rotations)]
        tilted = [
            self._view(camera, f"tilt{level}-{number}", float(np.rad2deg(azimuth_rad)), TILT_STEP**level)
            for level in range(1, self.levels + 1)
            for number, azimuth_rad in enumerate(tilt_azimuths_rad(level))
        ]
        return (source_view(camera), *turned, *tilted)

    def _view(self, camera: Camera, name: str, turn_deg: float, tilt: float) -> View:
        """The whole image turned clockwise by turn_deg, then shrunk by `tilt` along the view's x axis."""
        linear: FloatArray = np.diag([1.0 / tilt, 1.0]) @ rotation_z(turn_deg)[:2, :2]
        border = undistort(camera, border_px(camera, _BORDER_POINTS_PER_SIDE))
        corners = border[np.isfinite(border).all(axis=1)] @ linear.T
        low, high = corners.min(axis=0), corners.max(axis=0)
        scale = min(1.0, float(np.sqrt(self.max_megapixels * 1e6 / (high - low).prod())))
        width, height = (max(1, int(np.floor(side * scale + 1e-6))) for side in high - low)
        undistorted_from_view = np.eye(3)
        undistorted_from_view[:2, :2] = np.linalg.inv(linear * scale)
        # The box's top left corner is that of view pixel (0, 0).
        undistorted_from_view[:2, 2] = np.linalg.inv(linear) @ (low + 0.5 / scale)
        angle_deg = float(np.rad2deg(np.arccos(1.0 / tilt)))
        return View(name, width, height, undistorted_from_view, is_source=False, angle_deg=angle_deg)
