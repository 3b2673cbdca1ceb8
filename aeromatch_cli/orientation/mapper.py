"""The mapper's own process: a COLMAP database and given positions in, oriented models out. See `mapping`.

Run as a module: FOLDER, which holds database.db, task.json and priors.npz; model<k>.npz and result.json are written
into it. A process of its own, since pycolmap stops the whole process on a fault. One thread and fixed seeds: the same
input gives the same bytes.
"""

from __future__ import annotations

import copy
import json
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.orientation.placing import Placement, place

# Mapping starts again with the focal lengths that it found until none changes by more than this share.
_FOCAL_CHANGE = 0.1
_MAX_STARTS = 3
_MIN_IMAGES = 3
# Images with fewer points than this in their model are taken out of it.
_MIN_OBSERVATIONS = 12
# A prior focal length is taken where the cost with it is larger by no more than this share.
_SAME_COST = 0.05
# Position priors beyond this many standard deviations pull less and less (Cauchy).
_PRIOR_LOSS_SIGMAS = 3.0


def solve(folder: Path) -> None:
    """Map the database of `folder` and write every model in the world frame."""
    zlib.compress(b"")  # pycolmap aborts when it is the first user of zlib
    import pycolmap

    pycolmap.logging.minloglevel = 3
    task = json.loads((folder / "task.json").read_text(encoding="utf-8"))
    priors = np.load(folder / "priors.npz")
    models = _mapped(pycolmap, folder, task["mapper"])
    facts = []
    for number, model in enumerate(models):
        _drop_weak_images(model)
        if model.num_reg_images() < _MIN_IMAGES:
            continue
        placement = _adjusted(pycolmap, model, task["cameras"], priors["positions_m"], priors["sigmas_m"])
        name = f"model{number}.npz"
        np.savez(folder / name, **_arrays(pycolmap, model))
        facts.append({"file": name, "kind": placement.kind, **_figures(model)})
    (folder / "result.json").write_text(json.dumps({"models": facts}), encoding="utf-8")


def _mapped(pycolmap: ModuleType, folder: Path, mapper: str) -> list[Any]:
    """Models, the largest first, from focal lengths that mapping itself confirms.

    A wrong focal length bends the relative rotations that mapping starts from; the bundle adjustment at its end finds
    the right one all the same. Mapping starts again with it, until it finds what it started from.
    """
    models: list[Any] = []
    database = folder / "database.db"
    for start in range(_MAX_STARTS):
        out = folder / f"start{start}"
        out.mkdir(exist_ok=True)
        found = _global(pycolmap, database, out) if mapper == "global" else _incremental(pycolmap, database, out)
        models = sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
        if not models or not _update_focal_lengths(pycolmap, database, models):
            break
    return models


def _update_focal_lengths(pycolmap: ModuleType, database: Path, models: list[Any]) -> bool:
    """Write the focal lengths of the largest model with each camera; whether one has changed by much."""
    changed = False
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            found = next((m.cameras[camera.camera_id] for m in models if _sees(m, camera.camera_id)), None)
            if found is None:
                continue
            changed |= abs(found.mean_focal_length() / camera.mean_focal_length() - 1.0) > _FOCAL_CHANGE
            camera.params = found.params
            opened.update_camera(camera)
    return changed


def _sees(model: Any, camera_id: int) -> bool:
    return any(image.has_pose and image.camera_id == camera_id for image in model.images.values())


def _global(pycolmap: ModuleType, database: Path, out: Path) -> dict[int, Any]:
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = options.mapper.random_seed = 0
    options.num_threads = options.mapper.num_threads = 1
    options.min_model_size = _MIN_IMAGES
    found: dict[int, Any] = pycolmap.global_mapping(database, out, out, options)
    return found


def _incremental(pycolmap: ModuleType, database: Path, out: Path) -> dict[int, Any]:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = 0, 1
    options.min_model_size = _MIN_IMAGES
    options.extract_colors = False
    found: dict[int, Any] = pycolmap.incremental_mapping(database, out, out, options=options)
    return found


def _drop_weak_images(model: Any) -> None:
    for image in list(model.images.values()):
        if image.has_pose and image.num_points3D < _MIN_OBSERVATIONS:
            model.deregister_frame(image.frame_id)


def _adjusted(
    pycolmap: ModuleType, model: Any, cameras: dict[str, Any], positions_m: FloatArray, sigmas_m: FloatArray
) -> Placement:
    """Place a model in the world, adjust it with the given positions as observations, and place it once more.

    The adjustment takes what the positions say of the model's shape; how it is levelled is for `place` to weigh.
    """
    ids = _ids(model)
    rows = np.array(ids) - 1
    placement = _placed(pycolmap, model, ids, positions_m[rows], sigmas_m[rows])

    def adjuster(which: Any, fixed_cameras: bool) -> Any:
        return _adjuster(pycolmap, which, ids, placement, positions_m, sigmas_m, fixed_cameras)

    if not _with_prior_focal_lengths(pycolmap, model, cameras, adjuster):
        adjuster(model, False).solve()
    return _placed(pycolmap, model, ids, positions_m[rows], sigmas_m[rows])


