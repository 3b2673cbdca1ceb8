"""The nouns that every layer speaks of. All frozen; arrays are never written to after construction.

Frames are stated once in `geometry/frames.py`. Points are rows (x, y) in pixels, (0, 0) being the centre of the
top-left pixel of the stored raster.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]
IntArray = NDArray[np.integer[Any]]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Camera:
    """A lens and a sensor, shared by a group of images.

    model: one of `geometry.cameras.MODELS`: BROWN, or a name of COLMAP's.
    width_px, height_px: size of the stored raster.
    params: in the order of MODELS; focal lengths in px, cx and cy in this project's pixel frame (COLMAP's minus 0.5).
    """

    model: str
    width_px: int
    height_px: int
    params: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a camera was and, if known, how it looked.

    center_m: (3,) float64, projection centre in the world frame, metres.
    world_rotation: (3, 3) float64, rotation part of cam_from_world, or None where only the position is known.
    sigma_position_m, sigma_angle_deg: standard deviation of each coordinate and of each angle.
    sigmas_m: standard deviations along x, y, z of the world frame where they differ, sigma_position_m being their root
    mean square; None where each is sigma_position_m.
    """

    center_m: FloatArray
    world_rotation: FloatArray | None
    sigma_position_m: float
    sigma_angle_deg: float
    sigmas_m: tuple[float, float, float] | None = None

    @property
    def axis_sigmas_m(self) -> FloatArray:
        """(3,) standard deviations along x, y, z of the world frame."""
        return np.full(3, self.sigma_position_m) if self.sigmas_m is None else np.array(self.sigmas_m)


@dataclass(frozen=True, eq=False)
class AdjustedPose:
    """A pose as a bundle adjustment leaves it.

    center_m: (3,) in the world frame; rotation: (3, 3) cam_from_world. sigmas_m, sigmas_deg: (3,) standard deviations
    of x, y, z and of omega, phi, kappa; NaN where they are not known. sweep_m: (3,) by how much the centre moves in the
    world between the exposures of the first row and the last, zero of a shutter that exposes all at once; center_m is
    that of the middle row.
    """

    center_m: FloatArray
    rotation: FloatArray
    sigmas_m: FloatArray
    sigmas_deg: FloatArray
    sweep_m: FloatArray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False)
class AdjustedBlock:
    """Cameras, poses and points of a bundle adjustment, world frame.

    cameras: camera_id -> Camera. poses: image_id -> AdjustedPose; images that could not be tied are absent. points_m:
    (P, 3). errors_px: (P,) mean reprojection errors. tracks: image_id -> (n, 2) int32, keypoint of the image and row
    of points_m. frames: image_id -> number of the frame of its own that its group lies in, from 1; absent where
    positions have placed it in the world.
    """

    cameras: Mapping[str, Camera]
    poses: Mapping[str, AdjustedPose]
    points_m: FloatArray
    errors_px: FloatArray
    tracks: Mapping[str, IntArray]
    frames: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def empty(cls) -> AdjustedBlock:
        """Of no image, where none could be adjusted."""
        return cls({}, {}, np.zeros((0, 3)), np.zeros(0), {})

    def cameras_of(self, block: Block) -> dict[str, Camera]:
        """image_id -> its camera as adjusted, else as the block has it."""
        lenses = {**block.cameras, **self.cameras}
        return {image.image_id: lenses[image.camera_id] for image in block.images}

    @property
    def observations(self) -> int:
        """Of points by images."""
        return sum(len(track) for track in self.tracks.values())

    def parts(self) -> list[AdjustedBlock]:
        """Return the block in parts that have a frame each, with the points of their images, numbered anew: first what
        positions have placed in the world, then groups in frames of their own, the largest first; itself where it is
        one. At least one part.
        """
        parts = by_frame(self.poses, self.frames)
        return [self] if len(parts) < 2 else [self._part(part) for part in parts]

    def aside(self, *, in_world: bool) -> frozenset[str]:
        """Return the images whose place beside the first part is not known; `in_world` that in the world."""
        return _aside(self.poses, self.frames, in_world=in_world)

    def _part(self, image_ids: Sequence[str]) -> AdjustedBlock:
        tracks = {i: self.tracks[i] for i in image_ids if i in self.tracks}
        seen = np.unique(np.concatenate([np.zeros(0, np.int32), *(track[:, 1] for track in tracks.values())]))
        for i, track in tracks.items():
            tracks[i] = np.column_stack([track[:, 0], np.searchsorted(seen, track[:, 1])]).astype(np.int32)
        poses = {i: self.poses[i] for i in image_ids}
        frames = {i: self.frames[i] for i in image_ids if i in self.frames}
        return AdjustedBlock(self.cameras, poses, self.points_m[seen], self.errors_px[seen], tracks, frames)


