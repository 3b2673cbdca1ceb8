"""Bundler: bundle.out and list.txt, which Metashape and many others import with tie points.

x right, y up, looking along -z; pixels from the middle of the image, y upwards; one focal length, distortion by k1 and
k2. A principal point beside the middle, further radial terms, tangential distortion and affinity have no place there:
the nearest camera is written.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from aeromatch_cli.data import Camera, FloatArray
from aeromatch_cli.geometry.cameras import parameters
from aeromatch_cli.geometry.frames import CAM_FROM_PHOTO
from aeromatch_cli.geometry.lenses import nearest_of
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.solution import (
    Matched,
    Solution,
    held,
    keypoints_of,
    matched,
    summary_of,
    write,
    write_world,
)

_GREY = "128 128 128"


class Bundler(Strategy):
    """Writes bundle.out (cameras, points of the adjusted block with their measurements), list.txt and world.json;
    coordinates are those of the block's world, the CRS less the origin that world.json names."""

    version: ClassVar[int] = 6
    name: Literal["bundler"] = "bundler"

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written."""
        solution = Solution.of(contents)
        with whole_folder(folder) as partial:
            write_world(partial, contents.block)
            found = matched(contents, adjusted_tracks=True)
            keypoints = keypoints_of(contents)
            write(partial / "list.txt", "".join(f"{image.name}\n" for image in solution.images))
            points = _points(found, solution, keypoints)
            lenses, remarks = held(solution, "Bundler", lambda camera: nearest_of(camera, ("f", "k1", "k2")))
            cameras = [_camera(solution, lenses, number) for number in range(len(solution.images))]
            head = f"# Bundle file v0.3\n{len(cameras)} {len(points)}\n"
            write(partial / "bundle.out", head + "".join(cameras) + "".join(points))
            count = sum(map(len, keypoints.values()))
            return summary_of(folder, partial, contents, len(solution.poses), count, found.counts, remarks)


def _camera(solution: Solution, lenses: Mapping[str, Camera], number: int) -> str:
    """Five lines; zeros for an image without pose."""
    image = solution.images[number]
    if image.image_id not in solution.poses:
        return "0 0 0\n" * 5
    rotation, center_m = solution.poses[image.image_id]
    values = parameters(lenses[image.camera_id])
    bundler = CAM_FROM_PHOTO @ rotation
    rows = [(values["fx"], values["k1"], values["k2"]), *bundler, -bundler @ center_m]
    return "".join(" ".join(f"{value:.15g}" for value in row) + "\n" for row in rows)


def _points(found: Matched, solution: Solution, keypoints: Mapping[str, FloatArray]) -> list[str]:
    """Those whose place is known."""
    starts, lines = found.starts, []
    for number, point in enumerate(found.points_m):
        own = range(starts[number], starts[number + 1])
        if not np.isfinite(point).all() or not own:
            continue
        seen = []
        for row in own:
            image = solution.images[found.image_idx[row]]
            x, y = keypoints[image.image_id][found.keypoint[row]]
            seen.append(
                f"{found.image_idx[row]} {found.keypoint[row]} {x + 0.5 - image.width_px / 2.0:.6f} "
                f"{image.height_px / 2.0 - y - 0.5:.6f}"
            )
        place = " ".join(f"{value:.9f}" for value in point)
        lines.append(f"{place}\n{_GREY}\n{len(seen)} {' '.join(seen)}\n")
    return lines
