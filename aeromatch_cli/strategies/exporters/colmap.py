"""COLMAP: a database for its mappers and a text model: the adjusted block, or the given poses without points.

Groups of images whose place beside the others is not known are models of their own, in folders beside that of the first
one: what COLMAP (`automatic_reconstructor`) finds below `sparse` it takes for all models that there are, and the first
one lies in `sparse` itself.

Translated on the way: keypoints and principal points move by +0.5 px (COLMAP's origin is the corner of the first
pixel); image and camera ids become 1, 2, ... in the order of our sorted ids, so that id0 < id1 stays true and
x1^T E x0 = 0 needs no transposition. Positions are the block's world: its CRS minus its origin, both repeated in
world.json.
"""

from __future__ import annotations

import signal
import sqlite3
import threading
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from aeromatch_cli.data import AdjustedBlock, Block, Camera, FloatArray, Image, IntArray, Pose, by_frame
from aeromatch_cli.errors import WorkspaceError
from aeromatch_cli.formats.adjusted import orientation_text, residuals_text
from aeromatch_cli.geometry.cameras import colmap_camera
from aeromatch_cli.geometry.epipolar import fundamental
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX
from aeromatch_cli.geometry.lenses import in_colmap, in_colmaps_mappers
from aeromatch_cli.geometry.reprojection import with_errors
from aeromatch_cli.geometry.rotations import to_quaternion
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, PairContents, whole_folder
from aeromatch_cli.strategies.exporters.solution import Solution, adjusted_poses, held, known_poses, write_world
from aeromatch_cli.words import counted

# Ours (pixel centre) to COLMAP's pixel frame (corner).
_COLMAP_FROM_PX = np.array([[1.0, 0.0, COLMAP_OFFSET_PX], [0.0, 1.0, COLMAP_OFFSET_PX], [0.0, 0.0, 1.0]])
_NO_POINT = -1
# Folder of the model, or of the first one.
_SPARSE = "sparse"


class Colmap(Strategy):
    """Writes database.db (cameras, rigs, frames, images, keypoints, matches, two-view geometries, pose priors),
    sparse/{cameras,images,points3D}.txt, world.json and, of an adjusted block, orientation.csv and residuals.csv. Where
    an image name contains a space, which COLMAP cannot read from text, sparse holds the binary model as well. Groups of
    images whose place beside the others is not known are models of their own: sparse_own2 has frame "own 2" of
    orientation.csv.
    """

    version: ClassVar[int] = 5
    name: Literal["colmap"] = "colmap"
    raw_matches: bool = Field(
        True, description="Also write the matches before filtering, so that COLMAP can verify them itself."
    )
    pose_priors: bool = Field(
        True, description="Write the given positions with their covariance, for COLMAP's pose_prior_mapper."
    )

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written, ValueError on a match without keypoint."""
        with whole_folder(folder) as partial:
            ids = Numbers.of(contents.block)
            lenses = {k: in_colmaps_mappers(camera).camera or camera for k, camera in contents.block.cameras.items()}
            counts = self._write_database(contents, lenses, ids, partial / "database.db")
            cameras, remarks = held(Solution.of(contents), "COLMAP", in_colmap)
            models = _models(contents)
            for name, model in models.items():
                write_model(contents, model, cameras, ids, partial / name)
            posed = sum(len(model.poses) for model in models.values())
            remarks += _models_remark(models)
            if contents.adjusted is not None:
                text = orientation_text(contents.adjusted, contents.block)
                (partial / "orientation.csv").write_text(text, encoding="utf-8")
            if contents.residuals:
                text = residuals_text(contents.residuals, contents.block.images)
                (partial / "residuals.csv").write_text(text, encoding="utf-8")
            _write_worlds(partial, contents.block, models)
            names = sorted(path.relative_to(partial) for path in partial.rglob("*") if path.is_file())
        return ExportSummary(
            files=tuple(folder / name for name in names),
            images=len(contents.block.images),
            posed_images=posed,
            remarks=tuple(remarks),
            **counts,
        )

    def _write_database(
        self, contents: ExportContents, lenses: Mapping[str, Camera], ids: Numbers, path: Path
    ) -> dict[str, int]:
        """lenses: cameras of the block as COLMAP's mappers can refine them."""
        pycolmap = import_pycolmap()
        try:
            # No pycolmap.DatabaseTransaction: it aborts the process on a full disk, and is no faster.
            with pycolmap.Database.open(path) as database:
                _write_cameras(pycolmap, database, contents, lenses, ids)
                sizes = self._write_images(pycolmap, database, contents, ids)
                counts = self._write_pairs(pycolmap, database, contents, lenses, ids, sizes)
        except RuntimeError as error:
            raise WorkspaceError(f"{path} cannot be written ({error}); check free space, then run again") from error
        if path.with_name(path.name + "-wal").exists():
            raise WorkspaceError(f"{path} could not be completed; check free space, then run again")
        _leave_wal_mode(path)
        return {"keypoints": sum(sizes.values()), **counts}

    def _write_images(
        self, pycolmap: ModuleType, database: Any, contents: ExportContents, ids: Numbers
    ) -> dict[str, int]:
        """Images, keypoints and pose priors; returns the number of keypoints of every image."""
        sizes = {}
        given = contents.block.poses if contents.positions is None else contents.positions
        for image in contents.block.images:
            _write_image(pycolmap, database, image, ids)
            keypoints = np.asarray(contents.keypoints_px(image.image_id), dtype=np.float32).reshape(-1, 2)
            database.write_keypoints(ids.image[image.image_id], keypoints + np.float32(COLMAP_OFFSET_PX))
            sizes[image.image_id] = len(keypoints)
            pose = given.get(image.image_id)
            if self.pose_priors and pose is not None:
                _write_pose_prior(pycolmap, database, ids.image[image.image_id], ids.camera[image.camera_id], pose)
        return sizes

    def _write_pairs(
        self, pycolmap: ModuleType, database: Any, contents: ExportContents, lenses: Mapping[str, Camera], ids: Numbers,
        sizes: dict[str, int],
    ) -> dict[str, int]:  # fmt: skip
        """Matches and two-view geometries; returns the counts of the summary."""
        counts = dict.fromkeys(("matched_pairs", "matches", "verified_pairs", "verified_matches"), 0)
        cameras = {image.image_id: lenses[image.camera_id] for image in contents.block.images}
        for item in contents.pairs:
            id0, id1 = item.pair.image_id0, item.pair.image_id1
            _check_indices(item, ids, sizes)
            if self.raw_matches and len(item.matches):
                database.write_matches(ids.image[id0], ids.image[id1], _uint32(item.matches))
            if len(item.verified):
                geometry = _two_view_geometry(pycolmap, item, cameras[id0], cameras[id1])
                database.write_two_view_geometry(ids.image[id0], ids.image[id1], geometry)
            counts["matched_pairs"] += len(item.matches) > 0
            counts["matches"] += len(item.matches)
            counts["verified_pairs"] += len(item.verified) > 0
            counts["verified_matches"] += len(item.verified)
        return counts