def by_frame(image_ids: Iterable[str], frames: Mapping[str, int]) -> list[list[str]]:
    """Return images in parts that have a frame each: first those in the world, which `frames` lacks, then groups in
    frames of their own, the largest first."""
    members: dict[int, list[str]] = {}
    for image_id in image_ids:
        members.setdefault(frames.get(image_id, 0), []).append(image_id)
    return [members[k] for k in sorted(members, key=lambda k: (k > 0, -len(members[k]), k))]


def _aside(image_ids: Iterable[str], frames: Mapping[str, int], *, in_world: bool) -> frozenset[str]:
    parts = by_frame(image_ids, frames)
    beside = frozenset(image_id for part in parts[1:] for image_id in part)
    return beside | {i for part in parts[:1] for i in part if i in frames} if in_world else beside


@dataclass(frozen=True, eq=False)
class PoseResidual:
    """An adjusted pose beside the one given, and how well the image fits its points.

    position_m: (3,) adjusted less given, x, y, z of the world. rotation_deg: (3,) rotation vector, about the same axes,
    that turns the given attitude into the adjusted one. position_sigmas, rotation_sigmas: (3,) both in the standard
    deviations that were stated, each axis in its own. NaN where nothing was given, and in a frame that no position
    ties to the world. error_px: mean reprojection error; points: how many; images_per_point: mean of them. NaN without
    points.
    """

    position_m: FloatArray
    position_sigmas: FloatArray
    rotation_deg: FloatArray
    rotation_sigmas: FloatArray
    error_px: float
    points: int
    images_per_point: float


@dataclass(frozen=True, eq=False)
class ControlPoint:
    """A surveyed point. position_m: (3,) in the world frame. check: it takes no part in any fit.

    pixels: image_id -> (2,) stored pixel. sigmas_m: standard deviations of x, y, z; sigma_px: of each coordinate of a
    pixel.
    """

    name: str
    position_m: FloatArray
    check: bool
    pixels: Mapping[str, FloatArray]
    sigmas_m: tuple[float, float, float] = (0.02, 0.02, 0.03)
    sigma_px: float = 0.5


@dataclass(frozen=True)
class Image:
    """One stored raster of the block.

    image_id: unique slug of the relative path, fixed once; names every file of this image in the workspace.
    name: path relative to the images folder, with forward slashes.
    exif_orientation: 1-8; turns previews only, never coordinates.
    time: capture time as ISO text, or "" where unknown.
    """

    image_id: str
    name: str
    width_px: int
    height_px: int
    camera_id: str
    exif_orientation: int = 1
    time: str = ""


class Ground(Protocol):
    """The terrain below the block."""

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """World heights (N,) in metres below the world points xy_m (N, 2)."""
        ...


class Raster(Protocol):
    """A stored picture, read only as far as it is needed: gray, float32, proportional to light as far as it is known.

    Every read gives values (H, W) on one scale and where they are valid, (H, W) or None = everywhere.
    """

    @property
    def width_px(self) -> int: ...

    @property
    def height_px(self) -> int: ...

    @property
    def finest(self) -> float:
        """The largest scale that anything may be read at, 1 for stored pixels."""
        ...

    def reduced(self, scale: float) -> tuple[FloatArray, BoolArray | None]:
        """The whole picture, its area averaged to `scale` <= 1: stored pixel x lies at (x + 0.5) scale - 0.5."""
        ...

    def window(self, left: int, top: int, width: int, height: int) -> tuple[FloatArray, BoolArray | None]:
        """Stored pixels from (left, top), which must lie inside."""
        ...


class PictureQuality(NamedTuple):
    """How sharp and well exposed a picture is. blur: 0 (sharp) to 1 (of one value), NaN where nothing is seen. black,
    white: shares of the pixels that show nothing. damage: what the decoder complains of, "" for nothing. sha256: of the
    file, to tell one that was only touched from one that has changed."""

    blur: float
    black: float
    white: float
    damage: str = ""
    sha256: str = ""


