"""Where a pixel of one rendered image really lies in another: asked of the scene itself, rebuilt from truth.json."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray, Camera, FloatArray, Pose
from aeromatch_cli.errors import ConfigError, InputError
from aeromatch_cli.geometry.cameras import from_colmap, normalise, project
from aeromatch_cli.lab.synthetic.raycast import RayCaster
from aeromatch_cli.lab.synthetic.render import row_share
from aeromatch_cli.lab.synthetic.scene import SCENE_VERSION, Scene, build_scene, scene_digest
from aeromatch_cli.lab.synthetic.stations import Exterior
from aeromatch_cli.lab.synthetic.terrain import Area
from aeromatch_cli.lab.synthetic.write import (
    POSE_COLUMNS,
    TRUTH_FORMAT,
    depth_path,
    read_raster,
    sun_path,
    surface_path,
)

# A surface point counts as seen when nothing stands more than this in front of it.
_TOLERANCE_M = 2e-3
# Each step leaves a hundredth of the error, or less: an aircraft moves by some rows while all of them are read.
_ROW_STEPS = 6


@dataclass(frozen=True, eq=False)
class Truth:
    """A rendered block's scene, and the exact camera and pose of each image by name.

    folder: the block. sorties: which flight of the day took an image. sweeps_m: image -> (3,) by which its projection
    centre moved from the first row to the last (`render.View`); absent where all rows were exposed at once.
    """

    folder: Path
    scene: Scene
    caster: RayCaster
    cameras: Mapping[str, Camera]
    poses: Mapping[str, Pose]
    sorties: Mapping[str, int]
    sweeps_m: Mapping[str, FloatArray] = field(default_factory=dict)

    def sun(self, image: str) -> NDArray[np.uint8]:
        """(H, W) 255 times the share of the sun's disc in view at pixel centres; below 128 is shadow."""
        return read_raster(sun_path(self.folder, self._known(image)))

    def depth_m(self, image: str) -> NDArray[np.float32]:
        """(H, W) metres along the optical axis at pixel centres, NaN for sky."""
        return read_raster(depth_path(self.folder, self._known(image)))

    def surface(self, image: str) -> NDArray[np.uint32]:
        """(H, W) 1 + the index of the triangle that a pixel's centre sees, 0 for sky."""
        return read_raster(surface_path(self.folder, self._known(image)))

    def centers_m(self, image: str, points_px: FloatArray) -> FloatArray:
        """Projection centres (N, 3) of an image when it took stored pixels (N, 2)."""
        camera, _, center_m = self._view(image)
        if image not in self.sweeps_m:
            return np.tile(center_m, (len(points_px), 1))
        moved: FloatArray = center_m + row_share(camera, points_px[:, 1])[:, None] * self.sweeps_m[image]
        return moved

    def project(self, image: str, points_m: FloatArray) -> FloatArray:
        """Stored pixels (N, 2) of world points (N, 3); NaN behind the camera or outside the lens model."""
        camera, rotation, center_m = self._view(image)
        places = project(camera, rotation, center_m, points_m)
        if image not in self.sweeps_m:
            return places
        for _ in range(_ROW_STEPS):  # the row says where the camera was, which says the row
            # A camera that moves by v sees a point where one at rest would see it moved by -v.
            shifts_m = self.centers_m(image, places) - center_m
            places = project(camera, rotation, center_m, points_m - shifts_m)
        return places

    def surface_points(self, image: str, points_px: FloatArray) -> FloatArray:
        """World points (N, 3) that an image shows at stored pixels (N, 2); NaN where it shows sky or has no ray."""
        camera, rotation, _ = self._view(image)
        directions = np.column_stack([normalise(camera, points_px), np.ones(len(points_px))]) @ rotation
        centers_m = self.centers_m(image, points_px)
        surface = np.full((len(points_px), 3), np.nan)
        usable = np.flatnonzero(np.isfinite(directions).all(axis=1))
        hits = self.caster.first_hits(centers_m[usable], directions[usable])
        hit = np.isfinite(hits.distances)
        surface[usable[hit]] = centers_m[usable[hit]] + hits.distances[hit, None] * directions[usable[hit]]
        return surface

    def transfer(self, image0: str, points_px: FloatArray, image1: str) -> tuple[FloatArray, BoolArray]:
        """Exact places in image 1 of what image 0 shows at stored pixels (N, 2).

        Returns places (N, 2) and hidden (N,). Hidden: sky in image 0, outside image 1, or something stands in front of
        it there. The place of a hidden point ignores what hides it; it is NaN for sky and for points behind camera 1.
        Raises ConfigError on an unknown image.
        """
        camera, _, _ = self._view(image1)
        surface = self.surface_points(image0, np.asarray(points_px, dtype=np.float64).reshape(-1, 2))
        places = self.project(image1, surface)
        last = np.array([camera.width_px, camera.height_px]) - 0.5
        with np.errstate(invalid="ignore"):
            hidden: BoolArray = np.any(~((places >= -0.5) & (places <= last)), axis=1)
        asked = np.flatnonzero(~hidden)
        hidden[asked] = ~self.in_open_view(image1, surface[asked])
        return places, hidden

    def in_open_view(self, image: str, points_m: FloatArray) -> BoolArray:
        """Whether nothing stands between an image's projection centre and world points (N, 3), finite ones."""
        _, _, center_m = self._view(image)
        centers_m: FloatArray = center_m
        if image in self.sweeps_m:  # a point that has no pixel is looked at from where the middle row was exposed
            centers_m = self.centers_m(image, self.project(image, points_m))
            centers_m = np.where(np.isfinite(centers_m), centers_m, center_m)
        directions = points_m - centers_m
        hits = self.caster.first_hits(centers_m, directions)
        # In units of these directions the point itself lies at 1.
        seen: BoolArray = hits.distances >= 1.0 - _TOLERANCE_M / np.linalg.norm(directions, axis=1)
        return seen

    def _known(self, image: str) -> str:
        if image not in self.poses:
            raise ConfigError(
                f"{image!r} is no image of this rendered block; it has {', '.join(list(self.poses)[:3])} ..."
            )
        return image

    def _view(self, image: str) -> tuple[Camera, FloatArray, FloatArray]:
        pose = self.poses[self._known(image)]
        assert pose.world_rotation is not None
        return self.cameras[image], pose.world_rotation, pose.center_m


