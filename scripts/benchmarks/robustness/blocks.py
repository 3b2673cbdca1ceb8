"""Good blocks, and ways to spoil one: what the adjustment is given, beside the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import Rotation

from aeromatch_cli.data import BoolArray, Camera, ControlPoint, FloatArray, Pose
from aeromatch_cli.geometry.cameras import focal_px
from aeromatch_cli.geometry.rotations import rotation_x
from aeromatch_cli.sfm.mapping import Group, Observed
from aeromatch_cli.strategies.exporters.contents import ExportContents, PairContents
from benchmarks.calibration.simulate import Positions, SimulatedBlock, perturbed, simulate

# Between two exposures, and what a control point is measured and surveyed with.
_INTERVAL_S = 2.0
_MEASURED_PX, _SURVEYED_M = 0.3, np.array([0.02, 0.02, 0.03])
_STREAM = 401


@dataclass(frozen=True, eq=False)
class Task:
    """What the adjustment gets. fixed: poses are kept as they are given."""

    block: SimulatedBlock
    contents: ExportContents
    groups: list[Group]
    observed: Observed
    fixed: bool = False

    def observing(self, **changes: object) -> Task:
        return replace(self, observed=replace(self.observed, **changes))  # type: ignore[arg-type]


def good_task(block: SimulatedBlock) -> Task:
    contents, groups = perturbed(block)
    return Task(block, contents, groups, block.observed)


@dataclass(frozen=True)
class Plan:
    """What is simulated; a task is made of it and spoilt."""

    scene: str = "farmland"
    flight: str = "cross"
    images: int = 16
    positions: Positions = "rtk2cm"
    seed: int = 1
    attitudes: bool = True
    wrong_share: float = 0.02
    control: int = 0

    def task(self, tie_points: int) -> Task:
        block = simulate(
            self.scene, self.flight, self.images, self.positions, self.seed, attitudes=self.attitudes,
            tie_points=tie_points, wrong_share=self.wrong_share,
        )  # fmt: skip
        task = good_task(block)
        return with_control(task, self.control) if self.control else task


def with_control(task: Task, count: int) -> Task:
    """Control points, every third of them a check point; measured and surveyed as well as is stated."""
    rng, block = np.random.default_rng([task.block.seed, _STREAM]), task.block
    points = []
    for number in range(min(count, len(block.check_points_m))):
        pixels = {
            image_id: exact[number] + _MEASURED_PX * rng.standard_normal(2)
            for image_id, exact in block.check_px.items()
            if np.isfinite(exact[number]).all()
        }
        place_m = block.check_points_m[number] + _SURVEYED_M * rng.standard_normal(3)
        points.append(ControlPoint(f"P{number + 1}", place_m, number % 3 == 2, pixels, sigma_px=_MEASURED_PX))
    return task.observing(control=tuple(points))


def _ids(task: Task) -> list[str]:
    return [image.image_id for image in task.contents.block.images]


def _halves(task: Task) -> tuple[list[str], list[str]]:
    """Images of the first and of the second flight, in the order of taking."""
    ids = _ids(task)
    return ids[: len(ids) // 2], ids[len(ids) // 2 :]


def _velocities(task: Task) -> Mapping[str, FloatArray]:
    """(3,) metres per second; turns between strips count as strips."""
    ids = _ids(task)
    moves = {a: (task.block.poses[b].center_m - task.block.poses[a].center_m) / _INTERVAL_S for a, b in pairwise(ids)}
    return moves | {ids[-1]: moves[ids[-2]]}


def _moved(task: Task, move: Callable[[str, FloatArray], FloatArray], sigma: float = 1.0) -> Task:
    """Given positions changed, with standard deviations `sigma` times what they were."""
    poses = {
        image_id: replace(
            pose,
            center_m=move(image_id, pose.center_m),
            sigma_position_m=sigma * pose.sigma_position_m,
            sigmas_m=None if pose.sigmas_m is None else tuple(sigma * value for value in pose.sigmas_m),
        )
        for image_id, pose in task.observed.poses.items()
    }
    return task.observing(poses=poses)


def _flights(task: Task) -> Task:
    first, second = _halves(task)
    return task.observing(flights={**dict.fromkeys(first, "first"), **dict.fromkeys(second, "second")})


def _second_moved(task: Task, move_m: FloatArray) -> Task:
    _, second = _halves(task)
    return _moved(_flights(task), lambda image_id, place: place + move_m * (image_id in second))


def _delayed(task: Task) -> Task:
    speeds = _velocities(task)
    return _moved(task, lambda image_id, place: place + 0.5 * speeds[image_id])


def _exchanged(task: Task) -> Task:
    """Positions of two pairs of images."""
    ids, poses = _ids(task), task.observed.poses
    other = {ids[1]: ids[-2], ids[-2]: ids[1], ids[4]: ids[-5], ids[-5]: ids[4]}
    return _moved(task, lambda image_id, place: poses[other[image_id]].center_m if image_id in other else place)


def _next_ones(task: Task) -> Task:
    """Every image has the position of the next one."""
    ids, poses = _ids(task), task.observed.poses
    following = dict(zip(ids, [*ids[1:], ids[0]], strict=True))
    return _moved(task, lambda image_id, _: poses[following[image_id]].center_m)


def _stated(task: Task, change: Callable[[Camera], Camera], sigma: float) -> Task:
    """Cameras that are stated to `sigma` of their focal length, and are `change` of the exact ones."""
    cameras = {camera_id: change(camera) for camera_id, camera in task.block.cameras.items()}
    return task.observing(cameras=cameras, focal_sigmas=dict.fromkeys(cameras, sigma))


def _with_params(camera: Camera, change: Mapping[str, Callable[[float], float]]) -> Camera:
    """Of a BROWN camera."""
    names = ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1", "b2")
    assert len(camera.params) == len(names)
    params = tuple(change.get(name, lambda old: old)(old) for name, old in zip(names, camera.params, strict=True))
    return replace(camera, params=params)


def _half_size(camera: Camera) -> Camera:
    return _with_params(camera, dict.fromkeys(("f", "cx", "cy"), lambda old: 0.5 * old))


def _one_camera(task: Task) -> Task:
    """Images of all cameras are said to be of the first."""
    block = task.contents.block
    first = min(block.cameras)
    images = tuple(replace(image, camera_id=first) for image in block.images)
    block = replace(block, images=images, cameras={first: block.cameras[first]})
    focal = {first: task.observed.focal_sigmas[first]}
    return replace(task, contents=replace(task.contents, block=block)).observing(focal_sigmas=focal)


def _keeping(task: Task, keep: Callable[[PairContents], BoolArray | None]) -> Task:
    """Pairs with those matches that `keep` says, (M,); None drops a pair."""
    pairs = []
    for pair in task.contents.pairs:
        left = keep(pair)
        if left is not None and left.any():
            pairs.append(replace(pair, matches=pair.matches[left], verified=pair.verified[left]))
    return replace(task, contents=replace(task.contents, pairs=tuple(pairs)))


def _pairs_only(task: Task) -> Task:
    """Every keypoint is matched in one pair: no point is seen by three images."""
    used: dict[str, set[int]] = {image_id: set() for image_id in _ids(task)}

    def keep(pair: PairContents) -> BoolArray:
        ends = used[pair.pair.image_id0], used[pair.pair.image_id1]
        free = np.array([a not in ends[0] and b not in ends[1] for a, b in pair.matches.tolist()], dtype=bool)
        for own, numbers in zip(ends, pair.matches[free].T.tolist(), strict=True):
            own.update(numbers)
        return free

    return _keeping(task, keep)


def _loose(task: Task) -> Task:
    """Two halves that one pair with ten matches connects."""
    _, second = _halves(task)
    left = [1]

    def keep(pair: PairContents) -> BoolArray | None:
        every = np.ones(len(pair.matches), dtype=bool)
        if (pair.pair.image_id0 in second) == (pair.pair.image_id1 in second):
            return every
        if not left:
            return None
        left.pop()
        return np.asarray(np.arange(len(every)) < 10)

    return _keeping(task, keep)


def _lacking(task: Task) -> Task:
    """Three images in ten have no pair."""
    absent = set(_ids(task)[::3])
    return _keeping(
        task,
        lambda pair: (
            None if absent & {pair.pair.image_id0, pair.pair.image_id1} else np.ones(len(pair.matches), dtype=bool)
        ),
    )


def _kept(task: Task, turn_deg: float) -> Task:
    """Poses that are kept as they are given, each turned about an axis of its own."""
    rng = np.random.default_rng([task.block.seed, _STREAM, 2])
    poses = {}
    for image_id, pose in task.block.poses.items():
        assert pose.world_rotation is not None
        axis = rng.standard_normal(3)
        turn = Rotation.from_rotvec(np.deg2rad(turn_deg) * axis / np.linalg.norm(axis)).as_matrix()
        poses[image_id] = replace(pose, world_rotation=turn @ pose.world_rotation)
    contents = replace(task.contents, block=replace(task.contents.block, poses=poses))
    return replace(task, contents=contents, groups=[Group("given", tuple(poses))], fixed=True)


def _tilted(task: Task) -> Task:
    """Angles off by 12 degrees about the world's x axis where they are stated to 1 degree."""
    poses: dict[str, Pose] = {}
    for image_id, pose in task.observed.poses.items():
        assert pose.world_rotation is not None
        poses[image_id] = replace(pose, world_rotation=pose.world_rotation @ rotation_x(12.0))
    return task.observing(poses=poses)


