"""Adjustment of pycolmap models, for the processes of `mapping_process` and `adjustment_process`: in the world frame,
with what was given of positions, attitudes and cameras as observations.

Image numbers are those of the database, from 1; arrays of what was given have one row for each.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from types import ModuleType
from typing import Any

import numpy as np

from aeromatch_cli.data import BoolArray, FloatArray, IntArray
from aeromatch_cli.geometry.components import connected_groups
from aeromatch_cli.sfm.bundle.adjust import Adjusted, Options, adjust
from aeromatch_cli.sfm.bundle.network import LENS, READOUT, SLOPES, Network, Unknowns, drift_of
from aeromatch_cli.sfm.bundle.of_model import (
    Lenses,
    image_numbers,
    image_points,
    lens_of,
    set_lens,
    take,
    unknowns_of,
)
from aeromatch_cli.sfm.bundle.projection import project
from aeromatch_cli.sfm.bundle.shared import lenses_if_freed
from aeromatch_cli.sfm.bundle.solve import solve
from aeromatch_cli.sfm.georeferencing import Placement, delay_s, height_steps_m, place
from aeromatch_cli.sfm.model_arrays import BEHIND_PX, centers_of, points_of, rotations_of

# A focal length this many times longer or shorter than its prior is no lens: the images of that camera were misplaced.
_LENS_RATIO = 3.0
# Images are connected by so many points that both see.
_SHARED_POINTS = 8
# Images with fewer points than this in their model are taken out of it.
MIN_OBSERVATIONS = 12
# Headings are wrong beyond this, degrees, and so many standard deviations of the north that positions tell.
_WRONG_HEADING_DEG, _WRONG_HEADING_SIGMAS = 20.0, 3.0
# Given attitudes have an error in common of up to this, degrees: that of the mounting.
_COMMON_DEG = 1.0
# Points are where their rays meet when a step lowers the cost by a smaller share.
_INTERSECTED = 1e-5
# Unknowns of a lens that pycolmap's cameras have no parameter for.
_BESIDE = [LENS.index("b2"), READOUT]
# Fewer image points of a camera tell no more of its lens than the focal length: errors of matches have causes in common
# (a rendered block of five pictures of 320 x 240 pixels with 111 points puts the principal point 7 pixels off).
_LENS_POINTS = 500
# So many positions hold a model in the world frame.
_HOLDING = 3
# A position that is so many standard deviations away is not that of the image.
WRONG_SIGMAS = 5.0
# Positions beyond so many standard deviations, and this share of the flying height, are no observations of an
# adjustment in the making.
_FAR_SIGMAS, _NEAR_SHARE = 10.0, 0.05


@dataclass(frozen=True, eq=False)
class Given:
    """Holds what was given of N images; rows are the images' numbers less one.

    positions_m, sigmas_m: (N, 3), NaN where there is none. ups: (N, 3) unit vectors upwards in the camera's frame by
    its measured tilt. rotations: (N, 3, 3) cam_from_world, sigmas_deg: (N,) of its angles. flights: (N,) from 0.
    velocities_m_s: (N, 3), zero where it is not known.
    """

    positions_m: FloatArray
    sigmas_m: FloatArray
    ups: FloatArray
    rotations: FloatArray
    sigmas_deg: FloatArray
    flights: IntArray
    velocities_m_s: FloatArray

    @classmethod
    def of_file(cls, arrays: Mapping[str, Any]) -> Given:
        """Read the arrays of priors.npz, see `mapping`."""
        return cls(**{name: arrays[name] for name in cls.__dataclass_fields__})

    @property
    def mean_sigmas_m(self) -> FloatArray:
        """(N,) over the axes."""
        return np.asarray(np.sqrt((self.sigmas_m**2).mean(axis=1)))

    def places(self, numbers: Collection[int]) -> bool:
        """Whether images have positions enough to place a group in the world: one tells neither scale nor north."""
        return int(np.isfinite(self.positions_m[np.array(sorted(numbers)) - 1]).all(axis=1).sum()) >= 2

    def without_positions(self) -> Given:
        """Return what was given for a group in a frame of its own, where given positions are no observations."""
        unknown = np.full_like(self.positions_m, np.nan)
        return replace(self, positions_m=unknown, sigmas_m=unknown)


@dataclass(frozen=True, eq=False)
class Work:
    """Holds what all adjustments of a process share.

    priors, sigmas: by camera number (12,) as in `network.LENS`, sigmas zero where an unknown is held; fisheyes: numbers
    of such cameras. options: of the adjustment. lenses: what adjustments have found, by camera number. held_sigmas: of
    what settings hold, as far as it is known.
    """

    pycolmap: ModuleType
    priors: Lenses
    sigmas: Lenses
    fisheyes: frozenset[int]
    options: Options
    lenses: Lenses = field(default_factory=dict)
    held_sigmas: Lenses = field(default_factory=dict)

    @classmethod
    def of_task(cls, pycolmap: ModuleType, cameras: Mapping[str, Any], options: Options) -> Work:
        """cameras: of task.json, see `mapping`."""
        named = {int(number): one for number, one in cameras.items()}
        return cls(
            pycolmap,
            {number: np.array(one["lens"]) for number, one in named.items()},
            {number: np.array(one["sigmas"]) for number, one in named.items()},
            frozenset(number for number, one in named.items() if one["fisheye"]),
            options,
            held_sigmas={number: np.array(one["held_sigmas"]) for number, one in named.items()},
        )

    def lens(self, model: Any, number: int) -> FloatArray:
        """(12,) as a model has it, with what its camera has no parameter for from the last adjustment."""
        lens = lens_of(model.cameras[number])
        if number in self.lenses:
            lens[_BESIDE] = self.lenses[number][_BESIDE]
        return lens

    def start(self, model: Any) -> None:
        """Give a model's cameras the form that holds all that an adjustment finds."""
        for number, camera in model.cameras.items():
            set_lens(self.pycolmap, camera, lens_of(camera), number in self.fisheyes)


