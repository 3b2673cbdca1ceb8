"""openMVG and, with the same kinds of file, AliceVision: sfm_data.json, features, matches.

Text: `<image>.feat` x y scale orientation; `matches.f.txt` with I J, the number of matches, and index pairs
(src/openMVG/matching/indMatch_utils.cpp). Rotations are cam_from_world, pixels count from the middle of the first one.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar, Literal

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Image
from aeromatch_cli.geometry.cameras import BROWN, MODELS, is_fisheye, parameters, pixels_of_rays
from aeromatch_cli.geometry.lenses import Nearest, fitted, nearest_of
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.solution import (
    Solution,
    called,
    held,
    matched,
    summary_of,
    write,
    write_world,
)

# cereal's marks: a plain view, a new object, a new kind of object.
_PLAIN, _NEW, _NEW_KIND = 1073741824, 2147483648, 2147483649
_SCALE = "1 0"


class OpenMvg(Strategy):
    """Writes sfm_data.json (views, intrinsics, poses), matches/ (features, matches.f.txt, image_describer.json) and
    world.json (CRS and origin that poses count from). It has one focal length and no skew: other cameras are written as
    the nearest ones."""

    version: ClassVar[int] = 5
    name: Literal["openmvg"] = "openmvg"

    def check_images(self, images: Sequence[Image]) -> None:
        """Raises ConfigError where two images have one name without suffix."""
        self._called(images)

    def _called(self, images: Sequence[Image]) -> dict[str, str]:
        how = "openMVG names features by file names without suffix"
        return called(images, lambda name: PurePosixPath(name).stem, self.name, how)

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written, ConfigError as `check_images`."""
        solution = Solution.of(contents)
        stems = self._called(solution.images)
        numbers = {image.image_id: number for number, image in enumerate(solution.images)}
        with whole_folder(folder) as partial:
            write_world(partial, contents.block)
            found = matched(contents)
            keypoints = 0
            for image in solution.images:
                places = np.asarray(contents.keypoints_px(image.image_id), np.float64).reshape(-1, 2)
                keypoints += len(places)
                lines = "".join(f"{x:.4f} {y:.4f} {_SCALE}\n" for x, y in places)
                write(partial / "matches" / f"{stems[image.image_id]}.feat", lines)
            blocks = (
                f"{numbers[id0]} {numbers[id1]}\n{len(rows)}\n" + "".join(f"{i} {j}\n" for i, j in rows)
                for id0, id1, rows in found.pairs
            )
            write(partial / "matches" / "matches.f.txt", "".join(blocks))
            write(
                partial / "matches" / "image_describer.json",
                json.dumps({"regions_type": _kind("SIFT_Regions", {"value0": [], "value1": []})}, indent=1),
            )
            cameras, remarks = held(solution, "openMVG", _nearest)
            write(partial / "sfm_data.json", json.dumps(_sfm_data(solution, cameras), indent=1))
            return summary_of(folder, partial, contents, len(solution.poses), keypoints, found.counts, remarks)


def _kind(name: str, data: dict[str, Any]) -> dict[str, Any]:
    return {"polymorphic_id": _NEW_KIND, "polymorphic_name": name, "ptr_wrapper": {"valid": 1, "data": data}}


def _nearest(camera: Camera) -> Nearest:
    """openMVG's fisheye has four terms, its other models three radial and two tangential ones."""
    if not is_fisheye(camera):
        return nearest_of(camera, [name for name in MODELS[BROWN] if name not in ("b1", "b2")])
    p = parameters(camera)
    if p["fx"] == p["fy"]:
        return Nearest(camera)

    def formula(values: FloatArray, rays: FloatArray) -> FloatArray:
        return pixels_of_rays(replace(camera, params=(values[0], *map(float, values))), rays)

    start = np.array(camera.params[1:])
    scale = np.where(np.arange(len(start)) < 3, float(camera.width_px), 1.0)
    values, whole_px, worst_px = fitted(formula, start, scale, camera)
    return Nearest(replace(camera, params=tuple(map(float, (values[0], *values)))), whole_px, worst_px)


def _sfm_data(solution: Solution, held_cameras: Mapping[str, Camera]) -> dict[str, Any]:
    cameras = {camera_id: number for number, camera_id in enumerate(sorted(solution.cameras))}
    views, poses = [], []
    for number, image in enumerate(solution.images):
        posed, path = image.image_id in solution.poses, PurePosixPath(image.name)
        data = {
            "local_path": str(path.parent).removeprefix("."), "filename": path.name,
            "width": image.width_px, "height": image.height_px, "id_view": number,
            "id_intrinsic": cameras[image.camera_id], "id_pose": number,
        }  # fmt: skip
        views.append(
            {"key": number, "value": {"polymorphic_id": _PLAIN, "ptr_wrapper": {"id": _NEW + number + 1, "data": data}}}
        )
        if posed:
            rotation, center_m = solution.poses[image.image_id]
            poses.append({"key": number, "value": {"rotation": rotation.tolist(), "center": center_m.tolist()}})
    intrinsics = [
        {"key": number, "value": value}
        for number, value in enumerate(_intrinsics([held_cameras[camera_id] for camera_id in cameras], len(views)))
    ]
    return {
        "sfm_data_version": "0.3", "root_path": "images", "views": views, "intrinsics": intrinsics, "extrinsics": poses,
        "structure": [], "control_points": [],
    }  # fmt: skip


def _intrinsics(cameras: Sequence[Camera], objects: int) -> Iterator[dict[str, Any]]:
    """Radial cameras where nothing is tangential, as every version reads them, else Brown's model, or a fisheye. The
    name of a kind stands at its first camera alone, as cereal writes it. objects: that are numbered already."""
    kinds: dict[str, int] = {}
    for number, camera in enumerate(cameras, start=objects + 1):
        values = parameters(camera)
        radial = [values["k1"], values["k2"], values["k3"]]
        tangential = [values["p1"], values["p2"]]
        kind, lens = ("pinhole_brown_t2", {"disto_t2": radial + tangential}) if any(tangential) else (
            "pinhole_radial_k3", {"disto_k3": radial})  # fmt: skip
        if is_fisheye(camera):
            kind, lens = "fisheye", {"fisheye": [*radial, values["k4"]]}
        mark: dict[str, Any] = {"polymorphic_id": kinds.get(kind)}
        if kind not in kinds:
            kinds[kind] = len(kinds) + 1
            mark = {"polymorphic_id": _NEW + kinds[kind], "polymorphic_name": kind}
        data = {
            "width": camera.width_px, "height": camera.height_px, "focal_length": values["fx"],
            "principal_point": [values["cx"], values["cy"]], **lens,
        }  # fmt: skip
        yield {**mark, "ptr_wrapper": {"id": _NEW + number, "data": data}}
