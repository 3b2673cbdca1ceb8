"""OpenSfM and ODM: features, matches, tracks and metadata of a project, for create_tracks and reconstruct.

Cameras are `brown` or `fisheye_opencv`, which hold all but b2. Pixels (opensfm/features.py): u = (x + 0.5 - w / 2) /
max(w, h) of x from the centre of the first pixel; the same for v. tracks.csv is version 2
(src/map/src/tracks_manager.cc); of an adjusted block it has the tracks of its points, by whose names
reconstruction.json calls them. Matches are pickled under numpy 1's module names, which both OpenSfM and ODM's fork
load. GPS positions are those that were given.
"""

from __future__ import annotations

import gzip
import json
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar, Literal

import numpy as np

from aeromatch_cli.data import FloatArray, Image
from aeromatch_cli.geometry.lenses import in_colmap
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import Colours, ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.opensfm_model import Project, capture_time, lla, reconstructions
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


class OpenSfm(Strategy):
    """Writes features, matches, tracks.csv, exif, camera_models.json, reference_lla.json and config.yaml of an OpenSfM
    project, and reconstruction.json of an adjusted block, with colours; put the images beside them as `images`. OpenSfM
    calls images by their file names, without folders."""

    version: ClassVar[int] = 3
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
            if contents.adjusted is not None:
                parts = reconstructions(project, found, track_colours(found, colours))
                write(partial / "reconstruction.json", json.dumps(parts) + "\n")
            keypoints = sum(map(len, places.values()))
            return summary_of(folder, partial, contents, len(solution.poses), keypoints, found.counts, remarks)


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