@dataclass(frozen=True, eq=False)
class Outcome:
    """result: of the adjustment; images, points, cameras, flights: numbers of its rows. placement: None where the model
    had its place. steps_m: (N,) by row of what was given, steps of height of the flights that were taken out before.
    if_freed: `lenses_if_freed` of what settings hold, None before the final adjustment.
    """

    result: Adjusted
    images: list[int]
    points: list[int]
    cameras: list[int]
    flights: list[int]
    placement: Placement | None = None
    steps_m: FloatArray | None = None
    if_freed: tuple[FloatArray, float] | None = None


def adjusted(work: Work, model: Any, given: Given, held: Collection[int] = ()) -> Outcome:
    """Place a model in the world and adjust it with the given positions as observations.

    held: numbers of cameras that stay as they are.
    """
    ids = image_numbers(model)
    rows = np.array(ids, dtype=int) - 1
    given, steps_m = _without_steps(model, given)
    positions_m, sigmas_m = given.positions_m[rows], given.mean_sigmas_m[rows]
    late_s = delay_s(centers_of(model, ids), positions_m, given.velocities_m_s[rows])
    positions_m = positions_m - late_s * given.velocities_m_s[rows]
    placement = _placed(work.pycolmap, model, ids, positions_m, sigmas_m, given.ups[rows])
    # A wrong lens puts images far from positions that are right, however exact these are: the adjustment tells.
    centers_m = centers_of(model, ids)
    off_m = np.linalg.norm(centers_m - positions_m, axis=1)
    flying_m = abs(float(np.median(centers_m[:, 2]) - np.median(points_of(model)[:, 2])))
    near = off_m <= np.maximum(_FAR_SIGMAS * sigmas_m, _NEAR_SHARE * flying_m)
    counts = (placement.agreeing | near) & (placement.kind == "positions")
    levels = np.full((len(ids), 3), np.inf)
    if placement.kind == "positions" and np.isfinite(placement.level_sigma_deg):
        # What tilts or terrain say of the whole block, as observations of all images that together are as exact.
        levels[:, :2] = np.deg2rad(placement.level_sigma_deg) * np.sqrt(len(ids))
    now = rotations_of(model, ids)
    drifting = placement.by_tilts
    outcome = _adjust(work, model, ids, given, counts, now, levels, np.zeros(6), held, drifting=drifting)
    if placement.kind == "level":  # its scale and place are those of an adjusted flying height
        _placed(work.pycolmap, model, ids, positions_m, sigmas_m, given.ups[rows])
    return replace(outcome, placement=placement, steps_m=steps_m)


