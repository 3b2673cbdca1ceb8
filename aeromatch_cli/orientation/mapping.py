"""Cameras, poses and points of a block from its verified matches, by pycolmap's mappers.

Global mapping (GLOMAP, Pan et al. 2024) averages all relative rotations at once and then finds all positions, so that
a block of weak links becomes one model where incremental mapping makes several. Its models are placed in the world by
the given positions and adjusted with them as observations (`placing`, `mapper`).
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, IntArray, Pose
from aeromatch_cli.errors import InputError
from aeromatch_cli.geometry.cameras import colmap_params, focal_px, from_colmap
from aeromatch_cli.strategies.exporters.colmap import Colmap
from aeromatch_cli.strategies.exporters.contents import ExportContents

Mapper = Literal["global", "incremental"]


@dataclass(frozen=True, eq=False)
class Model:
    """Images that were oriented together, in the world frame.

    rotations: image_id -> (3, 3) cam_from_world; centers_m: image_id -> (3,). cameras: camera_id -> Camera as
    calibrated. points_m: (P, 3), errors_px: (P,) mean reprojection errors, track_lengths: (P,) images that see each.
    observations: image_id -> points that it sees. kind: how it was placed (`placing.Placement`). figures: counts.
    """

    rotations: Mapping[str, FloatArray]
    centers_m: Mapping[str, FloatArray]
    cameras: Mapping[str, Camera]
    points_m: FloatArray
    errors_px: FloatArray
    track_lengths: IntArray
    observations: Mapping[str, int]
    kind: str
    figures: Mapping[str, Any]


def map_block(
    contents: ExportContents, positions: Mapping[str, Pose], focal_sigmas: Mapping[str, float], mapper: Mapper
) -> tuple[Model, ...]:
    """Models of a block's verified pairs, the largest first.

    focal_sigmas: camera_id -> standard deviation of its focal length, as a share of it.

    positions: image_id -> pose whose centre and sigma_position_m are observations; its rotation is not used.
    Raises InputError where the mapper stops; no model is no error.
    """
    image_ids = sorted(image.image_id for image in contents.block.images)
    camera_ids = sorted(contents.block.cameras)
    with tempfile.TemporaryDirectory(prefix="aeromatch-") as scratch:
        folder = Path(scratch)
        exporter = Colmap(raw_matches=False, pose_priors=False)
        exporter(contents, folder / "colmap")
        (folder / "colmap" / "database.db").rename(folder / "database.db")
        cameras = {
            str(number): {
                "params": colmap_params(contents.block.cameras[k]),
                "focal_px": focal_px(contents.block.cameras[k]),
                "sigma": focal_sigmas[k],
            }
            for number, k in enumerate(camera_ids, start=1)
        }
        (folder / "task.json").write_text(json.dumps({"mapper": mapper, "cameras": cameras}), encoding="utf-8")
        nowhere = np.full(3, np.nan)
        np.savez(
            folder / "priors.npz",
            positions_m=np.array([positions[i].center_m if i in positions else nowhere for i in image_ids]),
            sigmas_m=np.array([positions[i].sigma_position_m if i in positions else np.nan for i in image_ids]),
        )
        command = [sys.executable, "-m", "aeromatch_cli.orientation.mapper", str(folder)]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        result = folder / "result.json"
        if done.returncode or not result.is_file():
            said = " ".join((done.stderr or done.stdout).strip().splitlines()[-1:])
            raise InputError(f"pycolmap's {mapper} mapping stopped with exit code {done.returncode}: {said}")
        facts = json.loads(result.read_text(encoding="utf-8"))["models"]
        return tuple(_read(folder, one, image_ids, camera_ids, contents.block.cameras) for one in facts)


def _read(
    folder: Path, facts: dict[str, Any], image_ids: list[str], camera_ids: list[str], given: Mapping[str, Camera]
) -> Model:
    arrays = np.load(folder / facts.pop("file"))
    names = [image_ids[number - 1] for number in arrays["images"]]
    cameras = {camera_ids[n - 1]: _camera(given[camera_ids[n - 1]], arrays[f"params{n}"]) for n in arrays["cameras"]}
    return Model(
        rotations=dict(zip(names, arrays["rotations"], strict=True)),
        centers_m=dict(zip(names, arrays["centers_m"], strict=True)),
        cameras=cameras,
        points_m=arrays["points_m"],
        errors_px=arrays["errors_px"],
        track_lengths=arrays["track_lengths"],
        observations=dict(zip(names, (int(n) for n in arrays["observations"]), strict=True)),
        kind=str(facts.pop("kind")),
        figures=facts,
    )


def _camera(given: Camera, params: FloatArray) -> Camera:
    """The given camera with what the mapper found, which counts pixels from the corner of the first."""
    return from_colmap(given.model, given.width_px, given.height_px, tuple(float(value) for value in params))
