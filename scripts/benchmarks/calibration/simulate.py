"""Tie points without pictures: a rendered scene's surfaces, a flight, real lenses, and what a matcher would measure.

What is simulated goes to `mapping.adjust_block` as verified pairs do; what is true stays beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from types import MappingProxyType
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from aeromatch_cli.blocks.cameras import FOCAL_SIGMAS, FULL_FRAME_DIAGONAL_MM
from aeromatch_cli.data import Block, BoolArray, Camera, FloatArray, Image, Pair, PairGeometry, Pose
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.geometry.angles import Angles
from aeromatch_cli.geometry.cameras import BROWN, as_brown, focal_px, undistort
from aeromatch_cli.geometry.rotations import to_omega_phi_kappa
from aeromatch_cli.geometry.two_view import Sampling, estimate
from aeromatch_cli.lab.synthetic.flights import Flight, gsd_m, plan_flight
from aeromatch_cli.lab.synthetic.lenses import focal_35mm, real_lens
from aeromatch_cli.lab.synthetic.presets import PRESETS
from aeromatch_cli.lab.synthetic.raycast import RayCaster
from aeromatch_cli.lab.synthetic.receivers import GPS_M, RTK_M, gps_errors_m, rtk_errors_m
from aeromatch_cli.lab.synthetic.scene import build_scene
from aeromatch_cli.lab.synthetic.terrain import Area
from aeromatch_cli.sfm.georeferencing import LOCAL_FLYING_HEIGHT
from aeromatch_cli.sfm.mapping import Group, Mapper, Observed, map_block
from aeromatch_cli.strategies.exporters.contents import ExportContents, PairContents
from benchmarks.calibration.tracks import Keypoints, Picture, Sight, chosen, look, measured, spread

Positions = Literal["gps5m", "rtk2cm", "nothing"]
POSITIONS: tuple[Positions, ...] = ("gps5m", "rtk2cm", "nothing")
# Name of the benchmark -> flight plan.
FLIGHTS: Mapping[str, str] = MappingProxyType(
    {"nadir": "nadir", "cross": "cross", "mixed": "tilted", "five": "dense-rig", "two-heights": "two-heights"}
)
WIDTH_PX, HEIGHT_PX = 4000, 3000
_SIGMAS_M: Mapping[Positions, tuple[float, float, float]] = MappingProxyType({"gps5m": GPS_M, "rtk2cm": RTK_M})
# Attitudes of a gimbal: every picture by itself, and the mounting of the camera.
_GIMBAL_DEG, _MOUNT_DEG = 1.0, 0.5
# A drone keeps its height better than the flights of rendered blocks do, which would tell focal lengths too much.
_HEIGHT_STEADINESS = 0.2
# Half the side of the scene that all blocks of a seed share, in flying heights.
_SCENE_HALF = 3.0
_TRACKS_SHARE = 0.34  # points that are looked for in an image, as a share of the tie points that it then has
_CHECK_PER_IMAGE, CHECK_POINTS = 40, 60
_FEWEST_MATCHES, _VERIFIED = 15, 300
# What pairs are verified with: lenses that are not calibrated yet.
_SAMPLING = Sampling(threshold_px=8.0, max_iterations=500)
# What poses of a first pass are off by, degrees and flying heights: neighbours, which matches tie, nearly alike; and so
# much of it by themselves.
_START_DEG, _START_SHARE, _START_OWN = 0.5, 0.01, 0.1
# Of what EXIF does not say of a lens, what a first pass of reduced pictures does not find either.
_START_LENS = 0.2
_STREAM = 201


@dataclass(frozen=True, eq=False)
class SimulatedBlock:
    """What a bundle adjustment gets, and the truth.

    contents: without poses; the block's cameras are the start cameras. cameras, poses: exact, by camera_id and
    image_id. points_m: (P, 3); keypoints: image_id -> which of them it measures. check_points_m: (C, 3), check_px:
    image_id -> (C, 2) exact pixels, NaN where it does not see one. flying_m: height above the ground, median.
    """

    contents: ExportContents
    observed: Observed
    positions: Positions
    cameras: Mapping[str, Camera]
    poses: Mapping[str, Pose]
    points_m: FloatArray
    keypoints: Mapping[str, Keypoints]
    check_points_m: FloatArray
    check_px: Mapping[str, FloatArray]
    gsd_m: float
    flying_m: float
    seed: int

    @property
    def camera_of(self) -> Mapping[str, str]:
        """image_id -> camera_id."""
        return {image.image_id: image.camera_id for image in self.contents.block.images}


def simulate(
    scene: str,
    flight: str,
    images: int,
    positions: Positions,
    seed: int,
    *,
    lens: Camera | None = None,
    start_camera: Camera | None = None,
    attitudes: bool = True,
    tie_points: int = 800,
    sigma_px: float = 0.3,
    wrong_share: float = 0.02,
) -> SimulatedBlock:
    """A block of `images` pictures of a preset's scene; equal arguments give equal blocks.

    scene: one of PRESETS. flight: one of FLIGHTS. lens: of all cameras instead of a real one for each. start_camera: of
    all cameras instead of what EXIF would say. attitudes: whether a gimbal's angles are given with the positions.
    tie_points: about as many in an image. Raises ConfigError on an unknown name.
    """
    if positions not in POSITIONS:
        raise ConfigError(f"positions {positions!r} are not known; use one of {', '.join(POSITIONS)}")
    seen = _seen(scene, flight, images, seed, lens, start_camera, tie_points, sigma_px, wrong_share)
    rng = np.random.default_rng([seed, _STREAM, POSITIONS.index(positions)])
    observed = _observed(seen, positions, rng, attitudes)
    return SimulatedBlock(
        contents=replace(seen.contents, positions=observed.poses),
        observed=observed,
        positions=positions,
        cameras={picture.camera_id: picture.camera for picture in seen.pictures},
        poses={picture.image_id: picture.pose for picture in seen.pictures},
        points_m=seen.sight.points_m,
        keypoints=seen.keypoints,
        check_points_m=seen.checks.points_m,
        check_px={p.image_id: seen.checks.places_px[k] for k, p in enumerate(seen.pictures)},
        gsd_m=seen.gsd_m,
        flying_m=float(np.median([p.pose.center_m[2] for p in seen.pictures]) - np.median(seen.sight.points_m[:, 2])),
        seed=seed,
    )


@dataclass(frozen=True, eq=False)
class _Seen:
    """What is the same whatever positions are given."""

    pictures: Sequence[Picture]
    sight: Sight
    checks: Sight
    keypoints: Mapping[str, Keypoints]
    contents: ExportContents
    gsd_m: float


@lru_cache(maxsize=1)
def _seen(
    scene: str, flight: str, images: int, seed: int, lens: Camera | None, start_camera: Camera | None,
    tie_points: int, sigma_px: float, wrong_share: float,
) -> _Seen:  # fmt: skip
    for name, known in ((scene, PRESETS), (flight, FLIGHTS)):
        if name not in known:
            raise ConfigError(f"{name!r} is not known here; use one of: {', '.join(known)}")
    rng = np.random.default_rng([seed, _STREAM, images, *f"{scene}:{flight}".encode()])
    planned = plan_flight(
        FLIGHTS[flight], images=images, width_px=WIDTH_PX, height_px=HEIGHT_PX, height_m=PRESETS[scene].height_m,
        lens="SIMPLE_PINHOLE", rng=rng,
    )  # fmt: skip
    lenses = {
        camera_id: lens or real_lens(rng, WIDTH_PX, HEIGHT_PX, focal_px(camera) / WIDTH_PX)
        for camera_id, camera in planned.cameras.items()
    }
    pictures = _pictures(planned, lenses)
    caster = _caster(scene, seed)
    sight = look(pictures, caster, rng, round(_TRACKS_SHARE * tie_points))
    checks = spread(look(pictures, caster, rng, _CHECK_PER_IMAGE), CHECK_POINTS)
    member = chosen(sight, pictures, rng)
    keypoints = measured(sight, member, pictures, rng, sigma_px, wrong_share)
    start = {camera_id: start_camera or exif_camera(camera) for camera_id, camera in lenses.items()}
    contents = _contents(pictures, member, keypoints, start, seed)
    return _Seen(pictures, sight, checks, keypoints, contents, gsd_m(planned))


@lru_cache(maxsize=1)
def _caster(scene: str, seed: int) -> RayCaster:
    """The surfaces of a scene; building takes up to 20 s, so that all flights of a seed share one."""
    half_m = _SCENE_HALF * PRESETS[scene].height_m
    return RayCaster(build_scene(PRESETS[scene].scene, seed, Area(-half_m, -half_m, half_m, half_m)))


def _pictures(planned: Flight, lenses: Mapping[str, Camera]) -> list[Picture]:
    found = []
    for number, station in enumerate(planned.stations):
        height_m = station.height_m + _HEIGHT_STEADINESS * (station.exterior.z_m - station.height_m)
        pose = replace(station.exterior, z_m=height_m).pose()
        camera = lenses[station.camera_id]
        found.append(Picture(f"image_{number:04d}", station.camera_id, camera, pose, station.height_m))
    return found


def exif_camera(camera: Camera) -> Camera:
    """What EXIF says of a camera: the 35-mm equivalent in whole millimetres, and nothing of its lens."""
    diagonal_px = float(np.hypot(camera.width_px, camera.height_px))
    focal = focal_35mm(camera) / FULL_FRAME_DIAGONAL_MM * diagonal_px
    middle = 0.5 * (camera.width_px - 1), 0.5 * (camera.height_px - 1)
    return Camera("SIMPLE_RADIAL", camera.width_px, camera.height_px, (focal, *middle, 0.0))


def _contents(
    pictures: Sequence[Picture], member: BoolArray, keypoints: Mapping[str, Keypoints], start: Mapping[str, Camera],
    seed: int,
) -> ExportContents:  # fmt: skip
    images = tuple(
        Image(p.image_id, f"{p.image_id}.jpg", p.camera.width_px, p.camera.height_px, p.camera_id) for p in pictures
    )
    block = Block(images, start, {}, "local", (0.0, 0.0, 0.0), None, "", None)
    pairs = tuple(_pairs(block, member, keypoints, seed))
    return ExportContents(block, lambda image_id: keypoints[image_id].pixels, pairs)


def _pairs(block: Block, member: BoolArray, keypoints: Mapping[str, Keypoints], seed: int) -> Iterator[PairContents]:
    number = np.full(member.shape, -1, dtype=np.int32)
    straight = {}
    for column, image in enumerate(block.images):
        own = keypoints[image.image_id]
        number[own.point, column] = np.arange(len(own.point))
        straight[image.image_id] = undistort(block.camera(image), own.pixels.astype(np.float64))
    for (i, image0), (j, image1) in combinations(enumerate(block.images), 2):
        both = np.flatnonzero(member[:, i] & member[:, j])
        if len(both) < _FEWEST_MATCHES:
            continue
        matches = np.column_stack([number[both, i], number[both, j]])
        pair = Pair(image0.image_id, image1.image_id, np.nan, np.nan, "overlap")
        geometry = PairGeometry(pair, block.camera(image0), block.camera(image1), None, None, None)
        some = matches[:_VERIFIED]
        sides = straight[image0.image_id][some[:, 0]], straight[image1.image_id][some[:, 1]]
        model = estimate(*sides, geometry, "relative_pose", _SAMPLING, seed).model
        yield PairContents(pair, matches, matches, "E", model)


def _observed(seen: _Seen, positions: Positions, rng: np.random.Generator, attitudes: bool) -> Observed:
    pictures = seen.pictures
    focal = dict.fromkeys(seen.contents.block.cameras, FOCAL_SIGMAS["35-mm equivalent"])
    if positions == "nothing":
        return Observed({}, focal, {}, seen.contents.block.cameras)
    errors_m = (rtk_errors_m if positions == "rtk2cm" else gps_errors_m)(len(pictures), rng)
    turns = _turned(rng, _MOUNT_DEG, 1) * _turned(rng, _GIMBAL_DEG, len(pictures))
    poses, angles = {}, {}
    for picture, error_m, turn in zip(pictures, errors_m, turns, strict=True):
        rotation = turn.as_matrix() @ picture.rotation() if attitudes else None
        sigma_deg = float(np.hypot(_GIMBAL_DEG, _MOUNT_DEG))
        stated_m = float(np.sqrt(np.mean(np.square(_SIGMAS_M[positions]))))
        center_m = picture.pose.center_m + error_m
        poses[picture.image_id] = Pose(center_m, rotation, stated_m, sigma_deg, _SIGMAS_M[positions])
        if rotation is not None:
            angles[picture.image_id] = Angles("omega_phi_kappa", to_omega_phi_kappa(rotation))
    return Observed(poses, focal, angles, seen.contents.block.cameras)


def _turned(rng: np.random.Generator, sigma_deg: float, count: int) -> Rotation:
    return Rotation.from_rotvec(np.deg2rad(sigma_deg) * rng.standard_normal((count, 3)))


def perturbed(block: SimulatedBlock) -> tuple[ExportContents, list[Group]]:
    """A start as a good first pass leaves it: exact poses made worse, in a frame of their own without positions, and
    lenses that are calibrated but for a share of what EXIF does not say of them."""
    rng = np.random.default_rng([block.seed, _STREAM, 9])
    centers_m = np.array([pose.center_m for pose in block.poses.values()])
    turns = Rotation.from_rotvec(np.deg2rad(_START_DEG) * _wave(centers_m, rng))
    shifts_m = _START_SHARE * block.flying_m * _wave(centers_m, rng)
    scale = LOCAL_FLYING_HEIGHT / block.flying_m if block.positions == "nothing" else 1.0
    poses = {}
    for turn, shift_m, (image_id, pose) in zip(turns, shifts_m, block.poses.items(), strict=True):
        assert pose.world_rotation is not None
        center_m = scale * (pose.center_m + shift_m)
        sigma_m = scale * _START_SHARE * block.flying_m
        poses[image_id] = Pose(center_m, turn.as_matrix() @ pose.world_rotation, sigma_m, _START_DEG)
    kind = "level" if block.positions == "nothing" else "positions"
    cameras = {k: _between(exif_camera(camera), camera, _START_LENS) for k, camera in block.cameras.items()}
    return _started(block, cameras, poses), [Group(kind, tuple(poses))]


def _between(stated: Camera, true: Camera, share: float) -> Camera:
    """The true camera with this share of its difference from the stated one."""
    ends = zip(as_brown(true).params, as_brown(stated).params, strict=True)
    params = tuple(value + share * (start - value) for value, start in ends)
    return Camera(BROWN, true.width_px, true.height_px, params)


def _wave(centers_m: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(N, 3) of standard deviation 1: a wave four times as long as the block, and a little of each by itself."""
    plan_m = centers_m[:, :2] - centers_m[:, :2].mean(axis=0)
    direction_rad = rng.uniform(0.0, 2.0 * np.pi)
    along = plan_m @ [np.cos(direction_rad), np.sin(direction_rad)] / max(np.ptp(plan_m, axis=0).max(), 1.0)
    phase = 0.5 * np.pi * along[:, None]
    common = rng.standard_normal(3) * np.cos(phase) + rng.standard_normal(3) * np.sin(phase)
    return np.asarray(common + _START_OWN * rng.standard_normal(centers_m.shape))


def mapped(block: SimulatedBlock, mapper: Mapper = "global") -> tuple[ExportContents, list[Group]]:
    """A start from `map_block`: its models, cameras as the largest has them."""
    models = map_block(block.contents, block.observed, mapper)
    cameras, poses = dict(block.contents.block.cameras), dict[str, Pose]()
    for model in reversed(models):
        cameras |= model.cameras
        for image_id, rotation in model.rotations.items():
            sigma_m = _START_SHARE * block.flying_m
            poses[image_id] = Pose(model.centers_m[image_id], rotation, sigma_m, _START_DEG)
    groups = [Group(model.kind, tuple(model.rotations)) for model in models]
    return _started(block, cameras, poses), groups


def _started(block: SimulatedBlock, cameras: Mapping[str, Camera], poses: Mapping[str, Pose]) -> ExportContents:
    return replace(block.contents, block=replace(block.contents.block, cameras=cameras, poses=poses))
