"""OpenSfM and ODM: features, matches, tracks and metadata of a project, for create_tracks and reconstruct.

Cameras are `brown` or `fisheye_opencv`, which hold all but b2. Pixels (opensfm/features.py): u = (x + 0.5 - w / 2) /
max(w, h) of x from the centre of the first pixel; the same for v. tracks.csv is version 2
(src/map/src/tracks_manager.cc); of an adjusted block it has the tracks of its points, by whose names
reconstruction.json calls them. Matches are pickled under numpy 1's module names, which both OpenSfM and ODM's fork
load. GPS positions are those that were given.

The frame of reconstruction.json, east, north and up of a reference, is the plane of opensfm/geo.py through it, whose
axes are geocentric ones turned; a CRS is another one: turned by the convergence, stretched by its scale, and curved.
Centres and points are therefore converted one by one, and each attitude is turned by what the frame does where its
camera stands. Heights below and above the cameras are stretched like distances across, for a block was adjusted with
one scale in all directions: so points stay where the images see them.
"""

from __future__ import annotations

import gzip
import json
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar, Literal

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Image
from aeromatch_cli.geometry.cameras import is_fisheye, parameters
from aeromatch_cli.geometry.ellipsoid import topocentric
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX
from aeromatch_cli.geometry.lenses import in_colmap
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import Colours, ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.solution import (
    Matched,
    Solution,
    called,
    colours_of,
    held,
    matched,
    summary_of,
    track_colours,
    write,
)

_TRACKS_HEAD = "OPENSFM_TRACKS_VERSION_v2\n"
_FEATURES_VERSION = 3
# The size of a keypoint is not handed on; nothing after matching reads it.
_SIZE_PX = 4.0
_CONFIG = "# Features, matches and tracks are those of aeromatch.\nmin_track_length: 2\n"
# By which the frame is tried out around a camera, metres.
_STEP_M = 10.0
# What OpenSfM calls the reference of a block without positions.
_NOWHERE = 0.0, 0.0, 0.0