def _without_steps(model: Any, given: Given) -> tuple[Given, FloatArray]:
    """Positions without steps of height between flights, and these: (N,) metres."""
    ids = image_numbers(model)
    rows = np.array(ids, dtype=int) - 1
    steps_m = np.zeros(len(given.positions_m))
    rotations = rotations_of(model, ids)
    in_model = np.einsum("nji,nj->ni", rotations, given.ups[rows])
    seen = centers_of(model, ids), points_of(model), given.positions_m[rows], given.mean_sigmas_m[rows], in_model
    steps_m[rows] = height_steps_m(*seen, given.flights[rows])
    return replace(given, positions_m=given.positions_m - steps_m[:, None] * [0.0, 0.0, 1.0]), steps_m


def adjust_in_place(
    work: Work, model: Any, given: Given, observed: Collection[int], held: Collection[int] = ()
) -> Outcome:
    """Adjust a model whose poses are in the world frame already.

    Positions far from where an image is are not used: they have been found wrong before. observed: numbers of the
    images whose given attitudes are observations. held: numbers of cameras that stay as they are.
    """
    ids = image_numbers(model)
    rows = np.array(ids, dtype=int) - 1
    off_m = np.linalg.norm(centers_of(model, ids) - given.positions_m[rows], axis=1)
    counts = off_m <= WRONG_SIGMAS * given.mean_sigmas_m[rows]
    counts &= counts.sum() >= _HOLDING
    known = np.isin(ids, list(observed))
    sigmas = np.where(known, np.deg2rad(given.sigmas_deg[rows]), np.inf)
    mount = np.zeros(6)
    if known.any():  # their mean is no better than what they have in common
        mount[:3] = np.deg2rad(min(_COMMON_DEG, float(np.median(given.sigmas_deg[rows][known]))))
    levels = np.repeat(sigmas[:, None], 3, axis=1)
    attitudes = given.rotations[rows]
    return _adjust(work, model, ids, given, counts, attitudes, levels, mount, held, drifting=bool(known.any()))


def _adjust(
    work: Work,
    model: Any,
    ids: list[int],
    given: Given,
    counts: BoolArray,
    attitudes: FloatArray,
    attitude_sigmas: FloatArray,
    mount_sigmas: FloatArray,
    held: Collection[int],
    *,
    drifting: bool,
) -> Outcome:
    """counts: (N,) which positions are observations; attitudes (N, 3, 3) with standard deviations (N, 3), radians.
    drifting: whether heights of positions may have a slope in common."""
    rows = np.array(ids, dtype=int) - 1
    network, start, points, numbers = _network(work, model, given)
    count = len(numbers)
    network = replace(
        network,
        lens_prior=np.array([start.lens[k] if n in held else work.priors[n] for k, n in enumerate(numbers)]),
        lens_sigmas=_free_sigmas(work, network, numbers, held),
        positions_m=np.where(counts[:, None], given.positions_m[rows], np.nan),
        position_sigmas_m=np.where(counts[:, None], given.sigmas_m[rows], np.inf),
        attitudes=attitudes,
        attitude_sigmas=attitude_sigmas,
        mount_sigmas=np.repeat(mount_sigmas[None], count, axis=0),
        held=np.zeros(len(ids), dtype=bool),
    )
    if drifting:
        network = _with_drifts(network)
    start = replace(start, lens=np.where(network.lens_sigmas > 0.0, start.lens, network.lens_prior))
    result = adjust(network, start, work.options)
    _take(work, model, ids, points, numbers, result.state)
    unknown = np.array([work.held_sigmas.get(n, np.zeros(len(LENS))) * (n not in held) for n in numbers])
    final, tolerance = work.options.final, work.options.tolerance
    freed = lenses_if_freed(result.network, result.state, unknown, tolerance) if final else None
    return Outcome(result, ids, points, numbers, np.unique(given.flights[rows]).tolist(), if_freed=freed)


