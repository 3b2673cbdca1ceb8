"""The context holds what every stage knows: settings, workspace, block, pairs, and what follows from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from aeromatch_cli.config import Settings
from aeromatch_cli.data import Block, Camera, ControlPoint, FloatArray, Image, Neighbour, Pair, PairGeometry, Pose
from aeromatch_cli.executor import Executor
from aeromatch_cli.fingerprints import fingerprint
from aeromatch_cli.geometry.angles import Angles
from aeromatch_cli.geometry.cameras import focal_px
from aeromatch_cli.geometry.footprints import block_footprints, degenerate_words
from aeromatch_cli.images.remote import RemoteFile, on_disk
from aeromatch_cli.images.scaling import scale_within, shrink_camera
from aeromatch_cli.results.record import StageRecord
from aeromatch_cli.sfm.focal import with_focal_length
from aeromatch_cli.sfm.mapping import Observed
from aeromatch_cli.stages.shard import Shard
from aeromatch_cli.store.block_store import BlockStore
from aeromatch_cli.store.index import Index
from aeromatch_cli.strategies import Matcher
from aeromatch_cli.workspace import Workspace

V = TypeVar("V")
# A focal length with a larger standard deviation, as a share of it, is a guess.
_GUESS = 0.2


@dataclass(frozen=True, eq=False)
class JoinedFingerprints:
    """Holds the fingerprints that the features of every image and the matches of every pair of a cascade must carry, by
    id."""

    features: Mapping[str, str]
    matches: Mapping[tuple[str, str], str]


@dataclass(frozen=True, eq=False)
class Given:
    """Holds what was given of a block, before it was oriented.

    block: images, cameras, poses and ground as they were stated.
    image_fingerprints: image_id -> fingerprint of the image file, which results are made of.
    touched: image_id -> present fingerprint of a file of which nothing but its time has changed since.
    focal_sigmas: camera_id -> standard deviation of its focal length as it was stated, as a share of it.
    likely_focals: camera_id -> focal length in pixels that EXIF supports, where it contradicts the given one.
    angles: image_id -> attitude as it was given.
    flights: image_id -> name of its flight.
    velocities: image_id -> (3,) velocity of the aircraft in the world frame, m/s, where it is known.
    control: surveyed points.
    remote: name of an image -> where it lies on another machine; empty where the images lie in a folder.
    """

    block: Block
    image_fingerprints: Mapping[str, str]
    touched: Mapping[str, str] = field(default_factory=dict)
    focal_sigmas: Mapping[str, float] = field(default_factory=dict)
    likely_focals: Mapping[str, float] = field(default_factory=dict)
    angles: Mapping[str, Angles] = field(default_factory=dict)
    flights: Mapping[str, str] = field(default_factory=dict)
    velocities: Mapping[str, FloatArray] = field(default_factory=dict)
    control: tuple[ControlPoint, ...] = ()
    remote: Mapping[str, RemoteFile] = field(default_factory=dict)

    @property
    def guessed_cameras(self) -> frozenset[str]:
        """Cameras whose focal length was no more than a guess."""
        return frozenset(i for i, sigma in self.focal_sigmas.items() if sigma >= _GUESS)


@dataclass(frozen=True, eq=False)
class Scope:
    """Says which part of the work a command does.

    shard: the part of the block that it works on; None for all.
    overwrite: whether results that are up to date are made again.
    chosen: the pairs (image_id0, image_id1) that a step of a cascade works on; None for all.
    continues: the matcher that made the matches which a step of a cascade continues from; None without such a step.
    joined: the fingerprints of features and matches that the steps of a cascade have made together; None without one.
    part: a prefix to the names of stages where progress is shown.
    """

    shard: Shard | None = None
    overwrite: bool = False
    chosen: frozenset[tuple[str, str]] | None = None
    continues: Matcher | None = None
    joined: JoinedFingerprints | None = None
    part: str = ""


@dataclass(frozen=True, eq=False)
class Context:
    """Holds everything that a stage needs to know. It is made once per command by `stages.pairs.prepare`.

    settings: the resolved settings. workspace: the paths of the workspace's files. executor: runs the tasks of stages.
    given: what was given of the block.
    block: images, cameras, poses and ground in the world frame, oriented once `stages.orient` has run.
    pairs: the pairs of pairs.csv, in its order.
    scope: the part of the work that is done.
    index: what is known of the files of the workspace.

    What follows from these is kept in `known`, which is filled on demand; `dataclasses.replace` starts it anew, so that
    it never outlives what it was made from.
    """

    settings: Settings
    workspace: Workspace
    executor: Executor
    given: Given
    block: Block
    pairs: tuple[Pair, ...] = ()
    scope: Scope = field(default_factory=Scope)
    index: Index = field(default_factory=Index, repr=False)
    known: dict[tuple[Any, ...], Any] = field(default_factory=dict, init=False, repr=False)

    def with_scope(self, **changes: Any) -> Context:
        """Return the context with another scope. changes: of the fields of `Scope`."""
        return replace(self, scope=replace(self.scope, **changes))

    def once(self, *key: Any, make: Callable[[], V]) -> V:
        """Return what follows from the context, made once as long as the context stays. key: names it."""
        if key not in self.known:
            self.known[key] = make()
        value: V = self.known[key]
        return value

    @property
    def store(self) -> BlockStore:
        """Return what the workspace holds."""
        return BlockStore(self.workspace, self.index)

    def recorded(self, stage: str) -> StageRecord | None:
        """Return what a stage of the whole block has left, as `BlockStore.report`; None where all is made anew."""
        return None if self.scope.overwrite else self.store.report(stage)

    @property
    def observed(self) -> Observed:
        """Return what was given, as observations for mapping and adjustment."""
        adjust = self.settings.adjust
        switches: dict[str, bool] = {**dict.fromkeys(adjust.free, True), **dict.fromkeys(adjust.hold, False)}
        return Observed(
            calibration=adjust.calibration,
            switches=switches,
            rolling_shutter=adjust.rolling_shutter,
            poses=self.given.block.poses,
            focal_sigmas=self.given.focal_sigmas,
            angles=self.given.angles,
            cameras={camera_id: self._stated_camera(camera_id) for camera_id in self.given.block.cameras},
            flights=self.given.flights,
            velocities=self.given.velocities,
            control=self.given.control,
        )

    def _stated_camera(self, camera_id: str) -> Camera:
        """A camera as given; where EXIF contradicts it, with that focal length which the pictures are nearer to."""
        stated = self.given.block.cameras[camera_id]
        if camera_id not in self.given.likely_focals or camera_id not in self.block.cameras:
            return stated
        found_px = focal_px(self.block.cameras[camera_id])
        nearest_px = min(
            focal_px(stated), self.given.likely_focals[camera_id], key=lambda px: abs(np.log(px / found_px))
        )
        return with_focal_length(stated, nearest_px)

    @property
    def guessed_cameras(self) -> frozenset[str]:
        """Cameras whose focal length is no more than a guess."""
        return self.given.guessed_cameras - self.block.calibrated

    def owns(self, item_id: str) -> bool:
        return self.scope.shard is None or self.scope.shard.owns(item_id)

    def images(self) -> list[Image]:
        """The images of this shard."""
        return [image for image in self.block.images if self.owns(image.image_id)]

    def rows(self) -> dict[str, list[Pair]]:
        """Pairs of this shard and step by image_id0, in order."""
        rows: dict[str, list[Pair]] = {}
        chosen = self.scope.chosen
        for pair in self.pairs:
            wanted = chosen is None or (pair.image_id0, pair.image_id1) in chosen
            if wanted and self.owns(pair.image_id0):
                rows.setdefault(pair.image_id0, []).append(pair)
        return rows

    def picture(self, image: Image) -> Path | RemoteFile:
        """Return where an image lies, here or elsewhere."""
        return self.given.remote.get(image.name) or Path(self.settings.block.images) / image.name

    def image_path(self, image: Image) -> Path:
        """Return the file of an image on this machine. Raises ItemError where it cannot be fetched."""
        return on_disk(self.picture(image))

    def pose(self, image_id: str) -> Pose | None:
        return self.block.poses.get(image_id)

    def ground_z_m(self, image_id: str) -> float | None:
        """Ground height where an image looks (below it, without attitude), None without ground or position."""
        return _ground_heights(self.block).get(image_id)

    def ground_remark(self, image_id: str) -> str:
        """Say why the ground of an image is not the terrain below it, else return ""."""
        footprint = block_footprints(self.block).get(image_id)
        if footprint is None or footprint.degenerate is None:
            return ""
        return degenerate_words(footprint.degenerate, self.block)

    def working_camera(self, image: Image) -> Camera:
        """The camera of the picture that is worked on (--max-size)."""
        scale = scale_within(self.settings.block.max_size_px, image.width_px, image.height_px)
        return shrink_camera(self.block.camera(image), scale)

    @property
    def image_by_id(self) -> Mapping[str, Image]:
        return _image_index(self.block)

    def geometry(self, pair: Pair) -> PairGeometry:
        """Return what is known of a pair. Poses in frames of their own say nothing of images outside these."""
        images = self.image_by_id
        related = self._share_frame(pair.image_id0, pair.image_id1)
        heights = [h for h in (self.ground_z_m(pair.image_id0), self.ground_z_m(pair.image_id1)) if h is not None]
        return PairGeometry(
            pair=pair,
            camera0=self.block.camera(images[pair.image_id0]),
            camera1=self.block.camera(images[pair.image_id1]),
            pose0=self.pose(pair.image_id0) if related else None,
            pose1=self.pose(pair.image_id1) if related else None,
            ground_z_m=sum(heights) / len(heights) if heights else None,
        )

    def lacks_attitude(self, image_id: str) -> bool:
        """Whether an image, or one that it is paired with, has no attitude in a common frame: north-up views of both
        cannot be compared then, the source images can."""
        ids = (image_id, *(other for other, _ in self._paired.get(image_id, ())))
        poses = [self.pose(i) if self._share_frame(image_id, i) else None for i in ids]
        return any(pose is None or pose.world_rotation is None for pose in poses)

    def _share_frame(self, image_id0: str, image_id1: str) -> bool:
        """Whether the poses of two images, as far as there are two, lie in one frame."""
        posed = self.block.poses.keys() >= {image_id0, image_id1}
        return not posed or self.block.frames.get(image_id0) == self.block.frames.get(image_id1)

    def neighbours(self, image_id: str) -> tuple[Neighbour, ...]:
        """Return from where else the ground of an image is looked at: the images it is paired with that have an
        attitude."""
        found = []
        for other_id, overlap in self._paired.get(image_id, ()):
            pose = self.pose(other_id) if self._share_frame(image_id, other_id) else None
            if pose is not None and pose.world_rotation is not None:
                camera = self.working_camera(self.image_by_id[other_id])
                found.append(Neighbour(camera, pose, overlap, self.ground_z_m(other_id)))
        return tuple(found)

    def same_illumination(self, image_id: str, minutes: float) -> bool:
        """Whether an image and all that it is paired with are known to be taken within so many minutes."""
        images = self.image_by_id
        times = [images[i].time for i in (image_id, *(other for other, _ in self._paired.get(image_id, ())))]
        if minutes <= 0.0 or not all(times):
            return False
        taken, *others = (datetime.fromisoformat(time) for time in times)
        return all(abs((other - taken).total_seconds()) <= 60.0 * minutes for other in others)

    @cached_property
    def _paired(self) -> Mapping[str, Sequence[tuple[str, float]]]:
        """image_id -> the other image and the overlap of each of its pairs, in the order of the ids."""
        found: dict[str, list[tuple[str, float]]] = {}
        for pair in self.pairs:
            found.setdefault(pair.image_id0, []).append((pair.image_id1, pair.overlap))
            found.setdefault(pair.image_id1, []).append((pair.image_id0, pair.overlap))
        return {image_id: sorted(others) for image_id, others in found.items()}

    def geometry_fingerprint(self, image_id: str, needs: frozenset[str]) -> str:
        """Return the fingerprint of what strategies with these `needs` read of one image's geometry."""
        return self.once("geometry", image_id, needs, make=lambda: self._geometry_fingerprint(image_id, needs))

    def _geometry_fingerprint(self, image_id: str, needs: frozenset[str]) -> str:
        pose = self.pose(image_id)
        parts: dict[str, Any] = {}
        if "camera" in needs:
            parts["camera"] = self.block.camera(self.image_by_id[image_id])
        if "pose" in needs:
            parts["pose"] = (pose.center_m, pose.world_rotation) if pose else None
            if image_id in self.block.frames:
                parts["frame"] = self.block.frames[image_id]
        if "sigma" in needs:
            parts["sigma"] = (pose.sigma_position_m, pose.sigma_angle_deg) if pose else None
        if "ground" in needs:
            parts["ground"] = (self.ground_z_m(image_id), self.block.views_gsd_m)
        if "neighbours" in needs:
            parts["neighbours"] = [
                (n.camera, n.pose.center_m, n.pose.world_rotation, n.overlap, n.ground_z_m)
                for n in self.neighbours(image_id)
            ]
        return fingerprint(parts)


@lru_cache(maxsize=4)
def _ground_heights(block: Block) -> Mapping[str, float]:
    """World height of the ground by image_id: over relief an oblique image looks at other heights than it stands on."""
    if block.ground is None:
        return {}
    below = {i: float(block.ground.height_m(pose.center_m[None, :2])[0]) for i, pose in block.poses.items()}
    heights = below | {i: footprint.ground_z_m for i, footprint in block_footprints(block).items()}
    # To the millimetre: a terrain that has grown gives the same heights but for the last bits.
    return {i: round(height_m, 3) for i, height_m in heights.items()}


@lru_cache(maxsize=4)
def _image_index(block: Block) -> Mapping[str, Image]:
    return {image.image_id: image for image in block.images}