class OpenSfm(Strategy):
    """Writes features, matches, tracks.csv, exif, camera_models.json, reference_lla.json and config.yaml of an OpenSfM
    project, and reconstruction.json of an adjusted block, with colours; put the images beside them as `images`. OpenSfM
    calls images by their file names, without folders."""

    version: ClassVar[int] = 4
    name: Literal["opensfm"] = "opensfm"

    def check_images(self, images: Sequence[Image]) -> None:
        """Raises ConfigError where file names are not different."""
        self._called(images)

    def _called(self, images: Sequence[Image]) -> dict[str, str]:
        how = "OpenSfM calls images by file names"
        return called(images, lambda name: PurePosixPath(name).name, self.name, how)

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written, ConfigError as `check_images`."""
        solution = Solution.of(contents)
        names = self._called(solution.images)
        lenses, remarks = held(solution, "OpenSfM", in_colmap)  # what it holds of lenses is what COLMAP holds
        project = Project.of(contents, solution, names, lenses)
        with whole_folder(folder) as partial:
            # Points of a reconstruction are found by the names of their tracks.
            found = matched(contents, adjusted_tracks=True)
            places = {i.image_id: _normalised(contents, i) for i in solution.images}
            colours = colours_of(contents, places)
            for image in solution.images:
                path = partial / "features" / f"{names[image.image_id]}.features.npz"
                _write_features(path, places[image.image_id], colours[image.image_id], image)
            _write_matches(partial / "matches", found, names)
            write(partial / "tracks.csv", _tracks_text(found, solution, places, colours, names))
            write(partial / "image_list.txt", "".join(f"images/{image.name}\n" for image in solution.images))
            write(partial / "config.yaml", _CONFIG)
            _write_metadata(partial, project)
            posed, apart = len(solution.poses), ""
            if contents.adjusted is not None:
                parts = reconstructions(project, found, track_colours(found, colours))
                write(partial / "reconstruction.json", json.dumps(parts) + "\n")
                posed = sum(len(part["shots"]) for part in parts)
                if len(parts) > 1:
                    apart = f"reconstruction.json has {len(parts)} parts, whose place beside each other is not known"
            keypoints = sum(map(len, places.values()))
            return summary_of(folder, partial, contents, posed, keypoints, found.counts, remarks, apart)


def _normalised(contents: ExportContents, image: Image) -> FloatArray:
    places = np.asarray(contents.keypoints_px(image.image_id), np.float64).reshape(-1, 2)
    size = np.array([image.width_px, image.height_px])
    return np.asarray((places + 0.5 - size / 2.0) / size.max())


def _write_features(path: Path, places: FloatArray, colours: Colours, image: Image) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    size = np.full(len(places), _SIZE_PX / max(image.width_px, image.height_px))
    points = np.column_stack([places, size, np.zeros(len(places))]).astype(np.float32)
    np.savez_compressed(
        path, points=points, descriptors=np.zeros((len(places), 1), np.uint8),
        colors=colours, segmentations=np.zeros(0), instances=np.zeros(0),
        segmentation_labels=np.zeros(0), OPENSFM_FEATURES_VERSION=_FEATURES_VERSION,
    )  # fmt: skip


def _write_matches(folder: Path, found: Matched, names: dict[str, str]) -> None:
    of_image: dict[str, dict[str, Any]] = {image_id: {} for image_id in names}
    for id0, id1, rows in found.pairs:
        of_image[id0][names[id1]] = np.ascontiguousarray(rows, np.int32)
    for image_id, matches in of_image.items():
        # Protocol 3 names modules in plain text, so that they can be those of numpy 1; protocol 2 would name one more,
        # which OpenSfM's reader forbids.
        raw = pickle.dumps(matches, protocol=3).replace(b"numpy._core.", b"numpy.core.")
        path = folder / f"{names[image_id]}_matches.pkl.gz"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(gzip.compress(raw, mtime=0))


def _tracks_text(
    found: Matched,
    solution: Solution,
    places: Mapping[str, FloatArray],
    colours: Mapping[str, Colours],
    names: Mapping[str, str],
) -> str:
    lines = [_TRACKS_HEAD]
    longer = [max(image.width_px, image.height_px) for image in solution.images]
    for track, image_idx, keypoint in zip(found.track, found.image_idx, found.keypoint, strict=True):
        image = solution.images[image_idx]
        x, y = places[image.image_id][keypoint]
        scale = _SIZE_PX / longer[image_idx]
        colour = "\t".join(map(str, colours[image.image_id][keypoint]))
        lines.append(f"{names[image.image_id]}\t{track}\t{keypoint}\t{x:.9g}\t{y:.9g}\t{scale:.9g}\t{colour}\t-1\t-1\n")
    return "".join(lines)


def _write_metadata(partial: Path, project: Project) -> None:
    write(partial / "camera_models.json", _json(dict(project.cameras.values())))
    for image in project.solution.images:
        name, model = project.cameras[image.camera_id]
        exif = {
            "make": "aeromatch", "model": image.camera_id, "width": image.width_px, "height": image.height_px,
            "projection_type": model["projection_type"], "focal_ratio": model["focal_x"], "orientation": 1,
            "capture_time": capture_time(image), "camera": name, "skey": "", "gps": project.gps.get(image.image_id, {}),
        }  # fmt: skip
        write(partial / "exif" / f"{project.names[image.image_id]}.exif", _json(exif))
    write(partial / "reference_lla.json", _json(lla(project.reference)))


def _json(value: Any) -> str:
    return json.dumps(value, indent=1) + "\n"


def camera_model(camera: Camera) -> dict[str, Any]:
    """OpenSfM's `brown` or `fisheye_opencv`: lengths as shares of the longer side, the principal point from the middle
    of the image."""
    values, longer = parameters(camera), max(camera.width_px, camera.height_px)
    middle = camera.width_px / 2.0 - COLMAP_OFFSET_PX, camera.height_px / 2.0 - COLMAP_OFFSET_PX
    model, terms = ("fisheye_opencv", ("k1", "k2", "k3", "k4")) if is_fisheye(camera) else (
        "brown", ("k1", "k2", "k3", "p1", "p2"))  # fmt: skip
    return {
        "projection_type": model, "width": camera.width_px, "height": camera.height_px,
        "focal_x": values["fx"] / longer, "focal_y": values["fy"] / longer, "c_x": (values["cx"] - middle[0]) / longer,
        "c_y": (values["cy"] - middle[1]) / longer, **{name: values[name] for name in terms},
    }  # fmt: skip


def capture_time(image: Image) -> float:
    """Seconds since 1970, 0 where unknown; a time without a zone counts as UTC."""
    if not image.time:
        return 0.0
    taken = datetime.fromisoformat(image.time)
    return (taken if taken.tzinfo else taken.replace(tzinfo=UTC)).timestamp()


@dataclass(frozen=True, eq=False)
class Project:
    """What the files of a project share.

    names: image_id -> file name. cameras: camera_id -> OpenSfM's name and model. gps: image_id -> latitude, longitude,
    altitude and `dop`, as given. reference: of east, north and up. shifts: image_id -> the same position from there.
    """

    contents: ExportContents
    solution: Solution
    names: Mapping[str, str]
    cameras: Mapping[str, tuple[str, dict[str, Any]]]
    gps: Mapping[str, dict[str, float]]
    reference: tuple[float, float, float]
    shifts: Mapping[str, list[float]]

    @classmethod
    def of(
        cls, contents: ExportContents, solution: Solution, names: Mapping[str, str], lenses: Mapping[str, Camera]
    ) -> Project:
        """lenses: camera_id -> camera that OpenSfM holds."""
        models = {camera_id: camera_model(camera) for camera_id, camera in lenses.items()}
        cameras = {
            camera_id: (f"v2 aeromatch {camera_id} {m['width']} {m['height']} {m['projection_type']}", m)
            for camera_id, m in models.items()
        }
        given = contents.block.poses if contents.positions is None else contents.positions
        ids = sorted(given)
        given_m = np.array([given[i].center_m for i in ids]).reshape(-1, 3)
        placed_m = given_m if ids else np.array([center_m for _, center_m in solution.poses.values()]).reshape(-1, 3)
        geographic = contents.geographic
        if geographic is None or not len(placed_m):
            return cls(contents, solution, names, cameras, {}, _NOWHERE, {})
        # As OpenSfM chooses it: the middle of the positions, at height 0.
        latitude, longitude = geographic(placed_m)[:, :2].mean(axis=0).tolist()
        reference = latitude, longitude, 0.0
        places = geographic(given_m)
        gps = {
            i: {**lla(place), "dop": float(given[i].sigma_position_m)}
            for i, place in zip(ids, places.tolist(), strict=True)
        }
        shifts = dict(zip(ids, topocentric(reference, places).tolist(), strict=True))
        return cls(contents, solution, names, cameras, gps, reference, shifts)


def lla(place: Sequence[float]) -> dict[str, float]:
    return dict(zip(("latitude", "longitude", "altitude"), place, strict=True))


def reconstructions(project: Project, found: Matched, colours: Colours) -> list[dict[str, Any]]:
    """One part for the images of each frame, the block's own first; of a block with a CRS that part alone, since what
    reads the file takes all parts for places of one reference. colours: RGB (T, 3) of the tracks."""
    adjusted, solution = project.contents.adjusted, project.solution
    assert adjusted is not None
    if project.contents.geographic is not None:
        return [_part(project, found, colours, solution.poses)] if solution.poses else []
    parts = ({i: (pose.rotation, pose.center_m) for i, pose in part.poses.items()} for part in adjusted.parts())
    return [_part(project, found, colours, poses) for poses in parts]


def _part(
    project: Project, found: Matched, colours: Colours, poses: Mapping[str, tuple[FloatArray, FloatArray]]
) -> dict[str, Any]:
    adjusted = project.contents.adjusted
    assert adjusted is not None
    images = [image for image in project.solution.images if image.image_id in poses]
    seen = np.isin(found.image_idx, [place for place, image_id in enumerate(found.image_ids) if image_id in poses])
    tracks = np.unique(found.track[seen])
    tracks = tracks[np.isfinite(adjusted.points_m[tracks]).all(axis=1)]
    points_m = adjusted.points_m[tracks]
    enu = _Frame(project, np.array([poses[image.image_id][1] for image in images]), points_m)
    shots = {
        project.names[image.image_id]: _shot(project, image, *enu.pose(*poses[image.image_id])) for image in images
    }
    places = np.round(enu.places(points_m), 6).tolist()
    points = {
        str(track): {"color": colour, "coordinates": place}
        for track, colour, place in zip(tracks, colours[tracks].astype(float).tolist(), places, strict=True)
    }
    cameras = dict(project.cameras[camera_id] for camera_id in sorted({image.camera_id for image in images}))
    reference = {} if project.contents.geographic is None else {"reference_lla": lla(project.reference)}
    return {"cameras": cameras, "shots": shots, "points": points, "biases": {}, **reference}


def _shot(project: Project, image: Image, rotation: FloatArray, center_m: FloatArray) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    shot = {
        "rotation": Rotation.from_matrix(rotation).as_rotvec().tolist(), "translation": (-rotation @ center_m).tolist(),
        "camera": project.cameras[image.camera_id][0], "orientation": 1, "capture_time": capture_time(image),
    }  # fmt: skip
    if image.image_id in project.shifts:
        shot["gps_position"] = project.shifts[image.image_id]
        shot["gps_dop"] = project.gps[image.image_id]["dop"]
    return shot


class _Frame:
    """From the block's world to OpenSfM's, as the module says; in a local frame both are one.

    centers_m (N, 3), points_m (P, 3): of the images that it is for.
    """

    def __init__(self, project: Project, centers_m: FloatArray, points_m: FloatArray) -> None:
        self._geographic, self._reference = project.contents.geographic, project.reference
        self._level_m, self._scale = 0.0, 1.0
        if self._geographic is not None:
            self._level_m = float(centers_m[:, 2].mean())
            # On the ground: up where the cameras are a metre across is a little longer.
            across = self._slopes((points_m if len(points_m) else centers_m).mean(axis=0))[:, :2]
            self._scale = float(np.linalg.norm(across, axis=0).mean())

    def places(self, world_m: FloatArray) -> FloatArray:
        if self._geographic is None or not len(world_m):
            return world_m
        heights_m = self._level_m + (world_m[:, 2] - self._level_m) * self._scale
        return topocentric(self._reference, self._geographic(np.column_stack([world_m[:, :2], heights_m])))

    def pose(self, rotation: FloatArray, center_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The same with the centre in OpenSfM's frame."""
        if self._geographic is None:
            return rotation, center_m
        left, _, right = np.linalg.svd(self._slopes(center_m))  # the nearest rotation of what the frame does here
        return rotation @ (left @ right).T, self.places(center_m[None])[0]

    def _slopes(self, center_m: FloatArray) -> FloatArray:
        """(3, 3): what becomes of a metre along x, y and z of the world, in columns."""
        steps = np.eye(3) * _STEP_M
        ends = self.places(np.concatenate([center_m + steps, center_m - steps]))
        return np.asarray((ends[:3] - ends[3:]).T / (2.0 * _STEP_M))
