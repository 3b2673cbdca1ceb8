"""The bundle adjustment's process: a COLMAP database, poses and given positions in; adjusted models with points out.

Run as a module: FOLDER, which holds database.db, sparse/ (poses without points), task.json and priors.npz; model<k>.npz
and result.json are written into it. See `mapping`, and `mapping_process` for why it is a process of its own.
"""

from __future__ import annotations

import json
import sys
from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.results.adjustment import ControlInGroup, GroupResult
from aeromatch_cli.sfm.bundle.adjust import Options
from aeromatch_cli.sfm.bundle.covariance import pose_sigmas
from aeromatch_cli.sfm.bundle.network import READOUT
from aeromatch_cli.sfm.bundle.of_model import image_numbers, lens_of, set_lens
from aeromatch_cli.sfm.control_adjustment import Surveyed, with_control
from aeromatch_cli.sfm.group_merging import Part, joined
from aeromatch_cli.sfm.group_results import Names, adjusted_group
from aeromatch_cli.sfm.model_adjustment import (
    MIN_OBSERVATIONS,
    Given,
    Outcome,
    Work,
    adjust_in_place,
    adjusted,
    believed_tilts,
    connected_parts,
    drop_weak_images,
    images_by_camera,
    intersect,
    keep_images,
    state_errors,
)
from aeromatch_cli.sfm.model_arrays import BEHIND_PX, arrays, figures, tracks_of
from aeromatch_cli.sfm.process import ANY_DISTORTION, quiet_pycolmap
from aeromatch_cli.sfm.thinning import take_poses, thinned

# Points are made and poses adjusted again while that takes away this share of the reprojection error.
_WORTH_AGAIN = 0.1
_MAX_ROUNDS = 3
# An adjustment ends when a step lowers the cost by a smaller share. With 1e-4 it takes a third of the time, and heights
# of check points come out four times as bad.
_COST_TOLERANCE = 1e-6
# That of the first round, which only finds points for the next.
_FIRST_TOLERANCE = 1e-4
# Fewer images make no group.
_FEWEST_IMAGES = 3
# With fewer points of three images or more, those of two count as well.
_FEW_OBSERVATIONS = 50
# An image is tied by so many points of those that it shares with the block, a quarter of them at least.
_FEWEST_INLIERS = 8
# Elements of rotations that were written and read again.
_SAME = 1e-6
_NOWHERE = np.full(3, np.nan)
# Poses that are not exact yet: points of the first round may be so far off, and are filtered as usual from then on.
_FIRST_ERROR_PX = 12.0


def refine(folder: Path) -> None:
    """Triangulate and adjust every group of posed images, and tie further images to it, to the largest group first.

    A group whose parts share no points becomes several, each placed by itself.
    """
    pycolmap = quiet_pycolmap()
    task = json.loads((folder / "task.json").read_text(encoding="utf-8"))
    given = Given.of_file(np.load(folder / "priors.npz"))
    work = Work.of_task(
        pycolmap, task["cameras"], Options(_COST_TOLERANCE, final=True, choose=task["chosen"], readout=task["readout"])
    )
    _hold_all_that_adjusts(work, folder)
    models: list[dict[str, Any]] = []
    names = Names(**task["names"])
    surveyed = [Surveyed.of_task(entry) for entry in task["control"]]
    waiting = deque(task["groups"])
    if len(waiting) > 1 and not task["fixed"]:
        waiting = deque(_joined_groups(work, folder, task["groups"]))
    grouped = {number for group in task["groups"] for number in group["images"]}
    held: set[int] = set()  # cameras that a larger group has found: each is one and the same for all groups
    while waiting:
        group = waiting.popleft()
        free = not task["fixed"]
        model = _posed(work, folder, set(group["images"]))
        model = _triangulated(pycolmap, model, folder, rough=free)
        if free and group["kind"] != "given":
            parts = connected_parts(model)
            if not parts:
                continue
            keep_images(model, parts[0])
            waiting.extend(_groups_of(group, parts[1:]))
        kind = group["kind"]
        if kind == "positions" and not given.places(image_numbers(model)):
            kind = "level"
        observed = given if kind != "level" else given.without_positions()
        attitudes = _attitudes(model, given) if kind == "given" else ()
        registered: list[int] = []
        outcome: Outcome | None = None
        control: ControlInGroup | None = None
        if free:
            if task["more"]:
                model, registered = _grown(pycolmap, model, folder, grouped - set(group["images"]))
                grouped |= set(registered)
                model = _triangulated(pycolmap, model, folder, rough=False) if registered else model
            # Poses fit the lens that they were found with: only points from both tell what fits another one.
            for number in sorted(held & images_by_camera(model).keys()):
                set_lens(pycolmap, model.cameras[number], work.lenses[number], number in work.fisheyes)
            inside = surveyed if kind != "level" else []
            model, outcome, control = _refined(work, folder, model, kind, observed, attitudes, held, inside)
        _clean(work, model, observed)
        if not image_numbers(model):
            continue
        lenses = {n: work.lens(model, n) for n in images_by_camera(model)}
        held |= lenses.keys()
        name = f"model{len(models)}.npz"
        _write_model(folder / name, model, lenses, given, outcome)
        first = names.image(min(image_numbers(model)))
        result = GroupResult(
            kind=kind, registered=[*map(names.image, registered)], first_image=first, control=control, **figures(model)
        )
        if outcome is not None:
            result = adjusted_group(result, outcome, observed, names)
        models.append({"file": name, "result": result.as_json()})
    (folder / "result.json").write_text(json.dumps({"models": models}), encoding="utf-8")


