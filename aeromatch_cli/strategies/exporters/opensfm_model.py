"""OpenSfM's reconstruction.json: the adjusted cameras, poses and points, east, north and up of a reference.

The frame is the plane of opensfm/geo.py through the reference, whose axes are geocentric ones turned; a CRS is another
one: turned by the convergence, stretched by its scale, and curved. Centres and points are therefore converted one by
one, and each attitude is turned by what the frame does where its camera stands. Heights below and above the cameras are
stretched like distances across, for a block was adjusted with one scale in all directions: so points stay where the
images see them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Image
from aeromatch_cli.geometry.cameras import is_fisheye, parameters
from aeromatch_cli.geometry.ellipsoid import topocentric
from aeromatch_cli.geometry.frames import COLMAP_OFFSET_PX
from aeromatch_cli.strategies.exporters.contents import Colours, ExportContents
from aeromatch_cli.strategies.exporters.solution import Matched, Solution

# By which the frame is tried out around a camera, metres.
_STEP_M = 10.0
# What OpenSfM calls the reference of a block without positions.
_NOWHERE = 0.0, 0.0, 0.0


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
    """One part for the images of each frame, the block's own first. colours: RGB (T, 3) of the tracks."""
    adjusted, solution = project.contents.adjusted, project.solution
    assert adjusted is not None
    frames = {image_id: adjusted.frames.get(image_id, 0) for image_id in solution.poses}
    return [
        _part(project, found, colours, {image_id for image_id in frames if frames[image_id] == frame})
        for frame in sorted(set(frames.values()))
    ]


def _part(project: Project, found: Matched, colours: Colours, ids: Set[str]) -> dict[str, Any]:
    solution = project.solution
    images = [image for image in solution.images if image.image_id in ids]
    seen = np.isin(found.image_idx, [place for place, image_id in enumerate(found.image_ids) if image_id in ids])
    tracks = np.unique(found.track[seen])
    tracks = tracks[np.isfinite(found.points_m[tracks]).all(axis=1)]
    points_m = found.points_m[tracks]
    enu = _Frame(project, np.array([solution.poses[image.image_id][1] for image in images]), points_m)
    shots = {
        project.names[image.image_id]: _shot(project, image, *enu.pose(*solution.poses[image.image_id]))
        for image in images
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