@dataclass(frozen=True, eq=False)
class Block:
    """What was flown.

    images: sorted by image_id. cameras: camera_id -> Camera. poses: image_id -> Pose; images without any position
    are absent. crs: authority code of the world frame, or "local". origin_m: (3,) what was subtracted from the
    coordinates of that CRS. ground_source: where the ground came from, in words. gsd_m: the common ground sampling
    distance of the images, or None where no image has an attitude; reduced_gsd_m: of them as they are worked on, None
    where none is reduced. tied: pairs (image_id0, image_id1) that a first pass has matched; similar: pairs that look
    alike, where that was asked for. outside: images without an attitude that `orient` has confirmed or found.
    calibrated: camera_ids whose focal length the first pass has found. metric: whether lengths are metres; false in a
    frame of the pictures' own, whose scale is arbitrary. frames: image_id -> number of the frame of its own that its
    group lies in, from 1; absent where the image has its place in the world.
    """

    images: tuple[Image, ...]
    cameras: Mapping[str, Camera]
    poses: Mapping[str, Pose]
    crs: str
    origin_m: tuple[float, float, float]
    ground: Ground | None
    ground_source: str
    gsd_m: float | None
    tied: tuple[tuple[str, str], ...] = ()
    similar: tuple[tuple[str, str], ...] = ()
    outside: frozenset[str] = frozenset()
    calibrated: frozenset[str] = frozenset()
    reduced_gsd_m: float | None = None
    metric: bool = True
    frames: Mapping[str, int] = field(default_factory=dict)

    def aside(self, *, in_world: bool) -> frozenset[str]:
        """Return the images whose place beside the first part is not known, as `AdjustedBlock.aside`."""
        return _aside(self.poses, self.frames, in_world=in_world)

    @property
    def names(self) -> dict[str, str]:
        """image_id -> name of its file."""
        return {image.image_id: image.name for image in self.images}

    @property
    def views_gsd_m(self) -> float | None:
        """The common ground sampling distance of the ground views, or None as gsd_m."""
        return self.gsd_m if self.gsd_m is None or self.reduced_gsd_m is None else self.reduced_gsd_m

    def camera(self, image: Image) -> Camera:
        return self.cameras[image.camera_id]


@dataclass(frozen=True)
class Pair:
    """Two images that may show the same ground; image_id0 < image_id1.

    overlap: shared ground area over the smaller footprint, 0-1, NaN where unknown.
    view_angle_deg: angle between the rays from both cameras to the middle of the overlap, NaN where unknown.
    reason: the rule that chose the pair, in one word ("overlap", "position", "name", "time", "exhaustive", ...).
    """

    image_id0: str
    image_id1: str
    overlap: float
    view_angle_deg: float
    reason: str

    @property
    def ids(self) -> tuple[str, str]:
        return self.image_id0, self.image_id1


@dataclass(frozen=True, eq=False)
class View:
    """A virtual camera made from one image by a plane-induced homography. View 0 may be the source itself.

    undistorted_from_view: (3, 3) float64; source pixel = distort(camera, undistorted_from_view . view pixel).
    angle_deg: angle between the image's own optical axis and the view's.
    world_direction: (3,) unit vector along which the view looks, world frame, None where the attitude is unknown.
    gsd_m: ground metres per view pixel, None where it is unknown or varies (perspective views).
    ground_from_view: (3, 3) view pixel -> world x, y in metres on the plane that the view was made of, None for the
    source. north_up: whether the view's axes follow the world's alone (a function of world_direction), so that things
    on the ground have the same orientation in all views of like direction. enhanced: whether its picture is the
    enhanced one where the picture as it was taken has a view of its own. beyond: of a view of distant ground: the
    view of nearer ground whose box it leaves out.
    """

    name: str
    width_px: int
    height_px: int
    undistorted_from_view: FloatArray
    is_source: bool
    angle_deg: float
    world_direction: FloatArray | None = None
    gsd_m: float | None = None
    north_up: bool = False
    ground_from_view: FloatArray | None = None
    enhanced: bool = False
    beyond: View | None = None


