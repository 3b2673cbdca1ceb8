"""COLMAP's own mapping and bundle adjustment of the same tie points, in a process of its own.

colmap           incremental mapping: SIMPLE_RADIAL, the principal point in the middle
colmap-opencv    its model adjusted once more as OPENCV, principal point free

Run as a module: FOLDER and PEER. The folder holds what the exporter for COLMAP has written, and stated.npy: given
positions (image number, x, y, z, sigma), which place the model in the world; found.npz is written into it.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.geometry.cameras import from_colmap
from aeromatch_cli.sfm.georeferencing import similarity
from aeromatch_cli.sfm.model_arrays import centers_of, image_numbers
from aeromatch_cli.sfm.process import quiet_pycolmap
from aeromatch_cli.strategies.exporters.colmap import Colmap
from benchmarks.calibration.accuracy import Found
from benchmarks.calibration.simulate import SimulatedBlock

PEERS = ("colmap", "colmap-opencv")
_SCRIPTS = Path(__file__).parent.parent.parent
_FEWEST_POSITIONS = 3


def mapped_by_colmap(block: SimulatedBlock, peer: str) -> Found | None:
    """The largest model that the peer makes, None where it makes none."""
    image_ids = sorted(image.image_id for image in block.contents.block.images)
    camera_ids = sorted(block.contents.block.cameras)
    with tempfile.TemporaryDirectory(prefix="aeromatch-") as scratch:
        folder = Path(scratch) / "task"
        Colmap(raw_matches=False)(block.contents, folder)
        stated = [
            [number, *pose.center_m, pose.sigma_position_m]
            for number, image_id in enumerate(image_ids, start=1)
            if (pose := block.observed.poses.get(image_id)) is not None
        ]
        np.save(folder / "stated.npy", np.array(stated).reshape(-1, 5))
        command = [sys.executable, "-m", "benchmarks.calibration.colmap", str(folder), peer]
        done = subprocess.run(command, cwd=_SCRIPTS, check=False, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{peer} stopped with exit code {done.returncode}: {done.stderr[-500:]}")
        if not (folder / "found.npz").is_file():
            return None
        found = dict(np.load(folder / "found.npz"))
    given = block.contents.block.cameras
    model = str(found["model"])
    names = [image_ids[number - 1] for number in found["images"]]
    return Found(
        {
            key: from_colmap(model, given[key].width_px, given[key].height_px, tuple(found[f"params{n}"].tolist()))
            for n in found["cameras"]
            for key in [camera_ids[n - 1]]
        },
        dict(zip(names, found["rotations"], strict=True)),
        dict(zip(names, found["centers_m"], strict=True)),
    )


def _solve(folder: Path, peer: str) -> None:
    pycolmap = quiet_pycolmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = 0, 1
    options.extract_colors = False
    found = pycolmap.incremental_mapping(folder / "database.db", folder, folder, options=options)
    if not found:
        return
    model = max(found.values(), key=lambda one: one.num_reg_images())
    stated = np.load(folder / "stated.npy")
    stated = stated[np.isin(stated[:, 0], image_numbers(model))]
    _place(pycolmap, model, stated)
    if peer != "colmap":
        _adjust(pycolmap, model)
        _place(pycolmap, model, stated)
    lens = next(iter(model.cameras.values())).model.name
    numbers, cameras = image_numbers(model), sorted(model.cameras)
    np.savez(
        folder / "found.npz",
        images=np.array(numbers),
        rotations=np.array([model.images[i].cam_from_world().rotation.matrix() for i in numbers]),
        centers_m=centers_of(model, numbers),
        cameras=np.array(cameras),
        model=np.array(lens),
        **{f"params{i}": np.array(model.cameras[i].params) for i in cameras},
    )


def _place(pycolmap: ModuleType, model: Any, stated: FloatArray) -> None:
    """Into the world by positions (image number, x, y, z, sigma), where there are enough."""
    if len(stated) >= _FEWEST_POSITIONS:
        scale, rotation, shift = similarity(centers_of(model, stated[:, 0].astype(int).tolist()), stated[:, 1:4])
        model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), shift))


def _adjust(pycolmap: ModuleType, model: Any) -> None:
    """As OPENCV with a free principal point."""
    for camera in model.cameras.values():
        focal, x, y, k1 = camera.params
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = [focal, focal, x, y, k1, 0.0, 0.0, 0.0]
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = True
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, options)


if __name__ == "__main__":
    _solve(Path(sys.argv[1]), sys.argv[2])