def _leave_wal_mode(path: Path) -> None:
    """Back to a rollback journal: in WAL mode a mere reader leaves files beside the database, or fails on a read-only
    disk."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")


def _write_cameras(
    pycolmap: ModuleType, database: Any, contents: ExportContents, lenses: Mapping[str, Camera], ids: Numbers
) -> None:
    """Cameras, each with the rig of one sensor that COLMAP 4 asks for."""
    for camera_id, number in ids.camera.items():
        camera = lenses[camera_id]
        model, params = colmap_camera(camera)
        database.write_camera(
            pycolmap.Camera(
                camera_id=number,
                model=model,
                width=camera.width_px,
                height=camera.height_px,
                params=params,
                has_prior_focal_length=camera_id not in contents.guessed_cameras,
            ),
            use_camera_id=True,
        )
        rig = pycolmap.Rig(rig_id=number)
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number))
        database.write_rig(rig, use_rig_id=True)


def _write_image(pycolmap: ModuleType, database: Any, image: Image, ids: Numbers) -> None:
    """An image and the frame that holds it alone."""
    number, camera_number = ids.image[image.image_id], ids.camera[image.camera_id]
    database.write_image(pycolmap.Image(name=image.name, camera_id=camera_number, image_id=number), use_image_id=True)
    frame = pycolmap.Frame(frame_id=number, rig_id=camera_number)
    frame.add_data_id(_data_id(pycolmap, number, camera_number))
    database.write_frame(frame, use_frame_id=True)


def _data_id(pycolmap: ModuleType, image_number: int, camera_number: int) -> Any:
    return pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_number), image_number)


def _write_pose_prior(pycolmap: ModuleType, database: Any, image_number: int, camera_number: int, pose: Pose) -> None:
    prior = pycolmap.PosePrior(
        pose_prior_id=image_number,
        corr_data_id=_data_id(pycolmap, image_number, camera_number),
        position=pose.center_m,
        position_covariance=np.eye(3) * pose.sigma_position_m**2,
        coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
    )
    database.write_pose_prior(prior, use_pose_prior_id=True)


def _check_indices(item: PairContents, ids: Numbers, sizes: dict[str, int]) -> None:
    id0, id1 = item.pair.image_id0, item.pair.image_id1
    if not ids.image[id0] < ids.image[id1]:
        raise ValueError(f"pair {id0}, {id1} is not in ascending order")
    for indices in (item.matches, item.verified):
        if len(indices) and (indices.min() < 0 or (indices.max(axis=0) >= [sizes[id0], sizes[id1]]).any()):
            raise ValueError(f"pair {id0}, {id1} has a match without keypoint")


def _uint32(indices: IntArray) -> IntArray:
    return np.ascontiguousarray(indices, dtype=np.uint32)


def _two_view_geometry(pycolmap: ModuleType, item: PairContents, camera0: Camera, camera1: Camera) -> Any:
    """E becomes CALIBRATED (with its F), F UNCALIBRATED, H PLANAR; F and H move to COLMAP's pixel frame."""
    configuration = pycolmap.TwoViewGeometryConfiguration
    geometry = pycolmap.TwoViewGeometry()
    geometry.inlier_matches = _uint32(item.verified)
    to_px = np.linalg.inv(_COLMAP_FROM_PX)
    if item.model_kind == "E":
        geometry.config = int(configuration.CALIBRATED)
        geometry.E = item.model
        geometry.F = to_px.T @ fundamental(item.model, camera0, camera1) @ to_px
    elif item.model_kind == "F":
        geometry.config = int(configuration.UNCALIBRATED)
        geometry.F = to_px.T @ item.model @ to_px
    elif item.model_kind == "H":
        geometry.config = int(configuration.PLANAR)
        geometry.H = _COLMAP_FROM_PX @ item.model @ to_px
    else:
        raise ValueError(f"pair {item.pair.image_id0}, {item.pair.image_id1}: unknown model {item.model_kind!r}")
    return geometry