def _groups_of(group: dict[str, Any], parts: Sequence[Collection[int]]) -> list[dict[str, Any]]:
    """Return the groups that parts of a group become, without parts of few images."""
    return [{**group, "images": part} for part in parts if len(part) >= _FEWEST_IMAGES]


def _clean(work: Work, model: Any, observed: Given) -> None:
    """Place the points of an adjusted model, and drop points and images that too little holds."""
    intersect(work, model, observed)
    _once_per_image(model)
    _drop_weak_points(model)
    drop_weak_images(model)


def _write_model(
    path: Path, model: Any, lenses: Mapping[int, FloatArray], given: Given, outcome: Outcome | None
) -> None:
    """Write poses, points, tracks and standard deviations of a model. lenses: by number of a camera."""
    deviations: dict[str, Any] = dict(_deviations(model, given, outcome))
    sweeps_m = _sweeps_m(model, given, lenses)
    np.savez(path, **arrays(model, lenses), **tracks_of(model), **deviations, sweeps_m=sweeps_m)


def _hold_all_that_adjusts(work: Work, folder: Path) -> None:
    """Give the database's cameras, too, the form that holds all that an adjustment finds."""
    with work.pycolmap.Database.open(folder / "database.db") as opened:
        for camera in opened.read_all_cameras():
            set_lens(work.pycolmap, camera, lens_of(camera), int(camera.camera_id) in work.fisheyes)
            opened.update_camera(camera)


def _deviations(model: Any, given: Given, outcome: Outcome | None) -> dict[str, FloatArray]:
    """Standard deviations (N, 3) of a model's poses: x, y, z in metres and omega, phi, kappa in degrees. Poses that
    were not adjusted are as exact as was stated."""
    ids = image_numbers(model)
    if outcome is None or outcome.result.found is None:
        rows = np.array(ids) - 1
        return {"sigmas_m": given.sigmas_m[rows], "sigmas_deg": np.repeat(given.sigmas_deg[rows][:, None], 3, axis=1)}
    sigmas_m, sigmas_deg = pose_sigmas(outcome.result.network, outcome.result.state, outcome.result.found)
    row = {number: k for k, number in enumerate(outcome.images)}
    unknown = np.full(3, np.nan)
    return {
        "sigmas_m": np.array([sigmas_m[row[i]] if i in row else unknown for i in ids]),
        "sigmas_deg": np.array([sigmas_deg[row[i]] if i in row else unknown for i in ids]),
    }


def _sweeps_m(model: Any, given: Given, lenses: Mapping[int, FloatArray]) -> FloatArray:
    """(N, 3) by how much projection centres move while a picture is read."""
    ids = image_numbers(model)
    seconds = np.array([lenses[int(model.images[i].camera_id)][READOUT] for i in ids])
    return np.asarray(seconds[:, None] * given.velocities_m_s[np.array(ids) - 1])


