"""Bundle adjustment of pycolmap models, for the processes of `mapper` and `refiner`: in the world frame, with the given
positions as observations.

Image numbers are those of the database, from 1; arrays of positions and standard deviations have one row for each.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from types import ModuleType
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.orientation.judgement import connected_groups
from aeromatch_cli.orientation.placing import Placement, place
from aeromatch_cli.orientation.results import BEHIND_PX, centers_of, image_numbers, points_of
from aeromatch_cli.orientation.spread import take_poses

# A prior focal length is taken where the cost with it is larger by no more than this share, or by so
# many times the mean of a residual: chance lowers it by one for every unknown. The share holds for twice the prior's
# standard deviation, and grows with the distance: what a lens model lacks also lowers the cost.
_SAME_COST, _CHANCE = 0.05, 6.0
# Closer to its prior than this share of twice the standard deviation, a focal length stays as it was found.
_NEAR = 0.1
# Fewer images do not determine a camera's focal length, or its distortion: it stays as it was given. A distortion that
# nobody has given is worse than what few images tell: without it, focal lengths of seven images are off by 4 instead of
# 2 %, their attitudes by 2 instead of 1 degree (seneca).
_FOCAL_IMAGES, _DISTORTION_IMAGES, GIVEN_DISTORTION_IMAGES = 3, 4, 10
# A focal length this many times longer or shorter than its prior is no lens: the images of that camera were misplaced.
_LENS_RATIO = 3.0
# Images are connected by so many points that both see.
_SHARED_POINTS = 8
# An image this many times as far from the middle of all as they are by the median was placed by chance.
_FAR = 20.0
# Images with fewer points than this in their model are taken out of it.
MIN_OBSERVATIONS = 12
# Headings are wrong beyond this, degrees, and so many standard deviations of the north that positions tell.
_WRONG_HEADING_DEG, _WRONG_HEADING_SIGMAS = 20.0, 3.0
# Given attitudes have an error in common of up to this, degrees: that of the mounting, or of their north.
_COMMON_DEG = 1.0
# So many positions hold a model in the world frame.
_HOLDING = 3
# A position that is so many standard deviations away is not that of the image.
_WRONG_SIGMAS = 5.0
# Positions beyond so many standard deviations are no observations of an adjustment in the making.
_FAR_SIGMAS = 10.0
# Position priors beyond this many standard deviations pull less and less (Cauchy).
_PRIOR_LOSS_SIGMAS = 3.0


def adjusted(
    pycolmap: ModuleType,
    model: Any,
    cameras: dict[str, Any],
    positions_m: FloatArray,
    sigmas_m: FloatArray,
    ups: FloatArray,
    tolerance: float,
    held: Collection[int] = (),
) -> Placement:
    """Place a model in the world, adjust it with the given positions as observations, and place it once more.

    The adjustment takes what the positions say of the model's shape; how it is levelled is for `place` to weigh. ups:
    one row per image number, unit vectors upwards in the camera's frame by its measured tilt, NaN where there is none.
    tolerance: it ends when a step lowers the cost by a smaller share. held: numbers of cameras that stay as they are.
    """
    ids = image_numbers(model)
    rows = np.array(ids) - 1
    placement = _placed(pycolmap, model, ids, positions_m[rows], sigmas_m[rows], ups[rows])
    # A wrong focal length puts images far from positions that are right: those count that may be.
    off_m = np.linalg.norm(centers_of(model, ids) - positions_m[rows], axis=1)
    used = [] if placement.kind == "level" else [
        i for i, off, sigma in zip(ids, off_m, sigmas_m[rows], strict=True) if off <= _FAR_SIGMAS * sigma
    ]  # fmt: skip
    _adjust(pycolmap, model, cameras, used, positions_m, sigmas_m, tolerance, held)
    return _placed(pycolmap, model, ids, positions_m[rows], sigmas_m[rows], ups[rows])


def believed_tilts(
    pycolmap: ModuleType,
    model: Any,
    positions_m: FloatArray,
    sigmas_m: FloatArray,
    ups: FloatArray,
    rotations: FloatArray,
) -> FloatArray:
    """The measured tilts, or NaN for all where the headings that were given with them are wrong.

    A list whose headings contradict the positions has a fault that may be in its tilts as well. rotations: (N, 3, 3)
    cam_from_world as given, NaN where there is none. The model is placed by its positions and the terrain.
    """
    ids = image_numbers(model)
    rows = np.array(ids) - 1
    placement = _placed(pycolmap, model, ids, positions_m[rows], sigmas_m[rows], np.full((len(ids), 3), np.nan))
    known = np.isfinite(rotations[rows]).all(axis=(1, 2))
    if placement.kind == "level" or not known.any():
        return ups
    found = np.array([model.images[i].cam_from_world().rotation.matrix() for i in ids])[known]
    turns = found.transpose(0, 2, 1) @ rotations[rows][known]
    headings = np.arctan2(turns[:, 1, 0] - turns[:, 0, 1], turns[:, 0, 0] + turns[:, 1, 1])
    most_deg = max(_WRONG_HEADING_DEG, _WRONG_HEADING_SIGMAS * placement.north_sigma_deg)
    wrong = float(np.median(np.abs(np.rad2deg(headings)))) > most_deg
    return np.full_like(ups, np.nan) if wrong else ups


def adjust_in_place(
    pycolmap: ModuleType,
    model: Any,
    cameras: dict[str, Any],
    positions_m: FloatArray,
    sigmas_m: FloatArray,
    attitudes: Attitudes,
    tolerance: float,
    held: Collection[int] = (),
) -> list[int]:
    """Adjust a model whose poses are in the world frame already; it stays there. Images whose positions were used.

    The adjustment itself knows no attitudes: afterwards the whole model is turned to the most probable attitude of the
    block, by what its positions and its attitudes say of it. Positions far from where an image is are not used: they
    have been found wrong before. held: numbers of cameras that stay as they are.
    """
    ids = image_numbers(model)
    off_m = np.linalg.norm(centers_of(model, ids) - positions_m[np.array(ids, dtype=int) - 1], axis=1)
    used = [i for i, off in zip(ids, off_m, strict=True) if off <= _WRONG_SIGMAS * sigmas_m[i - 1]]
    used = used if len(used) >= _HOLDING else []
    _adjust(pycolmap, model, cameras, used, positions_m, sigmas_m, tolerance, held)
    rows = np.array(used, dtype=int) - 1
    arms_m = positions_m[rows] - positions_m[rows].mean(axis=0) if used else np.zeros((0, 3))
    weights = 1.0 / sigmas_m[rows] ** 2
    by_positions = np.eye(3) * (weights @ (arms_m**2).sum(axis=1)) - (arms_m * weights[:, None]).T @ arms_m
    turn = attitudes.turn(model, by_positions)
    middle_m = centers_of(model, used or image_numbers(model)).mean(axis=0)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(turn), middle_m - turn @ middle_m))
    return used


@dataclass(frozen=True, eq=False)
class Attitudes:
    """Observed attitudes of some images: numbers, (N, 3, 3) cam_from_world, (N,) standard deviations in degrees."""

    images: tuple[int, ...]
    rotations: FloatArray
    sigmas_deg: FloatArray

    def turn(self, model: Any, information: FloatArray) -> FloatArray:
        """Rotation (3, 3) of the world that brings a model nearest to them.

        information: (3, 3) that other observations have of the model's turn as it is, per square radian.
        """
        from scipy.spatial.transform import Rotation

        weights = 1.0 / np.deg2rad(self.sigmas_deg) ** 2
        if not weights.sum() > 0.0:
            return np.eye(3)
        now = np.array([model.images[i].cam_from_world().rotation.matrix() for i in self.images])
        turns = Rotation.from_matrix(self.rotations.transpose(0, 2, 1) @ now)
        # Their mean is no better than what they have in common: the mounting's error, another north.
        common_deg = min(_COMMON_DEG, float(np.median(self.sigmas_deg)))
        own = np.eye(3) / (1.0 / weights.sum() + np.deg2rad(common_deg) ** 2)
        mean = turns.mean(weights).as_rotvec()
        return np.asarray(Rotation.from_rotvec(np.linalg.solve(own + information, own @ mean)).as_matrix())


def _adjust(
    pycolmap: ModuleType,
    model: Any,
    cameras: dict[str, Any],
    used: list[int],
    positions_m: FloatArray,
    sigmas_m: FloatArray,
    tolerance: float,
    held: Collection[int],
) -> None:
    """used: numbers of the images whose positions are observations; without any the frame is held by two images.

    held: numbers of cameras that stay as they are.
    """

    images = images_by_camera(model)
    unknown = {number for number in model.cameras if images[number] < _FOCAL_IMAGES or number in held}
    few = {number for number in model.cameras if _keeps_distortion(model, number, cameras, images) or number in held}
    distorted = not few >= images.keys()

    def adjuster(which: Any, fixed_cameras: bool) -> Any:
        fixed = set(model.cameras) if fixed_cameras else few if distorted else unknown
        return _adjuster(pycolmap, which, used, positions_m, sigmas_m, fixed, distorted, tolerance)

    if distorted and few > unknown:  # their focal lengths first, without anybody's distortion
        _adjuster(pycolmap, model, used, positions_m, sigmas_m, unknown, False, tolerance).solve()
    start = copy.deepcopy(model)
    cost = adjuster(model, False).solve().ceres_summary.final_cost
    own = {number: prior for number, prior in cameras.items() if int(number) not in held}
    _prefer_prior_focal_lengths(model, start, own, cost, adjuster)


def _prefer_prior_focal_lengths(
    model: Any, start: Any, priors: dict[str, Any], cost: float, adjuster: Callable[[Any, bool], Any]
) -> None:
    """Take focal lengths back towards their priors, as far as the pictures say little against the priors.

    Where all images look straight down on flat ground, any focal length goes with some flying height, and what an
    adjustment finds is chance. A prior far away is taken where the cost of an adjustment with it is nearly the same.
    Nearer ones are weighed: the cost grows with the square of the distance, and the prior's with it. start: the model
    before its adjustment: one with a far prior starts there, since points at the heights of another focal length end up
    behind the images, where they cost nothing. cost: of the model as it is.
    """
    lenses = {number: model.cameras[int(number)] for number in priors if int(number) in model.cameras}
    away = {
        number: abs(camera.mean_focal_length() / priors[number]["focal_px"] - 1.0) / (2.0 * priors[number]["sigma"])
        for number, camera in lenses.items()
    }
    far = {number: priors[number] for number, sigmas in away.items() if sigmas > 1.0}
    moved = far or {number: priors[number] for number, sigmas in away.items() if sigmas > _NEAR}
    if not moved:
        return
    trial = start if far else copy.deepcopy(model)
    for number, camera in model.cameras.items():
        trial.cameras[number].params = moved[str(number)]["params"] if str(number) in moved else camera.params
    spare = 2 * model.compute_num_observations() - 3 * model.num_points3D() - 6 * model.num_reg_images()
    most = max(away.values())
    same = max(_SAME_COST * (most if far else most**2), _CHANCE / max(spare, 1))
    rise = max(adjuster(trial, True).solve().ceres_summary.final_cost / cost - 1.0, 0.0)
    if far:
        trial.update_point_3d_errors()
        errors_px = np.array([point.error for point in trial.points3D.values()])
        if rise <= same and np.median(errors_px) < BEHIND_PX:
            take_poses(model, trial)
            for number, point in trial.points3D.items():
                model.points3D[number].xyz = point.xyz
        return
    share = same / (same + rise)
    for number, prior in moved.items():
        found = model.cameras[int(number)]
        found.params = found.params + share * (np.array(prior["params"]) - found.params)
    adjuster(model, True).solve()


def _placed(
    pycolmap: ModuleType, model: Any, ids: list[int], positions_m: FloatArray, sigmas_m: FloatArray, ups: FloatArray
) -> Placement:
    rotations = np.array([model.images[i].cam_from_world().rotation.matrix() for i in ids])
    in_model = np.einsum("nji,nj->ni", rotations, ups)
    placement = place(centers_of(model, ids), points_of(model), positions_m, sigmas_m, in_model)
    rotation = pycolmap.Rotation3d(placement.rotation)
    model.transform(pycolmap.Sim3d(placement.scale, rotation, placement.translation_m))
    return placement


def _adjuster(
    pycolmap: ModuleType,
    model: Any,
    used: list[int],
    positions_m: FloatArray,
    sigmas_m: FloatArray,
    fixed: Collection[int],
    distortion: bool,
    tolerance: float,
) -> Any:
    """fixed: cameras whose parameters stay; distortion: whether those of the others' lenses are unknowns, too."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance = tolerance
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.refine_extra_params = distortion
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in image_numbers(model):
        config.add_image(image_id)
    for camera_id in fixed:
        config.set_constant_cam_intrinsics(camera_id)
    if not used:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        return pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
    prior_options.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    prior_options.ceres.prior_position_loss_scale = _PRIOR_LOSS_SIGMAS
    priors = [_prior(pycolmap, model.images[i], positions_m[i - 1], sigmas_m[i - 1]) for i in used]
    return pycolmap.create_pose_prior_ceres_bundle_adjuster(options, prior_options, config, priors, model)