@dataclass(frozen=True)
class Numbers:
    """COLMAP numbers, from 1, in the order of the sorted ids. Rigs are numbered like cameras, frames like images."""

    image: dict[str, int]
    camera: dict[str, int]

    @classmethod
    def of(cls, block: Block) -> Numbers:
        image = {name: number for number, name in enumerate(sorted(i.image_id for i in block.images), start=1)}
        camera = {name: number for number, name in enumerate(sorted(block.cameras), start=1)}
        return cls(image, camera)


def import_pycolmap() -> ModuleType:
    # pycolmap 4.2.1 aborts the process when its own zlib is initialised before Python's.
    zlib.compress(b"")
    # Importing it replaces the handler of SIGTERM by one that prints a stack and dies: no clean-up, no resume message.
    before = signal.getsignal(signal.SIGTERM)
    import pycolmap

    pycolmap.logging.minloglevel = 2  # what it would warn of is raised and said here in words
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    return pycolmap


@dataclass(frozen=True, eq=False)
class Model:
    """Images of one frame: poses by image_id. frame: number of the frame of their own, 0 in the world. adjusted: their
    part of the adjusted block; None before the adjustment: poses without points."""

    poses: Mapping[str, tuple[FloatArray, FloatArray]]
    frame: int
    adjusted: AdjustedBlock | None


def _models(contents: ExportContents) -> dict[str, Model]:
    """Folder -> model of every frame, the first one in `sparse`."""
    block, adjusted = contents.block, contents.adjusted
    if adjusted is None:
        known = known_poses(block)
        parts = by_frame(known, block.frames) or [[]]
        models = [Model({i: known[i] for i in part}, _frame(part, block.frames), None) for part in parts]
    else:
        models = [Model(adjusted_poses(part), _frame(part.poses, part.frames), part) for part in adjusted.parts()]
    first, *others = models
    return {_SPARSE: first, **{f"{_SPARSE}_own{model.frame}": model for model in others}}


def _frame(image_ids: Iterable[str], frames: Mapping[str, int]) -> int:
    """The number of the frame of its own that a part lies in, 0 in the world."""
    return frames.get(next(iter(image_ids), ""), 0)


def _models_remark(models: Mapping[str, Model]) -> list[str]:
    sizes = [f"{name} ({counted(len(model.poses), 'image')})" for name, model in models.items()]
    if len(sizes) < 2:
        return []
    return [f"groups of images whose place beside each other is not known are models of their own: {', '.join(sizes)}"]


