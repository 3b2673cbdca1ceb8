"""AliceVision and Meshroom: cameras.sfm, features and matches.

<viewId>.sift.feat: x y scale orientation; matches.txt: the two view ids, the number of kinds of descriptor, for each
its name and count, and index pairs (src/aliceVision/matching/io.cpp). cameras.sfm: rotations column by column, numbers
as text, the principal point from the middle of the image (version 1.2.1).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from aeromatch_cli.data import Camera
from aeromatch_cli.geometry.cameras import is_fisheye, parameters
from aeromatch_cli.geometry.lenses import in_colmap
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.solution import Solution, held, matched, summary_of, write, write_world

_VERSION = ["1", "2", "1"]


class AliceVision(Strategy):
    """Writes cameras.sfm (views, intrinsics, poses), features/*.sift.feat, matches/0.matches.txt and world.json (CRS
    and origin that poses count from)."""

    version: ClassVar[int] = 5
    name: Literal["alicevision"] = "alicevision"

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written."""
        solution = Solution.of(contents)
        views = {image.image_id: number for number, image in enumerate(solution.images, start=1)}
        with whole_folder(folder) as partial:
            write_world(partial, contents.block)
            found = matched(contents)
            keypoints = 0
            for image_id, view in views.items():
                places = np.asarray(contents.keypoints_px(image_id), np.float64).reshape(-1, 2)
                keypoints += len(places)
                write(partial / "features" / f"{view}.sift.feat", "".join(f"{x:.4f} {y:.4f} 1 0\n" for x, y in places))
            blocks = (
                f"{views[id0]} {views[id1]}\n1\nsift {len(rows)}\n" + "".join(f"{i} {j}\n" for i, j in rows)
                for id0, id1, rows in found.pairs
            )
            write(partial / "matches" / "0.matches.txt", "".join(blocks))
            cameras, remarks = held(solution, "AliceVision", in_colmap)  # it has no b2 either
            write(partial / "cameras.sfm", json.dumps(_sfm(solution, cameras, views), indent=1))
            return summary_of(folder, partial, contents, len(solution.poses), keypoints, found.counts, remarks)


def _sfm(solution: Solution, cameras: Mapping[str, Camera], views: dict[str, int]) -> dict[str, Any]:
    numbers = {camera_id: str(number) for number, camera_id in enumerate(sorted(solution.cameras), start=1)}
    poses = []
    for image_id, (rotation, center_m) in solution.poses.items():
        transform = {"rotation": _texts(rotation.T), "center": _texts(center_m)}
        poses.append({"poseId": str(views[image_id]), "pose": {"transform": transform, "locked": "0"}})
    return {
        "version": _VERSION,
        "featuresFolders": ["features"],
        "matchesFolders": ["matches"],
        "views": [
            {
                "viewId": str(views[image.image_id]), "poseId": str(views[image.image_id]),
                "intrinsicId": numbers[image.camera_id], "path": image.name, "width": str(image.width_px),
                "height": str(image.height_px),
            }
            for image in solution.images
        ],
        "intrinsics": [
            {"intrinsicId": number, **_intrinsic(cameras[camera_id])} for camera_id, number in numbers.items()
        ],
        "poses": poses,
    }  # fmt: skip


def _intrinsic(camera: Camera) -> dict[str, Any]:
    """Brown's model, or OpenCV's fisheye, with focal lengths in pixels; the sensor counts as 36 mm wide."""
    values, sensor_mm = parameters(camera), 36.0
    focal_px = _texts([values["fx"], values["fy"]])
    # AliceVision adds half the size to it, in the frame of the features.
    middle = camera.width_px / 2.0, camera.height_px / 2.0
    kind, names = ("fisheye4", ("k1", "k2", "k3", "k4")) if is_fisheye(camera) else (
        "brown", ("k1", "k2", "k3", "p1", "p2"))  # fmt: skip
    return {
        "width": str(camera.width_px), "height": str(camera.height_px), "sensorWidth": f"{sensor_mm}",
        "sensorHeight": f"{sensor_mm * camera.height_px / camera.width_px:.15g}", "type": kind,
        "serialNumber": "", "initializationMode": "calibrated", "pxInitialFocalLength": focal_px[0],
        "pxFocalLength": focal_px, "principalPoint": _texts([values["cx"] - middle[0], values["cy"] - middle[1]]),
        "distortionParams": _texts([values[name] for name in names]), "locked": "0",
    }  # fmt: skip


def _texts(values: Any) -> list[str]:
    return [f"{value:.15g}" for value in np.asarray(values, np.float64).ravel()]
