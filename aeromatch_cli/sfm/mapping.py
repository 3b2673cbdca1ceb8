"""Cameras, poses and points of a block from its verified matches, by pycolmap's mappers.

Global mapping (GLOMAP, Pan et al. 2024) averages all relative rotations at once and then finds all positions, so that
a block of weak links becomes one model where incremental mapping makes several. Its models are placed in the world by
the given positions and adjusted with them as observations (`georeferencing`, `mapping_process`).
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from aeromatch_cli.data import AdjustedBlock, AdjustedPose, Block, Camera, ControlPoint, FloatArray, IntArray, Pose
from aeromatch_cli.geometry.angles import Angles
from aeromatch_cli.results.adjustment import GroupResult, PlacementKind
from aeromatch_cli.results.stages import MappedModel
from aeromatch_cli.sfm.bundle.network import LENS
from aeromatch_cli.sfm.calibration import Calibration, camera_of, freed, held_by, lens_prior
from aeromatch_cli.sfm.group_results import Names
from aeromatch_cli.sfm.model_arrays import rows_by_number
from aeromatch_cli.sfm.process import run_process
from aeromatch_cli.strategies.exporters.colmap import Colmap
from aeromatch_cli.strategies.exporters.contents import ExportContents

Mapper = Literal["global", "incremental"]
MAPPERS: tuple[Mapper, ...] = ("global", "incremental")


@dataclass(frozen=True, eq=False)
class Model:
    """Images that were oriented together, in the world frame.

    rotations: image_id -> (3, 3) cam_from_world; centers_m: image_id -> (3,). cameras: camera_id -> Camera as
    calibrated. points_m: (P, 3). figures: counts, and how it was placed. tied: images that hang on a single pair each
    -> standard deviations of their places, in the units of centers_m, and attitudes, degrees.
    """

    rotations: Mapping[str, FloatArray]
    centers_m: Mapping[str, FloatArray]
    cameras: Mapping[str, Camera]
    points_m: FloatArray
    figures: MappedModel
    tied: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def kind(self) -> PlacementKind:
        return self.figures.kind

    def with_images(self, found: Mapping[str, Pose]) -> Model:
        """Return the model with further images. found: image_id -> pose with an attitude."""
        rotations, centers_m = dict(self.rotations), dict(self.centers_m)
        for image_id, pose in found.items():
            assert pose.world_rotation is not None
            rotations[image_id], centers_m[image_id] = pose.world_rotation, pose.center_m
        figures = self.figures.model_copy(update={"images": len(rotations)})
        return replace(self, rotations=rotations, centers_m=centers_m, figures=figures)


@dataclass(frozen=True, eq=False)
class Observed:
    """Holds what was given of a block, as observations.

    poses: image_id -> pose whose centre is one, with its standard deviations. focal_sigmas: camera_id -> standard
    deviation of its focal length, as a share of it. angles: image_id -> attitude as it was given, of which the tilt
    counts. cameras: camera_id -> Camera as it was stated; of others the block's own count. calibration, switches: what
    is free of them, see `calibration.freed`; rolling_shutter: whether read-out times are. flights: image_id -> name of
    its flight. velocities: image_id -> (3,) of
    the aircraft in the world frame, metres per second, where it is known. control: surveyed points.
    """

    poses: Mapping[str, Pose]
    focal_sigmas: Mapping[str, float]
    angles: Mapping[str, Angles]
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    calibration: Calibration = "auto"
    switches: Mapping[str, bool] = field(default_factory=dict)
    rolling_shutter: bool = True
    flights: Mapping[str, str] = field(default_factory=dict)
    velocities: Mapping[str, FloatArray] = field(default_factory=dict)
    control: tuple[ControlPoint, ...] = ()


def map_block(contents: ExportContents, observed: Observed, mapper: Mapper) -> tuple[Model, ...]:
    """Return models of a block's verified pairs, the largest first; given rotations are not used, but for their tilts.

    Raises InputError where the mapper stops; no model is no error.
    """
    block = contents.block
    # Few matches of reduced pictures do not tell an affinity from a rolling shutter.
    observed = replace(observed, switches={**dict.fromkeys(("b1", "b2"), False), **observed.switches})
    with _task(contents, observed) as folder:
        found = _solved(folder, "mapping_process", {"mapper": mapper}, f"pycolmap's {mapper} mapping")
        return tuple(_read(folder, block, **one) for one in found)


@dataclass(frozen=True)
class Group:
    """Images that one orientation holds. kind: "given", or how `georeferencing` put them into the world."""

    kind: str
    images: tuple[str, ...]


def own_frames(groups: Sequence[Group]) -> dict[str, int]:
    """Number the frames of groups that no position has placed in the world: image_id -> number, from 1."""
    loose = [group.images for group in groups if group.kind == "level"]
    return {image_id: number for number, images in enumerate(loose, start=1) for image_id in images}


def adjust_block(
    contents: ExportContents, observed: Observed, groups: Sequence[Group], *, fixed: bool
) -> tuple[AdjustedBlock, list[GroupResult]]:
    """Return the block adjusted from its poses and verified pairs, and the result of every group.

    A given rotation is an observation in groups of kind "given", where the block still has it. groups: the largest
    first; those that matches tie become one, and images of none are tied to the first of which they share enough
    points. fixed: poses and cameras stay,
    points are triangulated all the same. Raises InputError where pycolmap stops.
    """
    block = contents.block
    number = {image_id: row for row, image_id in enumerate(_image_ids(block), start=1)}
    grouped = {image_id for group in groups for image_id in group.images}
    task = {
        "groups": [{"kind": group.kind, "images": [number[i] for i in group.images]} for group in groups],
        "more": len(grouped) < len(block.images),
        "fixed": fixed,
        "control": [
            {
                "name": point.name,
                "position_m": np.asarray(point.position_m).tolist(),
                "sigmas_m": list(point.sigmas_m),
                "sigma_px": point.sigma_px,
                "check": point.check,
                "pixels": [(number[i], *map(float, xy)) for i, xy in sorted(point.pixels.items()) if i in number],
            }
            for point in observed.control
        ],
    }
    names = Names(_image_ids(block), sorted(block.cameras), sorted(set(observed.flights.values())))
    with _task(contents, observed) as folder:
        found = _solved(folder, "adjustment_process", task | {"names": asdict(names)}, "the bundle adjustment")
        archives = [dict(np.load(folder / one["file"])) for one in found]
    results = [GroupResult(**one["result"]) for one in found]
    return _joined(archives, [one.kind for one in results], block), results


def _joined(archives: Sequence[Mapping[str, Any]], kinds: Sequence[str], block: Block) -> AdjustedBlock:
    """Join all groups to one block; a camera that several groups share is that of the largest group. kinds: how each
    was placed."""
    image_ids, camera_ids = _image_ids(block), sorted(block.cameras)
    cameras = dict(block.cameras)
    poses: dict[str, AdjustedPose] = {}
    tracks: dict[str, IntArray] = {}
    frames: dict[str, int] = {}
    first = 0
    for arrays in reversed(archives):
        cameras |= {
            camera_ids[n - 1]: camera_of(arrays[f"lens{n}"], block.cameras[camera_ids[n - 1]])
            for n in arrays["cameras"]
        }
    for arrays, kind in zip(archives, kinds, strict=True):
        if kind == "level":
            frame = 1 + max(frames.values(), default=0)
            frames |= {image_ids[number - 1]: frame for number in arrays["images"]}
        of_image = rows_by_number(arrays["track_images"])
        parts = (arrays[name] for name in ("images", "centers_m", "rotations", "sigmas_m", "sigmas_deg", "sweeps_m"))
        for number, *pose in zip(*parts, strict=True):
            own = of_image.get(int(number), np.zeros(0, dtype=np.int64))
            keypoints, points = arrays["track_keypoints"][own], arrays["track_points"][own] + first
            poses[image_ids[number - 1]] = AdjustedPose(*pose)
            tracks[image_ids[number - 1]] = np.column_stack([keypoints, points]).astype(np.int32)
        first += len(arrays["points_m"])
    points_m = np.concatenate([np.zeros((0, 3)), *(arrays["points_m"] for arrays in archives)])
    errors_px = np.concatenate([np.zeros(0), *(arrays["errors_px"] for arrays in archives)])
    return AdjustedBlock(cameras, poses, points_m, errors_px, tracks, frames)


def _image_ids(block: Block) -> list[str]:
    """Return the image ids in the order of their numbers in the database."""
    return sorted(image.image_id for image in block.images)


@contextmanager
def _task(contents: ExportContents, observed: Observed) -> Iterator[Path]:
    """A folder with database.db, sparse/, priors.npz and task.json for a process of its own."""
    positions = observed.poses
    image_ids = _image_ids(contents.block)
    with tempfile.TemporaryDirectory(prefix="aeromatch-") as scratch:
        folder = Path(scratch) / "task"
        # One model of all groups: the process takes each from it, whatever its frame.
        whole = replace(contents, block=replace(contents.block, frames={}))
        Colmap(raw_matches=False, pose_priors=False)(whole, folder)
        cameras = {
            str(number): _camera_task(contents.block, k, observed)
            for number, k in enumerate(sorted(contents.block.cameras), start=1)
        }
        how = {"chosen": observed.calibration != "brown", "readout": observed.rolling_shutter}
        (folder / "task.json").write_text(json.dumps({"cameras": cameras, **how}), encoding="utf-8")
        nowhere, untold = np.full(3, np.nan), np.full((3, 3), np.nan)
        flights = sorted(set(observed.flights.values()))
        ups = {i: one.rotation[:, 2] for i, one in observed.angles.items()}
        turns = {i: pose.world_rotation for i, pose in positions.items() if pose.world_rotation is not None}
        np.savez(
            folder / "priors.npz",
            positions_m=np.array([positions[i].center_m if i in positions else nowhere for i in image_ids]),
            sigmas_m=np.array([positions[i].axis_sigmas_m if i in positions else nowhere for i in image_ids]),
            ups=np.array([ups.get(i, nowhere) for i in image_ids]),
            rotations=np.array([turns.get(i, untold) for i in image_ids]),
            sigmas_deg=np.array([positions[i].sigma_angle_deg if i in positions else np.nan for i in image_ids]),
            flights=np.array([flights.index(observed.flights[i]) if i in observed.flights else -1 for i in image_ids]),
            velocities_m_s=np.array([observed.velocities.get(i, np.zeros(3)) for i in image_ids]),
        )
        yield folder


def _camera_task(block: Block, camera_id: str, observed: Observed) -> dict[str, Any]:
    """Return what a process needs to know of a camera: its prior, and which unknowns are free."""
    stated = observed.cameras.get(camera_id, block.cameras[camera_id])
    prior = lens_prior(stated, observed.focal_sigmas[camera_id])
    images = sum(image.camera_id == camera_id for image in block.images)
    held = held_by(observed.calibration, observed.switches)
    return {
        "lens": prior.lens.tolist(),
        "sigmas": freed(prior, observed.calibration, observed.switches, images).tolist(),
        "held_sigmas": [sigma * (name in held) for name, sigma in zip(LENS, prior.sigmas.tolist(), strict=True)],
        "fisheye": prior.fisheye,
    }


def _solved(folder: Path, process: str, task: Mapping[str, Any], what: str) -> list[dict[str, Any]]:
    """Return what a process of its own says of the models that it makes in `folder`. InputError where it stops."""
    path = folder / "task.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | task), encoding="utf-8")
    result = run_process(process, folder, "result.json", what)
    return list(json.loads(result.read_text(encoding="utf-8"))["models"])


def _read(folder: Path, block: Block, *, file: str, turned_back: Sequence[int], **counts: Any) -> Model:
    """A model that the mapper's process has written. turned_back: numbers of images."""
    arrays = np.load(folder / file)
    image_ids, camera_ids = _image_ids(block), sorted(block.cameras)
    names = [image_ids[number - 1] for number in arrays["images"]]
    given = block.cameras
    cameras = {camera_ids[n - 1]: camera_of(arrays[f"lens{n}"], given[camera_ids[n - 1]]) for n in arrays["cameras"]}
    return Model(
        rotations=dict(zip(names, arrays["rotations"], strict=True)),
        centers_m=dict(zip(names, arrays["centers_m"], strict=True)),
        cameras=cameras,
        points_m=arrays["points_m"],
        figures=MappedModel(turned_back=[image_ids[number - 1] for number in turned_back], **counts),
    )
