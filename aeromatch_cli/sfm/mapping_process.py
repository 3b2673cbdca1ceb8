"""The mapper's own process: a COLMAP database and given positions in, oriented models out. See `mapping`.

Run as a module: FOLDER, which holds database.db, task.json and priors.npz; model<k>.npz and result.json are written
into it. A process of its own, since pycolmap stops the whole process on a fault. One thread and fixed seeds: the same
input gives the same bytes.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from aeromatch_cli.sfm.bundle.adjust import Options
from aeromatch_cli.sfm.georeferencing import Placement
from aeromatch_cli.sfm.model_adjustment import (
    Given,
    Work,
    adjusted,
    believed_tilts,
    drop_far_images,
    drop_weak_images,
    images_by_camera,
    reset_lenses,
    state_errors,
)
from aeromatch_cli.sfm.model_arrays import arrays, figures
from aeromatch_cli.sfm.planar_ambiguity import turned_back
from aeromatch_cli.sfm.process import ANY_DISTORTION, quiet_pycolmap

# Mapping starts again with the focal lengths that it found until none changes by more than this share.
_FOCAL_CHANGE = 0.1
_MAX_STARTS = 3
# A focal length that is so many of its prior's standard deviations away has to be better than the prior: by more points
# or smaller errors than these shares leave.
_FAR_SIGMAS, _AS_MANY, _AS_EXACT = 4.0, 0.8, 1.2
_MIN_IMAGES = 3
# Positions are found from the longest tracks, so many in every image that has them, in large blocks fewer: 300 images
# take 13 s with 100, 36 s with 300. Small blocks need them: lewis 0.5 degrees with 100, 0.1 with 300. Points after that
# are left to the adjustment of the final matches.
_TRACKS_PER_IMAGE, _LEAST_TRACKS, _TRACKS = 300, 100, 30_000
# A block of more images than this is large: images have ties to spare, and a mapping takes long.
LARGE_BLOCK = 100
# There focal lengths are found before by a rough mapping of so few tracks per image: 8 s for 300 images, where a start
# that has to be made again takes 30 s.
_ROUGH_TRACKS = 30
# Fewer images of a camera determine no distortion while they are mapped: a distortion that nobody has given is worse
# than what few images tell (seneca).
_DISTORTION_IMAGES = 10
# Adjustments end when a step lowers the cost by a smaller share: exact enough for views and search.
_COST_TOLERANCE = 1e-4


def solve(folder: Path) -> None:
    """Map the database of `folder` and write every model in the world frame."""
    pycolmap = quiet_pycolmap()
    task = json.loads((folder / "task.json").read_text(encoding="utf-8"))
    priors = np.load(folder / "priors.npz")
    models = _mapped(pycolmap, folder, task["mapper"])
    if _far_from_priors(models, task["cameras"]):
        models = _with_priors(pycolmap, folder, task, models)
    work = Work.of_task(pycolmap, task["cameras"], Options(_COST_TOLERANCE, final=False))
    given = Given.of_file(priors)
    facts = []
    for number, model in enumerate(models):
        work.lenses.clear()
        work.start(model)
        reset_lenses(work, model)
        drop_far_images(model)
        drop_weak_images(model)
        if model.num_reg_images() < _MIN_IMAGES:
            continue
        ups = believed_tilts(pycolmap, model, given)
        believed = replace(given, ups=ups)
        adjust = partial(_placement, work, given=believed)
        upright = turned_back(pycolmap, model, adjust(model), given.positions_m, given.mean_sigmas_m, adjust)
        model, placement = upright.model, upright.placement
        drop_weak_images(model)
        if model.num_reg_images() < _MIN_IMAGES:
            continue
        state_errors(work, model, given)
        name = f"model{number}.npz"
        lenses = {n: work.lens(model, n) for n in images_by_camera(model)}
        np.savez(folder / name, **arrays(model, lenses))
        known = {"contradiction": placement.contradiction, "turned_back": upright.turned, **figures(model)}
        facts.append({"file": name, "kind": placement.kind, **known})
    (folder / "result.json").write_text(json.dumps({"models": facts}), encoding="utf-8")


def _placement(work: Work, model: Any, given: Given) -> Placement:
    placement = adjusted(work, model, given).placement
    assert placement is not None
    return placement


def _mapped(pycolmap: ModuleType, folder: Path, mapper: str) -> list[Any]:
    """Models, the largest first, from focal lengths that mapping itself confirms.

    A wrong focal length bends the relative rotations that mapping starts from; the bundle adjustment at its end finds
    the right one all the same. Mapping starts again with it, until it finds what it started from.
    """
    models: list[Any] = []
    database = folder / "database.db"
    if mapper == "global":
        _calibrate_large_block(pycolmap, database, folder / "rough")
    for start in range(_MAX_STARTS):
        out = folder / f"start{start}"
        out.mkdir(exist_ok=True)
        models = _once(pycolmap, database, out, mapper, free=True)
        if not models or not _update_focal_lengths(pycolmap, database, models):
            break
    return models


def _calibrate_large_block(pycolmap: ModuleType, database: Path, out: Path) -> None:
    """Write the focal lengths that a rough mapping finds, where the block is large."""
    with pycolmap.Database.open(database) as opened:
        if opened.num_images() <= LARGE_BLOCK:
            return
    options = _global_options(pycolmap, database, free=True)
    options.mapper.track_required_tracks_per_view = _ROUGH_TRACKS
    options.mapper.ba_skip_fixed_rotation_stage = True
    options.mapper.ba_num_iterations = 1
    out.mkdir(exist_ok=True)
    models = pycolmap.global_mapping(database, out, out, options)
    _update_focal_lengths(pycolmap, database, _largest_first(models))


def _once(pycolmap: ModuleType, database: Path, out: Path, mapper: str, *, free: bool) -> list[Any]:
    """Models, the largest first. free: whether focal lengths and distortions are unknowns."""
    run = _global if mapper == "global" else _incremental
    return _largest_first(run(pycolmap, database, out, free))


def _largest_first(models: dict[int, Any]) -> list[Any]:
    return sorted(models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _far_from_priors(models: list[Any], priors: dict[str, Any]) -> bool:
    """Whether the largest model has found a focal length that its prior speaks against."""
    for number, prior in priors.items():
        if models and _sees(models[0], int(number)):
            ratio = models[0].cameras[int(number)].mean_focal_length() / prior["focal_px"]
            if abs(ratio - 1.0) > max(_FOCAL_CHANGE, _FAR_SIGMAS * prior["sigma"]):
                return True
    return False


def _with_priors(pycolmap: ModuleType, folder: Path, task: dict[str, Any], free: list[Any]) -> list[Any]:
    """Models mapped with the prior focal lengths held, where they are as good as the `free` ones, else these.

    Straight views of flat ground go with any focal length and some flying height: what free mapping finds is chance.
    """
    database, out = folder / "database.db", folder / "held"
    out.mkdir(exist_ok=True)
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            camera.params = task["cameras"][str(camera.camera_id)]["params"]
            opened.update_camera(camera)
    held = _once(pycolmap, database, out, task["mapper"], free=False)
    if not held or held[0].num_reg_images() < free[0].num_reg_images():
        return free
    fewer = held[0].num_points3D() < _AS_MANY * free[0].num_points3D()
    worse = held[0].compute_mean_reprojection_error() > _AS_EXACT * free[0].compute_mean_reprojection_error()
    return free if fewer or worse else held


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


def _global(pycolmap: ModuleType, database: Path, out: Path, free: bool) -> dict[int, Any]:
    options = _global_options(pycolmap, database, free)
    found: dict[int, Any] = pycolmap.global_mapping(database, out, out, options)
    return found


def _global_options(pycolmap: ModuleType, database: Path, free: bool) -> Any:
    with pycolmap.Database.open(database) as opened:
        tracks = max(_LEAST_TRACKS, min(_TRACKS_PER_IMAGE, _TRACKS // max(1, opened.num_images())))
        most = max(Counter(image.camera_id for image in opened.read_all_images()).values(), default=0)
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = options.mapper.random_seed = 0
    options.num_threads = options.mapper.num_threads = 1
    options.min_model_size = _MIN_IMAGES
    options.mapper.track_required_tracks_per_view = tracks
    options.mapper.skip_retriangulation = True
    options.mapper.bundle_adjustment.ceres.solver_options.function_tolerance = _COST_TOLERANCE
    options.mapper.bundle_adjustment.refine_focal_length = free
    options.mapper.bundle_adjustment.refine_extra_params = (
        free and most >= _DISTORTION_IMAGES and not _divided(pycolmap, database)
    )
    return options


def _divided(pycolmap: ModuleType, database: Path) -> bool:
    """Whether a camera has terms that divide: these follow noise, and it has a calibration to begin with."""
    with pycolmap.Database.open(database) as opened:
        return any(camera.model.name == "FULL_OPENCV" for camera in opened.read_all_cameras())


def _incremental(pycolmap: ModuleType, database: Path, out: Path, free: bool) -> dict[int, Any]:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = 0, 1
    options.min_model_size = _MIN_IMAGES
    options.extract_colors = False
    options.ba_refine_focal_length = free
    options.ba_refine_extra_params = free and not _divided(pycolmap, database)
    options.max_extra_param = options.mapper.max_extra_param = options.triangulation.max_extra_param = ANY_DISTORTION
    found: dict[int, Any] = pycolmap.incremental_mapping(database, out, out, options=options)
    return found


if __name__ == "__main__":
    solve(Path(sys.argv[1]))