def load_truth(folder: Path) -> Truth:
    """Rebuild the scene of a rendered block (about half a second).

    Raises InputError where the folder holds no finished block, or one of another version of the scene generator.
    """
    facts = _read_json(folder / "truth.json")
    if facts.get("format") != TRUTH_FORMAT:
        raise InputError(
            f"{folder / 'truth.json'} is not the truth of a rendered block; give the folder that synth wrote"
        )
    block = _read_json(folder / "block.json")
    try:
        scene = build_scene(facts["scene"], facts["seed"], Area(**facts["area_m"]))
        same = facts["scene_version"] == SCENE_VERSION and facts["scene_sha256"] == scene_digest(scene)
        lenses = {camera_id: _camera(lens) for camera_id, lens in block["cameras"].items()}
        poses, cameras = _read_poses(folder / "poses.csv", lenses)
        sorties = {image["name"]: int(image["sortie"]) for image in facts["images"]}
        shutter = facts.get("rolling_shutter", {"readout_s": 0.0, "velocities_m_s": {}})
        sweeps_m = {name: shutter["readout_s"] * np.array(v) for name, v in shutter["velocities_m_s"].items()}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the truth in {folder} is damaged ({error!r}); render the block again") from error
    if not same:
        raise InputError(f"the block in {folder} was rendered by another version; render it again")
    return Truth(folder, scene, RayCaster(scene), cameras, poses, sorties, sweeps_m)


def transfer(truth: Truth | Path, image0: str, points_px: FloatArray, image1: str) -> tuple[FloatArray, BoolArray]:
    """`Truth.transfer` of a loaded truth, or of a rendered block's folder (which is then loaded anew each time)."""
    return (truth if isinstance(truth, Truth) else load_truth(truth)).transfer(image0, points_px, image1)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}); give the folder of a finished rendered block") from error
    if not isinstance(content, dict):
        raise InputError(f"{path} must hold one JSON object; give the folder of a finished rendered block")
    return content


def _camera(lens: dict[str, Any]) -> Camera:
    return from_colmap(lens["model"], int(lens["width"]), int(lens["height"]), tuple(lens["params"]))


def _read_poses(path: Path, lenses: Mapping[str, Camera]) -> tuple[dict[str, Pose], dict[str, Camera]]:
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); render the block again") from error
    numbers = POSE_COLUMNS[1:-1]
    poses = {row["image"]: Exterior(*(float(row[column]) for column in numbers)).pose() for row in rows}
    return poses, {row["image"]: lenses[row["camera"]] for row in rows}