def _with_prior_focal_lengths(
    pycolmap: ModuleType, model: Any, priors: dict[str, Any], adjuster: Callable[[Any, bool], Any]
) -> bool:
    """Whether focal lengths far from their priors are given up, since the pictures say nothing against the priors.

    Where all images look straight down on flat ground, any focal length goes with some flying height, and what an
    adjustment finds is chance. A prior is taken where the cost of an adjustment with it is nearly the same.
    """
    far = {
        number: prior
        for number, prior in priors.items()
        if int(number) in model.cameras
        and abs(model.cameras[int(number)].mean_focal_length() / prior["focal_px"] - 1.0) > 2.0 * prior["sigma"]
    }
    if not far:
        return False
    cost = adjuster(model, False).solve().ceres_summary.final_cost
    trial = copy.deepcopy(model)
    for number, prior in far.items():
        trial.cameras[int(number)].params = prior["params"]
    if adjuster(trial, True).solve().ceres_summary.final_cost > (1.0 + _SAME_COST) * cost:
        return False
    for number, prior in far.items():
        model.cameras[int(number)].params = prior["params"]
    adjuster(model, True).solve()
    return True


def _placed(
    pycolmap: ModuleType, model: Any, ids: list[int], positions_m: FloatArray, sigmas_m: FloatArray
) -> Placement:
    placement = place(_centers(model, ids), _points(model), positions_m, sigmas_m)
    rotation = pycolmap.Rotation3d(placement.rotation)
    model.transform(pycolmap.Sim3d(placement.scale, rotation, placement.translation_m))
    return placement


def _adjuster(
    pycolmap: ModuleType,
    model: Any,
    ids: list[int],
    placement: Placement,
    positions_m: FloatArray,
    sigmas_m: FloatArray,
    fixed_cameras: bool,
) -> Any:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in ids:
        config.add_image(image_id)
    if fixed_cameras:
        for camera_id in model.cameras:
            config.set_constant_cam_intrinsics(camera_id)
    if placement.kind == "level":
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        return pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
    prior_options.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    prior_options.ceres.prior_position_loss_scale = _PRIOR_LOSS_SIGMAS
    used = [i for i, agrees in zip(ids, placement.agreeing, strict=True) if agrees]
    priors = [_prior(pycolmap, model.images[i], positions_m[i - 1], sigmas_m[i - 1]) for i in used]
    return pycolmap.create_pose_prior_ceres_bundle_adjuster(options, prior_options, config, priors, model)


def _prior(pycolmap: ModuleType, image: Any, position_m: FloatArray, sigma_m: float) -> Any:
    return pycolmap.PosePrior(
        corr_data_id=image.data_id,
        position=position_m,
        position_covariance=np.eye(3) * float(sigma_m) ** 2,
        coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
    )


def _ids(model: Any) -> list[int]:
    return sorted(int(image_id) for image_id, image in model.images.items() if image.has_pose)


def _centers(model: Any, ids: list[int]) -> FloatArray:
    return np.array([model.images[i].projection_center() for i in ids])


def _points(model: Any) -> FloatArray:
    return np.array([model.points3D[i].xyz for i in sorted(model.points3D)]).reshape(-1, 3)


def _arrays(pycolmap: ModuleType, model: Any) -> dict[str, Any]:
    """What the parent reads: see `mapping.Model`."""
    del pycolmap
    ids, point_ids = _ids(model), sorted(model.points3D)
    model.update_point_3d_errors()
    points = [model.points3D[i] for i in point_ids]
    cameras = sorted(model.cameras)
    return {
        "images": np.array(ids),
        "rotations": np.array([model.images[i].cam_from_world().rotation.matrix() for i in ids]),
        "centers_m": _centers(model, ids),
        "observations": np.array([model.images[i].num_points3D for i in ids]),
        "cameras": np.array(cameras),
        "points_m": _points(model),
        "errors_px": np.array([point.error for point in points]),
        "track_lengths": np.array([point.track.length() for point in points]),
        **{f"params{i}": np.array(model.cameras[i].params) for i in cameras},
    }


def _figures(model: Any) -> dict[str, Any]:
    return {
        "images": model.num_reg_images(),
        "points": model.num_points3D(),
        "track_length": model.compute_mean_track_length(),
        "reprojection_error_px": model.compute_mean_reprojection_error(),
    }


if __name__ == "__main__":
    solve(Path(sys.argv[1]))