def _rolling(task: Task) -> Task:
    """Pictures that are read in 60 ms from a moving aircraft."""
    speeds, keypoints = _velocities(task), {}
    for image_id in _ids(task):
        pose, exact = task.block.poses[image_id], task.contents.keypoints_px(image_id)
        assert pose.world_rotation is not None
        camera = task.block.cameras[task.block.camera_of[image_id]]
        across = (pose.world_rotation @ speeds[image_id])[:2] * focal_px(camera) / task.block.flying_m
        seconds = 0.06 * (exact[:, 1] / camera.height_px - 0.5)
        keypoints[image_id] = (exact - across * seconds[:, None]).astype(np.float32)
    contents = replace(task.contents, keypoints_px=lambda image_id: keypoints[image_id])
    return replace(task, contents=contents).observing(rolling_shutter=False)


def _surveyed(task: Task, change: Callable[[int, FloatArray], FloatArray]) -> Task:
    control = [replace(p, position_m=change(k, p.position_m)) for k, p in enumerate(task.observed.control)]
    return task.observing(control=tuple(control))


def _names_exchanged(task: Task) -> Task:
    control = list(task.observed.control)
    control[0], control[1] = (
        replace(control[0], pixels=control[1].pixels), replace(control[1], pixels=control[0].pixels)
    )  # fmt: skip
    return task.observing(control=tuple(control))