def _with_drifts(network: Network) -> Network:
    """The network with unknown slopes of the heights of flights whose receivers had no corrections: errors at two ends
    of the block are as large as stated and have little in common, and would tilt it against all measured angles."""
    drifts = network.flight_sigmas.copy()
    arms_m = network.arms_m
    for flight in range(network.flights):
        own = network.located & (network.flight == flight)
        sigma_m = float(np.median(network.position_sigmas_m[own, 2])) if own.any() else 0.0
        drifts[flight, SLOPES] = drift_of(sigma_m, arms_m[own])
    return replace(network, flight_sigmas=drifts)


def _free_sigmas(work: Work, network: Network, numbers: Sequence[int], held: Collection[int]) -> FloatArray:
    """(K, 12) standard deviations of the unknowns of lenses, 0 where one is held."""
    sigmas = np.array([work.sigmas[number] * (number not in held) for number in numbers])
    seen = np.bincount(network.camera[network.image], minlength=len(numbers))
    sigmas[seen < _LENS_POINTS, LENS.index("f") + 1 :] = 0.0
    return sigmas


def _network(work: Work, model: Any, given: Given) -> tuple[Network, Unknowns, list[int], list[int]]:
    """A model's image points, with nothing else known and everything held; its values, and the numbers of its points
    and cameras."""
    ids, points = image_numbers(model), sorted(model.points3D)
    numbers = sorted({int(model.images[i].camera_id) for i in ids})
    rows = np.array(ids, dtype=int) - 1
    image, point, _, xy_px = image_points(model, ids, points)
    lens = np.array([work.lens(model, number) for number in numbers])
    flights, flight = np.unique(given.flights[rows], return_inverse=True)
    network = Network(
        image=image,
        point=point,
        xy_px=xy_px,
        sigma_px=np.ones(len(image)),
        camera=np.array([numbers.index(int(model.images[i].camera_id)) for i in ids]),
        flight=flight,
        fisheye=np.array([number in work.fisheyes for number in numbers]),
        rows_px=np.array([float(model.cameras[number].height) for number in numbers]),
        positions_m=np.full((len(ids), 3), np.nan),
        position_sigmas_m=np.full((len(ids), 3), np.inf),
        attitudes=np.full((len(ids), 3, 3), np.nan),
        attitude_sigmas=np.full((len(ids), 3), np.inf),
        velocities_m_s=given.velocities_m_s[rows],
        lens_prior=lens,
        lens_sigmas=np.zeros_like(lens),
        mount_sigmas=np.zeros((len(numbers), 6)),
        flight_sigmas=np.zeros((len(flights), 6)),
        control=np.zeros(0, dtype=np.int64),
        control_m=np.zeros((0, 3)),
        control_sigmas_m=np.zeros((0, 3)),
        held=np.ones(len(ids), dtype=bool),
    )
    return network, unknowns_of(model, ids, points, lens, len(numbers), len(flights)), points, numbers


def _take(work: Work, model: Any, ids: list[int], points: list[int], numbers: Sequence[int], state: Unknowns) -> None:
    found = dict(zip(numbers, state.lens, strict=True))
    cameras = {number: (values, number in work.fisheyes) for number, values in found.items()}
    take(work.pycolmap, model, ids, points, state, cameras)
    work.lenses.update(found)


def take_outcome(work: Work, model: Any, outcome: Outcome) -> None:
    """Give a model what an adjustment has found; rows of points beyond the model's own are those of control."""
    state = outcome.result.state
    own = replace(state, points_m=state.points_m[: len(outcome.points)])
    _take(work, model, outcome.images, outcome.points, outcome.cameras, own)


def intersect(work: Work, model: Any, given: Given) -> None:
    """Place the points of a model where their rays meet best, poses and lenses as they are, and state their errors."""
    network, start, points, numbers = _network(work, model, given)
    solved = solve(network, start, _INTERSECTED).state
    _take(work, model, image_numbers(model), points, numbers, solved)
    _write_errors(model, network, solved, points)


def state_errors(work: Work, model: Any, given: Given) -> float:
    """Write the mean reprojection error of every point, pixels, into a model; that of all image points."""
    network, state, points, _ = _network(work, model, given)
    return _write_errors(model, network, state, points)