def _write_worlds(folder: Path, block: Block, models: Mapping[str, Model]) -> None:
    """world.json, with the images of every frame where there is another than the block's own, and one in the folder of
    every model that lies in such."""
    names = block.names
    frames = []
    elsewhere = [name for name, model in models.items() if name != _SPARSE or (block.metric and model.frame)]
    for name, model in models.items() if elsewhere else ():
        frame = f"own {model.frame}" if model.frame else "world"
        unit = "m" if block.metric and not model.frame else "arbitrary"
        images = sorted(names[image_id] for image_id in model.poses)
        frames.append({"model": name, "frame": frame, "unit": unit, "images": images})
    write_world(folder, block, frames)
    for name in elsewhere:
        write_world(folder / name, replace(block, crs="local", origin_m=(0.0, 0.0, 0.0), metric=False))


def write_model(
    contents: ExportContents, model: Model, cameras: Mapping[str, Camera], ids: Numbers, sparse: Path
) -> None:
    """cameras.txt, images.txt and points3D.txt in the new folder `sparse`. cameras: by camera_id, those that COLMAP can
    hold."""
    sparse.mkdir()
    adjusted = model.adjusted
    if adjusted is not None and any(cameras[k] != camera for k, camera in adjusted.cameras.items()):
        # Errors of what is written: of the nearest camera where COLMAP cannot hold the adjusted one.
        lenses = {image.image_id: cameras[image.camera_id] for image in contents.block.images}
        adjusted = with_errors(adjusted, lenses, contents.keypoints_px)
    posed = [(image, *model.poses[image.image_id]) for image in contents.block.images if image.image_id in model.poses]
    (sparse / "cameras.txt").write_text(_cameras_text(cameras, ids), encoding="utf-8")
    with (sparse / "images.txt").open("w", encoding="utf-8") as stream:
        stream.write("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n")
        for image, world_rotation, center_m in posed:
            values = (*to_quaternion(world_rotation), *(-world_rotation @ center_m))
            numbers = " ".join(f"{value:.17g}" for value in values)
            stream.write(f"{ids.image[image.image_id]} {numbers} {ids.camera[image.camera_id]} {image.name}\n")
            stream.write("" if adjusted is None else _observations(contents, adjusted, image.image_id))
            stream.write("\n")
    with (sparse / "points3D.txt").open("w", encoding="utf-8") as stream:
        if adjusted is None:
            stream.write("# Empty: points are triangulated by COLMAP.\n")
        else:
            stream.writelines(_point_lines(adjusted, ids))
    if any(letter.isspace() for image, _, _ in posed for letter in image.name):
        # COLMAP reads names from text up to the first space; its binary model, which it prefers, keeps them whole.
        reconstruction = import_pycolmap().Reconstruction()
        reconstruction.read_text(sparse)
        for image, _, _ in posed:
            reconstruction.images[ids.image[image.image_id]].name = image.name
        reconstruction.write_binary(sparse)


def _cameras_text(cameras: Mapping[str, Camera], ids: Numbers) -> str:
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for camera_id, number in ids.camera.items():
        camera = cameras[camera_id]
        model, values = colmap_camera(camera)
        params = " ".join(f"{value:.17g}" for value in values)
        lines.append(f"{number} {model} {camera.width_px} {camera.height_px} {params}")
    return "\n".join(lines) + "\n"


def _observations(contents: ExportContents, adjusted: AdjustedBlock, image_id: str) -> str:
    """Every keypoint, as in the database, with the number of its point."""
    keypoints = np.asarray(contents.keypoints_px(image_id), dtype=np.float32).reshape(-1, 2) + COLMAP_OFFSET_PX
    points = np.full(len(keypoints), _NO_POINT)
    track = adjusted.tracks[image_id]
    points[track[:, 0]] = track[:, 1] + 1
    return " ".join(f"{x:.9g} {y:.9g} {point}" for (x, y), point in zip(keypoints, points, strict=True))


def _point_lines(adjusted: AdjustedBlock, ids: Numbers) -> Iterator[str]:
    """Points are numbered from 1 and grey: their colour is not known."""
    yield "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    images = np.concatenate(
        [np.zeros(0, int), *(np.full(len(track), ids.image[i]) for i, track in adjusted.tracks.items())]
    )
    rows = np.concatenate([np.zeros((0, 2), int), *adjusted.tracks.values()])
    order = np.lexsort((rows[:, 0], images, rows[:, 1]))
    images, rows = images[order], rows[order]
    starts = np.searchsorted(rows[:, 1], np.arange(len(adjusted.points_m) + 1))
    for number, (point, error) in enumerate(zip(adjusted.points_m, adjusted.errors_px, strict=True)):
        own = slice(starts[number], starts[number + 1])
        track = " ".join(f"{image} {keypoint}" for image, keypoint in zip(images[own], rows[own, 0], strict=True))
        place = " ".join(f"{value:.17g}" for value in point)
        yield f"{number + 1} {place} 128 128 128 {error:.9g} {track}\n"
