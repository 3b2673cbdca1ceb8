"""What several exporters write in their own ways: oriented images, tracks of verified matches, whole text files."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aeromatch_cli.data import AdjustedBlock, Block, Camera, FloatArray, Image, IntArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.components import component_labels
from aeromatch_cli.geometry.lenses import Nearest
from aeromatch_cli.strategies.exporters.contents import Colours, ExportContents, ExportSummary
from aeromatch_cli.words import counted, form

_GREY = 128


@dataclass(frozen=True, eq=False)
class Solution:
    """Cameras and poses after adjustment, else as the block has them.

    images: all, sorted by image_id. cameras: camera_id -> Camera. poses: image_id -> ((3, 3) cam_from_world, (3,)
    centre in the world); images without attitude are absent, and those that `unplaced` names.
    """

    images: tuple[Image, ...]
    cameras: Mapping[str, Camera]
    poses: Mapping[str, tuple[FloatArray, FloatArray]]

    @classmethod
    def of(cls, contents: ExportContents) -> Solution:
        block, adjusted, aside = contents.block, contents.adjusted, unplaced(contents)
        cameras = block.cameras if adjusted is None else {**block.cameras, **adjusted.cameras}
        known = known_poses(block) if adjusted is None else adjusted_poses(adjusted)
        return cls(block.images, cameras, {i: pose for i, pose in known.items() if i not in aside})

    def camera(self, image: Image) -> Camera:
        return self.cameras[image.camera_id]


def known_poses(block: Block) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Poses before adjustment, of all images that have an attitude, each in the frame of its group."""
    return {i: (p.world_rotation, p.center_m) for i, p in block.poses.items() if p.world_rotation is not None}