def _write_errors(model: Any, network: Network, state: Unknowns, points: Sequence[int]) -> float:
    """Write the mean reprojection error of every point, pixels, into a model; return that of all image points of its
    network. Points behind a camera have errors of BEHIND_PX."""
    apart_px = np.linalg.norm(project(network, state) - network.xy_px, axis=1)
    apart_px = np.where(np.isfinite(apart_px), apart_px, BEHIND_PX)
    counts = np.bincount(network.point, minlength=len(points))
    errors_px = np.bincount(network.point, apart_px, minlength=len(points)) / np.maximum(counts, 1)
    for number, error in zip(points, errors_px.tolist(), strict=True):
        model.points3D[number].error = error
    return float(np.mean(apart_px)) if len(apart_px) else 0.0


def believed_tilts(pycolmap: ModuleType, model: Any, given: Given) -> FloatArray:
    """Return the measured tilts, `Given.ups`, or NaN for all where the headings that were given with them are wrong.

    A list whose headings contradict the positions has a fault that may be in its tilts as well. The model is placed by
    its positions and the terrain.
    """
    ids = image_numbers(model)
    rows = np.array(ids) - 1
    untold = np.full((len(ids), 3), np.nan)
    placement = _placed(pycolmap, model, ids, given.positions_m[rows], given.mean_sigmas_m[rows], untold)
    known = np.isfinite(given.rotations[rows]).all(axis=(1, 2))
    if placement.kind == "level" or not known.any():
        return given.ups
    found = rotations_of(model, ids)[known]
    turns = found.transpose(0, 2, 1) @ given.rotations[rows][known]
    headings = np.arctan2(turns[:, 1, 0] - turns[:, 0, 1], turns[:, 0, 0] + turns[:, 1, 1])
    most_deg = max(_WRONG_HEADING_DEG, _WRONG_HEADING_SIGMAS * placement.north_sigma_deg)
    wrong = float(np.median(np.abs(np.rad2deg(headings)))) > most_deg
    return np.full_like(given.ups, np.nan) if wrong else given.ups


def _placed(
    pycolmap: ModuleType, model: Any, ids: list[int], positions_m: FloatArray, sigmas_m: FloatArray, ups: FloatArray
) -> Placement:
    rotations = rotations_of(model, ids)
    in_model = np.einsum("nji,nj->ni", rotations, ups)
    placement = place(centers_of(model, ids), points_of(model), positions_m, sigmas_m, in_model)
    rotation = pycolmap.Rotation3d(placement.rotation)
    model.transform(pycolmap.Sim3d(placement.scale, rotation, placement.translation_m))
    return placement


def images_by_camera(model: Any) -> Counter[int]:
    """Count the posed images of each camera of a model."""
    return Counter(int(image.camera_id) for image in model.images.values() if image.has_pose)


def reset_lenses(work: Work, model: Any) -> None:
    """Give a camera back what was known of it where the mapper has found a focal length that no lens has.

    Images that were placed with it are misplaced and leave the model. Blocks that need it: rendered suburbs, flight
    `mixed`, seeds 917 and 5102, 7 images.
    """
    for number in images_by_camera(model):
        camera, prior = model.cameras[number], work.priors[number]
        if not 1.0 / _LENS_RATIO < camera.mean_focal_length() / prior[0] < _LENS_RATIO:
            set_lens(work.pycolmap, camera, prior, number in work.fisheyes)
            _drop(model, [image for image in model.images.values() if image.has_pose and image.camera_id == number])


def connected_parts(model: Any) -> list[list[int]]:
    """Return numbers of images that shared points connect with each other, the largest part first."""
    shared: Counter[tuple[int, int]] = Counter()
    for point in model.points3D.values():
        shared.update(combinations(sorted({int(element.image_id) for element in point.track.elements}), 2))
    connected = connected_groups([pair for pair, count in shared.items() if count >= _SHARED_POINTS])
    return [sorted(part) for part in connected]


def keep_images(model: Any, numbers: Collection[int]) -> None:
    """Take all other images out of a model."""
    _drop(model, [i for i in model.images.values() if i.has_pose and i.image_id not in numbers])


def _drop(model: Any, images: Sequence[Any]) -> None:
    for frame_id in {image.frame_id for image in images}:
        model.deregister_frame(frame_id)


def drop_weak_images(model: Any) -> None:
    """Take images with few points out of a model."""
    _drop(model, [i for i in model.images.values() if i.has_pose and i.num_points3D < MIN_OBSERVATIONS])