@dataclass(frozen=True, eq=False)
class Neighbour:
    """Another image that is paired with one: where else its ground is looked at from.

    overlap: as in Pair, NaN where unknown. ground_z_m: world height of the ground under the neighbour, None if unknown.
    """

    camera: Camera
    pose: Pose
    overlap: float
    ground_z_m: float | None


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one image, merged over its views, and the descriptors that describe them.

    keypoints_px: (K, 2) float32, source frame, undistorted by nothing: the stored raster's pixels.
    sizes_px: (K,) float32, diameter of the described blob in source pixels.
    responses: (K,) float32, strength, larger is better.
    descriptors: (D, C) uint8 (RootSIFT x 512, clipped) or float32.
    descriptor_keypoint_idx: (D,) int32 into keypoints_px.
    view_idx: (D,) int32 into the view arrays; view_keypoints_px: (D, 2) float32 in that view's frame;
    view_size_px: (D,) float32 diameter in that view; view_orientation_deg: (D,) float32 in that view.
    view_sizes_px: (V, 2) int32 width, height of every view; view_angles_deg: (V,) float32.
    view_directions: (V, 3) float32 and view_gsd_m: (V,) float32 as in View, NaN where unknown.
    view_enhanced: (V,) bool as in View.
    colours: (K, 3) uint8 RGB (gray thrice) of the enhanced image, averaged over each keypoint's blob, or None.
    """

    keypoints_px: FloatArray
    sizes_px: FloatArray
    responses: FloatArray
    descriptors: NDArray[Any]
    descriptor_keypoint_idx: IntArray
    view_idx: IntArray
    view_keypoints_px: FloatArray
    view_size_px: FloatArray
    view_orientation_deg: FloatArray
    view_sizes_px: IntArray
    view_angles_deg: FloatArray
    view_directions: FloatArray
    view_gsd_m: FloatArray
    view_enhanced: BoolArray
    colours: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class JoinedKeypoints:
    """Keypoints of one image that several steps of a cascade have found.

    keypoints_px: (K, 2), sizes_px: (K,), responses: (K,) float32 as in Features. kinds: names of the steps; kind_idx:
    (K,) uint8, the first of them that found each keypoint. numbers: by step, (K_step,) int32 number here of each
    keypoint of its own features. colours: as in Features.
    """

    keypoints_px: FloatArray
    sizes_px: FloatArray
    responses: FloatArray
    kinds: tuple[str, ...]
    kind_idx: NDArray[np.uint8]
    numbers: Mapping[str, IntArray]
    colours: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Matches:
    """Correspondences of one pair. A keypoint is in one match at most; all arrays have the same length.

    indices: (M, 2) int32 into both images' keypoints, -1 for a point measured without a detector.
    scores: (M,) float32 in 0-1, larger is better. view_pairs: (M, 2) int16, the views that found each.
    points0_px, points1_px: (M, 2) float64 measured places in source pixels, or None where indices say it all.
    sigmas_px: (M,) float32 standard deviation of the measured place, source pixels, or None where none was measured.
    remark: why a matcher that judges the pair as a whole found nothing, else "".
    """

    indices: IntArray
    scores: FloatArray
    view_pairs: IntArray
    points0_px: FloatArray | None = None
    points1_px: FloatArray | None = None
    sigmas_px: FloatArray | None = None
    remark: str = ""


@dataclass(frozen=True, eq=False)
class PairGeometry:
    """What is known of a pair before it is matched: both cameras and, where known, both poses.

    ground_z_m: world height of the ground in the overlap, None where unknown.
    """

    pair: Pair
    camera0: Camera
    camera1: Camera
    pose0: Pose | None
    pose1: Pose | None
    ground_z_m: float | None

    def turned(self) -> PairGeometry:
        """The same seen from image 1."""
        return replace(self, camera0=self.camera1, camera1=self.camera0, pose0=self.pose1, pose1=self.pose0)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Matches of one pair as filters see them.

    points0_px, points1_px: (M, 2) float64 stored pixels. colours0, colours1: (M, 3) uint8 RGB of both sides as in
    Features, or None where the extractor kept none (extract.colours) or a point was measured without a detector.
    """

    points0_px: FloatArray
    points1_px: FloatArray
    colours0: NDArray[np.uint8] | None = None
    colours1: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        return len(self.points0_px)

    def take(self, which: IntArray | BoolArray) -> Candidates:
        """Those of the given positions or mask."""
        colours0, colours1 = (None if c is None else c[which] for c in (self.colours0, self.colours1))
        return Candidates(self.points0_px[which], self.points1_px[which], colours0, colours1)


State = Literal["verified", "rejected", "not verifiable"]


@dataclass(frozen=True, eq=False)
class Verdict:
    """What a chain of filters says of one pair.

    keep: (M,) bool over the matches given. state: "verified" (a model supports the kept matches), "rejected" (a
    filter refused the pair; reason says why; nothing is kept) or "not verifiable" (too few matches to judge).
    model_kind: "E", "F", "H" or "" ; model: (3, 3) float64 on undistorted pixels (F, H) or normalised rays (E),
    x1^T M x0 = 0 or x1 ~ H x0, zeros without a model.
    errors_px: (M,) float32 error to the model, NaN where none. rejected: filter name -> matches it dropped.
    relative_rotation: (3, 3) cam1_from_cam0 of the model where it has one, else None.
    doubt: why those of the matches (M,) bool that later filters leave no longer support the model, "" where they do.
    """

    keep: BoolArray
    state: State
    reason: str = ""
    model_kind: str = ""
    model: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    errors_px: FloatArray | None = None
    rejected: Mapping[str, int] = field(default_factory=dict)
    relative_rotation: FloatArray | None = None
    doubt: Callable[[BoolArray], str] | None = None