def _joined_groups(work: Work, folder: Path, groups: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Groups of which those that final matches tie are one; the poses on file are moved with them."""
    pycolmap, parts = work.pycolmap, []
    for group in sorted(groups, key=lambda one: (one["kind"] == "level", -len(one["images"]))):
        posed = _posed(work, folder, set(group["images"]))
        model = _triangulated(pycolmap, posed, folder, rough=True)
        parts.append(_part(group["kind"], model))
    with pycolmap.Database.open(folder / "database.db") as opened:
        seen = zip(*opened.read_two_view_geometries(), strict=True)
        matches = {tuple(pycolmap.pair_id_to_image_pair(k)): found.inlier_matches for k, found in seen}
    found = joined(parts, matches)
    if len(found) < len(parts):
        model = pycolmap.Reconstruction(folder / "sparse")
        for part in found:
            for number, rotation in part.rotations.items():
                pose = np.column_stack([rotation, -rotation @ part.centers_m[number]])
                image = model.images[number]
                image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose))
        model.write(folder / "sparse")
    found.sort(key=lambda part: -len(part.rotations))
    return [{"kind": part.kind, "images": sorted(part.rotations)} for part in found]


def _part(kind: str, model: Any) -> Part:
    images = {number: model.images[number] for number in image_numbers(model)}
    points_m = {
        number: np.array([model.points3D[p.point3D_id].xyz if p.has_point3D() else _NOWHERE for p in image.points2D])
        for number, image in images.items()
    }
    return Part(
        kind,
        {number: image.cam_from_world().rotation.matrix() for number, image in images.items()},
        {number: image.projection_center() for number, image in images.items()},
        {number: points.reshape(-1, 3) for number, points in points_m.items()},
    )


def _refined(
    work: Work,
    folder: Path,
    model: Any,
    kind: str,
    given: Given,
    attitudes: Collection[int],
    held: Collection[int],
    surveyed: Sequence[Surveyed],
) -> tuple[Any, Outcome | None, ControlInGroup | None]:
    """The model adjusted and triangulated in turn, while that makes it better; the last adjustment, and what control
    points say.

    attitudes: numbers of images whose given attitudes are observations. held: cameras that stay as they are.
    """
    if kind == "positions":
        given = replace(given, ups=believed_tilts(work.pycolmap, model, given))
    outcome: Outcome | None = None
    control: ControlInGroup | None = None
    for number in range(_MAX_ROUNDS):
        if model.num_points3D() < MIN_OBSERVATIONS:
            break
        thin = thinned(model)
        moved = model if thin is None else thin
        before = state_errors(work, moved, given)
        now = work if number else replace(work, options=replace(work.options, tolerance=_FIRST_TOLERANCE, final=False))
        if kind == "given":
            outcome = adjust_in_place(now, moved, given, attitudes, held)
        else:
            outcome = adjusted(now, moved, given, held)
        settled = state_errors(work, moved, given) > (1.0 - _WORTH_AGAIN) * before
        # The first points may be far off; after the last round nothing follows.
        settled = (settled and number > 0) or number == _MAX_ROUNDS - 1
        if settled and surveyed:
            outcome, control = with_control(work, moved, outcome, surveyed)
        if settled and thin is None:
            break
        if thin is not None:
            take_poses(model, thin)
        model = _triangulated(work.pycolmap, model, folder, rough=False)
        if settled:
            break
    return model, outcome, control


def _posed(work: Work, folder: Path, numbers: set[int]) -> Any:
    """Return a model of the poses that some images have been given, and of the lenses that they were found with."""
    model = work.pycolmap.Reconstruction(folder / "sparse")
    work.start(model)
    for image in list(model.images.values()):
        if image.has_pose and image.image_id not in numbers:
            model.deregister_frame(image.frame_id)
    return model


def _attitudes(model: Any, given: Given) -> list[int]:
    """Numbers of the images that have their given attitudes still: those that were corrected tell nothing."""
    kept = []
    for number in image_numbers(model):
        found, stated = model.images[number].cam_from_world().rotation.matrix(), given.rotations[number - 1]
        if np.isfinite(stated).all() and np.abs(found - stated).max() < _SAME:
            kept.append(number)
    return kept


def _triangulated(pycolmap: ModuleType, model: Any, folder: Path, rough: bool) -> Any:
    """The model with points of three images and more, and of two where an image has few others."""
    options = _options(pycolmap)
    if rough:
        options.mapper.filter_max_reproj_error = _FIRST_ERROR_PX
        options.triangulation.create_max_angle_error *= 3.0
        options.triangulation.continue_max_angle_error *= 3.0
        options.triangulation.complete_max_reproj_error = _FIRST_ERROR_PX
        options.triangulation.merge_max_reproj_error = _FIRST_ERROR_PX
    # The poses stand: `adjusted` weighs them with the given positions.
    out = folder / "triangulated"
    out.mkdir(exist_ok=True)
    model = pycolmap.triangulate_points(model, folder / "database.db", out, out, True, options, False)
    if _weak_images(model):
        options.triangulation.ignore_two_view_tracks = False
        model = pycolmap.triangulate_points(model, folder / "database.db", out, out, True, options, False)
    return model


def _weak_images(model: Any) -> set[int]:
    """Numbers of images with few points that three images see."""
    strong: Counter[int] = Counter()
    for point in model.points3D.values():
        seen = [element.image_id for element in point.track.elements]
        if len(seen) > 2:
            strong.update(seen)
    return {number for number in image_numbers(model) if strong[number] < _FEW_OBSERVATIONS}


def _once_per_image(model: Any) -> None:
    """Keep one keypoint of an image per point, the nearest to its projection: merged tracks hold several."""
    for number, point in list(model.points3D.items()):
        images = [element.image_id for element in point.track.elements]
        if len(set(images)) == len(images):
            continue
        off: dict[int, list[tuple[float, int]]] = {}
        for element in point.track.elements:
            image = model.images[element.image_id]
            seen = image.project_point(point.xyz)
            apart = np.inf if seen is None else float(np.linalg.norm(image.points2D[element.point2D_idx].xy - seen))
            off.setdefault(element.image_id, []).append((apart, element.point2D_idx))
        for image_id, places in off.items():
            for _, keypoint in sorted(places)[1:]:
                if number in model.points3D:
                    model.delete_observation(image_id, keypoint)


def _drop_weak_points(model: Any) -> None:
    """Points behind a camera or without a place, by errors that are up to date, go; those of two images hold only
    images that have few others."""
    weak = _weak_images(model)
    for number, point in list(model.points3D.items()):
        seen = {element.image_id for element in point.track.elements}
        if not point.error < BEHIND_PX or (len(seen) < 3 and not seen & weak):
            model.delete_point3D(number)


def _grown(pycolmap: ModuleType, model: Any, folder: Path, others: set[int]) -> tuple[Any, list[int]]:
    """The model with further images resected from its points, and their numbers. others: images of other groups."""
    before = {image.image_id for image in model.images.values() if image.has_pose}
    start, out = folder / "grown_from", folder / "grown"
    for path in (start, out):
        path.mkdir(exist_ok=True)
    model.write(start)
    options = _options(pycolmap)
    options.fix_existing_frames = True  # the frame of the world, and the time
    options.multiple_models = False
    with pycolmap.Database.open(folder / "database.db") as opened:
        options.image_names = [image.name for image in opened.read_all_images() if image.image_id not in others]
    options.mapper.abs_pose_min_num_inliers = _FEWEST_INLIERS
    found = pycolmap.incremental_mapping(folder / "database.db", out, out, options=options, input_path=start)
    grown = max(found.values(), key=lambda one: one.num_reg_images(), default=model)
    return grown, sorted({i.image_id for i in grown.images.values() if i.has_pose} - before)


def _options(pycolmap: ModuleType) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = 0, 1
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.max_extra_param = options.mapper.max_extra_param = options.triangulation.max_extra_param = ANY_DISTORTION
    return options


if __name__ == "__main__":
    refine(Path(sys.argv[1]))