_GPS, _NONE = Plan(positions="gps5m"), Plan(flight="nadir", positions="nothing")
_CONTROLLED = Plan(control=9)
_EAST, _UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])

# Name -> what is simulated, and how it is spoilt.
FAULTS: Mapping[str, tuple[Plan, Callable[[Task], Task]]] = MappingProxyType({
    "focal length stated 26 % too long, to 1 %": (
        Plan(), lambda t: _stated(t, lambda c: _with_params(c, {"f": lambda f: 1.26 * f}), 0.01)),
    "focal length stated 10 % too short, to 1 %; GPS": (
        _GPS, lambda t: _stated(t, lambda c: _with_params(c, {"f": lambda f: 0.9 * f}), 0.01)),
    "camera file of pictures of half the size": (Plan(), lambda t: _stated(t, _half_size, 0.03)),
    "camera file of another lens (k1 0.2 more)": (
        Plan(), lambda t: _stated(t, lambda c: _with_params(c, {"k1": lambda k: k + 0.2}), 0.01)),
    "five cameras taken as one": (Plan(flight="five", images=25), _one_camera),
    "RTK 1 m off in one of two flights": (Plan(), lambda t: _second_moved(t, np.array([0.6, 0.8, 0.0]))),
    "heights 15 m up in one of two flights": (Plan(positions="gps5m"), lambda t: _second_moved(t, 15.0 * _UP)),
    "the same without angles": (Plan(positions="gps5m", attitudes=False), lambda t: _second_moved(t, 15.0 * _UP)),
    "RTK stated ten times too exact": (Plan(), lambda t: _moved(t, lambda _, place: place, 0.1)),
    "RTK rounded to metres": (Plan(), lambda t: _moved(t, lambda _, place: np.round(place))),
    "positions 0.5 s late": (Plan(), _delayed),
    "positions 0.5 s late, velocities known": (Plan(), lambda t: _delayed(t.observing(velocities=_velocities(t)))),
    "x and y exchanged": (Plan(), lambda t: _moved(t, lambda _, place: place[[1, 0, 2]])),
    "another CRS (plan 1.6 times as large)": (Plan(), lambda t: _moved(t, lambda _, p: p * [1.6, 1.6, 1.0])),
    "heights in feet": (Plan(), lambda t: _moved(t, lambda _, place: place * [1.0, 1.0, 3.281])),
    "positions of four images exchanged": (Plan(), _exchanged),
    "positions of the next image": (Plan(), _next_ones),
    "angles 12 degrees off, stated to 1": (Plan(), _tilted),
    "a control point 0.5 m off": (
        _CONTROLLED, lambda t: _surveyed(t, lambda k, place: place + 0.5 * _UP * (k == 0))),
    "a check point 0.5 m off": (_CONTROLLED, lambda t: _surveyed(t, lambda k, place: place + 0.5 * _UP * (k == 2))),
    "names of two control points exchanged": (_CONTROLLED, _names_exchanged),
    "control points 40 m east of positions": (_CONTROLLED, lambda t: _surveyed(t, lambda _, p: p + 40.0 * _EAST)),
    "control points in feet": (_CONTROLLED, lambda t: _surveyed(t, lambda _, place: place / 0.3048)),
    "control points with x and y exchanged": (_CONTROLLED, lambda t: _surveyed(t, lambda _, place: place[[1, 0, 2]])),
    "focal length held 2 % too long": (
        Plan(), lambda t: _stated(t, lambda c: _with_params(c, {"f": lambda f: 1.02 * f}), 0.03).observing(
            switches={"f": False})),
    "20 % wrong matches": (Plan(wrong_share=0.2), lambda t: t),
    "tracks of two images only": (Plan(), _pairs_only),
    "two halves tied by ten matches": (Plan(), _loose),
    "a third of the images without a pair": (Plan(), _lacking),
    "a single strip, GPS, no angles": (Plan(flight="nadir", images=6, positions="gps5m", attitudes=False), lambda t: t),
    "no positions, straight views from one height": (_NONE, lambda t: t),
    "poses kept that are 2 degrees off": (Plan(), lambda t: _kept(t, 2.0)),
    "poses kept that are 0.3 degrees off": (Plan(), lambda t: _kept(t, 0.3)),
    "read-out of 60 ms, no rolling shutter": (Plan(), _rolling),
})  # fmt: skip

# Name -> what is simulated, and what is known beside it.
GOOD: Mapping[str, tuple[Plan, Callable[[Task], Task]]] = MappingProxyType({
    **{f"{flight}, {positions}, seed {seed}": (Plan(flight=flight, positions=positions, seed=seed), lambda t: t)
       for flight in ("nadir", "cross", "mixed", "two-heights")
       for positions in ("rtk2cm", "gps5m") for seed in (1, 2)},
    "cross, rtk2cm, 9 control points": (_CONTROLLED, lambda t: t),
    "cross, rtk2cm, 9 control points 40 m higher, as geoid and ellipsoid are apart": (
        _CONTROLLED, lambda t: _surveyed(t, lambda _, place: place + 40.0 * _UP)),
    "nadir, gps5m, 9 control points": (Plan(flight="nadir", positions="gps5m", control=9), lambda t: t),
    "cross, rtk2cm, factory calibration": (Plan(), lambda t: _stated(t, lambda c: c, 0.01)),
    "cross, rtk2cm, two flights": (Plan(), _flights),
    "cross, rtk2cm, without angles": (Plan(attitudes=False), lambda t: t),
    "five cameras, rtk2cm": (Plan(flight="five", images=25), lambda t: t),
})  # fmt: skip