def images_by_camera(model: Any) -> Counter[int]:
    """How many posed images each camera of a model has."""
    return Counter(int(image.camera_id) for image in model.images.values() if image.has_pose)


def _keeps_distortion(model: Any, number: int, priors: dict[str, Any], images: Mapping[int, int]) -> bool:
    """Whether a camera has too few images for another distortion than it was given."""
    given = np.array(priors[str(number)]["params"])[model.cameras[number].extra_params_idxs()]
    return bool(images[number] < (GIVEN_DISTORTION_IMAGES if given.any() else _DISTORTION_IMAGES))


def reset_lenses(model: Any, priors: dict[str, Any]) -> None:
    """Give cameras back what the mapper could not know of them, before a model is adjusted.

    Distortion of a camera with few images; a focal length that no lens has, with whose camera images are misplaced and
    leave the model. priors: by camera number, "params" and "focal_px".
    """
    images = images_by_camera(model)
    for number in [number for number in model.cameras if images[number]]:
        camera, prior = model.cameras[number], priors[str(number)]
        ratio = camera.mean_focal_length() / prior["focal_px"]
        if not 1.0 / _LENS_RATIO < ratio < _LENS_RATIO:
            camera.params = prior["params"]
            _drop(model, [image for image in model.images.values() if image.has_pose and image.camera_id == number])
        elif _keeps_distortion(model, number, priors, images):
            params = np.array(prior["params"])
            params[camera.focal_length_idxs()] = camera.params[camera.focal_length_idxs()]
            camera.params = params


def drop_far_images(model: Any) -> None:
    """Take images out of a model that lie far from all others: a mapper places some by a single pair, anywhere."""
    ids = image_numbers(model)
    if not ids:
        return
    centers = centers_of(model, ids)
    apart = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    _drop(model, [model.images[i] for i, far in zip(ids, apart > _FAR * np.median(apart), strict=True) if far])


def connected_parts(model: Any) -> list[list[int]]:
    """Numbers of images that shared points connect with each other, the largest part first."""
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


def _prior(pycolmap: ModuleType, image: Any, position_m: FloatArray, sigma_m: float) -> Any:
    return pycolmap.PosePrior(
        corr_data_id=image.data_id,
        position=position_m,
        position_covariance=np.eye(3) * float(sigma_m) ** 2,
        coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
    )


def drop_weak_images(model: Any) -> None:
    """Take images with few points out of a model."""
    _drop(model, [i for i in model.images.values() if i.has_pose and i.num_points3D < MIN_OBSERVATIONS])