def adjusted_poses(adjusted: AdjustedBlock) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Poses after adjustment, each in the frame of its group."""
    return {i: (pose.rotation, pose.center_m) for i, pose in adjusted.poses.items()}


def unplaced(contents: ExportContents) -> frozenset[str]:
    """Images of groups whose place beside the first part of the block is not known, as adjusted or, without adjustment,
    as oriented; of a block in metres all that no position has placed in its world."""
    return (contents.adjusted or contents.block).aside(in_world=contents.block.metric)


def unplaced_remark(contents: ExportContents) -> list[str]:
    """Return a sentence on the images that `unplaced` names, where a format leaves them out."""
    if not (beside := unplaced(contents)):
        return []
    frames = (contents.adjusted or contents.block).frames
    groups = len({frames[image_id] for image_id in beside})
    which = "another group" if groups == 1 else f"{groups} other groups"
    return [
        f"{counted(len(beside), 'image')} of {which}, whose place beside the first is not known, "
        f"{form(len(beside), 'has', 'have')} no pose and no point here: "
        "export=colmap writes a model of each group"
    ]


@dataclass(frozen=True, eq=False)
class Matched:
    """Verified pairs and what follows from all of them, in memory.

    pairs: (image_id0, image_id1, (V, 2) keypoint indices). image_ids: sorted. track, image_idx, keypoint: (N,) of every
    observation, sorted by track, then image; tracks are numbered from 0. points_m: (T, 3), NaN where none is known.
    counts: of the summary.
    """

    pairs: Sequence[tuple[str, str, IntArray]]
    image_ids: Sequence[str]
    track: IntArray
    image_idx: IntArray
    keypoint: IntArray
    points_m: FloatArray
    counts: Mapping[str, int]

    @property
    def starts(self) -> IntArray:
        """(T + 1,): the observations of track t are starts[t] to starts[t + 1]."""
        return np.asarray(np.searchsorted(self.track, np.arange(len(self.points_m) + 1)))


def matched(contents: ExportContents, *, adjusted_tracks: bool = False) -> Matched:
    """Tracks of all verified matches; two keypoints of one image in a track contradict each other and end it.

    adjusted_tracks: those of the adjusted block instead, where there is one, with their points; points of images that
    `unplaced` names have no place.
    """
    ids = [image.image_id for image in contents.block.images]
    place = {image_id: number for number, image_id in enumerate(ids)}
    pairs, counts = [], dict.fromkeys(("matched_pairs", "matches", "verified_pairs", "verified_matches"), 0)
    for item in contents.pairs:
        counts["matched_pairs"] += len(item.matches) > 0
        counts["matches"] += len(item.matches)
        counts["verified_pairs"] += len(item.verified) > 0
        counts["verified_matches"] += len(item.verified)
        if len(item.verified):
            pairs.append((item.pair.image_id0, item.pair.image_id1, np.asarray(item.verified, np.int64)))
    if adjusted_tracks and contents.adjusted is not None:
        found = contents.adjusted.tracks
        rows = [np.column_stack([np.full(len(t), place[i]), t]) for i, t in found.items()]
        table = np.concatenate([np.zeros((0, 3), np.int64), *rows])
        order = np.lexsort((table[:, 1], table[:, 0], table[:, 2]))
        image_idx, keypoint, track = table[order].T
        points_m = contents.adjusted.points_m.copy()
        for image_id in unplaced(contents) & found.keys():
            points_m[found[image_id][:, 1]] = np.nan
        return Matched(pairs, ids, track, image_idx, keypoint, points_m, counts)
    image_idx, keypoint, track = _joined(pairs, place)
    points = np.full((int(track.max(initial=-1)) + 1, 3), np.nan)
    return Matched(pairs, ids, track, image_idx, keypoint, points, counts)


def _joined(
    pairs: Sequence[tuple[str, str, IntArray]], place: Mapping[str, int]
) -> tuple[IntArray, IntArray, IntArray]:
    """Image, keypoint and track of every observation, by connected components of the matches."""
    if not pairs:
        return (np.zeros(0, np.int64),) * 3
    ends = [
        np.concatenate(
            [np.column_stack([np.full(len(rows), place[names[side]]), rows[:, side]]) for *names, rows in pairs]
        )
        for side in range(2)
    ]
    nodes, inverse = np.unique(np.concatenate(ends), axis=0, return_inverse=True)
    label = component_labels(len(nodes), inverse.reshape(2, -1).T)
    # A track that sees one image twice is none.
    seen, times = np.unique(np.column_stack([label, nodes[:, 0]]), axis=0, return_counts=True)
    bad = np.unique(seen[times > 1, 0])
    good = ~np.isin(label, bad)
    _, track = np.unique(label[good], return_inverse=True)
    order = np.lexsort((nodes[good, 0], track))
    return nodes[good, 0][order], nodes[good, 1][order], track[order]


def keypoints_of(contents: ExportContents) -> dict[str, FloatArray]:
    """image_id -> (K, 2) float64 stored pixels of every image, each read once."""
    return {i.image_id: np.asarray(contents.keypoints_px(i.image_id), np.float64) for i in contents.block.images}


def rows_of_images(image_idx: IntArray, count: int) -> list[IntArray]:
    """The rows of (N,) that are of each of so many images, in order: sorted once, not looked for by every image."""
    order = np.argsort(image_idx, kind="stable")
    return np.split(order, np.searchsorted(image_idx[order], np.arange(1, count)))


def colours_of(contents: ExportContents, keypoints: Mapping[str, FloatArray]) -> dict[str, Colours]:
    """image_id -> RGB (K, 3) of the picture at its keypoints, grey where it cannot be seen; every picture is decoded
    once."""
    found = {}
    for image_id, places_px in keypoints.items():
        seen = contents.colours(image_id)
        found[image_id] = np.full((len(places_px), 3), _GREY, np.uint8) if seen is None else seen
    return found


def track_colours(found: Matched, colours: Mapping[str, Colours]) -> Colours:
    """(T, 3) RGB of every track: the mean over the images that see it."""
    sums = np.zeros((len(found.points_m), 3))
    rows = rows_of_images(found.image_idx, len(found.image_ids))
    for image_id, own in zip(found.image_ids, rows, strict=True):
        sums[found.track[own]] += colours[image_id][found.keypoint[own]]  # a track sees an image once
    return np.rint(sums / np.maximum(np.diff(found.starts), 1)[:, None]).astype(np.uint8)


def summary_of(
    folder: Path,
    partial: Path,
    contents: ExportContents,
    posed: int,
    keypoints: int,
    counts: Mapping[str, int],
    remarks: Iterable[str] = (),
    apart: str = "",
) -> ExportSummary:
    """partial: the scratch folder that holds the files now. apart: where images are that `unplaced` names, empty where
    they are left out."""
    names = sorted(path.relative_to(partial) for path in partial.rglob("*") if path.is_file())
    return ExportSummary(
        files=tuple(folder / name for name in names), images=len(contents.block.images), posed_images=posed,
        keypoints=keypoints, remarks=(*remarks, *([apart] if apart else unplaced_remark(contents))), **counts,
    )  # fmt: skip


def held(
    solution: Solution, program: str, nearest: Callable[[Camera], Nearest]
) -> tuple[Mapping[str, Camera], list[str]]:
    """camera_id -> the camera that a program's format holds, and a remark for each that is another one.

    nearest: the camera of those that the format holds.
    """
    cameras, remarks = {}, []
    for camera_id, camera in sorted(solution.cameras.items()):
        found = nearest(camera)
        cameras[camera_id] = found.camera or camera
        remarks += misfit_remark(camera_id, program, found)
    return cameras, remarks


def misfit_remark(camera_id: str, program: str, found: Nearest) -> list[str]:
    """One sentence where the camera that was written is another one."""
    if not found.differs:
        return []
    return [f"camera {camera_id}: {program} has no such lens model; the nearest one is written, {found.misfit}"]


def write_world(folder: Path, block: Block, frames: Sequence[Mapping[str, object]] = ()) -> None:
    """world.json: in which CRS, less which origin, coordinates count that a format has no place for. frames: what is to
    be said of each, where there are several."""
    world = {
        "crs": block.crs,
        "origin_m": list(block.origin_m),
        "unit": "m" if block.metric else "arbitrary",
        "note": "coordinate in crs = coordinate here + origin",
        **({"frames": frames} if frames else {}),
    }
    write(folder / "world.json", json.dumps(world, indent=2) + "\n")


def write(path: Path, text: str) -> None:
    """With the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def called(images: Iterable[Image], name_of: Callable[[str], str], exporter: str, how: str) -> dict[str, str]:
    """image_id -> what a format calls an image, by its name. Raises ConfigError, which says how, where two images would
    be called the same: one's files would replace the other's."""
    names: dict[str, str] = {}
    first: dict[str, str] = {}
    for image in images:
        name = names[image.image_id] = name_of(image.name)
        if name in first:
            both = f"{first[name]} and {image.name} would both be called {name}"
            raise ConfigError(f"{how}, and {both}: rename one, or leave {exporter} out of export")
        first[name] = image.name
    return names
