"""The ground of a block: given, from a DEM, from the camera file, triangulated, or from relative altitudes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aeromatch_cli.blocks.ground import ConstantGround, open_dem
from aeromatch_cli.blocks.read import BlockInputs
from aeromatch_cli.config import Settings
from aeromatch_cli.data import Camera, FloatArray, Ground, Pair, PairGeometry, Pose
from aeromatch_cli.executor import Executor
from aeromatch_cli.geometry.frames import apply_homography, resize_matrix
from aeromatch_cli.images.files import read_pixels
from aeromatch_cli.images.scaling import shrink
from aeromatch_cli.orientation.terrain import choose_adjacent_pairs, ground_height
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.sift import Sift
from aeromatch_cli.strategies.matchers.descriptors.nearest import Nearest
from aeromatch_cli.strategies.simulators.none import source_view
from aeromatch_cli.workspace import image_fingerprint

# Automatic ground: this many seeds, images reduced to this longer side. Height needs far less than tie points do.
_GROUND_SEEDS = 5
_GROUND_SIZE_PX = 1200
_GROUND_KEYPOINTS = 2000
# A height that could not be found is not looked for again before the images, poses or settings change.
UNKNOWN = "unknown"


def find_ground(
    settings: Settings, inputs: BlockInputs, executor: Executor
) -> tuple[Ground | None, str, tuple[str, ...]]:
    """The ground, where it comes from in words, and remarks."""
    text = settings.block.ground
    try:
        return ConstantGround(float(text) - inputs.origin_m[2]), f"given: {float(text):g} m", ()
    except ValueError:
        pass
    if text != "auto":
        positions = np.array([pose.center_m for pose in inputs.poses.values()]).reshape(-1, 3)
        dem, remarks = open_dem(Path(text), inputs.crs, inputs.origin_m, positions)
        return dem, f"DEM {text}", remarks
    if inputs.ground_hint_z_m is not None and inputs.ground_is_stated:
        return ConstantGround(inputs.ground_hint_z_m), inputs.ground_hint_source, ()
    estimate_z_m, reason = _triangulated(settings, inputs, executor)
    if estimate_z_m is not None:
        return ConstantGround(estimate_z_m), reason, ()
    if inputs.ground_hint_z_m is not None:
        return ConstantGround(inputs.ground_hint_z_m), inputs.ground_hint_source, ()
    return None, f"{UNKNOWN}: {reason if inputs.poses else 'no poses'}", ()


@dataclass(frozen=True, eq=False)
class _GroundTask:
    """One adjacent pair to match at reduced size; mapped back to stored pixels."""

    paths: tuple[Path, Path]
    cameras: tuple[Camera, Camera]


def _triangulated(settings: Settings, inputs: BlockInputs, executor: Executor) -> tuple[float | None, str]:
    posed: dict[str, Pose] = {i: p for i, p in inputs.poses.items() if p.world_rotation is not None}
    pairs = choose_adjacent_pairs(posed, _GROUND_SEEDS)
    if not pairs:
        return None, "no two images with attitude"
    by_id = {image.image_id: image for image in inputs.images}
    root = Path(settings.block.images)
    cameras = {image_id: inputs.cameras[by_id[image_id].camera_id] for image_id in posed}
    tasks = [_GroundTask((root / by_id[a].name, root / by_id[b].name), (cameras[a], cameras[b])) for a, b in pairs]
    outcomes = executor.run(_match_reduced, tasks, "ground")
    nothing = (np.zeros((0, 2)), np.zeros((0, 2)))
    matched = {p: nothing if o.value is None else o.value for p, o in zip(pairs, outcomes, strict=True)}
    estimate = ground_height(matched, posed, cameras)
    return estimate.z_m, estimate.reason


def _match_reduced(task: _GroundTask) -> tuple[FloatArray, FloatArray]:
    """Matched stored-pixel points (N, 2) of two images, at reduced size."""
    features, scales = [], []
    for path, camera in zip(task.paths, task.cameras, strict=True):
        gray = read_pixels(path, colour=False)
        scale = min(1.0, _GROUND_SIZE_PX / max(gray.shape))
        view = source_view(camera)
        features.append(Sift(keypoints=_GROUND_KEYPOINTS)(camera, [ViewPixels(view, shrink(gray, scale), None)]))
        scales.append(scale)
    pair = Pair("0", "1", float("nan"), float("nan"), "ground")
    geometry = PairGeometry(pair, task.cameras[0], task.cameras[1], None, None, None)
    matches = Nearest()(features[0], features[1], geometry)
    points = [
        apply_homography(np.linalg.inv(resize_matrix(scale)), f.keypoints_px[matches.indices[:, side]])
        for side, (f, scale) in enumerate(zip(features, scales, strict=True))
    ]
    return points[0], points[1]


def ground_fingerprint(settings: Settings) -> str:
    """The ground setting; of a DEM also its content, since it may be replaced in place."""
    text = settings.block.ground
    return f"{text} {image_fingerprint(Path(text))}" if Path(text).is_file() else text
