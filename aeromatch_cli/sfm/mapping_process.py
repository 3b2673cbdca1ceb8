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
    work = Work.of_task(pycolmap, task["cameras"], Options(_COST_TOLERANCE, final=False))
    given = Given.of_file(priors)
    facts = []
    for number, model in enumerate(models):
        work.lenses.clear()
        work.start(model)
        reset_lenses(work, model)
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
    the right one all the same. Mapping starts again with it, until it finds what it started from. Blocks that need it:
    rendered suburbs, flight `mixed`, seeds 943 and 5101, 7 images.
    """
    models: list[Any] = []
    database = folder / "database.db"
    if mapper == "global":
        _calibrate_large_block(pycolmap, database, folder / "rough")
    for start in range(_MAX_STARTS):
        out = folder / f"start{start}"
        out.mkdir(exist_ok=True)
        run = _global if mapper == "global" else _incremental
        models = _largest_first(run(pycolmap, database, out))
        if not models or not _update_focal_lengths(pycolmap, database, models):
            break
    return models


def _calibrate_large_block(pycolmap: ModuleType, database: Path, out: Path) -> None:
    """Write the focal lengths that a rough mapping finds, where the block is large."""
    with pycolmap.Database.open(database) as opened:
        if opened.num_images() <= LARGE_BLOCK:
            return
    options = _global_options(pycolmap, database)
    options.mapper.track_required_tracks_per_view = _ROUGH_TRACKS
    options.mapper.ba_skip_fixed_rotation_stage = True
    options.mapper.ba_num_iterations = 1
    out.mkdir(exist_ok=True)
    models = pycolmap.global_mapping(database, out, out, options)
    _update_focal_lengths(pycolmap, database, _largest_first(models))


def _largest_first(models: dict[int, Any]) -> list[Any]:
    return sorted(models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


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
    options = _global_options(pycolmap, database)
    found: dict[int, Any] = pycolmap.global_mapping(database, out, out, options)
    return found


def _global_options(pycolmap: ModuleType, database: Path) -> Any:
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
    options.mapper.bundle_adjustment.refine_extra_params = most >= _DISTORTION_IMAGES and not _divided(
        pycolmap, database
    )
    return options


def _divided(pycolmap: ModuleType, database: Path) -> bool:
    """Whether a camera has terms that divide: these follow noise, and it has a calibration to begin with."""
    with pycolmap.Database.open(database) as opened:
        return any(camera.model.name == "FULL_OPENCV" for camera in opened.read_all_cameras())


def _incremental(pycolmap: ModuleType, database: Path, out: Path) -> dict[int, Any]:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = 0, 1
    options.min_model_size = _MIN_IMAGES
    options.extract_colors = False
    options.ba_refine_extra_params = not _divided(pycolmap, database)
    options.max_extra_param = options.mapper.max_extra_param = options.triangulation.max_extra_param = ANY_DISTORTION
    found: dict[int, Any] = pycolmap.incremental_mapping(database, out, out, options=options)
    return found


if __name__ == "__main__":
    solve(Path(sys.argv[1]))
