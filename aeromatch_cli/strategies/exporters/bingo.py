"""BINGO and PATB: image points, one block of lines for every photo.

`photo focal` in millimetres, then `point x y` in millimetres from the principal point with x to the right and y up,
free of distortion; -99 ends a photo. photos.txt has the number and name of each photo, camera.txt what millimetres
stand for, exterior.txt `photo x y z omega phi kappa` with angles in gon (400 to the circle) and coordinates of the CRS.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.cameras import focal_px, normalise, parameters
from aeromatch_cli.geometry.rotations import to_omega_phi_kappa
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.solution import Solution, matched, rows_of_images, summary_of, write

_MM_PER_UM = 1e-3
_END = "-99\n"
_DEG_PER_GON = 0.9


class Bingo(Strategy):
    """Writes image.txt (image points of BINGO and PATB), exterior.txt (positions and angles in gon), photos.txt (their
    numbers) and camera.txt."""

    version: ClassVar[int] = 4
    name: Literal["bingo"] = "bingo"
    pixel_um: float = Field(
        4.0, gt=0.0, description="Size of a pixel on the sensor, micrometres; it sets the scale of all millimetres."
    )

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written."""
        solution = Solution.of(contents)
        mm = self.pixel_um * _MM_PER_UM
        with whole_folder(folder) as partial:
            found = matched(contents, adjusted_tracks=True)
            rows = rows_of_images(found.image_idx, len(solution.images))
            lines, names, keypoints = [], [], 0
            for number, image in enumerate(solution.images, start=1):
                camera = solution.camera(image)
                places = np.asarray(contents.keypoints_px(image.image_id), np.float64).reshape(-1, 2)
                keypoints += len(places)
                own = rows[number - 1]
                rays = normalise(camera, places[found.keypoint[own]])
                names.append(f"{number} {image.name}\n")
                lines.append(f"{number} {focal_px(camera) * mm:.5f}\n")
                # As a camera of one focal length, without distortion and skew, would have them; y upwards.
                measured = rays * focal_px(camera) * mm * [1.0, -1.0]
                for track, (x, y) in zip(found.track[own], measured, strict=True):
                    if not np.isfinite(x + y):  # no ray of the lens has that pixel
                        continue
                    lines.append(f"{track + 1} {x:.6f} {y:.6f}\n")
                lines.append(_END)
            write(partial / "image.txt", "".join(lines))
            write(partial / "exterior.txt", "".join(_exterior(solution, np.array(contents.block.origin_m))))
            write(partial / "photos.txt", "".join(names))
            write(partial / "camera.txt", "".join(self._camera_lines(solution, mm)))
            return summary_of(folder, partial, contents, len(solution.poses), keypoints, found.counts)

    def _camera_lines(self, solution: Solution, mm: float) -> list[str]:
        lines = [f"pixel {self.pixel_um} um; millimetres count from the principal point, x right, y up\n"]
        for camera_id, camera in sorted(solution.cameras.items()):
            values = parameters(camera)
            lines.append(
                f"{camera_id}: focal length {focal_px(camera) * mm:.5f} mm, principal point {values['cx']:.3f} "
                f"{values['cy']:.3f} px from the middle of the first pixel\n"
            )
        return lines


def _exterior(solution: Solution, origin_m: FloatArray) -> Iterator[str]:
    """A line for every image with an attitude."""
    for number, image in enumerate(solution.images, start=1):
        if image.image_id in solution.poses:
            rotation, center_m = solution.poses[image.image_id]
            place = " ".join(f"{value:.4f}" for value in center_m + origin_m)
            angles = " ".join(f"{value / _DEG_PER_GON:.6f}" for value in to_omega_phi_kappa(rotation))
            yield f"{number} {place} {angles}\n"
